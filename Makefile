# Everything installs into .venv beside this file; PYTHON picks the interpreter it is made from.
PYTHON ?= python3
VENV   := .venv
PY     := $(VENV)/bin/python
DEMO   := runs/demo

# All that is installed is pinned with its hashes in locks/; the checkout itself comes last, editable.
PIN := -m pip install -q --require-hashes --no-deps --no-build-isolation -r

# PyTorch, which the planners and the tests need, the factory does not. On Linux its CPU build, 200 MB instead of
# gigabytes of CUDA: PyPI has no version with the label +cpu, so nothing but TORCH_INDEX, or a wheel that pip's own
# configuration points to, can satisfy it. With CUDA and gsplat: make test TORCH="-r locks/planners.lock". Another
# version, without hashes: TORCH=torch==<version>, and its index.
TORCH       ?= -r locks/torch_cpu.lock
TORCH_INDEX ?= https://download.pytorch.org/whl/cpu

# Says in one line what keeps PYTHON from being used, before anything is made from it; old versions run it too. Its
# second part: whether the .venv that is there, perhaps half made, is one of that version with a pip that works.
OLDEST := $(shell sed -n 's/^requires-python = ">=\(.*\)"/\1/p' pyproject.toml)
define FITS
import sys
found = sys.executable + " is Python " + ".".join(map(str, sys.version_info[:3]))
another = "; give another: make $(or $(firstword $(MAKECMDGOALS)),install) PYTHON=python$(OLDEST)"
if sys.version_info[:2] < tuple(map(int, "$(OLDEST)".split("."))):
    sys.exit(found + ", Python $(OLDEST) or later is needed" + another)
try:
    import ensurepip, venv
except ImportError as error:
    sys.exit(found + " and makes no .venv (%s), as where Debian's python%d.%d-venv is missing" % ((error,) + sys.version_info[:2]) + another)
endef
define IS_WHOLE
import pip, sys
sys.exit(sys.version.split()[0] != sys.argv[1])
endef
export FITS IS_WHOLE

.PHONY: install demo first-planner warm test unit lint format docs chaos mutants bench long gpu-check locks dist clean

install: $(VENV)/.installed

# What a run needs; make demo installs no more.
$(VENV)/.run: pyproject.toml locks/build.lock locks/run.lock
	@command -v $(PYTHON) >/dev/null || { echo "no $(PYTHON): give another by PYTHON=python$(OLDEST)" >&2; exit 1; }
	@$(PYTHON) -c "$$FITS"
	@$(PY) -c "$$IS_WHOLE" $$($(PYTHON) -c "import sys; print(sys.version.split()[0])") 2>/dev/null || \
		$(PYTHON) -m venv --clear $(VENV)
	$(PY) $(PIN) locks/build.lock
	$(PY) $(PIN) locks/run.lock
	$(PY) -m pip install -q --no-deps --no-build-isolation -e .
	touch $@

# PyTorch's index, where out of reach, is given up within a minute.
$(VENV)/.installed: $(VENV)/.run locks/dev.lock locks/torch_cpu.lock
	$(PY) $(PIN) locks/dev.lock
	$(PY) -m pip install -q --retries 2 --timeout 15 $(addprefix --extra-index-url ,$(TORCH_INDEX)) $(TORCH) || \
		{ echo "no $(TORCH): give TORCH= and TORCH_INDEX= (see the Makefile)"; exit 1; }
	$(PY) -m pip check
	touch $@

demo: $(VENV)/.run
	$(PY) -m factory.run preset=demo out=$(DEMO)

# The commands of docs/tutorials/first_planner.md, as they stand there; ARGS="steps=3000" changes values of theirs.
first-planner: install
	$(PY) -m tests.first_planner $(ARGS)

# Bytecode is kept in any case: the tests start hundreds of processes that import the same sources.
unexport PYTHONDONTWRITEBYTECODE

# Kernels are compiled once before two test processes would both do it, while PyTorch and the rest are installed.
warm: $(VENV)/.run
	$(PY) -m factory warm

test:
	@$(MAKE) --no-print-directory -j 2 install warm
	$(PY) -m pytest -n 2 --dist loadfile -m "not long"

unit:
	@$(MAKE) --no-print-directory -j 2 install warm
	$(PY) -m pytest -n 2 --dist loadfile --ignore tests/real --ignore tests/chaos -m "not ray and not slow and not long"

lint: install
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	$(PY) -m mypy

format: install
	$(PY) -m ruff format .
	$(PY) -m ruff check --fix .

# Every kind of file with 5,000 mutants each (half an hour), files crafted to do harm (150 minutes at most; goes on where
# it stopped), one flipped bit at a time in what a run keeps, every command in trouble made from outside (root for some; hours), kills at every step of a commit (Linux, a C compiler), 200 real
# logs of each format with damaged frames and boxes (10 minutes; SHARED=<folder of the real logs>), buckets that break
# requests, clips that do harm, a run under kills for HOURS (2).
# N=<mutants of each kind>, KINDS="ply spz".
chaos: install
	$(PY) -m tests.chaos.damaged_files.fuzz $(or $(N),5000) $(KINDS)
	$(PY) -m tests.chaos.hostile_files
	$(PY) -m experiments.chaos.flips
	$(PY) -m experiments.chaos.outside trials=30
	$(PY) -m tests.chaos.commit_steps
	$(PY) -m tests.chaos.damaged_logs $(or $(SHARED),../shared) rows=4
	$(PY) -m experiments.chaos.object_stores
	$(PY) -m experiments.chaos.poison
	$(PY) -m experiments.chaos.long_run hours=$(or $(HOURS),2)

