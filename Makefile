# make run      set up, then train: make run task=laikago_trot method=twostage budget=fast seed=0
# make test     set up, then run the tests
# make check    set up, then lint, format and types
# make setup    the virtual environment .venv with the pinned packages
# make faults   set up, then kill, starve and poison runs: N=50 kills, and every other fault once
# make docs     set up, then build the documentation: build/docs/index.html
# make bench    measure speed
# make compare  measure speed beside other libraries, such as ARGS='--only sb3'
# make gpu-bundle  collect what a machine with a GPU and without a network lacks
# make study    run the trainings of the paper's results, or go on with them: OUT=results/paper
# make clean    remove the files that make and the tests have made, but not runs/
#
# `make run` hands its key=value words to `tsbench run`. Words in capitals are for make: ARGS holds
# other words, such as ARGS='-m seed=0,1', N the number of kills, OUT the results folder, PYTHON the
# interpreter.

SHELL := /bin/bash
.DEFAULT_GOAL := help

VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.set-up
EXTRAS := $(VENV)/.extras
SITE := $(VENV)/.docs
PYTHON ?= $(firstword $(foreach name,python3.12 python3.11 python3,\
	$(shell $(name) -c 'import sys; (3, 11) <= sys.version_info < (3, 13) and print("$(name)")' 2>/dev/null)))
ARGS ?=

# The words of the command line, each quoted for the shell. In MAKEOVERRIDES make doubles every
# dollar and backslash, and puts a backslash before every space.
empty :=
space := $(empty) $(empty)
plain = $(subst \\,\,$(subst $$$$,$$,$(subst <blank>,$(space),$1)))
quoted = '$(subst ','\'',$(call plain,$1))'
given = $(filter-out ARGS=% PYTHON=% N=% OUT=%,$(subst \$(space),<blank>,$(MAKEOVERRIDES)))
words = $(if $(filter task=%,$(given)),,task=laikago_trot) $(foreach word,$(given),$(call quoted,$(word)))

.PHONY: help setup system run test check format faults docs bench compare gpu-bundle study clean

help:
	@sed -n 's/^# \(make .*\)/  \1/p' Makefile

setup: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { echo "tsbench: Python 3.11 or 3.12 is needed; none is on PATH" >&2; exit 2; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || .ci/debian python3-venv
	@test -x $(BIN)/pip || $(PYTHON) -m venv $(VENV)
	@echo "tsbench: installing the pinned packages into $(VENV), which takes some minutes the first time"
	@$(BIN)/python -m pip install -qq --constraint constraints.txt --editable '.[dev]'
	@touch $@

# The libraries that benchmarks/compare.py needs and a run does not.
$(EXTRAS): $(STAMP)
	@$(BIN)/python -m pip install -qq --constraint constraints.txt --editable '.[dev,bench]'
	@touch $@

# What builds the documentation and a run does not need.
$(SITE): $(STAMP)
	@$(BIN)/python -m pip install -qq --constraint constraints.txt --editable '.[dev,docs]'
	@touch $@

run: setup
	@$(BIN)/tsbench run $(words) $(ARGS)

# The tests draw pictures with a software renderer, and pages with a headless browser.
system:
	@.ci/debian libosmesa6 chromium

test: setup system $(EXTRAS)
	$(BIN)/python -m pytest --numprocesses=auto --dist=worksteal $(ARGS)

check: setup $(EXTRAS)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: setup
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

N ?= 50
faults: setup
	$(BIN)/python tests/faults.py --kills $(N) $(ARGS)

docs: setup $(SITE)
	$(BIN)/python -m sphinx --fail-on-warning --keep-going --quiet docs build/docs $(ARGS)
	@echo "tsbench: build/docs/index.html"

bench: setup
	@$(BIN)/tsbench bench $(ARGS)

compare: setup $(EXTRAS)
	@$(BIN)/python benchmarks/compare.py $(ARGS)

gpu-bundle: setup
	@$(BIN)/python benchmarks/bundle.py $(ARGS)

OUT ?= results/paper
study: setup
	@$(BIN)/python benchmarks/study.py benchmarks/paper.txt --out $(OUT) $(ARGS)

clean:
	rm -rf $(VENV) build dist docs/board.md docs/methods docs/tasks screenshots .mypy_cache .pytest_cache .ruff_cache .hypothesis
	find tsbench tests -name __pycache__ -type d -prune -exec rm -rf {} +
