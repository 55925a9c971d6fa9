# Every target works in a fresh clone that has only make and python3 (3.11 or newer): the first
# one to run fills .venv with the versions of requirements.lock.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
DOCS_READY := $(VENV)/.docs-ready
ROBOTS := $(VENV)/robots
ROBOTS_READY := $(VENV)/.robots-ready
OUT := out
TORCH := $(OUT)/torch
# A command that prints a lock file: with its hashes where they are those of the platform's wheels.
HASHED := $(filter Linux-x86_64-%,$(shell $(PYTHON) -c 'import platform as p, sys; \
	print(p.system(), p.machine(), "%d.%d" % sys.version_info[:2], sep="-")'))
WITHOUT_HASHES := sed 's/ --hash=[^ ]*//g'
LOCKED := $(if $(filter %-3.11 %-3.12,$(HASHED)),cat,$(WITHOUT_HASHES))
DOCS_LOCKED := $(if $(filter %-3.12 %-3.13,$(HASHED)),cat,$(WITHOUT_HASHES))
PYTEST := $(BIN)/python -m pytest -q
# One worker a core; the tests of a file stay together, for they share what is costly to make.
WORKERS := -n auto --dist loadfile

.PHONY: demo test test-all browser-test torch-test fuzz dist pins validate lint docs format clean

# Two scenes: films, pictures and a contact sheet in out/.
demo: $(READY)
	$(BIN)/warp-rigid run bunny_pile -o $(OUT)/bunny_pile.usdc --picture $(OUT)/bunny_pile.png
	$(BIN)/warp-rigid run box_stack --compare -o $(OUT)/box_stack.usdc \
		--picture $(OUT)/box_stack.png --contact-sheet $(OUT)/box_stack_sheet.png
	@echo "next: $(BIN)/warp-rigid view seesaw"

# The tests that every change must pass: about 4 minutes on 2 cores. Tests that measure time run last, alone.
test: $(READY) $(ROBOTS_READY)
	$(PYTEST) $(WORKERS) -m "not long and not quiet"; others=$$?; \
	$(PYTEST) -m "quiet and not long" && exit $$others

# The long tests too, with the coverage of the host code.
test-all: $(READY) $(ROBOTS_READY)
	$(PYTEST) $(WORKERS) -m "not quiet" --cov --cov-report=; others=$$?; \
	$(PYTEST) -m quiet --cov --cov-append --cov-fail-under=90 && exit $$others

# The viewer in a real page. Needs Debian's package chromium, or CHROMIUM=/path/to/a/chromium.
browser-test: $(READY) $(ROBOTS_READY)
	$(PYTEST) tests/browser

# The programs that use PyTorch, with the packages of .venv and PyTorch in an environment of its own.
torch-test: $(READY)
	$(PYTHON) -m venv $(TORCH)
	$(TORCH)/bin/python -m pip install --quiet --disable-pip-version-check torch==2.13.0
	$(BIN)/python -c 'import sysconfig as s; print("import site; site.addsitedir(%r)" % s.get_path("purelib"))' \
		>$$($(TORCH)/bin/python -c 'import sysconfig as s; print(s.get_path("purelib"))')/packages.pth
	$(TORCH)/bin/python -m pytest -q -k "torch or program or network" tests/test_readme.py tests/test_sweep_docs.py

# 10 000 new cases of wild input: meshes, files, scenes, values, commands, the socket, threads, kills, full disks.
fuzz: $(READY)
	FUZZ_CASES=10000 $(PYTEST) tests/fuzz

# Wheel and sdist of the last commit, of the same bytes every time: out/dist.
dist: $(READY)
	$(BIN)/python docs/make_dist.py $(OUT)/dist

# Renew the pinned results of ten scenes.
pins: $(READY)
	$(BIN)/python -m tests.pin_hashes

# Measure every validation case: tables and figures in out/validation/.
validate: $(READY)
	$(BIN)/warp-rigid validate -o $(OUT)/validation

# Rules, format and types; changes nothing.
lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# The site of the documents, warnings as errors: out/site/index.html.
docs: $(DOCS_READY)
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet
	@echo "built $(OUT)/site/index.html"

# What ruff can correct by itself.
format: $(READY)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# Remove the environment, the results and all caches of the checkout.
clean:
	rm -rf $(VENV) $(OUT) build *.egg-info .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(READY): requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "python3 must be 3.11 or newer")'
	$(PYTHON) -m venv $(VENV)
	$(LOCKED) requirements.lock >$(VENV)/requirements.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r $(VENV)/requirements.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check \
		--no-deps --no-build-isolation --editable .
	@touch $@

# The converters of robots' files have an environment of their own, and links to them beside the interpreter. They need
# Python 3.11 or 3.12: elsewhere their tests are skipped.
$(ROBOTS_READY): $(READY) tests/robots.lock
	@if $(PYTHON) -c 'import sys; sys.exit(sys.version_info >= (3, 13))'; then \
		$(PYTHON) -m venv $(ROBOTS) && \
		$(LOCKED) tests/robots.lock >$(VENV)/robots-requirements.txt && \
		$(ROBOTS)/bin/python -m pip install --quiet --disable-pip-version-check --no-deps -r $(VENV)/robots-requirements.txt && \
		ln -sf ../robots/bin/mujoco_usd_converter ../robots/bin/urdf_usd_converter $(BIN)/; \
	else echo "no converters of robots' files for this Python: their tests are skipped"; fi
	@touch $@

$(DOCS_READY): $(READY) docs/requirements.lock
	$(DOCS_LOCKED) docs/requirements.lock >$(VENV)/docs-requirements.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps -r $(VENV)/docs-requirements.txt
	@touch $@
