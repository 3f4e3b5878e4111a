# softmode: set-up, tests and the demo. Needs python3 >= 3.11 and make; everything is installed into .venv.
#   make demo            the arm lifts a soft object; writes out/lift.mp4
#   make test            the fast tests (what CI runs)
SHELL  := /bin/bash
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
UV     := $(BIN)/uv
ARGS   ?=

# The environment checker of stable-baselines3 imports torch; its CPU wheel (200 MB) is enough.
TORCH       ?= torch==2.13.0
TORCH_INDEX ?= https://download.pytorch.org/whl/cpu

# Compiled kernels and built bodies stay inside the checkout.
export WARP_CACHE_PATH ?= $(CURDIR)/.cache/warp
export SOFTMODE_CACHE  ?= $(CURDIR)/.cache/softmode
export PYTHONUNBUFFERED := 1
export PIP_DISABLE_PIP_VERSION_CHECK := 1
unexport VIRTUAL_ENV

.DEFAULT_GOAL := help
.PHONY: help demo test test-slow lint bench clean

help:  ## list the targets
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 14

$(VENV)/.created:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "softmode needs Python >= 3.11; name one with: make PYTHON=python3.12 ..." >&2; exit 2; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet uv
	@touch $@

# `uv sync` installs what uv.lock pins; where its index is out of reach, pip resolves anew with the machine's own settings.
$(VENV)/.demo: $(VENV)/.created pyproject.toml uv.lock
	$(UV) sync --quiet --frozen --inexact --extra demo || $(BIN)/python -m pip install --quiet --editable '.[demo]'
	@touch $@

$(VENV)/.dev: $(VENV)/.created pyproject.toml uv.lock
	$(UV) sync --quiet --frozen --inexact --extra dev || $(BIN)/python -m pip install --quiet --editable '.[dev]'
	$(BIN)/python -c 'import torch' 2>/dev/null || \
	  $(BIN)/python -m pip install --quiet --retries 1 --no-deps --index-url $(TORCH_INDEX) '$(TORCH)' || \
	  $(BIN)/python -m pip install --quiet '$(TORCH)'
	$(BIN)/python -m pip install --quiet stable-baselines3
	@touch $@ $(VENV)/.demo

demo: $(VENV)/.demo  ## play the scripted lift and write out/lift.mp4
	$(BIN)/softmode play softmode/LiftSoft-v0 --policy scripted --video out/lift.mp4 $(ARGS)

test: $(VENV)/.dev  ## run the fast tests
	$(BIN)/python -m pytest $(ARGS)

test-slow: $(VENV)/.dev  ## run all tests, slow ones included
	$(BIN)/python -m pytest -m 'slow or not slow' $(ARGS)

lint: $(VENV)/.dev  ## ruff and pyright
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

bench: $(VENV)/.demo  ## time the build and each stage of a step
	$(BIN)/python benchmarks/step.py $(ARGS)

clean:  ## remove what the targets made, the virtual environment included
	rm -rf $(VENV) .cache out build dist .pytest_cache .ruff_cache .hypothesis
	find softmode tests -name __pycache__ -type d -prune -exec rm -rf {} +
