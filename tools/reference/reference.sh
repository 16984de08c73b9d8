#!/usr/bin/env bash
# Worlds of `depthrig scenes`, by our caster and by a path tracer (reference.py). What is there is left alone.
# usage: tools/reference/reference.sh [ARGUMENT OF reference.py...]
set -euo pipefail
cd "$(dirname "$0")/../.."
out=target/reference
cargo build --package depthrig
if [ ! -e "$out/worlds" ]; then
    rm -rf "$out/worlds.part"
    "${CARGO_TARGET_DIR:-target}/debug/depthrig" scenes --seed 11 --count 8 --size 320x240 --worlds "$out/worlds.part"
    mv "$out/worlds.part" "$out/worlds"
fi
.venv-reference/bin/python tools/reference/reference.py "$out/worlds" "$out" "$@"
