# Each target makes what it needs: an environment in .venv from python3 -m venv and
# pip. PYTHON=/path/to/python3.12 chooses the interpreter it is made with.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt
CORE := $(VENV)/.core-installed
DEV := $(VENV)/.dev-installed

.PHONY: help install quickstart test check bench docs gl clean

help:
	@echo "make install     environment with flashdex in it"
	@echo "make quickstart  train four small motions on the CPU, minutes"
	@echo "make test        tests (no GPU, no data, no network)"
	@echo "make check       lint, format, types, recipes, links"
	@echo "make bench       environment and learner speed, as JSON; learning and slow tests"
	@echo "make docs        check the links of the pages"
	@echo "make clean       remove what was made, runs excepted"

install: $(CORE)

$(BIN)/python:
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "flashdex needs Python 3.11 or newer: make PYTHON=python3.11 install")'
	$(PYTHON) -m venv $(VENV)

# torch first and by its range, so that a build lying on disk (a CPU wheel in
# find-links, say) is taken before the package index's.
$(CORE): pyproject.toml setup.py constraints.txt | $(BIN)/python
	$(PIP) "torch>=2.11,<2.14"
	$(PIP) --editable .
	@touch $@

$(DEV): $(CORE)
	$(PIP) --editable ".[dev]"
	@touch $@

# Films and pictures need an off-screen GL; training does not. Never a reason to stop.
gl:
	@if [ "$$(uname)" = Linux ] && ! ldconfig -p 2>/dev/null | grep -q libOSMesa \
	    && [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
	    (apt-get install -y -qq libosmesa6 >/dev/null 2>&1 \
	        || { apt-get update -qq >/dev/null 2>&1 \
	             && apt-get install -y -qq libosmesa6 >/dev/null 2>&1; }) \
	        || echo "libosmesa6 could not be installed: going on without films"; \
	fi

quickstart: $(CORE) gl
	$(BIN)/flashdex train quickstart run_dir=runs/quickstart

test: $(DEV)
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist loadfile

check: $(DEV)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/codespell
	$(BIN)/flashdex validate recipes
	$(BIN)/python docs/check_links.py

bench: $(DEV)
	$(BIN)/python -m benchmarks.env --num-envs 64
	$(BIN)/python -m benchmarks.env --num-envs 512
	$(BIN)/python -m benchmarks.learner
	$(BIN)/python -m pytest -m "learn or slow"

docs: $(CORE)
	$(BIN)/python docs/check_links.py

clean:
	rm -rf build dist *.egg-info .pytest_cache .ruff_cache $(CORE) $(DEV)
	find flashdex tests -name __pycache__ -type d -prune -exec rm -rf {} +
