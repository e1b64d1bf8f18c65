# Two commands do all the set-up: `make demo` and `make test`.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# By uv, at the index that pip is set up for; where uv is not to be had or fails, by pip in minutes.
WHAT = --constraint constraints.txt --editable '.[$(EXTRAS)]'
INDEX = $(BIN)/python -m pip config list | sed -n "s/.*\.index-url='\(.*\)'/\1/p" | tail -n 1
UV = UV_DEFAULT_INDEX="$${UV_DEFAULT_INDEX:-$$($(INDEX))}" $(BIN)/python -m uv pip install
INSTALL = $(UV) --python $(BIN)/python --compile-bytecode $(WHAT) || \
	{ echo "uv failed; pip takes some minutes."; $(BIN)/python -m pip install $(WHAT); }
READY := $(VENV)/.ready
STAMP := $(VENV)/.installed

.PHONY: install demo lint docs pages fast check test certify costs bench watch profile clean

install: $(STAMP)

# A private environment, rebuilt when what it is made from changes: robins with its extras, to use.
$(READY): EXTRAS = all
$(READY): pyproject.toml constraints.txt
	@echo "Installing robins with its extras into $(VENV): 1 GB. 'make clean' removes it."
	$(PYTHON) -m venv $(VENV)
	-$(BIN)/python -m pip install --quiet uv
	@$(INSTALL)
	@# Where writing bytecode is forbidden, every start would read all of robins as text.
	@$(BIN)/python -m compileall -q src
	@touch $@

# And what develops and tests it.
$(STAMP): EXTRAS = all,dev
$(STAMP): $(READY)
	@echo "Installing the development tools and the packages that tests compare with: 1 GB more."
	@$(INSTALL)
	@touch $@

demo: $(READY)
	$(BIN)/robins demo

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

SPHINX = $(BIN)/python -m sphinx -W --keep-going -q -d docs/_build/doctrees
docs: install
	$(SPHINX) -b html docs docs/_build/html

# The documents read and their links resolved, without writing pages.
pages: install
	$(SPHINX) -b dummy docs docs/_build/dummy

# Of the tests three tiers, by cost; tests/tiers.py says which is in which.
# Without bytecode, which some machines forbid, every process would read all of robins as text.
PYTEST = env -u PYTHONDONTWRITEBYTECODE $(BIN)/python -m pytest --numprocesses 2 --dist loadfile --no-loadscope-reorder

# Without checks of annotations, which cost more than these tests.
fast: install
	UNCHECKED=1 $(PYTEST) -m fast

check: install
	$(MAKE) --jobs 2 lint fast

test: install
	$(MAKE) --jobs 2 lint pages
	$(PYTEST)

certify: install
	CERTIFICATE=docs/certified.md $(PYTEST) -m "certify or hypothesis" --hypothesis-profile=thousand

# What each file of tests costs, from an empty cache, against the budget of tests/budget.toml.
# FILES="tests/sim/test_orbit.py ..." measures those files only.
costs: install
	rm -rf .pytest_cache/costs
	COSTS=$(if $(FILES),some,all) JAX_COMPILATION_CACHE_DIR=$(CURDIR)/.pytest_cache/costs $(PYTEST) $(FILES)
	$(BIN)/python tests/budget.py

bench: install
	$(BIN)/python benchmarks/run.py

# At every save the fast tests that run what was changed; the first round runs them all.
watch: install
	@mkdir -p .pytest_cache
	UNCHECKED=1 TESTMON_DATAFILE=.pytest_cache/testmon $(BIN)/watchfiles --filter python \
		'$(BIN)/python -m pytest -q -m fast --testmon-forceselect' src tests

# Where a command of robins spends its time: make profile CMD="run satellite/s1 --runs 2"
profile: PAGE := profiles/$(shell date +%Y-%m-%d-%H%M%S).html
profile: install
	$(if $(CMD),,$(error Say what to profile: make profile CMD="run satellite/s1 --runs 2"))
	@mkdir -p profiles
	$(BIN)/pyinstrument --renderer html --outfile $(PAGE) $(BIN)/robins $(CMD)
	@echo 'Wrote $(PAGE): open it in a browser.'

clean:
	rm -rf $(VENV) docs/_build docs/_generated .pytest_cache .ruff_cache .hypothesis profiles
