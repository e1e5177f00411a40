# `make run` and `make test` set everything up in .venv, by the standard library alone or by uv where it is there.

VENV := .venv
BIN := $(VENV)/bin
RECENT := import sys; sys.exit(sys.version_info < (3, 11))
PYTHON ?= $(shell for python in python3 python3.14 python3.13 python3.12 python3.11; do \
	$$python -c '$(RECENT)' 2>/dev/null && { echo $$python; break; }; done)

.PHONY: run test test-thorough lint docs gpu-budget clean

run: $(VENV)/installed
	$(BIN)/rtcd optimize configs/pendulum_rtcd.yaml

# The tests' programs are small and many: all are kept, and shared by the tests' processes.
test test-thorough: export JAX_COMPILATION_CACHE_DIR ?= $(CURDIR)/.jax_cache
test test-thorough: export JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS ?= 0
test test-thorough: export JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES ?= -1
test: $(VENV)/installed-dev
	$(BIN)/python -m pytest -n 2 --dist loadfile

# What takes a test more than some seconds: whole searches, processes that are killed, terminals, large compilations.
test-thorough: $(VENV)/installed-dev
	$(BIN)/python -m pytest -n 2 --dist loadfile -m 'thorough and not slow'

lint: $(VENV)/installed-dev
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/pyright

# The site of docs/ and of the docstrings, in build/docs; a link that leads nowhere ends it.
docs: $(BIN)/python
	$(call install,'.[docs]')
	$(BIN)/mkdocs build --strict

# What a GPU would have to launch, compiled and counted without one: 224 MB of wheels, some minutes.
gpu-budget: $(VENV)/installed-dev
	$(BIN)/python launch/bench/gpu_budget.py

clean:
	rm -rf $(VENV) .jax_cache .pytest_cache .ruff_cache

$(VENV)/installed: pyproject.toml | $(BIN)/python
	$(call install,.)
	touch $@

$(VENV)/installed-dev: pyproject.toml | $(BIN)/python
	$(call install,'.[dev]')
	touch $@ $(VENV)/installed

$(BIN)/python:
	@test -n '$(PYTHON)' || { echo 'rtcd_jax needs Python 3.11 or newer; found none. Say which: make PYTHON=/path/to/python3.12'; exit 1; }
	@'$(PYTHON)' -c '$(RECENT)' || { echo 'rtcd_jax needs Python 3.11 or newer; $(PYTHON) is older or does not run'; exit 1; }
	'$(PYTHON)' -m venv $(VENV) || { rm -rf $(VENV); echo 'No virtual environment: Debian and Ubuntu need the package python3-venv'; exit 1; }

install = if command -v uv >/dev/null; then uv pip install --python $(BIN)/python -e $(1); \
	else $(BIN)/python -m pip install --disable-pip-version-check -e $(1); fi
