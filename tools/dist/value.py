#!/usr/bin/env python3
"""Prints a value that the packages need, from the file that defines it.

    tools/dist/value.py version      of the workspace (Cargo.toml)
    tools/dist/value.py glibc        the oldest one that the binary runs with (pyproject.toml)
    tools/dist/value.py epoch        the time of the last commit, for files in packages (SOURCE_DATE_EPOCH)
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def one(file: str, pattern: str) -> str:
    """The one match of the pattern in a file."""
    found = re.findall(pattern, (ROOT / file).read_text(), re.MULTILINE)
    if len(found) != 1:
        raise SystemExit(f"{file}: {pattern} matches {len(found)} times in place of once")
    return str(found[0])


def version() -> str:
    return one("Cargo.toml", r'^\[workspace\.package\]\nversion = "([0-9.]+)"$')


def glibc() -> str:
    return one("pyproject.toml", r'^compatibility = "manylinux_([0-9]+_[0-9]+)"$').replace("_", ".")


def epoch() -> str:
    if os.environ.get("SOURCE_DATE_EPOCH"):
        return os.environ["SOURCE_DATE_EPOCH"]
    git = ["git", "-C", str(ROOT), "log", "-1", "--format=%ct"]
    return subprocess.run(git, capture_output=True, text=True, check=True).stdout.strip()


VALUES = {"version": version, "glibc": glibc, "epoch": epoch}

if __name__ == "__main__":
    if len(sys.argv) != 2 or sys.argv[1] not in VALUES:
        raise SystemExit(__doc__)
    print(VALUES[sys.argv[1]]())
