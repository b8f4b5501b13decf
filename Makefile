# `make demo` and `make test` need nothing but Python 3.11 or newer; they install into .venv.

PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin
DATA   ?=
PIP    := $(BIN)/python -m pip --disable-pip-version-check -q
# Pins are complete; pip would refuse the newer typer that pyproject.toml sets for openapi-python-client.
PINNED := $(PIP) install --no-deps --require-hashes --only-binary :all: -r
MAREY  := $(PIP) install --no-deps --no-build-isolation -e .
ARGS   ?=
# Tests start hundreds of processes, each of which would compile the sources again.
unexport PYTHONDONTWRITEBYTECODE
EFFORT ?= 4
PYTEST := $(BIN)/python -m pytest -q --dist loadgroup $(ARGS)
# Two processes more than two processors: tests of faults wait, for leases to end or processes to start; others compute.
PROCESSES ?= 4

# Where npm is missing, or cannot install packages, tests that need the pages are left out and counted.
PAGES_IF_POSSIBLE := command -v npm > /dev/null && $(BIN)/python hatch_build.py || true

.DEFAULT_GOAL := help
.PHONY: help installed web web-test demo check slow-tests test soak lint types rules format dev bench docs pins audit bom clean

help: ## Show what can be made
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## /  make \1\t/' | expand -t 22

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "Marey needs Python 3.11 or newer; say which with make PYTHON=..."; exit 1; }
	$(PYTHON) -m venv $(VENV)

$(VENV)/.installed-all: pyproject.toml pins/build.txt pins/all.txt | $(BIN)/python
	$(PINNED) pins/all.txt
	$(MAREY)
	$(BIN)/python -m marey_motion.warm_up --processes 2
	@touch $@

$(VENV)/.installed-dev: pyproject.toml pins/build.txt pins/all.txt pins/traces.txt pins/kubernetes.txt pins/dev.txt | $(BIN)/python
	$(PINNED) pins/dev.txt
	$(MAREY)
	$(BIN)/python -m marey_motion.warm_up --processes 2
	@touch $@ $(VENV)/.installed-all

installed: $(VENV)/.installed-dev

demo: $(VENV)/.installed-all ## From takes to an evaluated, reported dataset; DATA=folder for your own motion
	$(BIN)/marey demo $(if $(DATA),"$(DATA)")

dev: $(VENV)/.installed-dev ## A server and a worker on this machine, with data in ./marey-data
	$(BIN)/marey serve

web: $(VENV)/.installed-dev ## The browser pages, which need Node 20.19 or newer
	$(BIN)/python hatch_build.py

web-test: web ## Types and tests of the browser pages
	npm --prefix web run check
	$(BIN)/python -m tests.support.web_cases web/tests/cases
	npm --prefix web test
	npm --prefix web run sizes

check: $(VENV)/.installed-dev lint ## In 4 minutes: lint, types, units, REST on SQLite, one whole way
	$(PAGES_IF_POSSIBLE)
	$(PYTEST) -n auto --tier check tests

slow-tests: $(VENV)/.installed-dev ## Measure which tests the tier check leaves out, on a machine that does nothing else
	$(PYTEST) -n auto --tier check --store-slow tests

test: $(VENV)/.installed-dev lint ## In 15 minutes: everything a change can break, on SQLite and on Postgres
	$(PAGES_IF_POSSIBLE)
	$(PYTEST) -n $(PROCESSES) --tier test tests

soak: $(VENV)/.installed-dev lint ## Long forms of all tests, on both databases; EFFORT=20 for more examples, in hours
	tests/support/install_slurm.sh
	tests/support/install_chromium.sh
	$(PAGES_IF_POSSIBLE)
	$(PYTEST) -n $(PROCESSES) --tier soak --effort $(EFFORT) -o timeout=7200 --durations=25 tests
	$(BIN)/python -m tests.support.motion_fuzz $$((300 * $(EFFORT)))
	$(BIN)/python -m tests.support.hostile_figures
	$(BIN)/python -m tests.support.hostile_figures --postgres
	$(BIN)/python -m tests.support.endurance faults
	$(BIN)/python -m tests.support.endurance load

lint: $(VENV)/.installed-dev ## Style, types, and which package may import which
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	@$(MAKE) --no-print-directory -j 2 types rules

types: $(VENV)/.installed-dev
	$(BIN)/pyrefly check --python-interpreter-path $(BIN)/python

rules: $(VENV)/.installed-dev
	$(BIN)/lint-imports
	$(BIN)/python -m lint

format: $(VENV)/.installed-dev ## Format the code
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

$(VENV)/.installed-%: $(VENV)/.installed-dev pins/%.txt
	$(PINNED) pins/$*.txt
	@touch $@

bench: $(VENV)/.installed-bench ## Speed against peers, as ratios
	$(BIN)/python -m benchmarks

docs: $(VENV)/.installed-dev ## Write the reference pages that come from the code
	$(BIN)/python -m docs.generate

pins: $(VENV)/.installed-audit ## Resolve pyproject.toml again; ARGS="--upgrade-package NAME" for a newer version
	$(BIN)/python -m lint.pins $(ARGS)

audit: $(VENV)/.installed-audit ## Known weaknesses of the pinned packages; needs the network
	@$(BIN)/pip-audit --strict --disable-pip --require-hashes -r pins/dev.txt || { echo "A package has a known weakness, or could not be audited because the package index did not answer; see above."; exit 1; }

bom: $(VENV)/.installed-audit ## Bill of materials of what users run, as CycloneDX in marey-bom.json
	@$(BIN)/python -W ignore::UserWarning -m cyclonedx_py requirements --pyproject pyproject.toml -o marey-bom.json pins/all.txt
	@echo marey-bom.json

clean: ## Remove the environment and what tools leave behind
	rm -rf $(VENV) .ruff_cache .pytest_cache .hypothesis marey-demo marey-bom.json web/node_modules server/marey_server/webui
