# depthrig: `make demo` shows what it does, `make test` tests it. Both install missing dependencies (tools/setup.sh).
SHELL := /bin/bash
.DEFAULT_GOAL := help

# Extra arguments for the demo and the virtual machine: make demo ARGS="--seconds 30"
ARGS ?=
# Real sensor images for the tests.
export DEPTHRIG_TEST_DATA ?= $(abspath ../shared/data)

READERS := tests/readers
VENV := .venv
# LeRobot brings PyTorch, so it has its own environment, with Python 3.12 or later if available.
LEROBOT := .venv-lerobot
# Other recorders for comparison; with Debian's Python, which Debian's rosbag requires.
PEERS := tests/peers
PEERS_VENV := .venv-peers
# Other image transports for comparison.
FEED := .venv-feed
# The vendor's SDK of OAK cameras, 450 MB.
OAK := .venv-oak
# Robots' meshes and a ray tracer, for the alignment of cameras with a robot's arm.
ROBOTS := .venv-robots
# A path tracer, for reference images of random worlds. No test needs it.
REFERENCE := .venv-reference
# mdBook, which makes the site of the documents.
DOCS := .venv-docs
REQUIREMENTS := python/requirements-test.txt tests/python/requirements-s3.txt $(READERS)/requirements.txt tests/page_browser/requirements.txt tests/terminal/requirements.txt

.PHONY: help demo demo-two-hosts demo-calibration lab-demo train-tiny noise-models reference environments test check-debian13 test-long vm fuzz lint docs dist test-dist bench bench-page bench-mirror bench-peers bench-feed clean setup-build setup-test setup-vm setup-peers setup-fuzz setup-dist

help: ## show this list
	@sed -nE 's/^([a-z0-9-]+):.*## (.*)/\1|\2/p' $(MAKEFILE_LIST) | awk -F'|' '{printf "  make %-16s %s\n", $$1, $$2}'

demo: setup-build ## the mount of seven cameras with ten depth modes, without a camera: record, verify, replay, report
	@tools/onnxruntime.sh || true
	tools/demo.sh $(ARGS)

demo-two-hosts: ## the mount on two computers, as two namespaces: record, cut the wire, join, verify, replay
	@tools/setup.sh build two-hosts
	tools/demo-two-hosts.sh $(ARGS)

demo-calibration: setup-build ## seven simulated cameras and a printed board: views, calibration, the cloud before and after
	tools/demo-calibration.sh $(ARGS)

environments: $(VENV)/.stamp $(LEROBOT)/.stamp $(OAK)/.stamp $(ROBOTS)/.stamp $(DOCS)/.stamp $(READERS)/node_modules/.stamp ## the environments of Python and Node that tests need
	tools/python.sh environments

test: setup-test environments ## every test: Rust, Python, third-party readers, the virtual machine
	@tools/onnxruntime.sh || true
	tools/test.sh

test-long: ## the long forms: every test with DEPTHRIG_LONG=1, ten minutes of recording, twelve of the daemon, a second computer, an hour of fuzzing per target
	DEPTHRIG_LONG=1 $(MAKE) test
	cargo build --release --package depthrig
	target/release/depthrig bench soak --check
	tests/soak.py target/release/depthrig
	tests/vm/second_host
	$(MAKE) fuzz

vm: setup-build setup-vm $(VENV)/.stamp ## drivers and daemon on a real kernel, in a virtual machine; one scenario: make vm ARGS="vivid-smoke"
	tests/vm/run --require $(ARGS)

# How long for each target, and which: make fuzz FUZZ="600 segment"
FUZZ ?= 3600
fuzz: setup-fuzz ## an hour for each fuzz target, or FUZZ="SECONDS [TARGET...]"
	tools/fuzz.sh $(FUZZ)

check-debian13: ## build in a clean Debian 13, as root: make check-debian13 ARGS="test --package depthrig-driver"
	tools/check_debian13.sh $(ARGS)

lint: ## formatting and lints, as CI runs them
	cargo fmt --all --check
	cargo clippy --workspace --all-targets -- --deny warnings
	tools/notice.py --check
	tools/cycles.py
	tools/words.py
	tools/docs/build.py check
	tools/python.sh types || [ $$? -eq 77 ]
	@if command -v cargo-deny >/dev/null; then cargo deny check; else echo "cargo-deny is not installed: licences not checked"; fi

lab-demo: setup-build $(LEROBOT)/.stamp ## the depth lab in a quarter of an hour: makes scenes, trains a very small network, evaluates it, serves it live
	tools/onnxruntime.sh
	tools/lab-demo.sh $(ARGS)

train-tiny: setup-build $(LEROBOT)/.stamp ## the refiner `tiny`: makes its data, trains, measures, writes cdm_plugin/models/tiny.{onnx,toml}
	tools/train-tiny.sh

noise-models: setup-build $(LEROBOT)/.stamp ## the noise models of a simulated D435, how good they are, and which raw depth trains best
	tools/noise-models.sh

