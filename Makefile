# `make demo` and `make test` need nothing but Python 3.11 or newer; they install into .venv.

PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin
DATA   ?=
PIP    := $(BIN)/python -m pip --disable-pip-version-check -q
ARGS   ?=
PYTEST := $(BIN)/python -m pytest -q -n 2 --dist loadgroup $(ARGS)

.DEFAULT_GOAL := help
.PHONY: help installed demo check test soak lint format dev bench docs clean

help: ## Show what can be made
	@grep -hE '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed -E 's/^([a-z]+):.*## /  make \1\t/' | expand -t 16

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "Marey needs Python 3.11 or newer; say which with make PYTHON=..."; exit 1; }
	$(PYTHON) -m venv $(VENV)

$(VENV)/.installed-all: pyproject.toml constraints.txt | $(BIN)/python
	$(PIP) install -c constraints.txt -e '.[all]'
	$(BIN)/python -m marey_motion.warm_up --processes 2
	@touch $@

$(VENV)/.installed-dev: pyproject.toml constraints.txt | $(BIN)/python
	$(PIP) install -c constraints.txt -e '.[dev]'
	$(BIN)/python -m marey_motion.warm_up --processes 2
	@touch $@ $(VENV)/.installed-all

installed: $(VENV)/.installed-dev

demo: $(VENV)/.installed-all ## From takes to an evaluated, reported dataset; DATA=folder for your own motion
	$(BIN)/marey demo $(if $(DATA),"$(DATA)")

dev: $(VENV)/.installed-dev ## A server and a worker on this machine, with data in ./marey-data
	$(BIN)/marey serve

check: $(VENV)/.installed-dev lint ## In 4 minutes: lint, types, units, REST on SQLite, one whole way
	$(PYTEST) --tier check tests

test: $(VENV)/.installed-dev lint ## In 15 minutes: everything a change can break, on SQLite and on Postgres
	$(PYTEST) --tier test tests

soak: $(VENV)/.installed-dev lint ## Every fault on both databases, hours of generated files, requests and state machines
	$(PYTEST) --tier soak -o timeout=7200 tests
	$(BIN)/python -m tests.support.motion_fuzz 3600

lint: $(VENV)/.installed-dev ## Style, types and the arrows between rooms
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python -m lint

format: $(VENV)/.installed-dev ## Put the code in house style
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

$(VENV)/.installed-bench: $(VENV)/.installed-dev
	$(PIP) install -c constraints.txt -e '.[bench]'
	@touch $@

bench: $(VENV)/.installed-bench ## Speed against peers, as ratios
	$(BIN)/python -m benchmarks

docs: $(VENV)/.installed-dev ## Write the reference pages that come from the code
	$(BIN)/python -m docs.generate

clean: ## Remove the environment and what tools leave behind
	rm -rf $(VENV) .mypy_cache .ruff_cache .pytest_cache .hypothesis marey-demo
