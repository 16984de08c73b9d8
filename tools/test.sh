#!/usr/bin/env bash
# Runs every test there is and ends with one line that counts them. `make test` prepares what it needs.
set -uo pipefail
cd "$(dirname "$0")/.."

python=$PWD/.venv/bin/python
logs=target/test-logs
mkdir -p "$logs"
# Tests in Rust that could not be done append a line here: cargo keeps to itself what a passing test prints.
export DEPTHRIG_TEST_SKIPS=$PWD/$logs/skips
rm -f "$DEPTHRIG_TEST_SKIPS"
failed_steps=""
step() { # NAME COMMAND...: runs it, keeps its output, remembers a failure
    local name=$1
    shift
    printf '\n== %s\n' "$name"
    if ! "$@" 2>&1 | tee "$logs/$name.log"; then
        failed_steps+=" $name"
        echo "== $name FAILED"
    fi
}

if [ ! -d "$DEPTHRIG_TEST_DATA" ]; then
    echo "the real pictures are not at $DEPTHRIG_TEST_DATA; set DEPTHRIG_TEST_DATA to their folder" >&2
    exit 1
fi

# Tests of the network in ONNX Runtime skip themselves where it could not be fetched, and nowhere else.
if compgen -G "${CARGO_TARGET_DIR:-target}/onnxruntime/cpu/libonnxruntime.so*" >/dev/null; then
    export DEPTHRIG_REQUIRE_ONNXRUNTIME=1
fi

# Property tests draw the same cases each time, so that a failure is of the change at hand; the long form draws new ones.
[ -n "${DEPTHRIG_LONG:-}" ] || export PROPTEST_RNG_SEED=${PROPTEST_RNG_SEED:-1}

step rust cargo test --workspace --no-fail-fast --quiet
# The same selection as above, so that nothing is compiled twice with other features.
cargo build --workspace --bins --examples --quiet || exit 1
target=${CARGO_TARGET_DIR:-$PWD/target}/debug
export DEPTHRIG_BIN=$target/depthrig
export DEPTHRIG_TEST_PUBLISHER=$target/examples/publish

# The OAK program in Rust cannot be linked without a built depthai-core; its types can be looked at.
oak_crate() {
    CARGO_TARGET_DIR=$(dirname "$target")/oak cargo check --manifest-path drivers/oak/Cargo.toml --locked --quiet \
        --features no-native --all-targets &&
        CARGO_TARGET_DIR=$(dirname "$target")/oak cargo test --manifest-path drivers/oak/Cargo.toml --locked --quiet
}
step oak-crate oak_crate

step python "$python" -m pytest --quiet python/tests
# The wheel on other versions of Python, and with PyTorch.
step python-versions tools/python.sh versions
skipped=""
torch() {
    tools/python.sh torch
    local status=$?
    [ "$status" -ne 77 ] || echo "PyTorch skipped"
    [ "$status" -eq 0 ] || [ "$status" -eq 77 ]
}
step python-torch torch
if grep -q '^PyTorch skipped' "$logs/python-torch.log"; then skipped+=", 1 skipped: tests with PyTorch"; fi
oak() {
    tools/python.sh oak
    local status=$?
    [ "$status" -ne 77 ] || echo "OAK skipped"
    [ "$status" -eq 0 ] || [ "$status" -eq 77 ]
}
step python-oak oak
if grep -q '^OAK skipped' "$logs/python-oak.log"; then skipped+=", 1 skipped: the OAK bridge with its SDK"; fi
step daemon "$python" -m pytest --quiet tests/python

# Readers that are not ours must find the same pixels.
work=$(mktemp --directory)
trap 'rm -rf "$work"' EXIT
step golden "$target/examples/golden" "$work/dataset" "$work/expected"
step reader-python "$python" tests/readers/check_python.py "$work/dataset" "$work/expected"
step reader-node node tests/readers/check_node.mjs "$work/dataset" "$work/expected"
# Depth in our own codec, colour as PNG. Python's readers take it apart with the package depthrig; in JavaScript there
# is no decoder of it.
step golden-rank "$target/examples/golden" "$work/rank" "$work/rank-expected" rank
step reader-python-rank "$python" tests/readers/check_python.py "$work/rank" "$work/rank-expected"
step golden-stereo "$target/examples/golden" "$work/stereo" "$work/stereo-expected" stereo
step reader-python-stereo "$python" tests/readers/check_python.py "$work/stereo" "$work/stereo-expected"
step reader-node-stereo node tests/readers/check_node.mjs "$work/stereo" "$work/stereo-expected"
step golden-zed "$target/examples/zed_replay_golden" "$work/zed" "$work/zed-expected"
step reader-python-zed "$python" tests/readers/check_python.py "$work/zed" "$work/zed-expected"
step reader-node-zed node tests/readers/check_node.mjs "$work/zed" "$work/zed-expected"

# The drivers and the daemon on a real kernel. 77: what that needs is not installed, which DEPTHRIG_REQUIRE_VM forbids.
vm() {
    tests/vm/run --no-build ${DEPTHRIG_REQUIRE_VM:+--require}
    local status=$?
    [ "$status" -ne 77 ] || echo "virtual machine skipped; tools/setup.sh vm installs what it needs"
    [ "$status" -eq 0 ] || [ "$status" -eq 77 ]
}
step vm vm
if grep -q '^virtual machine skipped' "$logs/vm.log"; then skipped+=", 1 skipped: the virtual machine"; fi

# Every test that cargo and pytest counted, every check of the virtual machine, and one for each of the other steps.
count() { grep -ohE "[0-9]+ $1" "$logs"/{rust,oak-crate,python,python-versions,python-torch,python-oak,daemon,vm}.log | awk '{n += $1} END {print n + 0}'; }
passed=$(count passed)
failed=$(count failed)
# A test that found no small disk has passed for cargo. Nothing could be mounted, which DEPTHRIG_REQUIRE_TMPFS forbids.
disks=0
if [ -f "$DEPTHRIG_TEST_SKIPS" ]; then disks=$(grep -c '^tmpfs: ' "$DEPTHRIG_TEST_SKIPS"); fi
if [ "$disks" -gt 0 ]; then
    passed=$((passed - disks))
    skipped+=", $disks skipped: tests with a small disk (tmpfs)"
fi
for name in {golden,reader-python,reader-node}{,-stereo,-zed} {golden,reader-python}-rank; do
    case "$failed_steps " in
    *" $name "*) failed=$((failed + 1)) ;;
    *) passed=$((passed + 1)) ;;
    esac
done
[ -z "$failed_steps" ] || printf '\nfailed:%s\n' "$failed_steps"
printf '\n%d passed, %d failed%s\n' "$passed" "$failed" "$skipped"
[ -z "$failed_steps" ]
