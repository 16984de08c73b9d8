# depthrig: `make demo` shows what it does, `make test` proves it. Both install what is missing (tools/setup.sh).
SHELL := /bin/bash
.DEFAULT_GOAL := help

# Extra arguments for the demo: make demo ARGS="--seconds 30"
ARGS ?=
# Real sensor pictures for the tests.
export DEPTHRIG_TEST_DATA ?= $(abspath ../shared/data)

READERS := tests/readers
VENV := .venv
# LeRobot brings PyTorch, so it has an environment of its own, and a Python of 3.12 or later if there is one.
LEROBOT := .venv-lerobot
REQUIREMENTS := python/requirements-test.txt $(READERS)/requirements.txt

.PHONY: help demo test lint bench clean setup-build setup-test

help: ## show this list
	@sed -nE 's/^([a-z-]+):.*## (.*)/\1|\2/p' $(MAKEFILE_LIST) | awk -F'|' '{printf "  make %-7s %s\n", $$1, $$2}'

demo: setup-build ## the seven-camera rig with synthetic cameras: record, verify, replay, report
	cargo build --release --package depthrig
	target/release/depthrig demo $(ARGS)

test: setup-test $(VENV)/.stamp $(LEROBOT)/.stamp $(READERS)/node_modules/.stamp ## every test there is: Rust, Python, readers that are not ours
	tools/test.sh

lint: ## formatting and lints, as CI runs them
	cargo fmt --all --check
	cargo clippy --workspace --all-targets -- --deny warnings
	@if command -v cargo-deny >/dev/null; then cargo deny check; else echo "cargo-deny is not installed: licences not checked"; fi

bench: setup-build ## the numbers of docs/performance.md
	cargo build --release --package depthrig
	target/release/depthrig bench bus
	target/release/depthrig bench record

clean: ## remove what was built
	cargo clean
	rm -rf $(VENV) $(LEROBOT) $(READERS)/node_modules

setup-build:
	@tools/setup.sh build

setup-test:
	@tools/setup.sh build test

$(VENV)/.stamp: $(REQUIREMENTS) python/pyproject.toml
	python3 -m venv $(VENV)
	$(VENV)/bin/pip install --quiet $(addprefix --requirement ,$(REQUIREMENTS)) --editable ./python
	touch $@

$(LEROBOT)/.stamp: tests/python/requirements-lerobot.txt
	for python in python3.12 $$HOME/.pyenv/versions/3.12*/bin/python python3; do \
		"$$python" -c 'import venv' 2>/dev/null && break; done && "$$python" -m venv --clear $(LEROBOT)
	$(LEROBOT)/bin/pip install --quiet --no-deps --no-compile --no-cache-dir --requirement $<
	touch $@

$(READERS)/node_modules/.stamp: $(READERS)/package.json $(READERS)/package-lock.json
	npm ci --prefix $(READERS) --no-audit --no-fund --loglevel=error
	touch $@
