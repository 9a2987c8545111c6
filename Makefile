# What one does with negopipe. Everything runs in .venv, which `setup` makes and keeps up to date.
SHELL := bash
.DEFAULT_GOAL := help

# of the command line or the environment, where an empty one is none
override PYTHON := $(or $(PYTHON),python3)
override OUTPUTS := $(or $(OUTPUTS),outputs)
override STORE := $(or $(STORE),$(OUTPUTS))
override NAME := $(or $(NAME),yield)
override CHECKPOINT := $(or $(CHECKPOINT),pretrained/generalist)
override PORT := $(or $(PORT),5000)
override DOCS_PORT := $(or $(DOCS_PORT),8000)
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
DOCS_READY := $(VENV)/.docs
DOCS := build/docs
ARGS ?=
INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint .ci/requirements.lock

# compiled Python is kept, since tests start many processes
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help setup yield push play unseen smoke compare test test-slow test-sweeps lint lock ui docs docs-serve

help:  ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-12s %s\n", $$1, $$2}' $(MAKEFILE_LIST)
	@echo '  ARGS adds to the command: make yield ARGS="seed=2 device=cpu"'

setup: $(READY)  ## make .venv and install negopipe into it
$(READY): pyproject.toml .ci/requirements.lock
	$(PYTHON) -m venv $(VENV)
	$(INSTALL) --editable '.[dev,joblib,submitit,optuna]'
	@touch $@

yield: $(READY)  ## train, evaluate and report on the yield task
	$(BIN)/python -m negopipe +experiment=yield $(ARGS)

push: $(READY)  ## the same on the push task
	$(BIN)/python -m negopipe +experiment=push $(ARGS)

play: $(READY)  ## drive against the policies yourself: a page on this machine
	@$(BIN)/python -m negopipe.play 'outputs=$(OUTPUTS)' $(ARGS)

unseen: $(READY)  ## put the generalist, or the policy of CHECKPOINT, to tasks that no training contains
	$(BIN)/python -m negopipe +experiment=unseen 'checkpoint=$(CHECKPOINT)' 'outputs=$(OUTPUTS)/unseen-v1' $(ARGS)
	$(BIN)/python -m negopipe.sweeping.unseen '$(OUTPUTS)/unseen-v1'

smoke: $(READY)  ## the whole pipeline, tiny: does it run from end to end?
	$(BIN)/python -m negopipe +experiment=smoke $(ARGS)

compare: $(READY)  ## compare the runs of NAME: tables with intervals, figures, the best config
	@$(BIN)/python -m negopipe.sweeping.compare '$(OUTPUTS)/$(NAME)' $(ARGS)

test: $(READY)  ## the fast tests
	$(BIN)/python -m pytest -m 'not slow' --numprocesses auto --maxprocesses 4 --dist worksteal $(ARGS)

test-slow: $(READY)  ## the tests that take longer
	$(BIN)/python -m pytest -m slow --numprocesses auto --maxprocesses 4 --dist worksteal $(ARGS)

test-sweeps: $(READY)  ## launchers and searches, really run; installs Ray (240 MB) beside the others
	$(INSTALL) --editable '.[dev,joblib,submitit,ray,optuna]'
	$(BIN)/python -m pytest -m slow tests/sweeping $(ARGS)

lint: $(READY)  ## ruff, ruff format, mypy and the lock, as in CI
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python .ci/check_lock.py

lock: $(READY)  ## resolve all dependencies anew: .ci/requirements.lock
	$(BIN)/python .ci/check_lock.py --write

ui: $(READY)  ## MLflow's dashboard of all runs under OUTPUTS, or in STORE=sqlite:///file
	@$(BIN)/python -m negopipe.tracking.dashboard '$(STORE)' '$(PORT)'

$(DOCS_READY): $(READY)
	$(INSTALL) --editable '.[docs]'
	@touch $@

docs: $(DOCS_READY)  ## build the documentation site strictly: a broken link or an unexplained config key fails
	$(BIN)/python -m sphinx --fail-on-warning --keep-going --fresh-env --quiet -b html docs $(DOCS)
	@echo '$(DOCS)/index.html'

docs-serve: docs  ## show the documentation site on this machine, at DOCS_PORT
	$(BIN)/python -m http.server '$(DOCS_PORT)' --bind 127.0.0.1 --directory $(DOCS)
