# Two commands do all the set-up: `make demo` and `make test`.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --constraint constraints.txt --editable
READY := $(VENV)/.ready
STAMP := $(VENV)/.installed

.PHONY: install demo test lint docs bench clean

install: $(STAMP)

# A private environment, rebuilt when what it is made from changes: robins with its extras, to use.
$(READY): pyproject.toml constraints.txt
	@echo "Installing robins with its extras into $(VENV): 1 GB, some minutes. 'make clean' removes it."
	$(PYTHON) -m venv $(VENV)
	$(PIP) '.[all]'
	@touch $@

# And what develops and tests it.
$(STAMP): $(READY)
	@echo "Adding the tools of development and the packages that tests compare with: 1 GB more."
	$(PIP) '.[all,dev]'
	@touch $@

demo: $(READY)
	$(BIN)/robins demo

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

docs: install
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs docs/_build/html

test: lint docs
	$(BIN)/python -m pytest -n 2 --dist loadfile

bench: install
	$(BIN)/python benchmarks/run.py

clean:
	rm -rf $(VENV) docs/_build docs/_generated .pytest_cache .ruff_cache .hypothesis
