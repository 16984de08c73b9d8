#!/usr/bin/env bash
# From a printed board to a calibrated mount, with seven simulated cameras whose poses were measured with a ruler: draws the board,
# records it, calibrates, and shows the cloud of all cameras before and after. Then one camera is bumped, and `check` finds it.
# usage: tools/demo-calibration.sh [NEW FOLDER FOR EVERYTHING]
set -euo pipefail
cd "$(dirname "$0")/.."
out=${1:-demo-data/calibration_$(date --utc +%Y%m%d_%H%M%S)}
if [ -e "$out" ]; then
    echo "$out exists; name a new folder" >&2
    exit 2
fi
cargo build --release --package depthrig
depthrig=${CARGO_TARGET_DIR:-$PWD/target}/release/depthrig
rig=$PWD/tools/demo-calibration.toml
mkdir -p "$out"
cd "$out"

step() { printf '\n== %s\n' "$*"; }
# A recording of the rig $1 in the new folder $2, $3 seconds long; a slow computer may lose sets of it (status 3).
record() { "$depthrig" run "$1" --record "$2" --seconds "$3" --quiet || [ $? -eq 3 ]; }

# Starts the rig $1 and waits until its cameras are there; `stop` ends it.
daemon=""
start() {
    "$depthrig" run "$1" --quiet &
    daemon=$!
    until "$depthrig" status --rig demo_calibration >/dev/null 2>&1; do
        kill -0 "$daemon" || exit 1
        sleep 0.5
    done
}
stop() {
    [ -n "$daemon" ] || return 0
    kill -INT "$daemon" 2>/dev/null || true
    wait "$daemon" || true
    daemon=""
}
trap stop EXIT

step "the board, as it would be printed: board.pdf"
"$depthrig" calibrate board --paper a3
# A printer that printed true to scale.
echo 'measured_ruler_mm = 100.0' >>board.toml

step "the table without the board, with the poses that somebody measured with a ruler"
cp "$rig" rig.toml
sed 's/motion = "steps"/motion = "away"/' rig.toml >table.toml
record table.toml before 3

step "the board at one place after the other; a view is taken at each"
start rig.toml
"$depthrig" calibrate capture demo_calibration --board board.toml --out views --views 16
stop

step "from the views to calibration.toml"
"$depthrig" calibrate solve views --board board.toml --by demo

step "the table again, with the calibration"
(echo 'calibration = "calibration.toml"' && cat table.toml) >calibrated.toml
record calibrated.toml after 3

for when in before after; do
    step "the cloud of all cameras, $when"
    "$depthrig" cloud "$when"/* --max-m 1.5 --out "$when.ply" --image "$when.png"
done

step "somebody bumps camera d435 by 2 mm; check:"
sed '/^name = "d435"/,/^board/ s/translation_m = \[0.002, 0.003, -0.006\]/translation_m = [0.004, 0.003, -0.006]/' rig.toml >bumped.toml
start bumped.toml
status=0
"$depthrig" calibrate check demo_calibration --calibration calibration.toml || status=$?
stop
if [ "$status" -ne 3 ]; then
    echo "check ended with $status, not with 3" >&2
    exit 1
fi

step "in $out: calibration.toml, calibration.html, before.png, after.png, before.ply, after.ply"
