# Two commands do all on a fresh machine: `make demo` and `make test`.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin

.PHONY: demo site test test-long test-docs test-all test-slow test-lowest test-ros neighbours lint notebook sample-logs clean
.DEFAULT_GOAL := help

help:
	@echo "make demo         recordings in, a fine-tuned policy and a report out (build/demo/report.html)"
	@echo "make test         the tests (make test-slow: the slow ones and the documentation's too)"
	@echo "make test-long    the tests that take longer, or show in full what a shorter one shows"
	@echo "make site         the documentation as a site, build/site/index.html; a broken link fails"
	@echo "make test-docs    run every block of the documentation as it is printed"
	@echo "make test-all     those three in one run, as CI does"
	@echo "make test-lowest  the tests with the oldest releases of libraries that Restock runs with"
	@echo "make test-ros     the node under rclpy, over DDS on this machine, in a Python of its own"
	@echo "make neighbours   a Python with d3rlpy and lerobot, for the tests that read exports with them"
	@echo "make lint         ruff and mypy"
	@echo "make notebook     run docs/tutorial.md, write its outputs again and build/tutorial.ipynb"
	@echo "make sample-logs  record sample_logs/ again from its seed"

# The stamp files make each target install only what it needs, once per change of pyproject.toml or of
# the C files, which installing compiles where a compiler is.
$(VENV)/.runtime: pyproject.toml $(wildcard src/restock/compiled/*)
	@$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "Restock needs Python 3.11 or newer: set PYTHON=...")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check -e '.[all]'
	@touch $@

$(VENV)/.dev: pyproject.toml $(VENV)/.runtime
	$(BIN)/pip install --quiet --disable-pip-version-check -e '.[dev]'
	@touch $@

demo: $(VENV)/.runtime
	$(BIN)/restock demo --out build/demo

# A process a core, each with whole files: fixtures of a module are made once. Each computes on one
# thread: threads of several processes on the same cores wait for each other at full load.
test test-long test-docs test-all test-lowest test-ros: export OMP_NUM_THREADS = 1
# Many tests start Restock in a process of its own: where the environment forbids files of bytecode,
# each would compile it again, and each of these targets all tests.
test test-long test-docs test-all test-lowest test-ros: export PYTHONDONTWRITEBYTECODE =

test: $(VENV)/.dev
	$(BIN)/python -m pytest -n auto --maxprocesses 4 --dist loadfile

test-long: $(VENV)/.dev
	$(BIN)/python -m pytest -n auto --maxprocesses 4 --dist loadfile -m 'long and not slow and not docs'

test-docs: $(VENV)/.dev
	$(BIN)/python -m pytest -n auto --maxprocesses 4 -m 'docs and not slow'

test-all: $(VENV)/.dev
	$(BIN)/python -m pytest -n auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder -m 'not slow'

site: $(VENV)/.dev
	$(BIN)/python docs/build.py build/pages
	$(BIN)/zensical build --strict

test-slow: $(VENV)/.dev
	$(BIN)/python -m pytest -m ''

# With the oldest releases that pyproject.toml allows, in a Python of their own.
test-lowest: .venv-lowest/.ready
	.venv-lowest/bin/python -m pytest -n auto --maxprocesses 4 --dist loadfile

.venv-lowest/.ready: pyproject.toml $(VENV)/.runtime
	$(PYTHON) -m venv .venv-lowest
	PYTHONPATH=tests $(BIN)/python -m support.lowest > .venv-lowest/constraints.txt
	.venv-lowest/bin/pip install --quiet --disable-pip-version-check -c .venv-lowest/constraints.txt -e '.[test,all]'
	@touch $@

# A Python of its own, with packages beside those of $(VENV) or in place of them.
SITE := -c 'import sysconfig; print(sysconfig.get_path("purelib"))'
define beside
	$(BIN)/python -m venv $(1)
	echo "import site; site.addsitedir('$$($(BIN)/python $(SITE))')" > "$$($(1)/bin/python $(SITE))/beside.pth"
endef

# Where there are no wheels of rclpy the tests are skipped, and say so.
test-ros: .venv-ros/.ready
	.venv-ros/bin/python -m pytest -rs tests/ingest/test_ros.py

.venv-ros/.ready: pyproject.toml | $(VENV)/.dev
	$(call beside,.venv-ros)
	.venv-ros/bin/pip install --quiet --disable-pip-version-check 'restock[ros]'
	@touch $@

# d3rlpy pins an old gymnasium, which pip says that Restock cannot use: the tests that read exports
# back with d3rlpy and lerobot use a Python of their own, where there is one.
neighbours: .venv-neighbours/.ready

.venv-neighbours/.ready: Makefile | $(VENV)/.dev
	$(call beside,.venv-neighbours)
	.venv-neighbours/bin/pip install --quiet --disable-pip-version-check 'd3rlpy>=2.8' \
		datasets pandas av draccus einops jsonlines psutil deepdiff pillow safetensors packaging
	.venv-neighbours/bin/pip install --quiet --disable-pip-version-check --no-deps lerobot accelerate
	@touch $@

lint: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

notebook: $(VENV)/.dev
	PYTHONPATH=tests $(BIN)/python -m support.notebook docs/tutorial.md build

sample-logs: $(VENV)/.runtime
	$(BIN)/python sample_logs/make.py

clean:
	rm -rf $(VENV) .venv-neighbours .venv-lowest .venv-ros build dist *.egg-info
