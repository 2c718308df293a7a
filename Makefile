# Two commands: `make demo` sets everything up and runs the main job, `make test` passes the tests.

PYTHON ?= $(firstword $(foreach p,python3.11 python3.12 python3.13 python3.14 python3,$(shell command -v $(p) 2>/dev/null)))
VENV ?= .venv
BIN := $(VENV)/bin
OUT ?= out
# Small matrices: BLAS threads only get in each other's way.
export OPENBLAS_NUM_THREADS ?= 1
# Each worker begins with a half of its own, so that what the tests of a file share is made once.
WORKERS := -n 2 --dist worksteal
# Where an image sets it, every process would compile everything anew.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test test-fast test-slow test-benchmarks docs format check clean

demo: $(VENV)/.installed  ## simulate the default mission with failing beams, smooth it, show table and figure
	$(BIN)/ssm-graph simulate demo --overwrite --out $(OUT)/demo/mission
	$(BIN)/ssm-graph smooth $(OUT)/demo/mission --out $(OUT)/demo/result
	@echo "figure: $(OUT)/demo/result/figure.png"

test: check test-fast  ## format, lint, types and the fast tests

test-fast: $(VENV)/.installed-dev
	$(BIN)/python -m pytest $(WORKERS)

test-slow: $(VENV)/.installed-dev  ## the tests that take minutes
	$(BIN)/python -m pytest $(WORKERS) -m slow

test-benchmarks: $(VENV)/.installed-dev  ## every benchmark in its smallest form
	$(BIN)/python -m pytest $(WORKERS) -m benchmark

docs: $(VENV)/.installed-dev  ## the documentation as a site, out/site/index.html; no network is needed
	$(BIN)/python -m mkdocs build --strict --quiet --site-dir $(OUT)/site
	@echo "site: $(OUT)/site/index.html"

check: $(VENV)/.installed-dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

format: $(VENV)/.installed-dev
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

$(VENV)/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo "Python 3.11 or newer is needed, found: '$(PYTHON)'; try make PYTHON=/path/to/python3.11" >&2; exit 1; }
	@$(PYTHON) -m venv $(VENV) \
		|| { rm -rf $(VENV); echo "no virtual environment: on Debian try  apt-get install python3-venv" >&2; exit 1; }

$(VENV)/.installed: $(VENV)/bin/python pyproject.toml
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable .
	@touch $@

$(VENV)/.installed-dev: $(VENV)/bin/python pyproject.toml
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	@touch $@ $(VENV)/.installed

clean:
	rm -rf $(VENV) $(OUT) .mypy_cache .pytest_cache .ruff_cache .hypothesis
