# Everything installs into .venv beside this file; PYTHON picks the interpreter it is made from.
PYTHON ?= python3
VENV   := .venv
PY     := $(VENV)/bin/python
DEMO   := runs/demo

# PyTorch, which the planners and the tests need, the factory does not. On Linux its CPU build, 200 MB instead of
# gigabytes of CUDA: PyPI has no version with the label +cpu, so nothing but TORCH_INDEX, or a wheel that pip's own
# configuration points to, can satisfy it. With CUDA: make test TORCH=torch==2.13.0, or another label and its index.
TORCH       ?= torch==2.13.0$(if $(filter Linux,$(shell uname -s)),+cpu)
TORCH_INDEX ?= https://download.pytorch.org/whl/cpu

.PHONY: install demo test unit lint format bench bench-reward bench-render bench-loader bench-planners bench-scale bench-memory mutants study study-data study-logs study-logs-data clean

install: $(VENV)/.installed

# What a run needs; make demo installs no more.
$(VENV)/.run: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(PY) -m pip install -q --upgrade pip
	$(PY) -m pip install -q -c constraints.txt -e ".[run]"
	touch $@

# PyTorch comes by itself: its index is asked for nothing else and, where it is out of reach, given up within a minute.
# What PyTorch needs in turn comes with the rest.
$(VENV)/.installed: $(VENV)/.run
	$(PY) -m pip install -q -c constraints.txt --no-deps --retries 2 --timeout 15 --extra-index-url $(TORCH_INDEX) $(TORCH) || \
		{ echo "no $(TORCH): give TORCH= and TORCH_INDEX= (see the Makefile)"; exit 1; }
	$(PY) -m pip install -q -c constraints.txt -e ".[dev]"
	touch $@

demo: $(VENV)/.run
	$(PY) -m factory.run preset=demo out=$(DEMO)

# Kernels are compiled once before two test processes would both do it.
test: install
	$(PY) -m factory warm
	$(PY) -m pytest -n 2 --dist loadfile

unit: install
	$(PY) -m factory warm
	$(PY) -m pytest -n 2 --dist loadfile --ignore tests/real --ignore tests/chaos -m "not ray and not slow"

lint: install
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	$(PY) -m mypy

format: install
	$(PY) -m ruff format .
	$(PY) -m ruff check --fix .

# The kept bugs of tests/mutants, each against the tests that should notice; a release has at least 97 % of them noticed.
# ONLY=planners (or tasks/reward, or a bug's id; several with commas), J=<how many at a time, a core each>; goes on where it stopped.
mutants: install
	$(PY) -m factory warm
	$(PY) -m tests.mutants --only "$(ONLY)" -j $(or $(J),2)

bench: install
	$(PY) -m tests.bench

# PEER=<python of an environment with the packages navsim and nuplan-devkit> runs the public metric in turns with ours.
bench-reward: install
	OMP_NUM_THREADS=1 $(PY) -m tests.bench.bench_reward

# SCENE=<file> adds the row of a scene that a reconstruction wrote, PEER=<checkout of OpenSplat> its compiled CPU rasteriser.
bench-render: install
	$(PY) -m tests.bench.bench_render $(SCENE)

# TABLE=<out of a run with images> takes its pictures, THREADS=<n> as many threads as the machine has cores.
bench-loader: install
	OMP_NUM_THREADS=1 $(PY) -m tests.bench.bench_loader threads=$(or $(THREADS),2) $(if $(TABLE),table=$(TABLE))

# DEVICE=cuda: one training step of every planner at the paper's settings, samples/s and memory.
bench-planners: install
	$(PY) -m tests.bench.bench_planners device=$(or $(DEVICE),cpu)

# Peak memory of a training on rewards alone, 10,000 samples with 16,384 labelled trajectories.
bench-memory: install
	OMP_NUM_THREADS=1 $(PY) -m tests.bench.bench_memory

# The same run on 1, 2 and 4 nodes of this machine, with stages that only wait.
bench-scale: install
	$(PY) -m tests.bench.bench_scale

# The co-training study of docs/study.md. MINUTES=25: a part of it; the same command goes on where it stopped.
STUDY := runs/study
TRAIN := clips=synthetic_towns clips.first_seed=1 clips.n_towns=17 clips.logs_per_town=3 clips.split=train
BEGIN := clips=synthetic_towns clips.first_seed=201 clips.n_towns=32 clips.logs_per_town=6 clips.split=train clips.settings.steps_per_photo=5 clips.settings.photo_steps=36 clips.settings.lidar_beams=0
HELD  := clips=synthetic_towns clips.first_seed=101 clips.n_towns=6 clips.logs_per_town=6 clips.first_window=1 clips.split=test
# Vehicles are not held against their photos: the study's samples are those of before there was such a gate.
TOWN  := render=town render.psnr_gate=mark render.gate.vehicle_min=0 $(if $(MINUTES),minutes=$(MINUTES))
LABEL := vocabulary.k=32768 reward.label_vocabulary=$(STUDY)/labels.npy

# No drive is refused: what the label is worth is the question.
OPEN  := reward.full=[] reward.progress_above=-1

