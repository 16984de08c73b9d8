#!/usr/bin/env bash
# Enters a clean system, in namespaces of its own (tests/dist/run): what is written there goes into a layer above it.
set -euo pipefail
mkdir "$layer/upper" "$layer/work" "$layer/system"
system=$layer/system
mount -t overlay overlay -o "lowerdir=$root,upperdir=$layer/upper,workdir=$layer/work" "$system"
mount -t proc proc "$system/proc"
mount --rbind /sys "$system/sys"
mount -t tmpfs -o mode=0755 tmpfs "$system/dev"
for device in null zero full random urandom tty; do
    touch "$system/dev/$device"
    mount --bind "/dev/$device" "$system/dev/$device"
done
mkdir "$system/dev/shm" "$system/dev/pts"
mount -t devpts -o newinstance,ptmxmode=0666 devpts "$system/dev/pts"
ln -s pts/ptmx "$system/dev/ptmx"
mount -t tmpfs -o mode=1777,size=1g tmpfs "$system/dev/shm"
mkdir "$system/packages" "$system/wheels" "$system/test"
cp "$WHEEL" "$DEB" "$system/packages/"
mount --bind "$WHEELS" "$system/wheels"
mount --bind "$HERE" "$system/test"
cp --dereference /etc/resolv.conf "$system/etc/resolv.conf"
exec env -i HOME=/root PATH=/usr/sbin:/usr/bin:/sbin:/bin LANG=C.UTF-8 DEBIAN_FRONTEND=noninteractive \
    chroot "$system" /bin/bash /test/inside.sh
