#!/usr/bin/env bash
# Builds libusb as a shared library with Zig, from the sources in the crate libusb1-sys: the wheel brings it beside the
# binary (it is LGPL, and users can replace it), and the linker of a cross build needs one. Finds devices through netlink,
# so that it needs the C library alone.
#
#   tools/dist/libusb.sh ARCH FOLDER    x86_64 or aarch64; writes FOLDER/libusb-1.0.so.0 and FOLDER/libusb-1.0.pc
set -euo pipefail
cd "$(dirname "$0")/../.."
arch=$1 folder=$2
glibc=$(tools/dist/value.py glibc)
python=${DEPTHRIG_DIST_PYTHON:-target/dist/venv/bin/python}

manifest=$(cargo metadata --locked --format-version 1 | python3 -c '
import json, sys
print(next(p["manifest_path"] for p in json.load(sys.stdin)["packages"] if p["name"] == "libusb1-sys"))')
source=$(dirname "$manifest")/libusb
version=$(sed -nE 's/.*static VERSION: &str = "([0-9.]+)".*/\1/p' "$(dirname "$manifest")/build.rs")
mkdir -p "$folder/include"
cp "$source/COPYING" "$folder/COPYING"
cp "$source/libusb/libusb.h" "$folder/include/"
: >"$folder/include/config.h"

files=(core descriptor hotplug io strerror sync os/linux_netlink os/linux_usbfs os/events_posix os/threads_posix)
sources=()
for file in "${files[@]}"; do sources+=("$source/libusb/$file.c"); done
# As the crate's build script defines them for Linux without libudev.
defines=(-D_GNU_SOURCE=1 -DENABLE_LOGGING=1 -DHAVE_ASM_TYPES_H=1 -DHAVE_CLOCK_GETTIME=1 -DHAVE_EVENTFD=1 -DHAVE_NFDS_T=1
    -DHAVE_SYS_TIME_H=1 -DHAVE_TIMERFD=1 -DOS_LINUX=1 -DPLATFORM_POSIX=1 '-DPRINTF_FORMAT(a,b)='
    '-DDEFAULT_VISIBILITY=__attribute__((visibility("default")))')
"$python" -m ziglang cc -target "$arch-linux-gnu.$glibc" -shared -fPIC -O2 -s -fvisibility=hidden -std=gnu11 \
    "-ffile-prefix-map=$source=libusb" -Wl,-soname,libusb-1.0.so.0 -Wl,-z,relro,-z,now -pthread \
    -I"$folder/include" -I"$source/libusb" "${defines[@]}" \
    "${sources[@]}" -o "$folder/libusb-1.0.so.0"
ln -sf libusb-1.0.so.0 "$folder/libusb-1.0.so"
cat >"$folder/libusb-1.0.pc" <<PC
Name: libusb-1.0
Description: USB devices from programs
Version: $version
Libs: -L$PWD/$folder -lusb-1.0
Cflags: -I$PWD/$folder/include
PC
