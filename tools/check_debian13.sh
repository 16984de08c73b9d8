#!/usr/bin/env bash
# Builds depthrig in a clean Debian 13 (newer kernel headers, glibc and libclang than on Debian 12), as a newcomer would: the
# tree as it is, tools/setup.sh, cargo. Needs root, mmdebstrap, the network and this computer's Rust toolchain.
#
#   tools/check_debian13.sh [CARGO ARGUMENT...]   default: build --locked --package depthrig
#
# The root is created once, in target/debian13; remove that folder to start over.
set -euo pipefail
cd "$(dirname "$0")/.."
suite=${DEBIAN_SUITE:-trixie}
target=${CARGO_TARGET_DIR:-$PWD/target}
root=$target/debian13/$suite
[ $# -gt 0 ] || set -- build --locked --package depthrig

if [ "$(id -u)" -ne 0 ]; then
    echo "it needs root, to make the system and to enter it" >&2
    exit 1
fi
if ! command -v mmdebstrap >/dev/null; then
    echo "mmdebstrap is missing: apt-get install --no-install-recommends mmdebstrap" >&2
    exit 1
fi
if [ ! -e "$root/etc/debian_version" ]; then
    mkdir -p "$(dirname "$root")"
    rm -rf "$root.part"
    mmdebstrap --variant=minbase --include=ca-certificates "$suite" "$root.part"
    mv "$root.part" "$root"
fi
sysroot=$(rustc --print sysroot)
export root sysroot
export cargo_home=${CARGO_HOME:-$HOME/.cargo}
mkdir -p "$root/src" "$root/toolchain" "$root/cargo" "$root/build" "$cargo_home/registry"
# A private mount namespace: no mount is left behind.
exec unshare --mount --propagation=private bash -euo pipefail -c '
    mount --rbind /dev "$root/dev"
    mount -t proc proc "$root/proc"
    mount --bind "$PWD" "$root/src"
    mount -o remount,bind,ro "$root/src"
    mount --bind "$sysroot" "$root/toolchain"
    mkdir -p "$root/cargo/registry"
    mount --bind "$cargo_home/registry" "$root/cargo/registry"
    # A registry mirror, if this computer has one.
    [ ! -e "$cargo_home/config.toml" ] || cp "$cargo_home/config.toml" "$root/cargo/config.toml"
    cp /etc/resolv.conf "$root/etc/resolv.conf"
    exec env -i HOME=/root PATH=/toolchain/bin:/usr/sbin:/usr/bin:/sbin:/bin CARGO_HOME=/cargo CARGO_TARGET_DIR=/build \
        CARGO_BUILD_JOBS="${CARGO_BUILD_JOBS:-2}" chroot "$root" \
        bash -euc "cd /src && tools/setup.sh build && . /etc/os-release && echo \"\$PRETTY_NAME\" && exec cargo \"\$@\"" cargo "$@"
' debian13 "$@"
