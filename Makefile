# What one does with negopipe. Everything runs in .venv, which `setup` makes and keeps up to date.
SHELL := bash
.DEFAULT_GOAL := help

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
OUTPUTS ?= outputs
PORT ?= 5000
ARGS ?=

.PHONY: help setup yield push smoke test test-slow lint ui

help:  ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-10s %s\n", $$1, $$2}' $(MAKEFILE_LIST)
	@echo '  ARGS adds to the command: make yield ARGS="seed=2 device=cpu"'

setup: $(READY)  ## make .venv and install negopipe into it
$(READY): pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev,joblib]'
	@touch $@

yield: $(READY)  ## train, evaluate and report on the yield task
	$(BIN)/python -m negopipe +experiment=yield $(ARGS)

push: $(READY)  ## the same on the push task
	$(BIN)/python -m negopipe +experiment=push $(ARGS)

smoke: $(READY)  ## the whole pipeline, tiny: does it run from end to end?
	$(BIN)/python -m negopipe +experiment=smoke $(ARGS)

test: $(READY)  ## the fast tests
	$(BIN)/python -m pytest -m 'not slow' --numprocesses auto --maxprocesses 4 --dist loadfile $(ARGS)

test-slow: $(READY)  ## the tests that take longer
	$(BIN)/python -m pytest -m slow $(ARGS)

lint: $(READY)  ## ruff, ruff format and mypy, as in CI
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

ui: $(READY)  ## MLflow's dashboard of all runs under OUTPUTS
	@$(BIN)/python -m negopipe.tracking.dashboard $(OUTPUTS) $(PORT)
