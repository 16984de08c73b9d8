#!/usr/bin/env bash
# Checks the dependencies of a built program: no newer C library than README.md promises, and libusb as a shared library
# (it is LGPL). usage: tools/check_binary.sh PROGRAM
set -euo pipefail
program=$1
promised=$(sed -nE 's/.*glibc ([0-9.]+) or later.*/\1/p' "$(dirname "$0")/../README.md" | head -1)
wanted=$(objdump -T "$program" | grep -oE 'GLIBC_[0-9.]+' | sort --unique --version-sort | tail -1)
newer=$(printf '%s\n' "GLIBC_$promised" "$wanted" | sort --version-sort | tail -1)
if [ "$newer" != "GLIBC_$promised" ]; then
    echo "$program needs $wanted, README.md promises glibc $promised; these functions need it:" >&2
    objdump -T "$program" | grep -F "$wanted" | awk '{print "  " $NF}' >&2
    exit 1
fi
# Read completely: a reader that exits early ends objdump with SIGPIPE, which pipefail treats as a failure.
needed=$(objdump -p "$program" | grep NEEDED)
if ! grep -q 'libusb-1.0.so' <<<"$needed"; then
    echo "$program does not load libusb-1.0.so: it was linked statically (tools/setup.sh build installs what is missing)" >&2
    exit 1
fi
echo "$program: $wanted, libusb-1.0.so"
