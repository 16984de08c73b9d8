#!/usr/bin/env bash
# Makes the refiner `tiny` from nothing: data, training, gates, and the files that ship. What is there is left alone, so
# the same command goes on after an interruption. Everything is below target/tiny but for the two files that ship:
# cdm_plugin/models/tiny.onnx and tiny.toml. The data are 4.6 GB.
set -euo pipefail
cd "$(dirname "$0")/.."
models=cdm_plugin/models
data=target/tiny
program=${CARGO_TARGET_DIR:-target}/debug/depthrig
# Training never sees these, and the held-out scenes have nothing else.
held_out=bottle,bowl,cable

cargo build --package depthrig # what computes is optimised in this profile too

scenes() { # NAME ARGUMENT...
    "$program" scenes --out "$data/$1" --per-shard 100 "${@:2}"
}
scenes wide --seed 101 --count 5000 --size 448x336 --hide 0.6 --without "$held_out" --camera d435,d405,l515,zed2i,d415
scenes full --seed 102 --count 1500 --size 640x480 --hide 0.6 --without "$held_out" --camera d435,d405,l515,zed2i
scenes stereo --seed 103 --count 300 --size 640x480 --hide 0.4 --without "$held_out" --camera d435,d405,zed2i --sensor stereo
scenes held-out --seed 901 --count 160 --size 640x480 --hide 0.5 --families "$held_out" --camera d435,d405,l515,zed2i

# The second run goes on from the weights of the first.
for run in tiny-train tiny-steady; do
    tools/python.sh run-lab torch.distributed.run --standalone --nproc-per-node 2 -m depthrig.lab.train "$models/$run.toml"
done
tools/python.sh run-lab depthrig.lab.ship "$models/tiny-steady.toml" --real "${DEPTHRIG_TEST_DATA:-../shared/data}" --depthrig "$program" \
    --out "$models"
