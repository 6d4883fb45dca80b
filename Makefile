# make demo | quick | test | test-long | test-random | bench | check | notebooks | pictures | reruns | site | release: each sets up .venv on
# its first call and never again while pyproject and requirements stay.
# Another Python beside it: make test PYTHON=python3.13 VENV=.venv-3.13
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
# Modules are kept compiled, wherever this runs: else every command compiles two hundred of them anew.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: demo quick test test-long test-random kernels bench check notebooks pictures reruns site release requirements clean

# Packages come by hash, through uv where it is there: what runs need, and for all but `demo` the rest. As with uv, modules
# are compiled when they are first imported: most never are, and compiling all takes two fifths of the time.
INSTALL := $(if $(shell command -v uv),uv pip install --quiet --python $(BIN)/python,$(BIN)/python -m pip install --quiet --no-compile --disable-pip-version-check)

$(VENV)/.installed: pyproject.toml requirements.txt
	$(PYTHON) -c 'import sys; sys.exit("Python 3.11 or newer is needed, this is " + sys.version.split()[0]) if sys.version_info < (3, 11) else None'
	$(PYTHON) -m venv $(VENV)
	$(INSTALL) --require-hashes --requirement requirements.txt
	$(INSTALL) --no-deps --editable .
	touch $@

$(VENV)/.rest: $(VENV)/.installed requirements-dev.txt
	$(INSTALL) --require-hashes --requirement requirements-dev.txt
	touch $@

demo: $(VENV)/.installed
	$(BIN)/copem-replay run logs/tc016d.yaml --out out/tc016d --overwrite
	@echo
	@$(BIN)/python tools/paper.py out/tc016d

# Fills the cache of compiled code with what most tests need, before workers start that would each compile it.
kernels: $(VENV)/.rest
	$(BIN)/copem-replay run logs/crossing.yaml --runs 1 --out out/kernels --overwrite > /dev/null

# Under two minutes on two cores: every room, but not the tests in tests/slow.txt, which tools/slow_tests.py measures.
quick: kernels
	$(BIN)/python -m pytest -q -n 3 --dist loadfile -m "not slow and not long"

# All that guards core and extras; 50 drawn examples.
test: kernels
	$(BIN)/python -m pytest -q -n 3 --dist loadfile -m "not long"

# The rest: commands that are killed, what pages print, real recordings, browsers, other processors; 200 drawn examples.
test-long: kernels
	ALL_EXAMPLES=1 $(BIN)/python -m pytest -q -n 3 --dist loadfile -m "long or hypothesis"

# Every night: the tests with drawn examples, with others each time. A failure prints the seed of all (to be given as SEED)
# and what gives its own example again.
SEED := $(or $(SEED),$(shell date +%s))
test-random: $(VENV)/.rest
	@echo "seed $(SEED)"
	ALL_EXAMPLES=1 RANDOM_EXAMPLES=1 $(BIN)/python -m pytest -q -n 2 -m hypothesis --hypothesis-seed=$(SEED)

bench: $(VENV)/.rest
	$(BIN)/python tools/bench.py

check: $(VENV)/.rest
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

notebooks: $(VENV)/.rest
	$(BIN)/python tools/run_notebooks.py

# Every night: the pictures of README and docs, by the commands beside them.
pictures: $(VENV)/.rest
	$(BIN)/python tools/pictures.py

# Viewers of the minor versions before and after the pinned one, as far as there are any: tests/system/test_viewer.py asks
# them to read what this one writes.
RERUN_MINOR := $(shell sed -n 's/^rerun-sdk==0\.\([0-9]*\)\..*/\1/p' requirements.txt)
reruns:
	for minor in $$(($(RERUN_MINOR) - 1)) $$(($(RERUN_MINOR) + 1)); do \
	  $(PYTHON) -m venv .venv-rerun-0.$$minor; \
	  .venv-rerun-0.$$minor/bin/python -m pip install --quiet --disable-pip-version-check "rerun-sdk==0.$$minor.*" \
	    || { rm -r .venv-rerun-0.$$minor; echo "no rerun-sdk 0.$$minor"; }; \
	done

# out/site, from docs/ by mkdocs.yml; a link or an anchor that leads nowhere stops it.
site: $(VENV)/.rest
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet
	@echo "out/site/index.html; with its search: $(BIN)/mkdocs serve"

# Builds, checks and tries a release, writes its section of the changelog and tags it: docs/develop/release.md.
$(VENV)-release/.installed: requirements-release.txt
	$(PYTHON) -m venv $(VENV)-release
	$(VENV)-release/bin/python -m pip install --quiet --disable-pip-version-check --require-hashes --requirement requirements-release.txt
	touch $@

release: $(VENV)-release/.installed
	$(VENV)-release/bin/python tools/release.py $(RELEASE)

# The files of pins anew, by uv; PINS= takes newer versions. The site needs colorama on every system, runs on Windows alone.
PINS := --constraint requirements.txt --constraint requirements-dev.txt
COMPILE := uv pip compile --quiet pyproject.toml --universal --python-version 3.11 --generate-hashes --no-annotate --no-emit-index-url --no-header
requirements:
	$(COMPILE) $(PINS) --output-file requirements.new
	$(COMPILE) $(PINS) --extra dev --extra bench $$(sed -n '/^colorama==/d;s/^\([A-Za-z0-9._-]*\)==.*/--no-emit-package \1/p' requirements.new) --output-file requirements-dev.new
	(sed -n '/^#/p' requirements.txt; cat requirements.new) > requirements.made && mv requirements.made requirements.txt
	(sed -n '/^#/p;/^-r/p' requirements-dev.txt; cat requirements-dev.new) > requirements.made && mv requirements.made requirements-dev.txt
	$(PYTHON) -c 'import tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))["project"]["optional-dependencies"]["release"], sep="\n")' \
	  | $(subst pyproject.toml,-,$(COMPILE)) $(PINS) --constraint requirements-release.txt --output-file requirements-release.new
	(sed -n '/^#/p' requirements-release.txt; cat requirements-release.new) > requirements.made && mv requirements.made requirements-release.txt
	rm requirements.new requirements-dev.new requirements-release.new

clean:
	rm -rf .venv .venv-* out build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
