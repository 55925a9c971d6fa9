# Every target works in a fresh clone that has only make and python3 (3.11 or newer): the first
# one to run fills .venv with the versions of requirements.lock.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
DOCS_READY := $(VENV)/.docs-ready
OUT := out

.PHONY: demo test browser-test validate lint docs format fuzz pins coverage clean

demo: $(READY)
	$(BIN)/warp-rigid run bunny_pile -o $(OUT)/bunny_pile.usdc --picture $(OUT)/bunny_pile.png
	$(BIN)/warp-rigid run box_stack --compare -o $(OUT)/box_stack.usdc \
		--picture $(OUT)/box_stack.png --contact-sheet $(OUT)/box_stack_sheet.png
	@echo "next: $(BIN)/warp-rigid view seesaw"

test: $(READY)
	$(BIN)/python -m pytest -q

# Needs Debian's package chromium, or CHROMIUM=/path/to/a/chromium.
browser-test: $(READY)
	$(BIN)/python -m pytest -q tests/browser

fuzz: $(READY)
	FUZZ_CASES=10000 $(BIN)/python -m pytest -q tests/fuzz

pins: $(READY)
	$(BIN)/python -m tests.pin_hashes

coverage: $(READY)
	$(BIN)/python -m pytest -q --cov --cov-fail-under=90 $(TESTS)

validate: $(READY)
	$(BIN)/warp-rigid validate -o $(OUT)/validation

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# The site of the documents, warnings as errors: out/site/index.html.
docs: $(DOCS_READY)
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet
	@echo "built $(OUT)/site/index.html"

format: $(READY)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf $(VENV) $(OUT) build *.egg-info .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(READY): requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "python3 must be 3.11 or newer")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check \
		--no-deps --no-build-isolation --editable .
	@touch $@

$(DOCS_READY): $(READY) docs/requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps -r docs/requirements.lock
	@touch $@
