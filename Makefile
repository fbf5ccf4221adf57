# The one door for people and CI. Every target sets up .venv first if it has to, then calls one command or one tool.

BASE_PYTHON ?= python3
PIP_ARGS    ?=
EXTRAS      ?= dev,render
PYTEST_ARGS ?=

REWARD      ?= ours
SPEED_RATIO ?= 1.1
PURSUERS    ?= 3
OBSTACLES   ?= 1
SCENE       ?= random
SEED        ?= 0
JOBS        ?= $(shell getconf _NPROCESSORS_ONLN 2>/dev/null || echo 1)
GRID        ?= study
RESULTS     ?= results

BIN    := .venv/bin
PYTHON := $(BIN)/python
CLI    := $(BIN)/marl-encircle
READY  := .venv/.ready
TRAIN   = $(CLI) train --reward $(REWARD) --speed-ratio $(SPEED_RATIO) --pursuers $(PURSUERS) \
          --obstacles $(OBSTACLES) --scene $(SCENE) --seed $(SEED) --out $(RESULTS)/runs

INSTALL = $(PYTHON) -m pip install $(PIP_ARGS) -c constraints.txt
VERSIONS = $(INSTALL) -q -e '.[lock]' && $(PYTHON) tools/versions.py

# One thread per process: runs are parallel by process, and results are promised per thread count.
export OMP_NUM_THREADS := 1

.DEFAULT_GOAL := help
.PHONY: help setup test soak coverage mutation test-lowest test-newest test-sb3 check lint format format-check \
        typecheck imports spelling supply-chain lock licences \
        train evaluate sweep tables figures report test-browser calibrate verify-results reproduce-tables docs bench tensorboard clean

help:  ## list the targets and the variables
	@awk -F':.*## ' '/^[a-z0-9-]+:.*## / {printf "  %-18s %s\n", $$1, $$2}' $(firstword $(MAKEFILE_LIST))
	@echo
	@echo "  REWARD=$(REWARD) SPEED_RATIO=$(SPEED_RATIO) PURSUERS=$(PURSUERS) OBSTACLES=$(OBSTACLES)" \
	      "SCENE=$(SCENE) SEED=$(SEED)"
	@echo "  JOBS=$(JOBS) GRID=$(GRID) RESULTS=$(RESULTS) EXTRAS=$(EXTRAS) PIP_ARGS=$(PIP_ARGS) PYTEST_ARGS=$(PYTEST_ARGS)"

setup: $(READY)  ## make .venv with the versions of constraints.txt, or add EXTRAS to it; PIP_ARGS for pip
	@[ "$$(cat $(READY))" = '$(EXTRAS)' ] || { $(INSTALL) -e '.[$(EXTRAS)]' && echo '$(EXTRAS)' > $(READY); }

$(READY): pyproject.toml constraints.txt
	$(BASE_PYTHON) -m venv .venv
	$(INSTALL) -e '.[$(EXTRAS)]'
	@echo '$(EXTRAS)' > $@

test: $(READY)  ## the tests (PYTEST_ARGS goes to pytest)
	$(PYTHON) -m pytest -n 2 $(PYTEST_ARGS)

soak: $(READY)  ## every promise of docs/reliability.md with its figure; under 40 minutes
	$(PYTHON) -m pytest -n 2 --dist loadfile --timeout 1800 tests/soak $(PYTEST_ARGS)

coverage: $(READY)  ## lines that the tests run, by module; the kernels as plain Python (PYTEST_ARGS goes to pytest)
	rm -f .coverage .coverage.*
	NUMBA_DISABLE_JIT=1 $(PYTHON) -m pytest -n 2 --timeout 1200 --cov --cov-report= $(PYTEST_ARGS) \
	  tests/core tests/envs tests/maddpg
	$(PYTHON) -m pytest -n 2 --timeout 1200 --cov --cov-append --cov-report= $(PYTEST_ARGS) \
	  --ignore tests/core --ignore tests/envs --ignore tests/maddpg tests
	$(BIN)/coverage report --fail-under 95

mutation: $(READY)  ## do the tests notice when the code is changed: at most an hour (MUTATION_ARGS)
	$(INSTALL) -q -e '.[mutation]'
	$(PYTHON) tools/mutation.py $(MUTATION_ARGS)

