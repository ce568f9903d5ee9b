# make test   everything that must hold: lint, types, rooms, tests
# make demo   a minute of a live fleet of three drones; says where its report is
# make test-compose  build the images and fly the compose fleets (skipped without a container engine)
# make docs   the configuration reference anew, and the documentation as a site in build/site
# make lock   resolve the dependencies anew and write requirements.lock
# make lowest run the tests with the lowest version of each dependency that pyproject.toml admits

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
PIP_OPTIONS := --disable-pip-version-check --progress-bar off --quiet
IS_NEW_ENOUGH := import sys; sys.exit(sys.version_info < (3, 11) and "fleetloc needs Python 3.11 or newer, found " + sys.version.split()[0] + "; choose one with: make PYTHON=python3.12")
# what the tests need besides dev: every extra that a command can lack
EXTRAS := report,studies,ulog,sitl
DEMO_FOLDER := out/demo
DEMO_SECONDS := 60

.PHONY: test demo test-compose docs lock lowest clean

test: $(INSTALLED)
	$(BIN)/ruff check
	@# the kernels are compiled beside the check of types, so that tests do not wait for each other's
	$(BIN)/fleetloc warmup -q & warmed=$$!; $(BIN)/mypy && wait $$warmed
	$(BIN)/lint-imports
	@# neighbouring tests stay with one worker: what a file flies once is flown once, and live fleets follow each other
	$(BIN)/pytest -n 2 --dist worksteal

demo: $(INSTALLED)
	$(BIN)/fleetloc fleet configs/line3.toml --duration $(DEMO_SECONDS) --out $(DEMO_FOLDER)
	@echo "open $(DEMO_FOLDER)/report.html in a browser; the figures are in $(DEMO_FOLDER)/report.json"

test-compose:
	$(PYTHON) tests/compose/run_compose.py
	$(PYTHON) tests/compose/run_compose.py --lossy

docs: $(INSTALLED)
	mkdir -p build
	$(BIN)/python -m fleetloc.config_reference > build/configuration.md
	mv build/configuration.md docs/configuration.md
	$(BIN)/python -m pip install $(PIP_OPTIONS) 'mkdocs>=1.6'
	$(BIN)/mkdocs build --strict

# The stamp is newer than the lock and the project file exactly when both are installed.
$(INSTALLED): requirements.lock pyproject.toml
	@test -x $(BIN)/python || { $(PYTHON) -c '$(IS_NEW_ENOUGH)' && $(PYTHON) -m venv $(VENV); }
	@$(BIN)/python -c '$(IS_NEW_ENOUGH)'
	@echo "installing into $(VENV) (a minute or two)"
	@$(BIN)/python -m pip install $(PIP_OPTIONS) -r requirements.lock
	@$(BIN)/python -m pip install $(PIP_OPTIONS) --no-deps --editable .
	@touch $@

# Python 3.14 has compilers of its own (pyproject.toml); the lines for it are kept as they are written in the lock
lock:
	$(PYTHON) -c '$(IS_NEW_ENOUGH)'
	rm -rf build/lock
	$(PYTHON) -m venv build/lock
	build/lock/bin/python -m pip install $(PIP_OPTIONS) '.[dev,$(EXTRAS)]'
	{ echo "# Every package of a working environment, pinned; made by make lock."; \
	  build/lock/bin/python -m pip freeze --all --exclude fleetloc --exclude pip \
	    | sed -E 's/^(llvmlite|numba|numpy)==.*/& ; python_version < "3.14"/'; \
	  grep '>= "3.14"$$' requirements.lock; } | sort -f > build/requirements.lock
	mv build/requirements.lock requirements.lock
	rm -rf build/lock

lowest:
	$(PYTHON) -c '$(IS_NEW_ENOUGH)'
	rm -rf build/lowest
	$(PYTHON) -m venv build/lowest
	$(PYTHON) -c 'import tomllib; p = tomllib.load(open("pyproject.toml", "rb"))["project"]; \
	  extras = p["optional-dependencies"]; \
	  print(*p["dependencies"], *(each for name in "dev,$(EXTRAS)".split(",") for each in extras[name]), sep="\n")' | sort -u | sed 's/>=/==/' > build/lowest.txt
	build/lowest/bin/python -m pip install $(PIP_OPTIONS) -r build/lowest.txt
	build/lowest/bin/python -m pip install $(PIP_OPTIONS) --no-deps --editable .
	build/lowest/bin/python -m pytest -n 2

clean:
	rm -rf $(VENV) build out .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache *.egg-info
