#!/usr/bin/env bash
# Fetches ONNX Runtime from PyPI into target/onnxruntime/, where the program looks for it: `cpu` (the default),
# `openvino` (16-bit floats on CPUs that have them) or `gpu` (CUDA and TensorRT, without NVIDIA's own libraries).
# Versions and hashes are pinned. Prints nothing if everything is there, one message if it is unavailable.
#   tools/onnxruntime.sh [--into DIR] [cpu|openvino|gpu]...
set -euo pipefail
cd "$(dirname "$0")/.."

into=${CARGO_TARGET_DIR:-target}/onnxruntime
if [ "${1:-}" = --into ]; then
    into=$2
    shift 2
fi
[ $# -gt 0 ] || set -- cpu

fail() { # WHAT
    echo "ONNX Runtime ($variant) was not fetched: $1. Without it camera depth models cannot run; everything else" \
        "works. Try again with: tools/onnxruntime.sh $variant" >&2
    exit 1
}

download() { # PROJECT VERSION FILE DIR: through pip, which knows mirrors and proxies, or directly if pip is missing
    local project=$1 version=$2 file=$3 dir=$4 url
    if python3 -m pip --version >/dev/null 2>&1; then
        python3 -m pip download --quiet --disable-pip-version-check --no-deps --only-binary=:all: \
            --implementation cp --python-version 3.11 --abi cp311 --platform "manylinux_2_28_$(uname -m)" \
            --dest "$dir" "$project==$version" >/dev/null 2>&1
        return
    fi
    url=$(curl --fail --silent --show-error --location "https://pypi.org/simple/$project/" |
        grep -o "href=\"[^\"#]*/$file" | head -1) || return 1
    curl --fail --silent --show-error --location --output "$dir/$file" "${url#href=\"}"
}

unpack() { # WHEEL DIR: the libraries of a wheel, without the one that Python loads
    if command -v python3 >/dev/null; then
        python3 - "$1" "$2" <<'PY'
import pathlib, sys, zipfile
wheel, out = zipfile.ZipFile(sys.argv[1]), pathlib.Path(sys.argv[2])
for name in wheel.namelist():
    file = pathlib.PurePosixPath(name).name
    if "/capi/" in name and ".so" in file and "pybind11" not in file:
        (out / file).write_bytes(wheel.read(name))
PY
    else
        unzip -q -j "$1" 'onnxruntime/capi/*.so*' -x '*pybind11*' -d "$2"
    fi
}

for variant in "$@"; do
    # In the order of: project, version, and the hash of its wheel for CPython 3.11 on this machine.
    case $variant-$(uname -m) in
    cpu-x86_64) pin="onnxruntime 1.31.1 5752bd508126ae7c49894d3b9d2e83f0c3d487319246d04c444b393308d7ad7f" ;;
    cpu-aarch64) pin="onnxruntime 1.31.1 da05378364c44d4407e463982d2bf8d5e4cfea873283757e48beeb41df97b7f3" ;;
    openvino-x86_64) pin="onnxruntime-openvino 1.24.1 3007c803634cc69c6d52af1dea7ce729d9bb62b9a11070fd2f959119199007a8" ;;
    gpu-x86_64) pin="onnxruntime-gpu 1.31.1 e26c475fe361b2015f45b4b824bd13f0bb20204e59b62814e6f0acd5f3d491a6" ;;
    *)
        fail "PyPI has no $variant of it for $(uname -m)"
        ;;
    esac
    read -r project version sha <<<"$pin"
    dir=$into/$variant
    [ "$(cat "$dir/version" 2>/dev/null)" != "$version" ] || continue

    echo "fetching ONNX Runtime $version ($variant) from PyPI into $dir"
    mkdir -p "$into"
    work=$(mktemp --directory "$into/.fetch.XXXXXX")
    trap 'rm -rf "$work"' EXIT
    file=${project//-/_}-$version-cp311-cp311-manylinux_2_28_$(uname -m).whl
    download "$project" "$version" "$file" "$work" || fail "PyPI could not be reached"
    wheel=$work/$file
    [ -f "$wheel" ] || fail "the download holds no $file"
    [ "$(sha256sum "$wheel" | cut -d' ' -f1)" = "$sha" ] || fail "$file has another SHA-256 than the pinned one"
    mkdir "$work/lib"
    unpack "$wheel" "$work/lib" || fail "$file could not be unpacked"
    compgen -G "$work/lib/libonnxruntime.so*" >/dev/null || fail "$file holds no libonnxruntime.so"
    echo "$version" >"$work/lib/version"
    rm -rf "$dir"
    mv "$work/lib" "$dir"
    rm -rf "$work"
    trap - EXIT
done
