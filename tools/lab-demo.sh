#!/usr/bin/env bash
# The depth lab from nothing to a policy's feed, on two cores and without a data set: makes random scenes, trains a very small
# network on them for some minutes, evaluates it beside `fill` and the one that ships, serves it live on a simulated
# camera and evaluates what was recorded. Ends with two HTML reports.
# usage: tools/lab-demo.sh [--small] [NEW FOLDER FOR EVERYTHING]
# --small: too few scenes and steps to learn anything; a trial of the steps. DEPTHRIG_BIN names a program that is built already.
set -euo pipefail
cd "$(dirname "$0")/.."
train=700 held_out=60 steps=700
if [ "${1:-}" = --small ]; then
    train=16 held_out=4 steps=4
    shift
fi
out=${1:-demo-data/lab_$(date --utc +%Y%m%d_%H%M%S)}
if [ -e "$out" ]; then
    echo "$out exists; name a new folder" >&2
    exit 2
fi
depthrig=${DEPTHRIG_BIN:-}
if [ -z "$depthrig" ]; then
    cargo build --release --package depthrig
    depthrig=${CARGO_TARGET_DIR:-$PWD/target}/release/depthrig
fi
root=$PWD
mkdir -p "$out"
cd "$out"
out=$PWD

# Each step with the seconds since the first one.
start=$SECONDS
step() { printf '\n== %s  [%d s]\n' "$*" $((SECONDS - start)); }
daemon=""
stop() {
    [ -n "$daemon" ] || return 0
    kill -INT "$daemon" 2>/dev/null || true
    wait "$daemon" || true
    daemon=""
}
trap stop EXIT

step "random tables and rooms: colour, true depth, and what a D435 measures of them"
scenes=("$depthrig" scenes --camera d435 --size 320x240 --hide 0.5)
"${scenes[@]}" --seed 1 --count "$train" --without bottle,cutlery --out train --preview scenes.png
"${scenes[@]}" --seed 2 --count "$held_out" --families bottle,cutlery --out held-out

step "training"
cat >train.toml <<TOML
name = "lab-demo"
folder = "run"
ships = true
seed = 1

[[data]]
kind = "shards"
path = "train"

[[check]]
kind = "shards"
path = "held-out"

[model]
kind = "tiny"
width = 16

[train]
steps = $steps
batch = 8
crop = [160, 208]
ema = 0.99
loss.space = "fill"
check_samples = 16
TOML
"$root/tools/python.sh" run-lab torch.distributed.run --standalone --nproc-per-node 2 -m depthrig.lab.train "$out/train.toml"

step "evaluation on families of objects that training never saw"
"$depthrig" eval held-out --refine fill --refine tiny --refine lab-demo=run/tiny.onnx --out held-out.html

step "live: a simulated D435 whose depth this network refines"
cp run/tiny.onnx lab-demo.onnx # its name is in the header of each frame
cat >rig.toml <<TOML
rig = "lab_demo"

[[camera]]
name = "d435"
backend = "synthetic"
model = "d435"
truth = true

[[camera.stream]]
name = "color"
width = 640
height = 480

[[camera.stream]]
name = "depth"
width = 640
height = 480

[[camera.stream]]
name = "depth_true_color"
width = 640
height = 480

[camera.refine]
engine = "tiny"
model = "lab-demo.onnx"
rate_hz = 5.0
record = true
TOML
"$depthrig" run rig.toml --record live --seconds 5 --quiet || [ $? -eq 3 ]

step "evaluation of what was recorded"
# Images that were not refined in time are left out (status 3).
"$depthrig" eval live/* --out live.html || [ $? -eq 3 ]

step "done"
echo "reports: $out/held-out.html $out/live.html"
