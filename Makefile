# Everything a newcomer needs: `make demo` shows the program at work, `make test` proves it.
# Both make .venv and install what they need; PYTHON chooses the interpreter (3.11 to 3.15).
PYTHON ?= python3
VENV := .venv
# Where programs are in a virtual environment.
SCRIPTS := $(if $(filter Windows_NT,$(OS)),Scripts,bin)
BIN := $(VENV)/$(SCRIPTS)
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check
UV := $(BIN)/uv
STAMP := $(VENV)/installed
DOCS_STAMP := $(VENV)/docs-installed
ORACLES_STAMP := $(VENV)/oracles-installed

# The build for the CPU: PyPI has none for Linux, whose own is gigabytes of CUDA. Pip finds it where
# it is told of https://download.pytorch.org/whl/cpu.
TORCH ?= torch==2.13.0+cpu
FLOORS := build/floors
NEWEST := build/newest
# Pythons to run `make newest` on: the first that can be had.
PYTHONS ?= 3.14
# Processes that `make test` runs tests in: one more than two processors, since some tests wait for
# browsers, clusters and disks.
WORKERS ?= 3
# What `make floors` and `make newest` run.
TESTS ?= tests
# What `make bounds` runs: whatever calls kernels, with small models.
BOUNDS := $(patsubst %,tests/test_%.py,kernels extremes correct directional growth_sheets forest knn parallel raster blocks \
	visibility distances refit metrics simplify scale sog_write palette rate_distortion)

# Python keeps compiled modules, whatever it is told elsewhere: tests start hundreds of processes.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: demo test stories bounds quick lint types check oracles floors newest docs dist clean help

help: ## list the targets
	@grep -E '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/'

$(STAMP): pyproject.toml hatch_build.py $(wildcard viewer/*.* viewer/src/*)
	$(PYTHON) -m venv $(VENV)
	$(PIP) uv
	$(UV) pip install --quiet --python $(VENV) --editable '.[dev]'
	touch $(STAMP)

demo: $(STAMP) ## simplify a real scene to 10 % in two ways, and show all in demo/report.html
	mkdir -p demo
	$(BIN)/nanogs demo demo/scene.ply -w
	$(BIN)/nanogs simplify demo/scene.ply demo/small.sog --ratio 0.1 -w
	$(BIN)/nanogs simplify demo/scene.ply demo/best.sog --ratio 0.1 --preset best -w
	$(BIN)/nanogs compare demo/scene.ply demo/small.sog demo/best.sog --report demo/report.html -w

# Kernels first, on all processors: otherwise several tests wait for the same ones at a time.
test: $(STAMP) ## run the tests
	$(BIN)/python -m nanogs warm
	$(BIN)/python -m pytest -n $(WORKERS) --dist worksteal -m "not story"

# For minutes each, in real time, which other tests beside them would only stretch.
stories: $(STAMP) ## run the tests that drive the studio through whole stories in a browser
	$(BIN)/python -m nanogs warm
	$(BIN)/python -m pytest -m story

# Each index of each kernel is checked as it is used: one that is out of its array raises, where a
# kernel as usual would read or write beside it. Vectors are written without checks, so the plain
# kernels stand for them. What is so compiled is kept in build/bounds.
bounds: $(STAMP) ## run the kernels' tests with checks of bounds
	NANOGS_SIMD=0 NUMBA_BOUNDSCHECK=1 NUMBA_CACHE_DIR=$(CURDIR)/build/bounds \
	  $(BIN)/python -m pytest -n 2 --dist worksteal -m "not slow and not story" $(BOUNDS)

quick: $(STAMP) ## run the tests that take less than some 5 seconds each
	$(BIN)/python -m pytest -n 2 --dist worksteal -m "not slow and not story"

lint: $(STAMP) ## check style and formatting
	$(BIN)/ruff check
	$(BIN)/ruff format --check

types: $(STAMP) ## check types
	$(BIN)/mypy

check: lint types test stories ## check style and types, and run all tests

$(ORACLES_STAMP): $(STAMP) tests/npm/package-lock.json
	$(UV) pip install --quiet --python $(VENV) --editable '.[dev,oracles]'
	$(PIP) '$(TORCH)' || echo "$(TORCH) cannot be had here: tests with it are skipped"
	npm ci --silent --prefix tests/npm || echo "tests/npm cannot be had here: tests with it are skipped"
	touch $(ORACLES_STAMP)

oracles: $(ORACLES_STAMP) ## install the other programs that tests hold ours against

# Kernels are kept apart: versions of Numba overwrite each other's.
floors: $(STAMP) ## run quick tests with the lowest versions that pyproject.toml allows
	$(UV) venv --quiet --clear --python 3.11 $(FLOORS)
	$(UV) pip install --quiet --python $(FLOORS) --resolution lowest-direct '.[bench,flip,cluster,s3]'
	$(UV) pip freeze --python $(FLOORS) --exclude nanogs >$(FLOORS)/lowest.txt
	$(UV) pip install --quiet --python $(FLOORS) --constraint $(FLOORS)/lowest.txt --editable '.[dev]'
	NUMBA_CACHE_DIR=$(CURDIR)/$(FLOORS)/kernels $(FLOORS)/$(SCRIPTS)/python -m pytest -n 2 --dist worksteal -m "not slow and not story" $(TESTS)

newest: $(STAMP) ## run quick tests with the newest Python; with OPTIONAL=1 where it can be had
	@for version in $(PYTHONS); do \
	  if $(UV) venv --quiet --clear --python $$version $(NEWEST); then \
	    echo "with Python $$version"; exec $(MAKE) --no-print-directory on-newest; fi; \
	  echo "Python $$version cannot be had here"; \
	done; test -n "$(OPTIONAL)"

on-newest:
	$(UV) pip install --quiet --python $(NEWEST) --editable '.[dev]'
	NUMBA_CACHE_DIR=$(CURDIR)/$(NEWEST)/kernels $(NEWEST)/$(SCRIPTS)/python -m pytest -n 2 --dist worksteal -m "not slow and not story" $(TESTS)

$(DOCS_STAMP): $(STAMP)
	$(UV) pip install --quiet --python $(VENV) --editable '.[docs]'
	touch $(DOCS_STAMP)

docs: $(DOCS_STAMP) ## build the documentation, with its pictures, into build/site
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet

dist: $(STAMP) ## build the source archive, and of it the wheel, into dist
	$(UV) build --quiet --clear --out-dir dist

clean: ## remove what these targets made
	rm -rf $(VENV) build/bounds $(FLOORS) $(NEWEST) build/site dist demo viewer/node_modules tests/npm/node_modules src/nanogs/view/viewer.js
