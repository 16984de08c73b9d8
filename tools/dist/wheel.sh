#!/usr/bin/env bash
# Builds the binary and the wheel for one architecture: the same bytes in whatever folder this is run.
#
#   tools/dist/wheel.sh ARCH FOLDER     x86_64 or aarch64; writes the wheel and `depthrig`, the binary in it, to FOLDER
set -euo pipefail
cd "$(dirname "$0")/../.."
arch=$1 folder=$2
python=$PWD/target/dist/venv/bin/python
libusb=target/dist/libusb/$arch
tools/dist/libusb.sh "$arch" "$libusb"

SOURCE_DATE_EPOCH=$(tools/dist/value.py epoch)
export SOURCE_DATE_EPOCH
export CARGO_TARGET_DIR=$PWD/target/dist/cargo
# Not the path of this folder, nor that of the crates' sources, in any message of the binary.
flags="--remap-path-prefix=$PWD=/depthrig"
c_flags="-ffile-prefix-map=$PWD=/depthrig"
for registry in "${CARGO_HOME:-$HOME/.cargo}"/registry/src/*; do
    flags+=" --remap-path-prefix=$registry=/crates"
    c_flags+=" -ffile-prefix-map=$registry=/crates"
done
# libusb is the system's, or the one that the wheel puts beside bin/.
export RUSTFLAGS="$flags -C link-arg=-Wl,-rpath,\$ORIGIN/../lib/depthrig"
export CFLAGS="$c_flags"
export PKG_CONFIG_ALLOW_CROSS=1
export PKG_CONFIG_LIBDIR=$PWD/$libusb

# The kernel's interfaces as Zig's headers have them. maturin names these relative to this folder, and the build script that
# reads them runs elsewhere.
zig=$("$python" -c 'import pathlib, ziglang; print(pathlib.Path(ziglang.__file__).parent / "lib")')
clang="-isystem $zig/include"
for part in "${arch/x86_64/x86}-linux-gnu" generic-glibc "${arch/x86_64/x86}-linux-any" any-linux-any; do
    clang+=" -isystem $zig/libc/include/$part"
done

# maturin and its cargo find Zig by the Python of this environment.
built=target/dist/maturin/$arch
rm -rf "$built"
env "PATH=${python%/*}:$PATH" "BINDGEN_EXTRA_CLANG_ARGS_$arch-unknown-linux-gnu=$clang" \
    "$python" -m maturin build --release --zig --locked --target "$arch-unknown-linux-gnu" --out "$built"
"$python" tools/dist/wheel.py "$built"/depthrig-*.whl "$libusb" "$folder"
