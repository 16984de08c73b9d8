#!/usr/bin/env bash
# Creates a Python environment for tests, as small as it can be: without pip unless that is asked for by its
# version, and sharing the files that the project's other environments have too.
#
#   tools/environment.sh FOLDER PYTHON PIP-ARGUMENT...
set -euo pipefail
cd "$(dirname "$0")/.."
folder=$1 python=$2
shift 2

"$python" -m venv --clear "$folder"
"$folder/bin/python" -m pip install --quiet --disable-pip-version-check --no-compile "$@"
packages=$(echo "$folder"/lib/python3*/site-packages)
# Compiled for the versions of Python that this one is not.
version=$("$folder/bin/python" -c 'import sys; print("%d%d" % sys.version_info[:2])')
find "$packages" -name '*.cpython-*-*.so' ! -name "*.cpython-$version-*" -delete
case " $* " in
*" pip=="*) ;;
*) rm -rf "$packages"/pip "$packages"/pip-*.dist-info "$folder"/bin/pip* ;;
esac
# Names of functions that only a debugger reads.
find "$packages" -type f -size +100M -exec strip --strip-unneeded {} + 2>/dev/null || true

# A wheel's files have the times at which it was unpacked. In Debian `hardlink` is part of util-linux, elsewhere a package.
if command -v hardlink >/dev/null; then
    shopt -s nullglob
    hardlink --quiet --ignore-time --minimum-size 16384 "$folder" .venv .venv-*/ "${CARGO_TARGET_DIR:-target}"/python/*/ 2>/dev/null || true
fi
