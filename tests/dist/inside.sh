#!/bin/bash
# Inside a clean Debian, as root: the wheel before the Debian package, because the second brings libusb to the system.
set -Eeuo pipefail
trap 'echo "failed: $BASH_COMMAND" >&2' ERR
. /etc/os-release
echo "$PRETTY_NAME, $(ldd --version | sed -n '1s/.* //p'), Python $(python3 -c 'import platform; print(platform.python_version())')"
useradd --create-home robot
robot() { runuser --user robot -- env -i HOME=/home/robot USER=robot PATH=/usr/bin:/bin LANG=C.UTF-8 "$@"; }

if ldconfig -p | grep -q libusb-1.0; then
    echo "this system has libusb already; the wheel must bring it" >&2
    exit 1
fi
robot bash /test/wheel.sh

apt-get update --quiet=2
apt-get install --quiet=2 --yes --no-install-recommends /packages/*.deb >/dev/null
dpkg --verify depthrig
if command -v udevadm >/dev/null && udevadm verify --help >/dev/null 2>&1; then
    udevadm verify /usr/lib/udev/rules.d/70-depthrig.rules
fi
robot bash /test/deb.sh
dpkg --listfiles depthrig >/tmp/listed

kept=$(cd /home/robot && find . -path ./environment -prune -o -type f -print0 | sort --zero-terminated | xargs --null sha256sum)
grep -q seg_0000.mcap <<<"$kept"
apt-get purge --quiet=2 --yes depthrig >/dev/null
after=$(cd /home/robot && find . -path ./environment -prune -o -type f -print0 | sort --zero-terminated | xargs --null sha256sum)
if [ "$kept" != "$after" ]; then
    diff <(echo "$kept") <(echo "$after") || true
    echo "removing the package changed files of the user" >&2
    exit 1
fi
while read -r path; do
    if [ -f "$path" ]; then
        echo "$path is still there after purge" >&2
        exit 1
    fi
done </tmp/listed
echo "purge: no file of the package is left, the user's $(wc -l <<<"$kept") files are unchanged"
