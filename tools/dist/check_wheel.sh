#!/usr/bin/env bash
# Checks what a built binary needs: the C library of the version that the wheel names or an older one, and libusb, which the
# wheel brings; and that it holds no path of this computer.
#
#   tools/dist/check_wheel.sh ARCH FOLDER     what tools/dist/wheel.sh wrote
set -euo pipefail
cd "$(dirname "$0")/../.."
arch=$1 folder=$2
binary=$folder/depthrig
glibc=$(tools/dist/value.py glibc)

needed=$(readelf --dynamic --wide "$binary" | sed -nE 's/.*\(NEEDED\).*\[(.*)\]/\1/p' | sort)
allowed='^(ld-linux-.*\.so\.[0-9]|libc\.so\.6|libdl\.so\.2|libm\.so\.6|libpthread\.so\.0|libusb-1\.0\.so\.0)$'
if foreign=$(grep -vE "$allowed" <<<"$needed"); then
    echo "$binary needs libraries that are neither the C library nor in the wheel:" $foreign >&2
    exit 1
fi
if ! grep -q '^libusb' <<<"$needed"; then
    echo "$binary does not load libusb: it was linked statically, and it is LGPL" >&2
    exit 1
fi
for file in "$binary" "target/dist/libusb/$arch/libusb-1.0.so.0"; do
    wanted=$(readelf --version-info --wide "$file" | grep -oE 'GLIBC_[0-9.]+' | sort --unique --version-sort | tail -1)
    newer=$(printf '%s\n' "GLIBC_$glibc" "$wanted" | sort --version-sort | tail -1)
    if [ "$newer" != "GLIBC_$glibc" ]; then
        echo "$file needs $wanted; pyproject.toml promises glibc $glibc" >&2
        exit 1
    fi
done
for path in "$PWD" "${CARGO_HOME:-$HOME/.cargo}"; do
    if strings --all "$binary" | grep --fixed-strings --max-count=3 "$path" >&2; then
        echo "$binary holds paths below $path" >&2
        exit 1
    fi
done
echo "$binary ($arch): $wanted," $needed
