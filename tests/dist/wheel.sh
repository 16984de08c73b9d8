#!/bin/bash
# As an ordinary user of a clean system without libusb: the wheel brings the binary and the Python package.
set -Eeuo pipefail
trap 'echo "failed: $BASH_COMMAND" >&2' ERR
cd
python3 -m venv environment
environment/bin/pip install --quiet --disable-pip-version-check --no-index --find-links /wheels /packages/*.whl
program=$HOME/environment/bin/depthrig
. /test/use.sh

loaded=$(LD_TRACE_LOADED_OBJECTS=1 "$program" | sed -nE 's/.*libusb-1.0.so.0 => (.*) \(.*/\1/p')
[ "$(realpath "$loaded")" = "$(realpath environment/lib/depthrig/libusb-1.0.so.0)" ]
record wheel-datasets "$HOME/environment/bin/python"
# The library for models: not there, then found in the environment.
engine_missing() {
    (cat rig.toml && printf '[camera.refine]\nengine = "onnxruntime"\n') >model.toml
    ("$program" doctor --json model.toml || true) | python3 -c '
import json, sys
found = [f for f in json.load(sys.stdin)["findings"] if f["id"] == "engine_missing"]
print(found[0]["what"] if found else "found")'
}
engine_missing | grep -q 'pip install onnxruntime'
environment/bin/pip install --quiet --disable-pip-version-check --no-index --find-links /wheels onnxruntime
[ "$(engine_missing)" = found ]
echo "ONNX Runtime: missing, then found in the wheel onnxruntime"
for name in oak ros2; do environment/bin/depthrig-$name --help >/dev/null; done
environment/bin/pip uninstall --quiet --yes depthrig
[ ! -e "$program" ] && [ ! -e environment/lib/depthrig/libusb-1.0.so.0 ]
echo "wheel: installed, recorded, verified, read from Python, removed"
