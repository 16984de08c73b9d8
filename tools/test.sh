#!/usr/bin/env bash
# Runs every test and ends with one line that counts them. `make test` prepares its dependencies.
#
# Tests run as an ordinary user. Started by root, this script builds as root (the toolchain may lie where nobody else may
# enter) and runs what was built as the user `depthrig-test`, which it creates; DEPTHRIG_TEST_USER=UID:GID:HOME names
# another one. Each step runs in a box (tests/runner/box.py): with default signals and time limits that kill all that it
# started. A part of the suite runs a second time beside two busy loops, with 256 MiB of /dev/shm and few descriptors.
#
# DEPTHRIG_REQUIRE_DATA, DEPTHRIG_REQUIRE_TMPFS and DEPTHRIG_REQUIRE_VM forbid to skip what needs these; .ci/run sets them.
set -uo pipefail
cd "$(dirname "$0")/.."

export PYTHONDONTWRITEBYTECODE=1
python=$PWD/.venv/bin/python
runner=tests/runner/rust.py
logs=target/test-logs
mkdir -p "$logs"
rm -f "$logs"/*
touch "$logs/failed"
target=${CARGO_TARGET_DIR:-$PWD/target}
# The longest that a step may take; each test has a limit of its own.
limit=${DEPTHRIG_STEP_LIMIT_S:-3600}
if [ -n "${DEPTHRIG_LONG:-}" ]; then
    limit=$((limit * 6))
    export DEPTHRIG_TEST_LIMIT_S=${DEPTHRIG_TEST_LIMIT_S:-3600}
fi

# Short: sockets lie below it.
home=$(mktemp --directory /tmp/dt.XXXXXX)
trap 'rm -rf "$home"' EXIT
mkdir "$home/t" "$home/r"
chmod 0755 "$home"
mkdir -p "$target/tmp" "$target/test-cache"
if [ "$(id -u)" -eq 0 ]; then
    . tools/test_user.sh
fi
box() { # [OPTION...] -- COMMAND...
    tests/runner/box.py --limit "$limit" "$@"
}
# Skipped tests, one per line, written by the test runners.
export DEPTHRIG_TEST_SKIPS=$home/skips
touch "$DEPTHRIG_TEST_SKIPS"
chmod 0666 "$DEPTHRIG_TEST_SKIPS"

step() { # NAME COMMAND...: runs it, keeps its output, remembers a failure
    local name=$1
    shift
    printf '\n== %s\n' "$name"
    local start=$SECONDS
    if ! "$@" 2>&1 | tee "$logs/$name.log"; then
        echo "$name" >>"$logs/failed"
        echo "== $name FAILED"
    fi
    echo "$name $((SECONDS - start))" >>"$logs/seconds"
}
optional() { # WHAT COMMAND...: as `step`, but for what ends with 77 because something is not installed
    local what=$1
    shift
    "$@"
    local status=$?
    [ "$status" -ne 77 ] || echo "$what: not installed" >>"$DEPTHRIG_TEST_SKIPS"
    [ "$status" -eq 0 ] || [ "$status" -eq 77 ]
}

if [ ! -d "$DEPTHRIG_TEST_DATA/lingbot_depth" ]; then
    if [ -n "${DEPTHRIG_REQUIRE_DATA:-}" ]; then
        echo "the real images are not at $DEPTHRIG_TEST_DATA; set DEPTHRIG_TEST_DATA to their folder" >&2
        exit 1
    fi
    echo "the real images are not at $DEPTHRIG_TEST_DATA (DEPTHRIG_TEST_DATA): tests that need them are skipped"
    # The images from a Debian package, fetched by tools/setup.sh.
    [ ! -d "$target/test-data" ] || export DEPTHRIG_TEST_DATA=$target/test-data
    export DEPTHRIG_DATA_MISSING=1
fi

# Measured: a fresh clone grows by 12 GB, and some recordings in tests need 2 GB free to begin. Better one message here than ten
# tests that fail.
need=4
[ -d "$target/debug/deps" ] || need=16
for place in "$target" "$home"; do
    free=$(($(stat --file-system --format='%a*%S' "$place") / 1000000000))
    if [ "$free" -lt "$need" ]; then
        echo "the tests need $need GB free for $place, $free GB are: free some space, or set CARGO_TARGET_DIR to another disk" >&2
        exit 1
    fi
done

# Tests of the network in ONNX Runtime skip themselves where it could not be fetched, and nowhere else.
if compgen -G "$target/onnxruntime/cpu/libonnxruntime.so*" >/dev/null; then
    export DEPTHRIG_REQUIRE_ONNXRUNTIME=1
fi

# Property tests draw the same cases each time, so that a failure is of the change at hand; the long form draws new ones.
[ -n "${DEPTHRIG_LONG:-}" ] || export PROPTEST_RNG_SEED=${PROPTEST_RNG_SEED:-1}

built=$logs/rust.json
cargo test --workspace --no-run --quiet --message-format=json-render-diagnostics >"$built" || exit 1
# The same selection as above, so that nothing is compiled twice with other features.
cargo build --workspace --bins --examples --quiet || exit 1
export DEPTHRIG_BIN=$target/debug/depthrig
export DEPTHRIG_TEST_PUBLISHER=$target/debug/examples/publish

tests=("$python" -m pytest --quiet -p no:cacheprovider)
step runner box -- "${tests[@]}" tests/runner

# Tests that talk to other processes and fill memory, with little of every resource. A stream takes about ten descriptors in
# the process that publishes it and ten in each that reads it: a rig and its readers in one process have more than 64.
small=(--shm 256 --busy 2)

# The OAK program in Rust cannot be linked without a built depthai-core; its types can be looked at.
oak_crate() {
    local cargo=(env "CARGO_TARGET_DIR=$target/oak" cargo)
    "${cargo[@]}" check --manifest-path drivers/oak/Cargo.toml --locked --quiet --features no-native --all-targets &&
        "${cargo[@]}" test --manifest-path drivers/oak/Cargo.toml --locked --quiet --no-run \
            --message-format=json-render-diagnostics >"$logs/oak.json" && "$runner" "$logs/oak.json"
}
beside_compiling() {
    step oak-crate oak_crate
    step python-oak optional "the OAK bridge with its SDK" tools/python.sh oak
}
beside() {
    step python box -- "${tests[@]}" python/tests
    step python-small box "${small[@]}" --nofile 64 -- "${tests[@]}" -m "not many_streams" \
        python/tests/test_stream.py python/tests/test_fresh.py python/tests/test_motion.py
    # The wheel on other versions of Python, and with PyTorch.
    step python-versions tools/python.sh versions
    step python-torch optional "tests with PyTorch" tools/python.sh torch
    step python-lab optional "the depth lab with PyTorch" tools/python.sh lab
}
# These wait more than they compute, so they run beside the tests in Rust; their output is printed when both have ended.
set -m # in a process group of its own, which ends with this script
beside >"$logs/beside" 2>&1 &
beside=$!
beside_compiling >"$logs/beside-compiling" 2>&1 &
compiling=$!
set +m
trap 'kill -- -"$beside" -"$compiling" 2>/dev/null; rm -rf "$home"' EXIT

step rust "$runner" "$built" --jobs 2 --without depthrig-tests:storage_faults
# rustdoc compiles these into a folder that only its own user can enter.
step rust-doc box --as-root -- cargo test --workspace --doc --no-fail-fast --quiet
step binary tools/check_binary.sh "$DEPTHRIG_BIN"
# Left out with 64 descriptors: a test that subscribes seventeen times in one process.
step rust-small "$runner" "$built" "${small[@]}" --nofile 64 --only depthrig-bus:channels \
    --skip a_dead_process_whose_description_is_gone --skip sixteen_subscribers_find_room
step rust-busy "$runner" "$built" "${small[@]}" --nofile 256 --only depthrig-tests:dataset --only depthrig-tests:replay

# Two files at a time, which wait more than they compute; a test that depends on the load says so and has room for it.
step daemon box -- "${tests[@]}" --numprocesses 2 --dist loadfile tests/python
step page box -- node --test tests/page/
step page-types box -- tests/readers/node_modules/.bin/tsc --project tests/page
step page-lint box -- tests/readers/node_modules/.bin/oxlint --config tests/page/oxlint.json daemon/page tests/page

# Third-party readers must find the same pixels.
work=$home/t/readers
box -- mkdir "$work"
readers() { # NAME EXAMPLE OPTION READER...
    local name=$1 example=$2 option=$3 reader
    shift 3
    step "golden$name" box -- "$target/debug/examples/$example" "$work/data$name" "$work/expected$name" $option
    for reader in "$@"; do
        case $reader in
        python) step "reader-python$name" box -- "$python" tests/readers/check_python.py "$work/data$name" "$work/expected$name" ;;
        node) step "reader-node$name" box -- node tests/readers/check_node.mjs "$work/data$name" "$work/expected$name" ;;
        esac
    done
}
readers "" golden "" python node
# Depth in our own codec, colour as PNG. Python's readers take it apart with the package depthrig; in JavaScript there
# is no decoder of it.
readers -rank golden rank python
readers -stereo golden stereo python node
readers -zed zed_replay_golden "" python node

wait "$beside" "$compiling"
trap 'rm -rf "$home"' EXIT
cat "$logs/beside" "$logs/beside-compiling"
# Shows that a failing disk does not delay a camera, so nothing else may.
step rust-quiet "$runner" "$built" --only depthrig-tests:storage_faults

# The drivers and the daemon on a real kernel: alone, because its cameras are as punctual as this computer.
step vm optional "the virtual machine (tools/setup.sh vm)" \
    box -- tests/vm/run --no-build ${DEPTHRIG_REQUIRE_VM:+--require}

# Every test that cargo and pytest counted, every check of the virtual machine, and one for each of the other steps.
counted=(runner rust rust-quiet rust-doc rust-small rust-busy oak-crate python python-small python-versions python-torch python-lab python-oak daemon vm)
count() { # WORD
    local name
    for name in "${counted[@]}"; do cat "$logs/$name.log"; done | grep -oE "[0-9]+ $1" | awk '{n += $1} END {print n + 0}'
}
failed_steps=$(tr '\n' ' ' 2>/dev/null <"$logs/failed")
passed=$(count passed)
failed=$(($(count failed) + $(count 'errors?\b')))
for log in "$logs"/binary.log "$logs"/page*.log "$logs"/golden*.log "$logs"/reader-*.log; do
    name=$(basename "$log" .log)
    case " $failed_steps " in
    *" $name "*) failed=$((failed + 1)) ;;
    *) passed=$((passed + 1)) ;;
    esac
done
skipped=$(wc -l <"$DEPTHRIG_TEST_SKIPS")
if [ "$skipped" -gt 0 ]; then
    printf '\nskipped:\n'
    sed 's/^/  /' "$DEPTHRIG_TEST_SKIPS"
fi
# Whoever sees the end of the output alone finds there what failed, and why.
for name in $failed_steps; do
    printf '\n%s failed:\n' "$name"
    {
        grep -E '^(FAILED|ERROR|vm: FAIL|vm: BROKEN:) ' "$logs/$name.log" || tail -n 3 "$logs/$name.log"
        grep '^E  ' "$logs/$name.log"
    } | head -n 12 | cut -c 1-300 | sed 's/^/  /'
done
[ -z "$failed_steps" ] || printf '\nfailed: %s\n' "$failed_steps"
[ -z "$failed_steps" ] || [ "$failed" -gt 0 ] || failed=1
printf '\n%d passed, %d failed%s\n' "$passed" "$failed" "$([ "$skipped" -eq 0 ] || echo ", $skipped skipped (named above)")"
[ -z "$failed_steps" ]
