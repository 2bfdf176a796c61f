# All commands run in .venv, which is created when it is missing or when the requirements have changed.
#   PYTHON=...     interpreter for .venv (3.11 or newer)
#   PIP_FLAGS=...  additional pip options, such as another package index
#   ARGS=...       additional arguments of the command: make serve ARGS="--port 9000"
#   JOBS=...       number of test processes (3: those of the browser and of servers wait for others)

PYTHON    ?= $(shell command -v python3.11 || command -v python3)
PIP_FLAGS ?=
ARGS      ?=
JOBS      ?= 3

VENV := .venv
BIN  := $(VENV)/bin
# --no-compile: compiling every module of every package adds half a minute; Python compiles modules when they are imported.
PIP  := $(BIN)/python -m pip install -qq --no-compile -c constraints.txt $(PIP_FLAGS)
# Packages to compile for the tests: their processes start at the same time, and each would compile them.
COMPILED := torch scipy numpy matplotlib viser fastapi pydantic
# Otherwise each of the many processes that the tests start would compile PyTorch again: 2 s of CPU time.
export PYTHONDONTWRITEBYTECODE :=

# loadfile: the tests of a file share a server, a browser or a training. tests/conftest.py orders the files and keeps
# those of the browser together.
PYTEST = $(BIN)/python -m pytest -n $(JOBS) --dist loadfile --no-loadscope-reorder

.DEFAULT_GOAL := help
.PHONY: help install serve test test-fast coverage lint lint-page api-types check check-all claims docs bench lock licences audit clean

help:
	@echo "make serve      install what is missing and serve the page on http://127.0.0.1:8000"
	@echo "make install    set up .venv with the development tools"
	@echo "make test-fast  run the tests that need no browser, process or training"
	@echo "make test       run all tests but the long ones (page tests are skipped without Chromium)"
	@echo "make check      lint, formatting, types and tests"
	@echo "make check-all  make check with the long tests"
	@echo "make lint       check formatting, types, import layers and the page's JavaScript"
	@echo "make lint-page  check the page's JavaScript (skipped without Node.js and npm)"
	@echo "make api-types  regenerate the page's types and constants from the server's"
	@echo "make coverage   run the tests and print the coverage of each module"
	@echo "make claims     run the commands named beside the numbers of the documentation and compare (ARGS=--all: long ones too)"
	@echo "make docs       build the documentation site in build/site"
	@echo "make bench      measure filters, maps, recordings and the page"
	@echo "make lock       pin every package with its hashes in requirements.lock"
	@echo "make licences   list the licences of all packages; fail if one is not allowed"
	@echo "make audit      check all packages for known vulnerabilities (needs the network)"
	@echo "make clean      remove .venv and generated files"

$(VENV)/installed: pyproject.toml constraints.txt
	@"$(PYTHON)" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { \
	  echo "Beliefscope needs Python 3.11 or newer, but '$(PYTHON)' is older or missing. Use: make PYTHON=/path/to/python3.11" >&2; exit 2; }
	@echo "Setting up $(VENV): about a minute, and downloads of about 600 MB the first time."
	@"$(PYTHON)" -m venv $(VENV)
	@$(PIP) pip
	@$(PIP) -e '.[attribution,tensorboard]'
	@touch $@

$(VENV)/installed-test: $(VENV)/installed
	@echo "Adding the test tools to $(VENV)."
	@$(PIP) -e '.[test]'
	@$(BIN)/python -m compileall -qq -j 0 $(foreach name,$(COMPILED),$(VENV)/lib/python3*/site-packages/$(name)) || true
	@touch $@

$(VENV)/installed-dev: $(VENV)/installed-test
	@echo "Adding the tools for development to $(VENV)."
	@$(PIP) -e '.[dev]'
	@touch $@

install: $(VENV)/installed-dev

serve: $(VENV)/installed
	@$(BIN)/beliefscope serve $(ARGS)

test: $(VENV)/installed-test
	@$(PYTEST) $(ARGS)

test-fast: $(VENV)/installed-test
	@$(PYTEST) -m "not slow and not browser and not long" $(ARGS)

coverage: $(VENV)/installed-test
	@$(PYTEST) -q --cov=app --cov=datasets --cov=filters --cov=inspect --cov=recordings --cov-report=term $(ARGS)

lint: install lint-page
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy src/beliefscope examples/06_public_calls.py
	@$(BIN)/lint-imports --no-logo --no-cache

# The page has no build step: the Node.js packages of package.json are development tools only.
node_modules: package.json package-lock.json
	@npm ci --silent --no-audit --no-fund
	@touch $@

lint-page: install
	@if command -v node >/dev/null && command -v npm >/dev/null; then \
	  $(MAKE) --no-print-directory node_modules && npm run --silent check && \
	  $(BIN)/python tools/page_constants.py --check && \
	  $(BIN)/python tools/openapi.py --models > $(VENV)/openapi.json && \
	  npm run --silent api-types -- --check; \
	else echo "lint-page skipped: Node.js and npm are not installed."; fi

api-types: install node_modules
	@$(BIN)/python tools/page_constants.py
	@$(BIN)/python tools/openapi.py --models > $(VENV)/openapi.json
	@npm run --silent api-types

check: lint test

check-all: lint
	@$(PYTEST) -m "" $(ARGS)

claims: install
	@$(BIN)/python tools/claims.py $(ARGS)

docs: install
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	@echo "The site is in build/site: open index.html."

bench: install
	@$(BIN)/python bench/run.py $(ARGS)

# Tools with their own environment, so that their requirements stay out of .venv.
$(VENV)/tools:
	@"$(PYTHON)" -m venv $@
	@$@/bin/python -m pip install -qq $(PIP_FLAGS) uv pip-audit

lock: $(VENV)/tools
	@$(VENV)/tools/bin/uv pip compile pyproject.toml --extra all --extra ray -c constraints.txt \
	  --universal --python-version 3.11 --generate-hashes --no-annotate --no-header -o $(VENV)/lock -q
	@sed '/^[^#]/,$$d' requirements.lock | cat - $(VENV)/lock > $(VENV)/lock.new
	@mv $(VENV)/lock.new requirements.lock

licences: install
	@$(BIN)/python bench/licences.py

audit: $(VENV)/tools
	@$(VENV)/tools/bin/pip-audit --strict --progress-spinner off -r requirements.lock --require-hashes --disable-pip 2>$(VENV)/audit.log || { \
	  if grep -qE "Traceback|not be audited" $(VENV)/audit.log; then \
	    echo "Advisory service not reachable, nothing checked; see $(VENV)/audit.log." >&2; \
	  else tail -n 1 $(VENV)/audit.log >&2; fi; exit 1; }

clean:
	rm -rf $(VENV) node_modules build dist src/beliefscope.egg-info .pytest_cache .mypy_cache .ruff_cache
