# Everything runs in a virtual environment of its own; nothing is installed outside this folder.
PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin
# Versions that were tried together; what is not in the list is free.
PIP    := $(BIN)/python -m pip install --disable-pip-version-check -c requirements.lock

.PHONY: dry-run test slow lint types bench docs pictures lock clean

# Set up and fly the example controller through level 0. More: make dry-run ARGS="--level level3"
dry-run: $(VENV)/run.stamp
	$(BIN)/crazyarena dry-run $(ARGS)

# Set up and run the tests. More: make test ARGS="-k vector"
test: $(VENV)/dev.stamp
	$(BIN)/python -m pytest -n 4 $(ARGS)

slow: $(VENV)/dev.stamp
	$(BIN)/python -m pytest -m slow $(ARGS)

lint: $(VENV)/dev.stamp
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/dev.stamp
	$(BIN)/mypy -p crazyarena
	$(BIN)/basedpyright

bench: $(VENV)/dev.stamp
	for b in benchmarks/[a-z]*.py; do echo "== $$b"; $(BIN)/python $$b || exit 1; done

# The documentation as a site, in site/; broken links fail. Read it: make docs && open site/index.html
docs: $(VENV)/docs.stamp
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

# Make every picture of the docs anew: each script in docs/pictures makes its own.
pictures: $(VENV)/dev.stamp
	for p in docs/pictures/[a-z]*.py; do echo "== $$p"; $(BIN)/python $$p || exit 1; done

# Debian splits venv from python3: where it is missing and we may, install it; else say how.
$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	    { echo "crazyarena needs Python 3.11 or newer; set PYTHON=/path/to/python3.11"; exit 1; }
	@$(PYTHON) -c 'import venv, ensurepip' 2>/dev/null || \
	    { [ "$$(id -u)" = 0 ] && apt-get update -q && apt-get install -qy python3-venv; } || \
	    { echo "Python's venv module is missing; run: sudo apt install python3-venv"; exit 1; }
	$(PYTHON) -m venv $(VENV)

$(VENV)/run.stamp: pyproject.toml | $(BIN)/python
	$(PIP) -e .
	@touch $@

$(VENV)/dev.stamp: pyproject.toml | $(BIN)/python
	$(PIP) -e '.[dev]'
	@touch $@ $(VENV)/run.stamp

$(VENV)/docs.stamp: pyproject.toml | $(BIN)/python
	$(PIP) -e '.[docs]'
	@touch $@ $(VENV)/run.stamp

# Pin the versions again; needs uv.
lock:
	uv pip compile --universal --quiet --no-header pyproject.toml --extra dev --extra all --extra docs -o requirements.lock

clean:
	rm -rf $(VENV) build site .pytest_cache .mypy_cache .ruff_cache