reference: setup-build $(REFERENCE)/.stamp ## random worlds by our caster beside a path tracer: depth, colour; into target/reference
	tools/reference/reference.sh $(ARGS)

docs: setup-build $(DOCS)/.stamp ## the site of the documents and the generated reference, in target/book
	cargo build --workspace --bins --quiet
	tools/docs/build.py site

# Architectures of the packages: x86_64, aarch64 or both.
ARCH ?= x86_64 aarch64
dist: setup-dist ## the wheel and the Debian package of each architecture, into dist/: make dist ARCH=x86_64
	tools/dist/dist.sh $(ARCH)

test-dist: setup-dist $(VENV)/.stamp ## the packages in dist/ in a clean Debian 12 and 13, as root, and by the tutorial; the binary for aarch64 in QEMU
	tests/dist/run $(ARGS)

bench: setup-build ## the numbers of docs/performance.md
	cargo build --release --package depthrig
	target/release/depthrig bench bus
	target/release/depthrig bench record
	cargo run --release --package depthrig-tests --example zed_replay_ratio
	cargo run --release --package depthrig-kinect-fixture --example kinect_speed

bench-page: setup-test $(VENV)/.stamp ## what the live page costs the rig that it shows
	cargo build --release --package depthrig
	$(VENV)/bin/python tests/page_cost.py target/release/depthrig $(ARGS)

bench-mirror: setup-test $(VENV)/.stamp ## what live frames of another computer cost, beside zenoh
	cargo build --release --package depthrig
	$(VENV)/bin/python tests/link/mirror_cost.py target/release/depthrig $(ARGS)

bench-peers: setup-peers $(PEERS_VENV)/.stamp ## compare with Python mcap, foxglove-sdk, rosbag and PNG files, in one run
	cargo build --release --package depthrig-recorder --example bench_frames
	$(PEERS_VENV)/bin/python $(PEERS)/compare.py --depthrig target/release/examples/bench_frames \
	    --json target/bench-peers.json $(ARGS)

bench-feed: setup-build $(FEED)/.stamp ## latency to a NumPy array in another process, beside pyzmq, zenoh and dora-rs
	cargo build --release --package depthrig-bus --example latency
	$(FEED)/bin/python $(PEERS)/feed.py --latency target/release/examples/latency --json target/bench-feed.json $(ARGS)

clean: ## remove build outputs
	cargo clean
	rm -rf $(VENV) $(LEROBOT) $(PEERS_VENV) $(FEED) $(OAK) $(ROBOTS) $(REFERENCE) $(DOCS) $(READERS)/node_modules

setup-build:
	@tools/setup.sh build

setup-test:
	@tools/setup.sh build test two-hosts

setup-vm:
	@tools/setup.sh vm

setup-fuzz:
	@tools/setup.sh build fuzz

setup-dist:
	@tools/setup.sh build dist

setup-peers:
	@tools/setup.sh build peers

$(VENV)/.stamp: $(REQUIREMENTS) python/pyproject.toml
	tools/environment.sh $(VENV) python3 $(addprefix --requirement ,$(REQUIREMENTS)) --editable ./python
	touch $@

$(LEROBOT)/.stamp: tests/python/requirements-lerobot.txt tests/python/without_cuda.py
	for python in python3.12 $$HOME/.pyenv/versions/3.12*/bin/python python3; do \
		"$$python" -c 'import venv' 2>/dev/null && break; done && \
		tools/environment.sh $(LEROBOT) "$$python" --no-deps --no-cache-dir --requirement $<
	$(LEROBOT)/bin/python tests/python/without_cuda.py
	touch $@

$(PEERS_VENV)/.stamp: $(PEERS)/requirements.txt
	/usr/bin/python3 -m venv --system-site-packages $(PEERS_VENV)
	$(PEERS_VENV)/bin/pip install --quiet --requirement $(PEERS)/requirements.txt
	touch $@

$(FEED)/.stamp: $(PEERS)/requirements-feed.txt python/pyproject.toml
	python3 -m venv $(FEED)
	$(FEED)/bin/pip install --quiet --requirement $< --editable ./python
	touch $@

$(OAK)/.stamp: python/requirements-oak.txt
	tools/environment.sh $(OAK) python3 --no-cache-dir --requirement $<
	touch $@

$(ROBOTS)/.stamp: tests/python/requirements-robots.txt tests/python/robots_only.py
	tools/environment.sh $(ROBOTS) python3 --no-deps --no-cache-dir --requirement $<
	$(ROBOTS)/bin/python tests/python/robots_only.py
	touch $@

$(REFERENCE)/.stamp: tools/reference/requirements.txt
	tools/environment.sh $(REFERENCE) python3 --no-cache-dir --requirement $<
	touch $@

$(DOCS)/.stamp: tools/docs/requirements.txt
	tools/environment.sh $(DOCS) python3 --require-hashes --requirement $<
	touch $@

$(READERS)/node_modules/.stamp: $(READERS)/package.json $(READERS)/package-lock.json
	npm ci --prefix $(READERS) --no-audit --no-fund --loglevel=error
	touch $@
