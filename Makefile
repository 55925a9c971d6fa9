# Every target works in a fresh clone that has only make and python3 (3.11 or newer, with its own pip): the first one to
# run fills .venv with the versions of requirements.lock.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
ROBOTS := $(VENV)/robots
ROBOTS_READY := $(VENV)/.robots-ready
FRAMEWORKS_READY := $(VENV)/.frameworks-ready
OUT := out
# The tests start hundreds of processes, each of which would compile all Python files anew.
export PYTHONDONTWRITEBYTECODE :=
# A lock is installed as it is: it holds every need, so that nothing is looked up, and a later version changes nothing.
# uv takes a tenth of the time of pip. It knows neither the settings nor the indexes of pip, which follows where uv fails.
PIP := -m pip
INSTALL := $(PIP) install --quiet --disable-pip-version-check --no-deps
LOCKED := --require-hashes --only-binary :all: -r
UV := $(BIN)/uv pip install --quiet --no-deps
# The environment, the lock.
install_lock = $(UV) --python $(1)/bin/python $(LOCKED) $(2) || $(1)/bin/python $(INSTALL) $(LOCKED) $(2)
COMPILE := $(BIN)/uv pip compile --quiet --universal --python-version 3.11 --only-binary :all: \
	--generate-hashes --no-annotate --no-strip-extras --custom-compile-command "make locks" $(UPGRADE)
PYTEST := $(BIN)/python -m pytest -q
# Besides the version of PYTHON; the tests are those of files that use most of the standard library and the dependencies.
OTHER_PYTHONS := 3.12 3.13
PART := public_names packaging simulator determinism cli sweep_files usd_export viewer_parts
# Only the files with tests that measure time are read to run these.
QUIET = $$(grep -rl 'mark\.quiet' tests --include='test_*.py')
# One worker a core; the tests of a file stay together, for they share what is costly to make. The longest files first.
WORKERS := -n auto --dist loadfile --no-loadscope-reorder

.PHONY: demo test test-all other-pythons other-python-test frameworks environments browser-test fuzz soak dist pins locks validate lint docs format clean

# Two scenes: films, pictures and a contact sheet in out/.
demo: $(READY)
	$(BIN)/warp-rigid run bunny_pile -o $(OUT)/bunny_pile.usdc --picture $(OUT)/bunny_pile.png
	$(BIN)/warp-rigid run box_stack --compare -o $(OUT)/box_stack.usdc \
		--picture $(OUT)/box_stack.png --contact-sheet $(OUT)/box_stack_sheet.png
	@echo "next: $(BIN)/warp-rigid view seesaw"

# The tests that every change must pass: at most 8 minutes on 2 cores. CI runs all tests.
test: $(READY) $(ROBOTS_READY)
	$(PYTEST) $(WORKERS) -m "not long and not quiet"

# All tests: also the long ones, and those that measure time, last and alone. The coverage of the host code is that of
# the tests that are neither long nor measure time.
test-all: $(READY) $(ROBOTS_READY)
	$(PYTEST) $(WORKERS) -m "not quiet" --cov --cov-fail-under=90; others=$$?; \
	$(PYTEST) -m quiet $(QUIET) && exit $$others

# A part of the tests with each other supported version of Python that is installed, in environments of their own.
other-pythons:
	@for version in $(OTHER_PYTHONS); do \
		export PYENV_VERSION=$$version; \
		python$$version -V || { echo "Python $$version is not installed and was not tested"; continue; }; \
		$(MAKE) --no-print-directory VENV=.venv-$$version PYTHON=python$$version other-python-test || exit 1; \
	done

other-python-test: $(READY)
	$(PYTEST) $(WORKERS) $(addprefix tests/test_,$(addsuffix .py,$(PART)))

# PyTorch, JAX and gymnasium (6 GB): the tests of their pages run where these are installed.
frameworks: $(FRAMEWORKS_READY)

# All environments; `make -j 2` installs them side by side.
environments: $(ROBOTS_READY) $(FRAMEWORKS_READY)

# The viewer in a real page. Needs Debian's package chromium, or CHROMIUM=/path/to/a/chromium.
browser-test: $(READY) $(ROBOTS_READY)
	$(PYTEST) tests/browser

# 10 000 new cases of random invalid input: meshes, files, scenes, values, commands, the socket, threads, kills, full disks; and
# 200 random scenes that are reset, saved and changed.
fuzz: $(READY)
	FUZZ_CASES=10000 $(PYTEST) tests/fuzz
	FORGETTING_SCENES=200 $(PYTEST) -m long tests/test_forgetting.py

# A pile from which bodies are removed and to which they return, over many steps.
soak: export SOAK_STEPS ?= 1000000
soak: $(READY)
	$(PYTEST) -s tests/test_soak.py -k trace

# Wheel and sdist of the last commit, of the same bytes every time: out/dist.
dist: $(READY)
	$(BIN)/python docs/make_dist.py $(OUT)/dist

# Renew the pinned results of ten scenes.
pins: $(READY)
	$(BIN)/python -m tests.pin_hashes

# Renew the locks and the bill of materials after a change of pyproject.toml. Versions stay where they suit;
# `make locks UPGRADE=--upgrade` takes the newest.
locks: $(READY)
	$(COMPILE) pyproject.toml --extra dev -o requirements.lock
	$(COMPILE) --group robots -o tests/robots.lock
	$(COMPILE) --group frameworks --constraints requirements.lock -o tests/frameworks.lock
	$(BIN)/python docs/make_sbom.py

# Measure every validation case: tables and figures in out/validation/.
validate: $(READY)
	$(BIN)/warp-rigid validate -o $(OUT)/validation

# Rules, format and types; changes nothing.
lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# The site of the documents, warnings as errors: out/site/index.html.
docs: $(READY)
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet
	@echo "built $(OUT)/site/index.html"

# Automatic corrections of ruff.
format: $(READY)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# Remove the environment, the results and all caches of the checkout.
clean:
	rm -rf $(VENV) .venv-* $(OUT) build *.egg-info .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(READY): requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "python3 must be 3.11 or newer")'
	$(PYTHON) -m venv $(VENV)
	awk '/^[^ ]/ { is_uv = /^uv==/ } is_uv' requirements.lock > $(VENV)/uv.lock
	$(BIN)/python $(INSTALL) $(LOCKED) $(VENV)/uv.lock
	$(call install_lock,$(VENV),requirements.lock)
	$(BIN)/python $(INSTALL) --no-build-isolation --editable .
	@touch $@

# The converters of robots' files have an environment of their own, and links to them beside the interpreter. They need
# Python 3.11 or 3.12: elsewhere their tests are skipped.
$(ROBOTS_READY): $(READY) tests/robots.lock
	@if $(PYTHON) -c 'import sys; sys.exit(sys.version_info >= (3, 13))'; then \
		$(PYTHON) -m venv --clear $(ROBOTS) && \
		{ $(call install_lock,$(ROBOTS),tests/robots.lock); } && \
		ln -sf ../robots/bin/mujoco_usd_converter ../robots/bin/urdf_usd_converter $(BIN)/; \
	else echo "no converters of robots' files for this Python: their tests are skipped"; fi
	@touch $@

$(FRAMEWORKS_READY): $(READY) tests/frameworks.lock
	$(call install_lock,$(VENV),tests/frameworks.lock)
	@touch $@
