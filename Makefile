# Everything a user needs: `make demo` and `make test` set themselves up in .venv and run.
PYTHON ?= python3
BIN := .venv/bin
PACKAGES := models rendering envs udp agents experiments cli

.PHONY: install demo test lint types docs clean

install: .venv/.installed

.venv/.installed: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and \
	  "rotorgram needs Python 3.11 or newer, this is %s; name one: make PYTHON=python3.12" % sys.version.split()[0])'
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check \
	  --constraint constraints.txt --editable '.[dev]'
	@mkdir -p .venv/types/rotorgram
	@for p in $(PACKAGES); do ln -sfn ../../../$$p .venv/types/rotorgram/$$p; done
	@touch $@

# A short comparison: three agents, three seeds; about three minutes on two cores. Too short and too
# few seeds to decide the paper's claims: docs/results.md has the long one.
demo: install
	$(BIN)/rotorgram compare --seeds 3 --env-steps 80000 --episodes 10

test: lint types docs
	$(BIN)/python -m pytest

lint: install
	$(BIN)/ruff check
	$(BIN)/ruff format --check

# mypy does not follow editable installs; .venv/types shows it the packages under their names.
types: install
	MYPYPATH=.venv/types $(BIN)/mypy

# The pages as a site, in build/site: python -m http.server -d build/site. A warning fails it.
docs: install
	$(BIN)/python docs/stage.py
	$(BIN)/zensical build --strict --clean

clean:
	rm -rf .venv *.egg-info build dist .cache .pytest_cache .mypy_cache .ruff_cache .hypothesis