test-lowest: $(READY)  ## the tests with the lowest versions that pyproject.toml allows
	$(VERSIONS) lowest

test-newest: $(READY)  ## the tests with the newest versions there are
	$(VERSIONS) newest

test-sb3: $(READY)  ## Stable-Baselines3's own tests on MADDPG and MATD3
	$(PYTHON) tests/sb3_suite.py

check: lint format-check typecheck imports spelling  ## all checks that run no code of ours

lint: $(READY)  ## ruff's rules
	$(BIN)/ruff check

format: $(READY)  ## format the code
	$(BIN)/ruff format

format-check: $(READY)  ## is the code formatted
	$(BIN)/ruff format --check

typecheck: $(READY)  ## mypy, strict
	$(BIN)/mypy

imports: $(READY)  ## the layers
	$(BIN)/lint-imports

spelling: $(READY)  ## codespell
	$(BIN)/codespell

supply-chain: $(READY)  ## is what is installed what is locked, with hashes
	$(PYTHON) tools/supply_chain.py

lock: $(READY)  ## write requirements.lock from constraints.txt: LOCK_ARGS, where the CPU wheel of torch is
	$(INSTALL) -q -e '.[lock]'
	$(BIN)/uv pip compile pyproject.toml --all-extras -c constraints.txt --generate-hashes --python $(PYTHON) \
	  --no-annotate --custom-compile-command 'make lock' --quiet --output-file requirements.lock $(LOCK_ARGS)

licences: $(READY)  ## write docs/licences.md from what is installed
	$(PYTHON) tools/licences.py

train: $(READY)  ## one training run: REWARD SPEED_RATIO PURSUERS OBSTACLES SCENE SEED RESULTS
	$(TRAIN)

evaluate: $(READY)  ## fresh rounds of that run (trained first if it is missing), or of RUN=its folder
	$(if $(RUN),$(CLI) evaluate $(RUN),run="$$($(TRAIN))" && $(CLI) evaluate "$$run")

sweep: $(READY)  ## train and evaluate what is missing of GRID: GRID JOBS RESULTS
	$(CLI) sweep $(GRID) --jobs $(JOBS) --out $(RESULTS)/runs

tables: $(READY)  ## render the tables from the runs there are: GRID RESULTS
	$(CLI) tables --grid $(GRID) --out $(RESULTS)

figures: $(READY)  ## draw the figures from the runs there are: GRID RESULTS
	$(CLI) figures --grid $(GRID) --out $(RESULTS)

report: $(READY)  ## tables, curves and a player of rounds in one HTML file: GRID RESULTS
	$(CLI) report --grid $(GRID) --out $(RESULTS)

test-browser: $(READY)  ## report and site in a real browser (CHROMIUM=, or one on the path)
	$(PYTHON) -m pytest tests/browser/report_page.py tests/browser/site_search.py $(PYTEST_ARGS)

calibrate: $(READY)  ## choose the study's scenario by its protocol: JOBS RESULTS
	$(CLI) calibrate --out $(RESULTS)/calibration --jobs $(JOBS)

verify-results: $(READY)  ## play every committed policy again and compare: GRID RESULTS
	$(CLI) verify-results --grid $(GRID) --out $(RESULTS)

reproduce-tables: $(READY)  ## the whole road: train, evaluate, render tables and figures: GRID JOBS RESULTS
	$(CLI) reproduce-tables --grid $(GRID) --out $(RESULTS) --jobs $(JOBS)
	$(CLI) figures --grid $(GRID) --out $(RESULTS)

docs: $(READY)  ## build the documentation into site/
	$(INSTALL) -q -e '.[docs]'
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build

bench: $(READY)  ## measure the speed, into benchmarks/results.json
	$(CLI) bench

tensorboard: $(READY)  ## the learning curves of all runs in a browser, on this machine alone: RESULTS
	$(CLI) tensorboard --out $(RESULTS)

clean:  ## remove caches and builds; .venv and results stay
	rm -rf build dist .cache .coverage* .hypothesis .import_linter_cache .mypy_cache .pytest_cache .ruff_cache
	find . -name .venv -prune -o -name __pycache__ -type d -print0 | xargs -0 rm -rf
