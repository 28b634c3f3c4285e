# A fresh machine needs Python >= 3.11, git and make; everything else comes into .venv at the first call.
# Another Python: `make demo PYTHON=python3.12`.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check

# Tests run in parallel, and matrix products of many threads in many processes fight for the cores.
SINGLE_THREAD := OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1
WORKERS := auto --maxprocesses 8

.DEFAULT_GOAL := help
.PHONY: help demo test lint docs pytest studies bench clean

help:  ## Say what there is
	@grep -hE '^[a-z]+:.*## ' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "make %-8s %s\n", $$1, $$2}'

demo: $(VENV)/.installed  ## A star through an 8 m telescope, its wavefront, a picture and the error in nm
	$(BIN)/nlcwfs demo

test: lint docs pytest  ## Everything that CI runs; ends with the summary of the tests

lint: $(VENV)/.installed-dev  ## Style, format, types, and light that only travels forward
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	PYRIGHT_PYTHON_IGNORE_WARNINGS=1 $(BIN)/pyright
	$(BIN)/lint-imports

docs: $(VENV)/.installed-dev  ## The pages of docs/ as HTML in docs/_build; a warning is an error
	$(BIN)/sphinx-build -W --keep-going -q -b html docs docs/_build
	@echo "Open docs/_build/index.html"

pytest: $(VENV)/.installed-dev  ## Tests and the examples in the docstrings
	$(SINGLE_THREAD) $(BIN)/pytest -n $(WORKERS) --dist loadfile -q

studies: $(VENV)/.installed-dev  ## The stored studies again, and the tests that take minutes
	$(BIN)/nlcwfs study studies/01-single-frame
	$(BIN)/nlcwfs study studies/02-every-method
	$(BIN)/nlcwfs sweep studies/03-closed-loop
	$(BIN)/nlcwfs sweep studies/04-faint-stars
	$(BIN)/nlcwfs sweep studies/05-fewer-planes
	$(BIN)/nlcwfs sensitivity studies/06-sensitivity
	$(BIN)/nlcwfs sensitivity studies/07-contrast/sensors
	$(BIN)/nlcwfs contrast studies/07-contrast/loop.toml --loop --out studies/07-contrast
	$(BIN)/nlcwfs contrast studies/07-contrast/contrast.toml --out studies/07-contrast
	$(BIN)/nlcwfs sweep studies/08-planes-and-pixels
	$(BIN)/nlcwfs sensitivity studies/09-one-family
	$(BIN)/nlcwfs sweep studies/10-colour-loop
	$(BIN)/nlcwfs study studies/11-sparse-pupil
	$(BIN)/nlcwfs study studies/12-whole-wavelengths
	$(BIN)/nlcwfs study studies/13-no-chromatic-lenses
	$(BIN)/nlcwfs study studies/14-sky-budgets
	$(BIN)/nlcwfs study studies/15-any-pupil
	$(BIN)/nlcwfs sweep studies/16-loop-on-the-sky
	$(SINGLE_THREAD) $(BIN)/pytest -n $(WORKERS) --dist loadfile -q -m slow

bench: $(VENV)/.installed  ## Time of the reconstructors against that of their own FFTs, and of a frame of the loop
	$(BIN)/python bench/gerchberg_saxton.py
	$(BIN)/python bench/maximum_a_posteriori.py
	$(BIN)/python bench/loop_speed.py

clean:  ## Back to a fresh clone, but for changes of yours
	rm -rf $(VENV) docs/_build docs/_generated demo dist .pytest_cache .ruff_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo "nlcwfs needs Python >= 3.11, got `$(PYTHON) --version`; try make PYTHON=python3.12"; exit 1; }
	$(PYTHON) -m venv $(VENV)

$(VENV)/.installed: pyproject.toml | $(BIN)/python
	$(PIP) install --quiet -e .
	@touch $@

$(VENV)/.installed-dev: pyproject.toml | $(BIN)/python
	$(PIP) install --quiet -e '.[test,docs]'
	@touch $@ $(VENV)/.installed
