# Everything installs into .venv beside this file; PYTHON picks the interpreter it is made from.
PYTHON ?= python3
VENV   := .venv
PY     := $(VENV)/bin/python
DEMO   := runs/demo

.PHONY: install demo test unit lint format bench bench-reward bench-render bench-loader bench-planners study study-data clean

install: $(VENV)/.installed

# torch first, pinned, so that nothing pulls the multi-gigabyte CUDA build in its place.
$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(PY) -m pip install -q --upgrade pip
	$(PY) -m pip install -q -c constraints.txt torch==2.13.0
	$(PY) -m pip install -q -c constraints.txt -e ".[dev]"
	touch $@

demo: install
	$(PY) -m factory.run preset=demo out=$(DEMO)

# Kernels are compiled once before two test processes would both do it.
test: install
	$(PY) -m factory.warm
	$(PY) -m pytest -n 2 --dist loadfile

unit: install
	$(PY) -m factory.warm
	$(PY) -m pytest -n 2 --dist loadfile --ignore tests/real --ignore tests/chaos -m "not ray and not slow"

lint: install
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	$(PY) -m mypy

format: install
	$(PY) -m ruff format .
	$(PY) -m ruff check --fix .

bench: install
	$(PY) -m tests.bench

bench-reward: install
	OMP_NUM_THREADS=1 $(PY) -m tests.bench.bench_reward

# SCENE=<file> adds the row of a scene that a reconstruction wrote.
bench-render: install
	$(PY) -m tests.bench.bench_render $(SCENE)

# TABLE=<out of a run with images> takes its pictures, THREADS=<n> as many threads as the machine has cores.
bench-loader: install
	OMP_NUM_THREADS=1 $(PY) -m tests.bench.bench_loader threads=$(or $(THREADS),2) $(if $(TABLE),table=$(TABLE))

# DEVICE=cuda: one training step of every planner at the paper's settings, samples/s and memory.
bench-planners: install
	$(PY) -m tests.bench.bench_planners device=$(or $(DEVICE),cpu)

# The co-training study of docs/study.md. MINUTES=25: a part of it; the same command goes on where it stopped.
STUDY := runs/study
TRAIN := clips=synthetic_towns clips.first_seed=1 clips.n_towns=17 clips.logs_per_town=3 clips.split=train
HELD  := clips=synthetic_towns clips.first_seed=101 clips.n_towns=6 clips.logs_per_town=6 clips.first_window=1 clips.split=test
TOWN  := render=town render.psnr_gate=mark $(if $(MINUTES),minutes=$(MINUTES))
LABEL := vocabulary.k=32768 reward.label_vocabulary=$(STUDY)/labels.npy

# Both runs over the training clips render from the same blocks.
study-data: install
	mkdir -p $(STUDY)/blocks $(STUDY)/train $(STUDY)/replay
	ln -sfn ../blocks $(STUDY)/train/cache
	ln -sfn ../blocks $(STUDY)/replay/cache
	test -f $(STUDY)/labels.npy || $(PY) -m factory.vocabulary kinematic=true k=512 out=$(STUDY)/labels.npy
	$(PY) -m factory.run $(TRAIN) $(TOWN) $(LABEL) rounds=5 out=$(STUDY)/train
	$(PY) -m factory.run preset=hard_benchmark $(HELD) $(TOWN) vocabulary.k=131072 out=$(STUDY)/hard
	$(PY) -m factory.run $(TRAIN) $(TOWN) $(LABEL) rounds=5 traffic=replay experts=[pdm_closed] out=$(STUDY)/replay

study: install
	OMP_NUM_THREADS=1 $(PY) -m planners.study vocabulary=$(STUDY)/labels.npy $(if $(MINUTES),minutes=$(MINUTES))

clean:
	rm -rf $(VENV) runs build *.egg-info
