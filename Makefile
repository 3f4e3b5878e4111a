# softmode: set-up, tests and the demo. Needs python3 >= 3.11 and make; everything is installed into .venv.
#   make demo            the arm lifts a soft object; writes out/lift.mp4
#   make test-fast       a sharp minute: a few tests of every room
#   make test            of every property the cheapest tests that show it
#   make test-rest       what that leaves out, but for the slow ones (CI runs lint, test and test-rest)
#   make dist            sdist and wheel in dist/; make smoke installs the wheel into an environment of its own and steps
SHELL  := /bin/bash
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
UV     := $(BIN)/uv
ARGS   ?=
# Processes that run tests, each a file of them at a time, with up to 4 GB; the longest files come first, by the seconds
# that tests/processor_seconds.py has recorded, or a process would wait at the end for the other's long one.
WORKERS ?= 2
FILES   := --numprocesses $(WORKERS) --dist loadfile --no-loadscope-reorder

# Tests train with stable-baselines3, rsl_rl and skrl, which need torch; a CPU wheel (200 MB) is enough, and the three and
# what they bring are 32 MB more. Where pip's own settings find no CPU wheel, the default one for Linux brings gigabytes of
# CUDA libraries: point PIP_EXTRA_INDEX_URL at PyTorch's index of CPU wheels to avoid that.
TORCH ?= torch==2.13.0

# Tests as another processor runs them, such as haswell, which has no AVX-512: its linear algebra, kernels for it.
ifdef PROCESSOR
export OPENBLAS_CORETYPE := $(PROCESSOR)
export SOFTMODE_TEST_PROCESSOR := $(PROCESSOR)
endif

# Compiled kernels and built bodies stay inside the checkout.
export WARP_CACHE_PATH ?= $(CURDIR)/.cache/warp
export SOFTMODE_CACHE  ?= $(CURDIR)/.cache/softmode
export PYTHONUNBUFFERED := 1
export PIP_DISABLE_PIP_VERSION_CHECK := 1
# Without Python's cache of compiled code a program takes 9.0 instead of 6.6 s to import an environment; tests start many.
unexport PYTHONDONTWRITEBYTECODE
unexport VIRTUAL_ENV

.DEFAULT_GOAL := help
.PHONY: help lock resolve demo test test-fast test-rest test-slow test-lowest test-lerobot test-ray lint docs dist smoke bench accuracy baselines clean coupling

help:  ## list the targets
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 14

$(VENV)/.created:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "softmode needs Python >= 3.11; name one with: make PYTHON=python3.12 ..." >&2; exit 2; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet uv
	@touch $@

# constraints.txt pins every dependency, see `make lock`. uv is an order of magnitude faster than pip; where it cannot reach
# an index, pip installs the same versions with the machine's own settings.
INSTALL = $(UV) pip install --quiet --python $(BIN)/python --constraint constraints.txt

$(VENV)/.demo: $(VENV)/.created pyproject.toml constraints.txt
	$(INSTALL) --editable '.[demo]' || $(BIN)/python -m pip install --quiet -c constraints.txt --editable '.[demo]'
	@touch $@

$(VENV)/.dev: $(VENV)/.created pyproject.toml constraints.txt
	$(INSTALL) --editable '.[dev]' || $(BIN)/python -m pip install --quiet -c constraints.txt --editable '.[dev]'
	$(BIN)/python -c 'import torch' 2>/dev/null || $(BIN)/python -m pip install --quiet '$(TORCH)'
	$(BIN)/python -m pip install --quiet -c constraints.txt stable-baselines3 tensorboard rsl-rl-lib skrl onnxruntime
	@touch $@ $(VENV)/.demo

# All but torch, whose wheel (CPU, or one of several for CUDA) is the machine's choice, and what only that needs.
lock: $(VENV)/.created  ## pin the newest versions that pyproject.toml allows
	$(UV) pip compile --quiet --universal --upgrade --python-version 3.11 --extra demo --extra dev --extra bench --extra rl \
	  --extra rsl-rl --extra skrl --extra onnx --override <(echo "torch; python_version < '3'") --no-header --no-annotate \
	  --no-emit-index-url pyproject.toml -o constraints.txt

resolve: $(VENV)/.created  ## check that all extras resolve to wheels on every supported Python
	set -eo pipefail; for python in 3.11 3.12 3.13 3.14; do \
	  echo "Python $$python:"; $(UV) pip compile --quiet --only-binary :all: --python-version $$python --all-extras \
	    --no-header --no-annotate pyproject.toml | wc -l | sed 's/$$/ packages/'; \
	done

# Wool as soft as foam, and as heavy as when it is wet: it gives way between the fingers and swings.
DEMO := --object glove --youngs-modulus 3e4 --density 400
demo: $(VENV)/.demo  ## play the scripted lift of a soft glove and write out/lift.mp4
	$(BIN)/softmode play softmode/LiftSoft-v0 $(DEMO) --video out/lift.mp4 $(ARGS)

# All cores compile an environment's kernels at once, before the processes of a run wait for each other's.
$(WARP_CACHE_PATH): | $(VENV)/.dev
	$(BIN)/python -c 'import gymnasium, softmode; gymnasium.make("softmode/LiftSoft-v0", obs_type="pixels").reset()'

