#!/usr/bin/env bash
# Checks every program and library in the packages of one architecture: they need the C library alone, of the version that
# pyproject.toml promises or an older one, and libusb, which the wheel brings; and they hold no path of this computer. Both
# packages have the same program.
#
#   tools/dist/check.sh WHEEL DEB
set -euo pipefail
wheel=$(realpath "$1") deb=$(realpath "$2")
cd "$(dirname "$0")/../.."
glibc=$(tools/dist/value.py glibc)
unpacked=$(mktemp --directory)
trap 'rm -rf "$unpacked"' EXIT
python3 -m zipfile --extract "$wheel" "$unpacked/wheel"
dpkg-deb --extract "$deb" "$unpacked/deb"
cmp "$unpacked"/wheel/depthrig-*.data/scripts/depthrig "$unpacked/deb/usr/bin/depthrig"

allowed='^(ld-linux-.*\.so\.[0-9]|libc\.so\.6|libdl\.so\.2|libm\.so\.6|libpthread\.so\.0|libusb-1\.0\.so\.0)$'
checked=0
while IFS= read -r -d '' file; do
    [ "$(head --bytes=4 "$file" | tail --bytes=3 | tr --delete "\0")" = ELF ] || continue
    checked=$((checked + 1))
    name=${file#"$unpacked"/}
    needed=$(readelf --dynamic --wide "$file" | sed -nE 's/.*\(NEEDED\).*\[(.*)\]/\1/p' | sort)
    if foreign=$(grep -vE "$allowed" <<<"$needed"); then
        echo "$name needs libraries that are neither the C library nor in the wheel:" $foreign >&2
        exit 1
    fi
    if [ "${name##*/}" = depthrig ] && ! grep -q '^libusb' <<<"$needed"; then
        echo "$name does not load libusb: it was linked statically, and it is LGPL" >&2
        exit 1
    fi
    # Names without a number, as GLIBC_ABI_DT_RELR of glibc 2.36, sort last.
    wanted=$(readelf --version-info --wide "$file" | sed -nE '/^Version needs/,$ s/.* Name: (GLIBC_)?([^ ]+).*/\2/p' |
        sort --version-sort | tail -1)
    if [ "$(printf '%s\n' "$glibc" "$wanted" | sort --version-sort | tail -1)" != "$glibc" ]; then
        echo "$name needs glibc $wanted; pyproject.toml promises $glibc" >&2
        exit 1
    fi
    for path in "$PWD" "${CARGO_HOME:-$HOME/.cargo}"; do
        # Read to the end: a reader that stops early ends `strings` with SIGPIPE, which pipefail takes for "not found".
        leaked=$(strings --all "$file" | grep --fixed-strings "$path" || true)
        if [ -n "$leaked" ]; then
            echo "$name holds paths below $path: $(sed -n 1,3p <<<"$leaked")" >&2
            exit 1
        fi
    done
    echo "$name: glibc $wanted," $needed
done < <(find "$unpacked" -type f -print0 | LC_ALL=C sort --zero-terminated)
# The program twice, and libusb.
if [ "$checked" -ne 3 ]; then
    echo "$checked programs and libraries in place of 3" >&2
    exit 1
fi
