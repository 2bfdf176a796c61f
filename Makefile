# Everything runs in .venv, which is made when it is missing or when the requirements have changed.
#   PYTHON=...     the interpreter to make .venv with (3.11 or newer)
#   PIP_FLAGS=...  more flags for pip, such as another package index
#   ARGS=...       more arguments for the command: make serve ARGS="--port 9000"
#   JOBS=...       processes that share the test files among them (2)

PYTHON    ?= $(shell command -v python3.11 || command -v python3)
PIP_FLAGS ?=
ARGS      ?=
JOBS      ?= 2

VENV := .venv
BIN  := $(VENV)/bin
# Compiling every module of every package would add half a minute to the first start; Python compiles what it imports.
PIP  := $(BIN)/python -m pip install -qq --no-compile -c constraints.txt $(PIP_FLAGS)

# A file's tests stay in one process: they share a server, a browser, a small training. tests/conftest.py orders the files.
PYTEST = $(BIN)/python -m pytest -n $(JOBS) --dist loadfile --no-loadscope-reorder

.DEFAULT_GOAL := help
.PHONY: help install serve test lint check check-all bench lock licences audit clean

help:
	@echo "make serve      set up what is missing and serve the page on http://127.0.0.1:8000"
	@echo "make test       run the tests (those of the page need Chromium and are skipped without it)"
	@echo "make check      lint, formatting, types and the tests"
	@echo "make check-all  the same with the tests that take minutes"
	@echo "make bench      measure the filters, the maps, the recordings and the page"
	@echo "make lock       pin every package with its hashes in requirements.lock"
	@echo "make licences   list the licences of all packages, and fail where one is not allowed"
	@echo "make audit      ask whether any of them has a known weakness (needs the network)"
	@echo "make install    only set up .venv, with the tools for development"
	@echo "make clean      remove .venv and what the tools left behind"

$(VENV)/installed: pyproject.toml constraints.txt
	@"$(PYTHON)" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { \
	  echo "Beliefscope needs Python 3.11 or newer; '$(PYTHON)' is not. Name one: make PYTHON=/path/to/python3.11" >&2; exit 2; }
	@echo "Setting up $(VENV): about a minute, and downloads of about 600 MB the first time."
	@"$(PYTHON)" -m venv $(VENV)
	@$(PIP) pip
	@$(PIP) -e .
	@touch $@

$(VENV)/installed-dev: $(VENV)/installed
	@echo "Adding the tools for development to $(VENV)."
	@$(PIP) -e '.[dev]'
	@touch $@

install: $(VENV)/installed-dev

serve: $(VENV)/installed
	@$(BIN)/beliefscope serve $(ARGS)

test: install
	@$(PYTEST) $(ARGS)

lint: install
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy src/beliefscope

check: lint test

check-all: lint
	@$(PYTEST) -m "" $(ARGS)

bench: install
	@$(BIN)/python bench/run.py $(ARGS)

# Tools that stay out of .venv: their own requirements are none of ours.
$(VENV)/tools:
	@"$(PYTHON)" -m venv $@
	@$@/bin/python -m pip install -qq $(PIP_FLAGS) uv pip-audit

lock: $(VENV)/tools
	@$(VENV)/tools/bin/uv pip compile pyproject.toml --extra ray --extra export --extra meshes -c constraints.txt \
	  --universal --python-version 3.11 --generate-hashes --no-annotate --no-header -o $(VENV)/lock -q
	@sed '/^[^#]/,$$d' requirements.lock | cat - $(VENV)/lock > $(VENV)/lock.new
	@mv $(VENV)/lock.new requirements.lock

licences: install
	@$(BIN)/python bench/licences.py

audit: $(VENV)/tools
	@$(VENV)/tools/bin/pip-audit --strict --progress-spinner off -r requirements.lock --require-hashes --disable-pip 2>$(VENV)/audit.log || { \
	  if grep -qE "Traceback|not be audited" $(VENV)/audit.log; then \
	    echo "The advisory service was not reached, so nothing is known; $(VENV)/audit.log says more." >&2; \
	  else tail -n 1 $(VENV)/audit.log >&2; fi; exit 1; }

clean:
	rm -rf $(VENV) build dist src/beliefscope.egg-info .pytest_cache .mypy_cache .ruff_cache
