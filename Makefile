# Every target creates .venv if necessary; only Python 3.11 (or newer) and make are required.
# Another interpreter: make test PYTHON=/path/to/python
# Newest versions instead of the pinned ones: make test CONSTRAINTS=

PYTHON ?= $(shell command -v python3.11 || command -v python3 || command -v python)
CONSTRAINTS ?= constraints.txt
VENV := .venv
IN_VENV := $(if $(filter Windows_NT,$(OS)),Scripts,bin)
BIN := $(VENV)/$(IN_VENV)
STAMP := $(VENV)/.installed
PIP := $(BIN)/python -m pip --quiet --disable-pip-version-check --no-input

# Tests of system-dependent code; they need neither a browser nor a compiled kernel.
PORTABLE_TESTS := tests/files tests/captures tests/scene tests/model/test_run_lock.py tests/cli/test_start.py
# Environments in which releases are made and lowest versions are tested.
RELEASE := build/release
LOWEST := build/lowest
TESTING := 'pytest>=8.3' 'hypothesis>=6.100' 'gsply>=0.4' 'pygltflib>=1.16'

.PHONY: help setup browser demo test portable lowest dist lint format docs bench clean
.DEFAULT_GOAL := help

help:
	@echo "make demo     train both methods on the bundled shop window and print where the pictures are"
	@echo "make test     style, types and tests, as in continuous integration"
	@echo "make portable only the tests of system-dependent code: files, captures, scenes, commands"
	@echo "make lowest   the same with the lowest version of every dependency"
	@echo "make dist     wheel and source distribution, checked, installed and tested"
	@echo "make lint     style, types and prose only"
	@echo "make format   rewrite the sources in the project's format"
	@echo "make docs     the documentation as a site, in build/docs"
	@echo "make bench    measure the kernels and the methods"
	@echo "make setup    only create .venv"
	@echo "make browser  install Chromium for the tests of pages, from Debian's packages (asks for sudo where needed)"
	@echo "make clean    remove .venv and every cache"

setup: $(STAMP)

# The stamp is written last, so an interrupted installation is repeated.
$(STAMP): pyproject.toml constraints.txt
	@"$(PYTHON)" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "glassplat needs Python 3.11 or newer; '$(PYTHON)' is not. Try: make PYTHON=/path/to/python3.11" >&2; exit 1; }
	@echo "Setting up $(VENV) (downloads PyTorch, takes a few minutes the first time) ..."
	@"$(PYTHON)" -m venv --clear $(VENV)
	@$(PIP) install $(addprefix --constraint ,$(CONSTRAINTS)) --config-settings editable_mode=compat --editable '.[dev]'
	@touch $@

# Without Chromium, tests of pages are skipped, and listed as skipped.
browser:
	@command -v chromium >/dev/null || \
		{ as_root=$$([ "$$(id -u)" = 0 ] || echo sudo); $$as_root apt-get update -q && \
		$$as_root apt-get install -q -y chromium; }

demo: $(STAMP)
	$(BIN)/glassplat demo

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python -m tools.check_prose

test: lint
	$(BIN)/python -m pytest --numprocesses=logical --maxprocesses=8 --dist=worksteal --durations=15

portable: $(STAMP)
	$(BIN)/python -m pytest $(PORTABLE_TESTS)

# uv, because pip cannot select the lowest versions.
lowest:
	"$(PYTHON)" -m venv --clear $(LOWEST)
	$(LOWEST)/$(IN_VENV)/python -m pip --quiet install uv
	$(LOWEST)/$(IN_VENV)/uv pip install --quiet --python $(LOWEST) --resolution lowest-direct \
		--editable '.[prepare,view,video,heic,formats]' $(TESTING)
	$(LOWEST)/$(IN_VENV)/python -m pytest $(PORTABLE_TESTS) tests/kernels/test_cache.py
	$(LOWEST)/$(IN_VENV)/glassplat demo --iterations 8 --output $(LOWEST)/demo

dist:
	rm -rf dist $(RELEASE)
	"$(PYTHON)" -m venv $(RELEASE)
	$(RELEASE)/$(IN_VENV)/python -m pip --quiet install build twine
	$(RELEASE)/$(IN_VENV)/python -m build
	$(RELEASE)/$(IN_VENV)/python -m twine check --strict dist/*
	$(RELEASE)/$(IN_VENV)/python -m pip --quiet install dist/*.whl
	cd $(RELEASE) && $(IN_VENV)/glassplat --version && $(IN_VENV)/glassplat --help >/dev/null
	cd $(RELEASE) && $(IN_VENV)/python -c 'import glassplat; glassplat.load'
	$(RELEASE)/$(IN_VENV)/python -m pip --quiet install $$(echo dist/*.whl)'[prepare,view,video,heic,formats]' $(TESTING)
	tar --extract --file dist/*.tar.gz --directory $(RELEASE)
	cd $(RELEASE)/glassplat-*/ && ../$(IN_VENV)/python -m pytest $(PORTABLE_TESTS)

format: $(STAMP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

docs: $(STAMP)
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict

bench: $(STAMP)
	$(BIN)/python -m benchmarks

clean:
	rm -rf $(VENV) build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
