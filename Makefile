# Everything a newcomer needs: `make demo` shows the program at work, `make test` proves it.
# Both make .venv and install what they need; PYTHON chooses the interpreter (3.11 to 3.13).
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/installed
DOCS_STAMP := $(VENV)/docs-installed

.PHONY: demo test lint types check docs clean help

help: ## list the targets
	@grep -E '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/'

$(STAMP): pyproject.toml hatch_build.py $(wildcard viewer/*.* viewer/src/*)
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	touch $(STAMP)

demo: $(STAMP) ## simplify a real scene to 10 % in two ways, and show all in demo/report.html
	mkdir -p demo
	$(BIN)/nanogs demo demo/scene.ply -w
	$(BIN)/nanogs simplify demo/scene.ply demo/small.sog --ratio 0.1 -w
	$(BIN)/nanogs simplify demo/scene.ply demo/best.sog --ratio 0.1 --preset best -w
	$(BIN)/nanogs compare demo/scene.ply demo/small.sog demo/best.sog --report demo/report.html -w

test: $(STAMP) ## run the tests
	$(BIN)/python -m pytest -n 2

lint: $(STAMP) ## check style and formatting
	$(BIN)/ruff check
	$(BIN)/ruff format --check

types: $(STAMP) ## check types
	$(BIN)/mypy

check: lint types test ## everything CI checks

$(DOCS_STAMP): $(STAMP)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[docs]'
	touch $(DOCS_STAMP)

docs: $(DOCS_STAMP) ## build the documentation, with its pictures, into build/site
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet

clean: ## remove what these targets made
	rm -rf $(VENV) build/site demo viewer/node_modules src/nanogs/view/viewer.js
