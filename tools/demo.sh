#!/usr/bin/env bash
# The demo with recordings in place of cameras: generates them, runs `depthrig demo` on a rig that plays them, and opens
# the dataset with third-party readers. Arguments are those of `depthrig demo`.
set -euo pipefail
cd "$(dirname "$0")/.."
target=${CARGO_TARGET_DIR:-$PWD/target}
recordings=$target/demo

out="" json="" previous=""
for argument in "$@"; do
    case $previous in --out) out=$argument ;; esac
    case $argument in --out=*) out=${argument#--out=} ;; --json) json=yes ;; esac
    previous=$argument
done
if [ -z "$out" ]; then
    out=demo-data/$(date --utc +%Y%m%d_%H%M%S)
    set -- "$@" --out "$out"
fi
say() { # on stdout, unless that is to be JSON alone
    if [ -n "$json" ]; then echo "$@" >&2; else echo "$@"; fi
}

cargo build --release --package depthrig --package depthrig-demo-recordings --bin depthrig --bin demo-recordings

# The camera of another process: depthrig's bridge for OAK where Luxonis' library is installed, else a player of the images.
oak=(env "PYTHONPATH=$PWD/python/src" "$PWD/.venv-oak/bin/python")
if [ -x "${oak[-1]}" ] && "${oak[@]}" -c 'import depthai, depthrig.oak' >/dev/null 2>&1; then
    command=("${oak[@]}" -m depthrig.oak --replay oak --fps 15)
else
    command=("$target/release/demo-recordings" --play "$recordings/oak")
    say "oak: its images without Luxonis' library, because .venv-oak is not there (make .venv-oak/.stamp)"
fi
rm -rf "$recordings"
"$target/release/demo-recordings" "$recordings" "${command[@]}" >/dev/null

status=0
"$target/release/depthrig" demo --config "$recordings/rig.toml" "$@" || status=$?

dataset=$out/dataset
python=$PWD/.venv/bin/python
if [ -d "$dataset" ] && [ -x "$python" ]; then
    say "opened by others:"
    say "$("$python" tests/readers/check_open.py "$dataset")" || status=$?
elif [ -d "$dataset" ]; then
    say "not opened by other readers: .venv is not there (make .venv/.stamp)"
fi
exit "$status"