# The site of the pages, into build/site; whatever MkDocs would warn of ends it. The variable leaves out a notice of the
# theme's makers about what comes after it.
docs: install
	NO_MKDOCS_2_WARNING=1 $(PY) -m mkdocs build -q
	@echo "build/site/index.html"

# The kept bugs of tests/mutants, each against the tests that should notice; a release has at least 97 % of them noticed.
# ONLY=planners (or tasks/reward, or a bug's id; several with commas), J=<how many at a time, a core each>; goes on where it stopped.
mutants: install warm
	$(PY) -m tests.mutants --only "$(ONLY)" -j $(or $(J),2)

# All quick tables, or NAME=reward (or another tests/bench/bench_*.py) ARGS="its own": render's scene
# file. PEER=<...> of reward and traffic: what runs beside; see there.
bench: install
	$(if $(filter reward,$(NAME)),OMP_NUM_THREADS=1) $(PY) -m tests.bench$(if $(NAME),.bench_$(NAME)) $(ARGS)

# Whether the longer benches still run, kept tables are made of their rows, more clips of the real logs keep what some
# do, and chaos finds nothing at its smallest.
long:
	@$(MAKE) --no-print-directory -j 2 install warm
	$(PY) -m pytest -n 2 --dist loadfile -m long

# Where there is a GPU: whether render.backend=gsplat agrees with the CPU, and how fast it is beside plain gsplat.
# Installed with TORCH="-r locks/planners.lock"; gsplat compiles its kernels the first time (needs nvcc, some minutes).
gpu-check: install
	$(PY) -m tests.bench.gpu_check $(ARGS)

build/tools/.installed: locks/build.lock locks/tools.lock
	$(PYTHON) -m venv --clear build/tools
	build/tools/bin/python $(PIN) locks/build.lock
	build/tools/bin/python $(PIN) locks/tools.lock
	touch $@

# The lock files anew from pyproject.toml, for every Python from 3.11.5 (mkdocs-material's oldest) and every platform.
# Pins that still fit stay; newer ones: UPGRADE=--upgrade, or UPGRADE="--upgrade-package ray". planners.lock has
# PyTorch with CUDA, dev.lock none: its CPU build is in torch_cpu.lock.
COMPILE = build/tools/bin/uv pip compile -q --universal --generate-hashes --no-annotate --no-header \
	--python-version 3.11.5 $(UPGRADE)
locks: build/tools/.installed
	$(COMPILE) --group build -o locks/build.lock
	$(COMPILE) --group tools -c locks/build.lock -o locks/tools.lock
	$(COMPILE) pyproject.toml --extra planners --extra gpu --extra alpasim -c locks/build.lock -o locks/planners.lock
	$(COMPILE) pyproject.toml --extra run -c locks/planners.lock -o locks/run.lock
	$(COMPILE) pyproject.toml --extra dev -c locks/planners.lock -o locks/dev.lock
	awk '/^[^ ]/ {kept = !/^(torch|triton|cuda-|nvidia-)/} kept' locks/dev.lock >build/dev.lock
	mv build/dev.lock locks/dev.lock
	sed -n "s/^\(torch==[0-9.]*\).*/\1+cpu ; sys_platform == 'linux'\n\1 ; sys_platform != 'linux'/p" \
		locks/planners.lock | $(COMPILE) --no-deps --default-index $(TORCH_INDEX) - -o locks/torch_cpu.lock

# Whether an SBOM names what a lock file pins, in the versions of this Python and platform.
define NAMES
import json, re, sys
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
parts = json.load(open(sys.argv[1]))["components"]
pins = map(Requirement, re.findall(r"^[^ ].*(?= \\$$)", open(sys.argv[2]).read(), re.M))
pinned = {pin.name + str(pin.specifier) for pin in pins if not pin.marker or pin.marker.evaluate()}
lacks = pinned - {canonicalize_name(part["name"]) + "==" + part["version"] for part in parts}
sys.exit("%s: not in the SBOM" % sorted(lacks) if lacks or not pinned else 0)
endef
export NAMES

# What a release hands out, into dist/, of the last commit: built and checked, then installed from the built file with
# what locks/run.lock pins into an environment of its own, where it makes the demo's samples; an SBOM (CycloneDX) of
# that environment. An upload is nobody's but yours.
dist: build/tools/.installed
	rm -rf dist build/release build/tried
	mkdir -p build/release
	git archive HEAD | tar x -C build/release
	build/tools/bin/check-jsonschema --builtin-schema vendor.citation-file-format build/release/CITATION.cff
	build/tools/bin/python -m build --no-isolation -o dist build/release >build/dist.log
	build/tools/bin/twine check --strict dist/*
	$(PYTHON) -m venv build/tried
	build/tried/bin/python $(PIN) locks/build.lock
	build/tried/bin/python $(PIN) locks/run.lock
	build/tried/bin/python -m pip install -q --no-index "$$(ls dist/*.whl)[run]"
	build/tried/bin/python -m pip check
	cd build/tried && bin/factory run preset=demo out=demo
	build/tools/bin/cyclonedx-py environment build/tried --output-reproducible \
		-o "$$(echo dist/*.whl | sed 's/-py3-none-any.whl/.cdx.json/')"
	sed -i 's#"file://[^"]*/#"#' dist/*.cdx.json
	build/tools/bin/python -c "$$NAMES" dist/*.cdx.json locks/run.lock

clean:
	rm -rf $(VENV) runs build dist *.egg-info
