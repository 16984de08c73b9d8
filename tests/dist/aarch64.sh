#!/usr/bin/env bash
# Runs the binary for aarch64 in QEMU (user mode) beside that of this computer, and compares what they compute.
#
#   tests/dist/aarch64.sh ROOT WHEEL DEB     ROOT: a Debian for arm64, unpacked, with libc6 and libusb
set -Eeuo pipefail
trap 'echo "failed: $BASH_COMMAND" >&2' ERR
cd "$(dirname "$0")/../.."
root=$1 wheel=$2 deb=$3
here=target/dist/out/x86_64/depthrig
data=${DEPTHRIG_TEST_DATA:-../shared/data}
work=$(mktemp --directory /tmp/depthrig-arm.XXXXXX)
trap 'rm -rf "$work"' EXIT
export DEPTHRIG_RUNTIME_DIR=$work/runtime

python3 -m zipfile --extract "$wheel" "$work/wheel"
dpkg-deb --extract "$deb" "$work/deb"
packaged=$work/deb/usr/bin/depthrig
cmp "$packaged" "$work"/wheel/depthrig-*.data/scripts/depthrig
arm() { qemu-aarch64 -L "$root" "$packaged" "$@"; }

readelf --file-header "$packaged" | grep --quiet 'Machine: *AArch64'
# The wheel's own libusb, not that of the system.
mkdir -p "$work/bare/bin" "$work/bare/lib/depthrig"
cp "$packaged" "$work/bare/bin/"
cp "$work"/wheel/depthrig-*.data/data/lib/depthrig/libusb-1.0.so.0 "$work/bare/lib/depthrig/"
qemu-aarch64 -L "$root" -E LD_TRACE_LOADED_OBJECTS=1 "$work/bare/bin/depthrig" | grep --fixed-strings /lib/depthrig/libusb
[ "$(arm --version)" = "$("$here" --version)" ]
echo "version: $(arm --version)"

. tests/dist/rig.sh # rig_file
rig_file >"$work/rig.toml"
arm config check "$work/rig.toml"
diff <(arm config show) <("$here" config show)
mkdir "$work/man" && arm man --out "$work/man/arm" && "$here" man --out "$work/man/here"
diff --recursive "$work/man/arm" "$work/man/here"
echo "configuration and manual pages: the same text"

# A recording of this computer, with each codec of depth, read there.
for depth in zstd rank; do
    sed "s/^\[recording\]/[recording]\ndepth = \"$depth\"/" "$work/rig.toml" >"$work/$depth.toml"
    "$here" run "$work/$depth.toml" --seconds 3 --record "$work/$depth" >"$work/log" 2>&1 || [ $? -eq 3 ] || { cat "$work/log"; exit 1; }
    arm verify "$work/$depth"/*
    arm cat "$work/$depth"/* --every 5 --out "$work/$depth-arm" >/dev/null
    "$here" cat "$work/$depth"/* --every 5 --out "$work/$depth-here" >/dev/null
    diff --recursive "$work/$depth-arm" "$work/$depth-here"
    echo "$depth: $(find "$work/$depth-arm" -type f | wc -l) images, the same bytes"
done

# Semi-global matching without the instructions of x86-64: the same disparity.
if [ -d "$data/opencv_aloe_stereo" ]; then
    pair=("$data/opencv_aloe_stereo/aloeL.jpg" "$data/opencv_aloe_stereo/aloeR.jpg")
    arm stereo --preset performance --out "$work/arm.npy" "${pair[@]}" >/dev/null
    "$here" stereo --preset performance --out "$work/here.npy" "${pair[@]}" >/dev/null
    cmp "$work/arm.npy" "$work/here.npy"
    echo "disparity of a real pair: the same bytes"
else
    echo "skipped: no stereo pair at $data"
fi
