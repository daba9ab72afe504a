# Needs Python >= 3.11 and make, nothing else; everything is installed into .venv.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
# Some files of tests at a time, each of them in one process.
PYTEST := $(BIN)/python -m pytest --numprocesses logical --maxprocesses 4 --dist loadfile

.DEFAULT_GOAL := help
.PHONY: help setup demo results benchmark docs test test-all faults soak lint format typecheck check

help: ## Show the commands
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/make \1\t\2/p' Makefile | expand -t 18

setup: $(STAMP) ## Create .venv and install the package with its development tools

# torch first and by itself: a CPU build that is there (or offered) is then the one that is kept.
$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.version_info >= (3, 11) or sys.exit("Python >= 3.11 is needed, this is " + sys.version.split()[0] + ": run make PYTHON=python3.11 ...")'
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@echo "Installing into $(VENV) (a minute or two) ..."
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt torch
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@touch $(STAMP)

demo: $(STAMP) ## Synthetic streets -> training -> evaluation -> a picture (about 6 minutes on two cores)
	$(BIN)/python -m occdetr.demo

results: $(STAMP) ## Draw every table and curve of the studies anew from docs/results
	$(BIN)/python -m occdetr.study.results

benchmark: $(STAMP) ## Measure parts, steps, growth and a peer: the tables of docs/performance.md
	@$(BIN)/python -c 'import transformers' 2>/dev/null \
		|| $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[benchmark]'
	$(BIN)/python -m occdetr.benchmark part=all device=cpu $(BENCHMARK)

docs: $(STAMP) ## Build the documentation as a site: outputs/site/index.html
	@$(BIN)/python -c 'import material, mkdocstrings_handlers.python' 2>/dev/null \
		|| $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[docs]'
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict
	@echo 'done: outputs/site/index.html; with its search: $(BIN)/python -m http.server -d outputs/site'

test: $(STAMP) ## Run the fast tests
	$(PYTEST) -m "not slow" $(TEST_OPTIONS)

test-all: $(STAMP) ## Run every test
	$(PYTEST) $(TEST_OPTIONS)

faults: $(STAMP) ## Kill, stop and damage runs, and give wrong inputs: what is lost (under 30 minutes)
	PYTHONPATH=$(CURDIR)/tests OMP_NUM_THREADS=1 $(BIN)/python -m faults $(FAULTS)

soak: $(STAMP) ## Train for two hours and draw memory, handles, disk and seconds a step
	PYTHONPATH=$(CURDIR)/tests $(BIN)/python -m faults.soak $(SOAK)

lint: $(STAMP) ## Check style and the direction of imports
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports

format: $(STAMP) ## Fix style
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

typecheck: $(STAMP) ## Check types
	$(BIN)/pyright

check: lint typecheck test ## All of lint, typecheck and test
