#!/usr/bin/env bash
# Builds the Debian package around a built binary: the same bytes each time for one commit.
#
#   tools/dist/deb.sh ARCH BINARY GENERATOR OUT    x86_64 or aarch64
#   tools/dist/deb.sh --tree BINARY GENERATOR OUT  only the files of the package, as a tree below OUT
#
# GENERATOR is a binary of the same version that runs on this computer: it writes manual pages and completions.
# DEPTHRIG_MAINTAINER ("Name <address>") is who answers for the package: set it to publish one.
set -euo pipefail
cd "$(dirname "$0")/../.."
arch=$1 binary=$2 generator=$(realpath "$3") out=$4
version=$(tools/dist/value.py version)-1
# The domain is reserved (RFC 2606): mail to it reaches nobody.
maintainer=${DEPTHRIG_MAINTAINER:-depthrig authors <authors@depthrig.invalid>}
SOURCE_DATE_EPOCH=$(tools/dist/value.py epoch)
export SOURCE_DATE_EPOCH

file() { # MODE SOURCE TARGET
    install -D --mode="$1" "$2" "$tree/$3"
}
packed() { # TARGET: what comes on standard input, compressed without name and time
    mkdir -p "$tree/$(dirname "$1")"
    gzip --best --no-name >"$tree/$1"
    chmod 0644 "$tree/$1"
}

# Nothing of the user's settings may change a page: each is written for a terminal of no known width.
run() {
    env -i HOME=/nonexistent "$generator" "$@"
}

fill() {
    file 0755 "$binary" usr/bin/depthrig
    file 0644 tools/udev/70-depthrig.rules usr/lib/udev/rules.d/70-depthrig.rules
    file 0644 tools/tmpfiles/depthrig.conf usr/lib/tmpfiles.d/depthrig.conf
    file 0644 tools/systemd/user/depthrig.service usr/lib/systemd/user/depthrig.service
    local pages page shell
    pages=$(mktemp --directory)
    run man --out "$pages/man"
    for page in "$pages"/man/*.1; do
        packed "usr/share/man/man1/$(basename "$page").gz" <"$page"
    done
    for shell in bash zsh fish; do run completions "$shell" >"$pages/$shell"; done
    file 0644 "$pages/bash" usr/share/bash-completion/completions/depthrig
    file 0644 "$pages/zsh" usr/share/zsh/vendor-completions/_depthrig
    file 0644 "$pages/fish" usr/share/fish/vendor_completions.d/depthrig.fish
    run config show >"$pages/rig.toml"
    file 0644 "$pages/rig.toml" usr/share/doc/depthrig/examples/rig.toml
    rm -r "$pages"
    packed usr/share/doc/depthrig/NOTICE.gz <NOTICE
    packed usr/share/doc/depthrig/changelog.gz <CHANGELOG.md
    packed usr/share/doc/depthrig/changelog.Debian.gz <<LOG
depthrig ($version) unstable; urgency=medium

  * Built from the sources of depthrig; changelog.gz lists what changed.

 -- $maintainer  $(date --utc --rfc-email --date="@$SOURCE_DATE_EPOCH")
LOG
    # Paragraphs of the licence, as the format of this file wants them.
    local mit
    mit=$(sed -e '1,4d' -e 's/^$/./' -e 's/^/ /' LICENSE-MIT)
    python3 - "$mit" >"$tree/usr/share/doc/depthrig/copyright" <<'PY'
import pathlib, sys
print(pathlib.Path("tools/dist/debian/copyright").read_text().replace("@MIT@", sys.argv[1]), end="")
PY
    chmod 0644 "$tree/usr/share/doc/depthrig/copyright"
}

if [ "$arch" = --tree ]; then
    tree=$out
    fill
    exit
fi
case $arch in
x86_64) debian=amd64 ;;
aarch64) debian=arm64 ;;
*)
    echo "unknown architecture $arch; x86_64 and aarch64 are built" >&2
    exit 2
    ;;
esac
tree=$(mktemp --directory)
trap 'rm -rf "$tree"' EXIT
chmod 0755 "$tree"
umask 022
fill
mkdir "$tree/DEBIAN"
# As dpkg counts: a folder is 1 KiB, whatever the file system gives it.
size=$(find "$tree" -path "$tree/DEBIAN" -prune -o -type f -printf '%s\n' -o -printf '1\n' |
    awk '{kib += int(($1 + 1023) / 1024)} END {print kib}')
sed -e "s/@VERSION@/$version/" -e "s/@ARCH@/$debian/" -e "s/@SIZE@/$size/" -e "s/@MAINTAINER@/$maintainer/" \
    -e "s/@GLIBC@/$(tools/dist/value.py glibc)/" tools/dist/debian/control >"$tree/DEBIAN/control"
for script in postinst postrm; do install --mode=0755 "tools/dist/debian/$script" "$tree/DEBIAN/$script"; done
(cd "$tree" && find usr -type f -print0 | LC_ALL=C sort --zero-terminated | xargs --null md5sum) >"$tree/DEBIAN/md5sums"
find "$tree" -exec touch --no-dereference --date="@$SOURCE_DATE_EPOCH" {} +
mkdir -p "$out"
# One thread: several write other blocks.
DPKG_DEB_THREADS_MAX=1 dpkg-deb --root-owner-group -Zxz --build "$tree" "$out/depthrig_${version}_$debian.deb"