test-fast: $(VENV)/.dev | $(WARP_CACHE_PATH)  ## run a few quick tests of every room
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest --numprocesses $(WORKERS) --dist worksteal -m fast $(ARGS)

test: $(VENV)/.dev | $(WARP_CACHE_PATH)  ## run of every property the cheapest tests that show it
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest $(FILES) $(ARGS)

test-rest: $(VENV)/.dev | $(WARP_CACHE_PATH)  ## run what `make test` leaves out: deeper repetitions, sphinx, the browser; not the slow ones
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest $(FILES) -m '(rest or sphinx or browser) and not slow' $(ARGS)

test-slow: $(VENV)/.dev | $(WARP_CACHE_PATH)  ## run all tests, slow ones included
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest $(FILES) -m 'slow or not slow' $(ARGS)

LOWEST := .venv-lowest
test-lowest: $(VENV)/.dev | $(WARP_CACHE_PATH)  ## run the tests with the lowest versions that pyproject.toml allows
	$(PYTHON) -m venv $(LOWEST)
	$(LOWEST)/bin/python -m pip install --quiet '$(TORCH)'
	$(UV) pip install --quiet --python $(LOWEST)/bin/python --resolution lowest-direct --editable '.[dev]'
	OMP_NUM_THREADS=1 $(LOWEST)/bin/python -m pytest $(FILES) $(ARGS)

# LeRobot asks for Python 3.12 and an older torch, and brings gigabytes.
LEROBOT := .venv-lerobot
LEROBOT_PYTHON ?= python3.12
test-lerobot: $(VENV)/.created | $(WARP_CACHE_PATH)  ## record, train and evaluate with LeRobot, in an environment of its own
	$(LEROBOT_PYTHON) -m venv $(LEROBOT)
	$(UV) pip install --quiet --python $(LEROBOT)/bin/python --editable '.[data,demo]' \
	  --editable packages/lerobot_env_softmode 'lerobot[dataset,training]==0.6.1' 'pytest>=8.3'
	$(LEROBOT)/bin/python -m pytest -c packages/lerobot_env_softmode/pyproject.toml packages/lerobot_env_softmode/tests $(ARGS)

# RLlib asks for an older Gymnasium than the newest; Ray and what it brings are 300 MB.
RAY := .venv-ray
test-ray: $(VENV)/.created | $(WARP_CACHE_PATH)  ## lose workers and the head of a Ray cluster, train with RLlib, in an environment of its own
	$(PYTHON) -m venv $(RAY)
	$(RAY)/bin/python -m pip install --quiet '$(TORCH)'
	$(UV) pip install --quiet --python $(RAY)/bin/python --editable '.[ray]' 'ray[rllib]==2.60.*' 'pytest>=8.3' 'hypothesis>=6.115'
	$(RAY)/bin/python -m pytest tests/cluster tests/envs/test_frameworks.py $(ARGS)

lint: $(VENV)/.dev  ## ruff, pyright, words that may not come back, names of what is not there
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --threads $(WORKERS)
	$(BIN)/python -m pytest tests/test_words.py tests/test_names.py

dist: $(VENV)/.dev  ## build sdist and wheel
	rm -rf dist
	$(BIN)/python -m hatchling build -t sdist -t wheel

smoke: dist  ## install the wheel alone into a new environment, make an environment, reset, step
	$(BIN)/python -m pytest -m 'not slow' tests/test_packaging.py $(ARGS)

bench: $(VENV)/.demo  ## time the build, a step and each stage of a grasp
	$(BIN)/python -m benchmarks.build
	$(BIN)/python benchmarks/step.py --stages $(ARGS)
	$(BIN)/python benchmarks/grasp_phases.py

$(VENV)/.bench: $(VENV)/.dev
	$(INSTALL) --editable '.[bench]' || $(BIN)/python -m pip install --quiet -c constraints.txt --editable '.[bench]'
	@touch $@

accuracy: $(VENV)/.bench  ## the tables and the picture of docs/accuracy.md
	$(BIN)/python -m benchmarks.accuracy $(ARGS)
	$(BIN)/python docs/accuracy_picture.py

baselines: $(VENV)/.bench  ## the table and the picture of docs/baselines.md
	$(BIN)/python -m benchmarks.baselines.run --picture docs/images/baselines.png $(ARGS)

coupling: $(VENV)/.dev  ## the tables of docs/coupling.md and docs/contact.md
	$(BIN)/python -m benchmarks.coupling $(ARGS)
	$(BIN)/python -m benchmarks.contact
	$(BIN)/python -m benchmarks.contact_targets --table

docs: $(VENV)/.dev  ## build the documentation: out/docs/index.html, no network needed
	$(BIN)/python -m sphinx --fail-on-warning --keep-going -b html docs out/docs $(ARGS)

clean:  ## remove what the targets made, the virtual environment included
	rm -rf $(VENV) .cache out build dist .pytest_cache .ruff_cache .hypothesis
	find softmode tests -name __pycache__ -type d -prune -exec rm -rf {} +
