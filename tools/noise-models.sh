#!/usr/bin/env bash
# The hole and the value model of a simulated D435, how good the hole model is, and which raw depth a small refiner learns
# from best (docs/depth-lab-training.md). Everything is below target/noise-models: 1 GB. What is there is left alone, so the
# same command goes on after an interruption. One hour of one core.
set -euo pipefail
cd "$(dirname "$0")/.."
data=target/noise-models
program=${CARGO_TARGET_DIR:-target}/debug/depthrig
# Training never sees these, and the held-out scenes have nothing else.
held_out=bottle,bowl,cable

cargo build --package depthrig # what computes is optimised in this profile too

scenes() { # NAME ARGUMENT...
    "$program" scenes --out "$data/$1" --per-shard 250 --camera d435 --size 320x240 "${@:2}"
}
scenes train --seed 301 --count 1500 --sensor stereo --without "$held_out"
scenes held-out --seed 303 --count 150 --sensor stereo --families "$held_out"
again=()
for n in 1 2 3; do
    scenes "again-$n" --seed 303 --count 150 --sensor stereo --families "$held_out" --again "$n"
    again+=("$data/again-$n")
done
# Clean worlds whose raw depth is measured in two ways, and made from the true depth.
scenes clean-stereo --seed 304 --count 100 --sensor stereo --without "$held_out"
scenes clean-statistical --seed 304 --count 100 --sensor statistical --without "$held_out"

lab() { tools/python.sh run-lab "$@"; }
lab depthrig.lab.train tools/noise-models/hole.toml
lab depthrig.lab.train tools/noise-models/value.toml
lab depthrig.lab.hole_iou tools/noise-models/hole.toml --again "${again[@]}"
lab depthrig.lab.ablation tools/noise-models/ablation.toml --seeds 3
