# Everything starts here. `make demo` and `make test` do all the set-up on a fresh machine with Python >= 3.11.
PYTHON ?= python3
BIN := .venv/bin
EACH_CORE := --numprocesses auto --dist loadfile
export OMP_NUM_THREADS ?= 1

.PHONY: install demo test test-long coverage check bench bench-accuracy bench-segment paper pictures docs

install: .venv/installed

.venv/installed: pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(f"Python 3.11 or newer is needed, this is {sys.version.split()[0]}: make PYTHON=python3.12 ..." if sys.version_info < (3, 11) else 0)'
	$(PYTHON) -c 'import ensurepip' 2>/dev/null || { echo 'venv is missing: apt-get install python3-venv'; exit 1; }
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	touch $@

demo: install
	$(BIN)/phytofit demo --out demo

test: install
	$(BIN)/python -m pytest $(EACH_CORE)

test-long: install
	$(BIN)/python -m pytest $(EACH_CORE) -m 'long or not long'

# Lines that `make test` runs: the total and the ten files with the least. Kernels are compiled, can't be traced, and count
# in no figure; what tests run in a process of its own isn't seen either.
coverage: install
	$(BIN)/python -m pytest $(EACH_CORE) --cov --cov-report=
	$(BIN)/python -m coverage report --sort=cover --skip-empty > .coverage.txt
	head -12 .coverage.txt
	tail -1 .coverage.txt

check: install
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy

bench: install
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[bench]'
	$(BIN)/python benchmarks/speed.py

bench-accuracy: install
	$(BIN)/python benchmarks/trust.py
	$(BIN)/python benchmarks/foreign.py
	$(BIN)/python benchmarks/quality.py
	$(BIN)/python benchmarks/robustness.py
	$(BIN)/python benchmarks/evidence.py
	$(BIN)/python benchmarks/leaf_ends.py
	$(BIN)/python benchmarks/sections.py --out docs/images
	$(BIN)/python benchmarks/repeatability.py
	$(BIN)/python benchmarks/accuracy.py

# The paper's tables and figures; stopped, it goes on where it was. FULL=1: without the limits. Open3D, for one picture and
# one column, is left out where it can't be had.
paper: install
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[paper]'
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[peers]' || true
	$(BIN)/python -m evaluation $(if $(FULL),--full)

bench-segment: install
	$(BIN)/python benchmarks/reconstruct.py
	$(BIN)/python benchmarks/segment.py --each
	$(BIN)/python benchmarks/plants.py
	$(BIN)/python benchmarks/neighbours.py

# The pictures of results of real clouds in the README and the documentation; they need ../shared/data.
pictures: install
	$(BIN)/python docs/pictures.py

docs: install
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[docs]'
	$(BIN)/python -m sphinx -W -b html docs docs/_build/html
