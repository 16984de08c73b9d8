#!/usr/bin/env bash
# Builds the packages into dist/: for each architecture a wheel and a Debian package around one and the same binary, and its
# list of parts; then their checksums. `make dist` calls it.
#
#   tools/dist/dist.sh [x86_64] [aarch64]
#
# A build takes 10 CPU minutes for each architecture; what is built lies in target/dist.
set -euo pipefail
cd "$(dirname "$0")/../.."
# Packages hold the permissions of their files.
umask 022
work=target/dist
[ $# -gt 0 ] || set -- x86_64 aarch64

requirements=tools/dist/requirements.txt
if ! cmp --silent "$requirements" "$work/venv/.stamp"; then
    tools/environment.sh "$work/venv" python3 --requirement "$requirements"
    cp "$requirements" "$work/venv/.stamp"
fi
for arch in "$@"; do
    if ! rustup target list --installed 2>/dev/null | grep --quiet --line-regexp "$arch-unknown-linux-gnu"; then
        rustup target add "$arch-unknown-linux-gnu"
    fi
done

host=$(uname --machine)
version=$(tools/dist/value.py version)
mkdir -p dist
for arch in "$@"; do
    out=$work/out/$arch
    rm -rf "$out"
    tools/dist/wheel.sh "$arch" "$out"
    # A program of this computer writes pages and completions, which are the same for every architecture.
    generator=$work/out/$host/depthrig
    if [ ! -x "$generator" ]; then
        echo "manual pages need the binary of this computer: make dist ARCH='$host $arch'" >&2
        exit 1
    fi
    tools/dist/deb.sh "$arch" "$out/depthrig" "$generator" "$out"
    tools/dist/check.sh "$out"/depthrig-*.whl "$out"/depthrig_*.deb
    cp "$out"/depthrig-*.whl "$out"/depthrig_*.deb dist/
    cp "$out/depthrig.cdx.json" "dist/depthrig-$version-$arch.cdx.json"
done
(cd dist && find . -maxdepth 1 -type f ! -name SHA256SUMS -printf '%P\0' | LC_ALL=C sort --zero-terminated |
    xargs --null sha256sum >SHA256SUMS && cat SHA256SUMS)
