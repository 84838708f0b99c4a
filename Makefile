# Two commands do all on a fresh machine: `make demo` and `make test`.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin

.PHONY: demo test test-slow lint sample-logs clean
.DEFAULT_GOAL := help

help:
	@echo "make demo         recordings in, a fine-tuned policy and a report out (build/demo/report.html)"
	@echo "make test         the tests (make test-slow: the slow ones too)"
	@echo "make lint         ruff and mypy"
	@echo "make sample-logs  record sample_logs/ anew from its seed"

# The stamp files make each target install only what it needs, once per change of pyproject.toml.
$(VENV)/.runtime: pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "Restock needs Python 3.11 or newer: set PYTHON=...")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check -e .
	@touch $@

$(VENV)/.dev: pyproject.toml $(VENV)/.runtime
	$(BIN)/pip install --quiet --disable-pip-version-check -e '.[dev]'
	@touch $@

demo: $(VENV)/.runtime
	$(BIN)/restock demo --out build/demo

test: $(VENV)/.dev
	$(BIN)/python -m pytest

test-slow: $(VENV)/.dev
	$(BIN)/python -m pytest -m ''

lint: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

sample-logs: $(VENV)/.runtime
	$(BIN)/python sample_logs/make.py

clean:
	rm -rf $(VENV) build dist *.egg-info
