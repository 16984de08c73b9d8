"""What a run was made of: the configuration, the revision of the code, hashes of the data."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import subprocess
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from .errors import LabError

__all__ = ["fingerprint", "fsync_folder", "keep", "write_atomically"]

HEAD = 1 << 16
"""So many bytes of each file enter the hash of a dataset."""


def fsync_folder(folder: Path) -> None:
    """Make renames in a folder durable."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def write_atomically(path: Path, data: bytes) -> None:
    """Write a file so that it is complete or as it was before, also after a crash or on a full disk."""
    # Of this process: the parts of a run write one file with the same content.
    part = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with part.open("wb") as f:
            f.write(data)
            f.flush()
            os.fsync(f.fileno())
        part.replace(path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise
    fsync_folder(path.parent)


def fingerprint(files: Iterable[Path], base: Path) -> str:
    """Return a SHA-256 over names, sizes and the first 64 KiB of `files`, in order of their names."""
    whole = hashlib.sha256()
    for path in sorted(files):
        whole.update(f"{os.path.relpath(path, base)}\0{path.stat().st_size}\0".encode())
        with path.open("rb") as f:
            whole.update(f.read(HEAD))
    return whole.hexdigest()


def _git(folder: Path) -> str:
    command = ["git", "-C", str(folder), "describe", "--always", "--dirty", "--abbrev=40"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=30, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return "unknown"
    return done.stdout.strip() or "unknown"


def keep(folder: Path, config: dict[str, Any], data: dict[str, str]) -> None:
    """Write `run.json` into the folder of a run, or hold an existing one against this run.

    :param data: the fingerprint of each dataset.
    :raises LabError: when the folder holds a run of another configuration or other data; names what differs.
    """
    config = json.loads(json.dumps(config))
    path = folder / "run.json"
    if path.exists():
        try:
            kept = json.loads(path.read_text())
            before = {**kept["config"], "data hashes": kept["data"]}
        except (ValueError, KeyError, TypeError) as e:
            raise LabError(f"{path}: not the record of a run ({e}); use a new folder") from None
        now = {**config, "data hashes": data}
        differs = [k for k in now if now[k] != before.get(k)]
        if differs:
            what = ", ".join(differs)
            raise LabError(
                f"{path}: this folder holds a run with another {what}; use a new folder or the same configuration"
            )
        return
    import torch

    versions = {"python": platform.python_version(), "torch": torch.__version__, "numpy": np.__version__}
    record = {"config": config, "data": data, "git": _git(Path(__file__).parent), "versions": versions}
    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(path, (json.dumps(record, indent=1) + "\n").encode())
