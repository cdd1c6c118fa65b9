# Everything a user needs: `make demo` and `make test` set themselves up in .venv and run.
PYTHON ?= python3
BIN := .venv/bin
PACKAGES := models scenes sim envs udp agents rendering flights training autopilots cli
# The tests start hundreds of short programs: byte code that is kept makes each start faster.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: install demo test test-other-processor test-wheel test-libraries lint types links docs clean

# What trains, draws, reports, records and speaks MAVLink; Ray and the tools of `make test` are left out.
install: .venv/.train,record,render,report,fast,autopilot links

# A short comparison: three agents, three seeds, eight drones; a minute and a half on two cores. Too short
# and too few seeds to decide the paper's claims: docs/results.md has the long one.
demo: .venv/.train,render,report
	$(BIN)/rotorgram compare --seeds 3 --env-steps 80000 --num-envs 8 --episodes 10

# First what may share the two cores, then what measures time, by itself.
test: lint types docs
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -m "not quiet" -n auto --dist worksteal
	$(BIN)/python -m pytest -m quiet

# The tests whose numbers depend on the processor, with the instructions of an older one (AVX2, without
# AVX-512) and in the plainest locale.
test-other-processor: .venv/.dev
	OPENBLAS_CORETYPE=Haswell ATEN_CPU_CAPABILITY=avx2 LC_ALL=C OMP_NUM_THREADS=1 \
	  $(BIN)/python -m pytest -m "not quiet" -n auto --dist worksteal tests/agents tests/sim tests/envs/test_compiled.py

# The wheel, installed without extras into an empty environment, flies from a folder outside of the
# checkout.
test-wheel: .venv/.dev
	PYTHON=$(PYTHON) .ci/wheel

# Other people's libraries fly our envs, in an environment of their own: docs/libraries.md.
test-libraries: .venv-libraries/.made
	.venv-libraries/bin/python studies/libraries.py docs/libraries.md

.venv-libraries/.made: pyproject.toml
	$(PYTHON) -m venv .venv-libraries
	.venv-libraries/bin/python -m pip install --quiet --disable-pip-version-check --editable '.[train,swarm,fast]' \
	  $(shell grep -E '^(torch|numpy|gymnasium|mujoco|stable_baselines3|pettingzoo)==' constraints.txt) \
	  torchrl skrl supersuit rl_zoo3 sb3-contrib
	@touch $@

lint: .venv/.dev
	$(BIN)/ruff check
	$(BIN)/ruff format --check

types: .venv/.dev links
	$(BIN)/mypy

# Editors and mypy do not follow editable installs: .venv/types shows them the packages under their
# names, and pyproject.toml names that folder.
links:
	@mkdir -p .venv/types/rotorgram
	@ln -sfn ../../../rotorgram/__init__.py .venv/types/rotorgram/__init__.py
	@for p in $(PACKAGES); do ln -sfn ../../../$$p .venv/types/rotorgram/$$p; done

# The pages as a site, in build/site: python -m http.server -d build/site. A warning fails it.
docs: .venv/.dev
	$(BIN)/python docs/stage.py
	$(BIN)/zensical build --strict --clean

# .venv/.EXTRA,EXTRA marks that these extras of pyproject.toml are installed.
.venv/.%: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and \
	  "rotorgram needs Python 3.11 or newer, this is %s; name one: make PYTHON=python3.12" % sys.version.split()[0])'
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check \
	  --constraint constraints.txt --editable '.[$*]'
	@touch $@

clean:
	rm -rf .venv .venv-libraries *.egg-info build dist .cache .pytest_cache .mypy_cache .ruff_cache .hypothesis
