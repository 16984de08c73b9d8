#!/usr/bin/env bash
# Installs the Debian packages for building (`build`), testing (`test`), two computers out of one (`two-hosts`), testing on a real kernel (`vm`), comparing with
# other recorders (`peers`), fuzzing (`fuzz`) and building and testing packages (`dist`) if permitted; else prints the
# command to run. Prints nothing if all are installed.
set -euo pipefail

# Prefix to run apt-get with; empty if not permitted.
apt=()
if command -v apt-get >/dev/null && [ "$(id -u)" -eq 0 ]; then
    apt=(env DEBIAN_FRONTEND=noninteractive apt-get)
elif command -v apt-get >/dev/null && sudo --non-interactive true 2>/dev/null; then
    apt=(sudo --non-interactive env DEBIAN_FRONTEND=noninteractive apt-get)
fi

# The version of Clang in this release of Debian; unknown on a computer without package lists.
clang_version() {
    apt-cache depends libclang1 2>/dev/null | sed -n 's/^ *Depends: libclang1-//p' || true
}

missing=()
need() { # PACKAGE COMMAND...: the package when the command fails
    local package=$1
    shift
    "$@" >/dev/null 2>&1 || missing+=("$package")
}

for part in "$@"; do
    case $part in
    build)
        need gcc command -v cc
        need libc6-dev test -e /usr/include/stdio.h
        # libusb, a shared library; without these two it would be built from source and linked statically.
        need pkg-config command -v pkg-config
        need libusb-1.0-0-dev pkg-config --exists libusb-1.0
        # The bindings of the kernel's video interface are generated from its header by libclang, with Clang's own headers.
        clang=$(clang_version)
        if [ -z "$clang" ] && [ ${#apt[@]} -gt 0 ]; then
            "${apt[@]}" update --quiet=2
            clang=$(clang_version)
        fi
        need "libclang1-${clang:-14}" eval '[ -n "${LIBCLANG_PATH:-}" ] || compgen -G "/usr/lib/*/libclang-[0-9]*.so*"'
        need "libclang-common-${clang:-14}-dev" compgen -G '/usr/lib/*/lib/clang/*/include/stddef.h'
        ;;
    test)
        # Compiled tests, and Python environments of which that with PyTorch is the largest.
        free_gb=$(df --output=avail --block-size=1G . | tail -1)
        if [ ! -d target/test-logs ] && [ "$free_gb" -lt 15 ]; then
            echo "the tests take about 15 GB of disk, and $((free_gb)) GB are free in $PWD" >&2
        fi
        need python3 command -v python3
        need python3-venv python3 -c 'import ensurepip, venv'
        need nodejs command -v node
        need npm command -v npm
        # Decodes H.264 of SVO2 recordings; loaded at run time.
        need libopenh264-7 eval 'grep -q libopenh264.so <<<"$(ldconfig -p)" || compgen -G "/usr/lib/*/libopenh264.so*"'
        # Other readers of recordings of an Azure Kinect.
        need ffmpeg command -v ffprobe
        need mkvtoolnix command -v mkvinfo
        # The bindings below drivers/oak are C++.
        need g++ command -v c++
        # Inspects the dependencies of a program.
        need binutils command -v objdump
        # Decodes the sixel images of `top`.
        need libsixel-bin command -v sixel2png
        # The browser that the live page is tested in.
        need chromium command -v chromium
        # The boxes that tests run in.
        need util-linux command -v setpriv
        need procps command -v pgrep
        ;;
    two-hosts)
        # An ordinary user's PATH may lack /usr/sbin.
        need iproute2 test -x /usr/sbin/tc
        # One of them is reached with OpenSSH; its server, which is fetched below, needs this library.
        need openssh-client command -v ssh
        need libwrap0 sh -c 'ldconfig -p | grep -q libwrap.so.0 || /sbin/ldconfig -p | grep -q libwrap.so.0'
        need util-linux command -v unshare
        need procps command -v pgrep
        ;;
    vm)
        need qemu-system-x86 command -v qemu-system-x86_64
        need busybox-static command -v busybox
        need kmod command -v depmod
        need zstd command -v zstd
        # A scenario checks its rules.
        need udev command -v udevadm
        # A scenario runs the service under it; nothing is started on this computer.
        need systemd test -x /lib/systemd/systemd
        need binutils command -v objcopy
        need python3 command -v python3
        ;;
    peers)
        # Debian's own Python: its rosbag works with no other.
        need python3 test -x /usr/bin/python3
        need python3-venv /usr/bin/python3 -c 'import ensurepip, venv'
        need python3-rosbag /usr/bin/python3 -c 'import importlib.util as u, sys; sys.exit(not u.find_spec("rosbag"))'
        need python3-sensor-msgs /usr/bin/python3 -c 'import importlib.util as u, sys; sys.exit(not u.find_spec("sensor_msgs"))'
        ;;
    fuzz)
        # libFuzzer is C++ and is built with the targets.
        need g++ command -v c++
        ;;
    dist)
        need python3 command -v python3
        need python3-venv python3 -c 'import ensurepip, venv'
        need dpkg command -v dpkg-deb
        need lintian command -v lintian
        # Systems without anything installed, in which the packages are tried.
        need mmdebstrap command -v mmdebstrap
        need util-linux command -v unshare
        # Runs the binary for aarch64.
        need qemu-user command -v qemu-aarch64
        need binutils command -v objdump
        ;;
    *)
        echo "usage: tools/setup.sh [build] [test] [two-hosts] [vm] [peers] [fuzz] [dist]" >&2
        exit 2
        ;;
    esac
