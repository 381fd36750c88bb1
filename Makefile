# make setup | setup-oldest | demo | test | test-oldest | test-package | test-slow
# make lint | docs | clean
# PYTHON=... EXTRAS=... VENV=... to choose
SHELL := /bin/sh
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/installed
PYTEST_FLAGS ?= -n 2 --dist worksteal
# What is installed. Where torch comes with CUDA, "sb3" takes gigabytes: its tests are
# left out without it.
EXTRAS ?= rl,viz,gym,brax,lanes,test

DEMO := runs/demo
# Enough to learn the task in about two minutes on two cores.
DEMO_STEPS ?= 6000000

.PHONY: setup setup-oldest demo test test-oldest test-oldest-here test-package \
    test-slow lint typecheck format docs clean

setup: $(INSTALLED)

# The first interpreter that really runs (a pyenv shim may exist and not run),
# is new enough, and can make virtual environments.
$(INSTALLED): pyproject.toml constraints.txt
	@set -e; \
	found=; reason="$(or $(PYTHON),python3) does not run here"; \
	for candidate in $(if $(PYTHON),"$(PYTHON)",python3.12 python3.13 python3 python3.11 python); do \
	    "$$candidate" -c '' 2>/dev/null || continue; \
	    if ! "$$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))'; then \
	        reason="$$candidate is older than Python 3.11"; continue; fi; \
	    if ! "$$candidate" -c 'import venv, ensurepip' 2>/dev/null; then \
	        reason="$$candidate has no venv module (on Debian: apt install python3-venv)"; continue; fi; \
	    found=$$candidate; break; \
	done; \
	if [ -z "$$found" ]; then \
	    echo "jaxrod needs Python 3.11 or newer, but $$reason." >&2; \
	    echo "Name one with: make setup PYTHON=/path/to/python3" >&2; exit 1; fi; \
	echo "Setting up $(VENV) with $$("$$found" -V) (a few minutes, once)"; \
	"$$found" -m venv --clear $(VENV)
	@# Python compiles what it imports. All files at once would take longer.
	@$(BIN)/python -m pip install -qq --disable-pip-version-check --no-input \
	    --no-compile -e ".[$(EXTRAS)]" -c constraints.txt
	@touch $@

demo: $(INSTALLED)
	$(BIN)/jaxrod train tracking --variant paper --algorithm ppo \
	    --steps $(DEMO_STEPS) --seed 0 --out $(DEMO) --overwrite
	$(BIN)/jaxrod evaluate $(DEMO)
	$(BIN)/jaxrod render $(DEMO)

test: $(INSTALLED)
	$(BIN)/python -m pytest $(PYTEST_FLAGS) -m "not slow" \
	    --nbmake --nbmake-timeout=600 tests notebooks/01_a_thousand_arms.ipynb

# On the oldest JAX, which Python 3.11 has: the tests of what depends most on JAX's inside.
OLDEST_PYTHON ?= python3.11
OLDEST_TESTS := tests/jax_internals tests/lanes tests/test_compiled_once.py \
    tests/test_doctor.py tests/physics/test_equilibrium.py tests/physics/test_statics.py \
    tests/systems/test_neighbour_lists.py tests/systems/test_one_by_one.py \
    tests/envs/test_protocol.py tests/envs/test_brax.py tests/envs/test_gymnasium.py \
    tests/envs/test_stable_baselines.py tests/envs/test_torch_env.py \
    tests/training/test_contract.py

OLDEST := VENV=build/oldest PYTHON=$(OLDEST_PYTHON)

setup-oldest:
	$(MAKE) setup $(OLDEST)

test-oldest:
	$(MAKE) test-oldest-here $(OLDEST)

test-oldest-here: $(INSTALLED)
	$(BIN)/python -m pytest $(PYTEST_FLAGS) -m "not slow" $(OLDEST_TESTS)

# The package as users get it: the wheel of the source distribution, in a fresh
# environment of each of these Pythons that runs here.
PYTHONS ?= python3.11 python3.12 python3.13
PACKAGE := build/package
define A_ROD
import jaxrod
size = dict(length=1.0, radius=0.05, density=1e3, youngs_modulus=1e7)
rod, state = jaxrod.straight_rod(9, **size)
scene = jaxrod.make_scene(rod, jaxrod.clamp(state), jaxrod.gravity())
print(jaxrod.advance(scene, state, jaxrod.stable_dt(scene), 99))
print(len(jaxrod.envs.names()), "tasks")
endef
export A_ROD

test-package: $(INSTALLED)
	$(BIN)/python -m pytest tests/test_packaging.py
	@rm -rf $(PACKAGE) && mkdir -p $(PACKAGE)
	$(BIN)/python -c 'from setuptools import build_meta as b; b.build_sdist("$(PACKAGE)")' \
	    >$(PACKAGE)/sdist.txt
	$(BIN)/python -m pip wheel -qq --disable-pip-version-check --no-deps \
	    --no-build-isolation -w $(PACKAGE) $(PACKAGE)/jaxrod-*.tar.gz
	@set -e; for python in $(PYTHONS); do \
	    "$$python" -c '' 2>/dev/null || { echo "$$python does not run here"; continue; }; \
	    echo "The wheel on $$("$$python" -V)"; own=$(PACKAGE)/$$python; \
	    "$$python" -m venv "$$own"; \
	    "$$own/bin/python" -m pip install -qq --disable-pip-version-check --no-input \
	        --no-compile $(PACKAGE)/jaxrod-*.whl -c constraints.txt; \
	    (cd "$$own" && bin/python -c "$$A_ROD" && bin/jaxrod doctor); \
	    rm -rf "$$own"; \
	done

test-slow: $(INSTALLED)
	$(BIN)/python -m pytest $(PYTEST_FLAGS) -m slow
	$(BIN)/python -m pytest --nbmake --nbmake-timeout=600 notebooks

lint: $(INSTALLED) typecheck
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

# mypy sees the package as it is installed, envs/ and training/ inside jaxrod, and the
# programs behind its commands.
typecheck: $(INSTALLED)
	@rm -rf build/typecheck && mkdir -p build/typecheck/jaxrod
	@ln -s $(CURDIR)/jaxrod/* $(CURDIR)/envs $(CURDIR)/training build/typecheck/jaxrod/
	@ln -s $(CURDIR)/benchmarks build/typecheck/
	cd build/typecheck && $(CURDIR)/$(BIN)/mypy \
	    --config-file $(CURDIR)/pyproject.toml --cache-dir $(CURDIR)/.mypy_cache -p jaxrod \
	    -p benchmarks.paper -p benchmarks.rod_steps -p benchmarks.tradeoff \
	    -p benchmarks.algorithms

# The site, from what is installed: pip install -e ".[docs]" -c constraints.txt first.
docs: $(INSTALLED)
	@$(BIN)/python -c 'import myst_nb, sphinx_book_theme' 2>/dev/null || \
	    $(BIN)/python -m pip install -qq --disable-pip-version-check --no-input \
	    -e ".[$(EXTRAS),docs]" -c constraints.txt
	$(BIN)/python -m sphinx -W --keep-going -q -b html -c docs . build/site
	@echo "build/site/docs/index.html"

format: $(INSTALLED)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf $(VENV) build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
