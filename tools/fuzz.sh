#!/usr/bin/env bash
# tools/fuzz.sh [SECONDS [TARGET...]]: fuzzes each target, an hour by default, one after the other on one core,
# and ends with a table. tools/fuzz.sh keep [TARGET...]: adds to the corpus, which is in the repository and runs in
# `make test`, the shortest new inputs, up to KEEP_BYTES per target.
# See docs/fuzzing.md. Exit code 1 if a failure was found.
set -euo pipefail
cd "$(dirname "$0")/../fuzz"

KEEP_BYTES=${KEEP_BYTES:-250000}
CARGO_FUZZ=0.13.2
# The instrumentation is not in the stable interface of rustc; it is the same in the stable one.
export RUSTC_BOOTSTRAP=1

export PATH=$PWD/target/tools/bin:$PATH
command -v cargo-fuzz >/dev/null ||
    cargo install cargo-fuzz --version "$CARGO_FUZZ" --locked --quiet --root target/tools

mode=${1:-3600}
shift || true
targets=("$@")
built=("$@")
# Without a name cargo-fuzz builds all of them at once.
[ ${#built[@]} -gt 0 ] || built=("")
[ ${#targets[@]} -gt 0 ] || mapfile -t targets < <(sed -nE 's/^name = "([a-z0-9_]+)"$/\1/p' Cargo.toml)

# Without a sanitizer: depthrig's code is safe Rust, where a bad access is a panic.
# With --release cargo-fuzz leaves assertions to the profiles in Cargo.toml; without it, it switches on those of all crates.
for target in "${built[@]}"; do
    cargo fuzz build --fuzz-dir . --release --sanitizer none ${target:+"$target"}
done
binaries=target/$(rustc -vV | sed -n 's/host: //p')/release

mkdir -p logs
../tools/corpus.py unpack "${targets[@]}"
if [ "$mode" = keep ]; then
    for target in "${targets[@]}"; do
        merged=$(mktemp --directory)
        mkdir -p "work/$target"
        "$binaries/$target" -merge=1 "$merged" "corpus/$target" "work/$target" 2>"logs/$target-merge.log"
        total=0
        # By size; names are the hashes of the contents.
        while read -r size file; do
            total=$((total + size))
            [ "$total" -gt "$KEEP_BYTES" ] && break
            cmp --silent "$file" "corpus/$target"/seed_* 2>/dev/null || cp "$file" "corpus/$target/"
        done < <(find "$merged" -type f -printf '%s %p\n' | sort -n)
        ../tools/corpus.py pack "$target"
        rm -r "$merged"
    done
    exit 0
fi

found=0
rows=""
for target in "${targets[@]}"; do
    mkdir -p "work/$target" artifacts logs
    log=logs/$target.log
    echo "== $target for $mode s: fuzz/$log"
    if ! "$binaries/$target" "work/$target" "corpus/$target" -max_total_time="$mode" -max_len=65536 -timeout=20 \
        -rss_limit_mb=2048 -artifact_prefix="artifacts/$target-" -print_final_stats=1 >"$log" 2>&1; then
        found=1
        echo "== $target: FOUND SOMETHING, see fuzz/$log and fuzz/artifacts"
    fi
    stat() { sed -nE "s/^stat::$1: *//p" "$log" | tail -1; }
    last=$(grep -E 'cov: ' "$log" | tail -1)
    rows+=$(printf '%-20s %12s %8s %8s %8s %8s' "$target" "$(stat number_of_executed_units)" \
        "$(stat average_exec_per_sec)" "$(sed -nE 's/.* cov: ([0-9]+).*/\1/p' <<<"$last")" \
        "$(sed -nE 's/.* ft: ([0-9]+).*/\1/p' <<<"$last")" "$(find artifacts -name "$target-*" | wc -l)")$'\n'
done
printf '\n%-20s %12s %8s %8s %8s %8s\n%s' target executions per_s edges features findings "$rows"
exit "$found"
