# make demo | test | bench | check | notebooks | pictures: each sets up .venv on its first call and never again while pyproject and constraints stay.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: demo test bench check notebooks pictures clean

.venv/.installed: pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit("Python 3.11 or newer is needed, this is " + sys.version.split()[0]) if sys.version_info < (3, 11) else None'
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev]'
	touch $@

demo: .venv/.installed
	$(BIN)/copem-replay run logs/tc016d.yaml --out out/tc016d --overwrite
	@echo
	@$(BIN)/python tools/paper.py out/tc016d

test: .venv/.installed
	$(BIN)/python -m pytest -q -n 2

.venv/.peers: .venv/.installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[bench]'
	touch $@

bench: .venv/.peers
	$(BIN)/python tools/bench.py

check: .venv/.installed
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

notebooks: .venv/.installed
	$(BIN)/python tools/run_notebooks.py

pictures: .venv/.installed
	$(BIN)/python tools/pictures.py

clean:
	rm -rf .venv out build *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