# All runs over the training clips render from the same blocks.
study-data: install
	mkdir -p $(STUDY)/blocks $(STUDY)/train $(STUDY)/replay $(STUDY)/control
	ln -sfn ../blocks $(STUDY)/train/cache
	ln -sfn ../blocks $(STUDY)/replay/cache
	ln -sfn ../blocks $(STUDY)/control/cache
	test -f $(STUDY)/labels.npy || $(PY) -m factory vocabulary kinematic=true k=512 out=$(STUDY)/labels.npy
	$(PY) -m factory.run $(BEGIN) $(TOWN) $(LABEL) experts=[human] rounds=1 out=$(STUDY)/begin
	$(PY) -m factory.run $(TRAIN) $(TOWN) $(LABEL) rounds=5 out=$(STUDY)/train
	$(PY) -m factory.run preset=hard_benchmark $(HELD) $(TOWN) vocabulary.k=131072 out=$(STUDY)/hard
	$(PY) -m factory.run $(TRAIN) $(TOWN) $(LABEL) rounds=5 traffic=replay experts=[pdm_closed] out=$(STUDY)/replay
	$(PY) -m factory.run $(TRAIN) $(TOWN) $(LABEL) rounds=5 $(OPEN) experts=[logged] out=$(STUDY)/control

study: install
	OMP_NUM_THREADS=1 $(PY) -m planners study vocabulary=$(STUDY)/labels.npy $(if $(MINUTES),minutes=$(MINUTES))

# The part of the study without images (docs/study_logs.md): real logs, split by log. Every command of it goes on where it
# stopped. SHARED holds data/av2, data/scenarionet and data/vocabulary. FOLDS=av2_7fab2350: some of it.
SHARED ?= ../shared
LOGS   := runs/study_logs
REPORT ?= docs/study/logs
FOLDS  ?= av2_7fab2350 av2_adcf7d18 nuscenes
HUMAN  := $(SHARED)/data/vocabulary/human_8192x40x3.npy
AV2    := clips=av2 clips.root=$(SHARED)/data/av2/sensor/val clips.stride_s=0.5
NUSC   := clips=scenarionet clips.root=$(SHARED)/data/scenarionet/nuscenes clips.stride_s=1.0
7FAB   := 7fab2350-7eaf-3b7e-a39d-6937a4c1bede
ADCF   := adcf7d18-0510-35b0-a2fa-b4cea13a6d76
SCENE  := sd_nuscenes_v1.0-mini_scene-
# A fold is named after what it holds out. steps: of equal optimiser steps, about those of the largest data set's epochs.
av2_7fab2350 := $(AV2)
av2_7fab2350_train := [$(ADCF)]
av2_7fab2350_test := [$(7FAB)]
av2_7fab2350_steps := 300
av2_adcf7d18 := $(AV2)
av2_adcf7d18_train := [$(7FAB)]
av2_adcf7d18_test := [$(ADCF)]
av2_adcf7d18_steps := 300
nuscenes := $(NUSC)
nuscenes_train := [$(SCENE)0061,$(SCENE)0553,$(SCENE)0757,$(SCENE)0796,$(SCENE)1077]
nuscenes_test := [$(SCENE)0655,$(SCENE)1100]
nuscenes_steps := 1000

study-logs-data: install
	@test -f $(HUMAN) || { echo "no logs at $(SHARED)/data: give SHARED=<folder with data/av2, data/scenarionet, data/vocabulary>"; exit 2; }
	$(foreach fold,$(FOLDS),$(call fold_data,$(fold)))

define fold_data
$(PY) -m factory.run $($(1)) clips.only=$($(1)_train) clips.split=train $(BLIND) rounds=5 out=$(LOGS)/$(1)/train
$(PY) -m factory.run preset=hard_benchmark $($(1)) clips.only=$($(1)_test) clips.split=test clips.first_window=1 $(BLIND) out=$(LOGS)/$(1)/hard

endef

study-logs: study-logs-data
	$(foreach fold,$(FOLDS),$(call fold_sweeps,$(fold)))

define fold_sweeps
$(call sweep,$(1),epochs,ego_mlp_bev_small,null) $(call learn,$(comma)$(RASTER))
$(call sweep,$(1),steps,ego_mlp_bev_small,$($(1)_steps)) $(call learn,$(comma)$(RASTER))
$(call sweep,$(1),ego_mlp,ego_mlp_small,$($(1)_steps)) rounds=[0,5] $(call learn)

endef
sweep = OMP_NUM_THREADS=1 $(PY) -m planners scaling data.real=[$(LOGS)/$(1)/train] data.sim=[$(LOGS)/$(1)/train] data.val=[$(LOGS)/$(1)/hard] \
	benchmark=$(LOGS)/$(1)/hard planners=[$(3)] experts=[recovery,pdm_closed] seeds=[0,1,2,3,4] steps=$(4) \
	out=$(LOGS)/$(1)/$(2) report=$(REPORT)/$(1)/$(2) $(if $(MINUTES),minutes=$(MINUTES))
learn = "+train={all: ['workers=1','validate_every=50','planner.training.batch_size=8','planner.training.epochs=40'$(1)]}"
RASTER := 'planner.settings.bev.cell_m=1.0'
comma := ,
BLIND := render=none reward.labels=none vocabulary.file=$(HUMAN) executor=local

clean:
	rm -rf $(VENV) runs build *.egg-info
