# Everything a laptop and CI run. `make help` lists the targets.

VENV := .venv
BIN := $(VENV)/bin
PYTHON ?= $(shell command -v python3.11 || command -v python3.12 || command -v python3.13 || command -v python3)
INSTALLED := $(VENV)/.installed
ARGS ?=
# In the order of tests/conftest.py.
TWO_AT_A_TIME := --numprocesses 2 --dist loadfile --no-loadscope-reorder
# Later options win, so ARGS overrides these.
TRAIN_DEFAULTS := --env Hopper-v5 --total-steps 300000

.DEFAULT_GOAL := help
.PHONY: help setup train test test-fast test-all test-external check format docs site build clean

help: ## Show this
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*##/\t/' | expand -t 12

setup: $(INSTALLED) ## Make .venv and install everything with the pinned versions

$(INSTALLED): pyproject.toml constraints.txt
	@echo "== installing a2s with everything into $(VENV) (torch is large: about a minute)"
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] < (3, 14))' || \
	  { echo "a2s needs Python 3.11 to 3.13; found $(PYTHON). Use: make setup PYTHON=python3.11"; exit 2; }
	@$(PYTHON) -m venv $(VENV) || \
	  { echo "could not make a virtual environment; on Debian: apt-get install python3-venv"; exit 2; }
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt uv
	@# Several times as fast as pip, whose configuration it does not read: else pip does it.
	VIRTUAL_ENV=$(VENV) $(BIN)/uv pip install --quiet -c constraints.txt -e '.[dev]' || \
	  $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@echo "== compiling what the learner computes (half a minute)"
	@$(BIN)/python -W ignore -c 'from a2s.learner.on_policy.warm_up import warm_up; warm_up()'
	@$(BIN)/python -W ignore -c 'from a2s.learner.off_policy.warm_up import warm_up; warm_up("f32")'
	@touch $(INSTALLED)

train: setup ## Train Hopper-v5 for about three minutes: make train ARGS="--env HalfCheetah-v5"
	@echo "== a2s train $(TRAIN_DEFAULTS) $(ARGS)"
	@$(BIN)/a2s train $(TRAIN_DEFAULTS) $(ARGS)

test-fast: setup ## Run the tests that start no run, in less than a minute
	@echo "== pytest"
	@$(BIN)/python -m pytest $(TWO_AT_A_TIME) -m "not system and not slow" $(ARGS)

test: setup ## Run the tests, two at a time, but for the long ones
	@echo "== pytest"
	@$(BIN)/python -m pytest $(TWO_AT_A_TIME) -m "not long" $(ARGS)

test-all: setup ## Run all tests
	@echo "== pytest"
	@$(BIN)/python -m pytest $(TWO_AT_A_TIME) $(ARGS)

test-external: setup ## Train one environment of each other package for 3,000 steps
	@bash tests/external/run.sh 3000 one

check: setup ## Style, types, layers
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: setup ## Format the code
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

docs: setup ## Write docs/hyperparameters.md and docs/commands.md from the code
	$(BIN)/python -m a2s.learner.run.tables > docs/hyperparameters.md
	$(BIN)/python docs/build_commands.py > docs/commands.md

site: setup ## Build the documentation as a site in build/site; a broken link is an error
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict
	@echo "open build/site/index.html"

build: setup ## Build wheel and sdist, and try the wheel in an environment of its own
	$(BIN)/python -m build --outdir dist .
	$(PYTHON) -m venv --clear build/try
	build/try/bin/python -m pip install --quiet --disable-pip-version-check -c constraints.txt dist/*.whl
	cd build && try/bin/a2s actor --help > /dev/null && ! try/bin/python -c 'import torch' 2> /dev/null
	@echo "the wheel works, and is an actor without torch"

clean: ## Remove what was made, but not the runs
	rm -rf $(VENV) .venv-external dist build .pytest_cache .mypy_cache .ruff_cache
