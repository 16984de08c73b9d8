#!/usr/bin/env bash
# The paper's seven cameras on two computers, four and three, without a second computer: two namespaces with networks and clocks of their own, joined
# by a wire of 1 Gbit/s and an OpenSSH server. Records, cuts the wire in the middle, joins, verifies and replays. Needs a user namespace and no other
# privilege.
#   tools/demo-two-hosts.sh [--seconds S] [--cut S] [--rate 1gbit] [--keep DIR]
set -euo pipefail
cd "$(dirname "$0")/.."

cargo build --release --package depthrig
exec python3 tests/link/demo.py "${CARGO_TARGET_DIR:-target}/release/depthrig" "$@"
