# A machine with make and Python 3.11 or newer (with venv) is enough: every target first sets up .venv.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
# Robot models of the MuJoCo Menagerie, where this checkout has them beside it; downloaded on first use otherwise.
export MENAGERIE_ROOT ?= $(wildcard $(abspath ../shared/menagerie))
# Go on with a run that an earlier, interrupted call left; start it otherwise.
resume = $(if $(wildcard $(1)/config.yaml),--resume)

.PHONY: help install demo demo-go2 test check study bench bench-brax clean

help:
	@echo 'make install    create $(VENV) from the pinned constraints'
	@echo 'make demo       train arm_reach, evaluate it, write runs/demo/report.html'
	@echo 'make demo-go2   the same for go2_walk, in runs/demo-go2'
	@echo 'make test       run the test suite'
	@echo 'make check      ruff and mypy'
	@echo 'make study      randomised against nominal training, several seeds (an hour; can be interrupted)'
	@echo 'make bench      run the benchmarks'
	@echo 'make bench-brax time to a return against Brax, in .venv-brax (an hour; can be interrupted)'

install: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "simreal needs Python 3.11 or newer; name one with 'make PYTHON=/path/to/python3 $(MAKECMDGOALS)'" >&2; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt hatchling editables
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-build-isolation -c constraints.txt -e '.[dev]'
	@touch $@

demo: $(STAMP)
	$(BIN)/simreal train arm_reach --out runs/demo $(call resume,runs/demo)
	$(BIN)/simreal evaluate runs/demo --require 'train.success>=0.95'

demo-go2: $(STAMP)
	$(BIN)/simreal train go2_walk --out runs/demo-go2 $(call resume,runs/demo-go2)
	$(BIN)/simreal evaluate runs/demo-go2 --require 'train.success>=0.9'

test: $(STAMP)
	$(BIN)/python -m pytest

check: $(STAMP)
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy

study: $(STAMP)
	$(BIN)/python benchmarks/randomization_study.py

bench: $(STAMP)
	$(BIN)/python benchmarks/engine_speed.py
	$(BIN)/python benchmarks/randomization_cost.py

bench-brax: .venv-brax/.installed
	.venv-brax/bin/python benchmarks/against_brax.py

.venv-brax/.installed: pyproject.toml constraints-brax.txt
	test -x .venv-brax/bin/python || $(PYTHON) -m venv .venv-brax
	.venv-brax/bin/python -m pip install --quiet --disable-pip-version-check -c constraints-brax.txt hatchling editables
	.venv-brax/bin/python -m pip install --quiet --disable-pip-version-check --no-build-isolation -c constraints-brax.txt -e .
	@touch $@

clean:
	rm -rf $(VENV) build dist .pytest_cache .mypy_cache .ruff_cache
