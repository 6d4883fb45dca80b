# make demo | test | test-random | bench | check | notebooks | pictures: each sets up .venv on its first call and never again while pyproject and requirements stay.
# Another Python beside it: make test PYTHON=python3.13 VENV=.venv-3.13
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin

.PHONY: demo test test-random bench check notebooks pictures clean

$(VENV)/.installed: pyproject.toml requirements.txt
	$(PYTHON) -c 'import sys; sys.exit("Python 3.11 or newer is needed, this is " + sys.version.split()[0]) if sys.version_info < (3, 11) else None'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes --requirement requirements.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --editable .
	touch $@

demo: $(VENV)/.installed
	$(BIN)/copem-replay run logs/tc016d.yaml --out out/tc016d --overwrite
	@echo
	@$(BIN)/python tools/paper.py out/tc016d

test: $(VENV)/.installed
	$(BIN)/python -m pytest -q -n 2

# Every night: the tests with drawn examples, with others each time. A failure prints the seed of all (to be given as SEED)
# and what gives its own example again.
SEED := $(or $(SEED),$(shell date +%s))
test-random: $(VENV)/.installed
	@echo "seed $(SEED)"
	RANDOM_EXAMPLES=1 $(BIN)/python -m pytest -q -n 2 -m hypothesis --hypothesis-seed=$(SEED)

bench: $(VENV)/.installed
	$(BIN)/python tools/bench.py

check: $(VENV)/.installed
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

notebooks: $(VENV)/.installed
	$(BIN)/python tools/run_notebooks.py

pictures: $(VENV)/.installed
	$(BIN)/python tools/pictures.py

clean:
	rm -rf .venv .venv-* out build *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