done

# Real test images from a Debian package; CONTRIBUTING.md lists the others.
images=${CARGO_TARGET_DIR:-target}/test-data/opencv_aloe_stereo
fetch_images() {
    local work
    work=$(mktemp --directory) || return
    (cd "$work" && apt-get download --quiet=2 opencv-doc >/dev/null 2>&1 && dpkg-deb --extract opencv-doc_*.deb .) &&
        mkdir -p "$images.part" &&
        find "$work/usr" -name 'aloe*' -type f -exec cp {} "$images.part" \; &&
        [ -s "$images.part/aloeL.jpg" ] && rm -rf "$images" && mv "$images.part" "$images"
    local status=$?
    rm -rf "$work" "$images.part"
    return "$status"
}
case " $* " in
*" test "*)
    if [ ! -d "${DEPTHRIG_TEST_DATA:-../shared/data}" ] && [ ! -d "$images" ] && command -v apt-get >/dev/null; then
        echo "fetching images of Debian's opencv-doc (95 MB) for tests into $images"
        fetch_images || echo "not fetched: tests of stereo on real images are skipped" >&2
    fi
    ;;
esac

if ! command -v cargo >/dev/null; then
    echo "Rust is missing: install the stable toolchain (1.92 or later) with rustup, see https://rustup.rs" >&2
    exit 1
fi
if [ ${#missing[@]} -gt 0 ]; then
    install=(install --yes --no-install-recommends "${missing[@]}")
    if [ ${#apt[@]} -eq 0 ]; then
        echo "missing: ${missing[*]}. Install them, then run this again:" >&2
        echo "  sudo apt-get ${install[*]}" >&2
        exit 1
    fi
    echo "installing: ${missing[*]}"
    "${apt[@]}" update --quiet=2
    "${apt[@]}" "${install[@]}"
fi

# An OpenSSH server for tests of two computers. The package is not installed: it would serve on port 22 of this computer.
server=${CARGO_TARGET_DIR:-target}/sshd
fetch_sshd() {
    local work
    work=$(mktemp --directory) || return
    (cd "$work" && apt-get download --quiet=2 openssh-server >/dev/null 2>&1) &&
        mkdir -p "$server" && dpkg-deb --extract "$work"/openssh-server_*.deb "$server"
    local status=$?
    rm -rf "$work"
    return "$status"
}
case " $* " in
*" two-hosts "*)
    if [ ! -x /usr/sbin/sshd ] && [ ! -x "$server/usr/sbin/sshd" ] && command -v apt-get >/dev/null; then
        fetch_sshd || echo "no OpenSSH server was fetched: what needs two computers is skipped" >&2
    fi
    ;;
esac
