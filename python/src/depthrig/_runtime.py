"""Finds rigs in the user's runtime folder, which has one lock file for each running rig."""

from __future__ import annotations

import fcntl
import os
import re
import time
from typing import Union

from ._layout import RUNTIME_DIR_VARIABLE
from .errors import AmbiguousRig, BusError, RigNotRunning

PathLike = Union[str, "os.PathLike[str]"]
_NAME = re.compile(r"[a-z][a-z0-9_]{0,30}", re.ASCII)
# A process that checks a lock holds it for an instant, so one refusal proves nothing.
_LOCK_ATTEMPTS, _LOCK_PAUSE_S = 20, 0.01


def check_name(name: str, what: str) -> str:
    """Return `name` if it is a valid name of a rig, camera or stream, else raise ValueError."""
    if not _NAME.fullmatch(name):
        raise ValueError(f"{name!r} cannot be the name of a {what}: 1 to 31 of a-z, 0-9 and _, beginning with a letter")
    return name


def runtime_dir(path: PathLike | None = None) -> str:
    """Return the runtime folder: `path`, else where the daemon puts it for this user."""
    if path is None:
        session = os.environ.get("XDG_RUNTIME_DIR")
        if RUNTIME_DIR_VARIABLE in os.environ:
            path = os.environ[RUNTIME_DIR_VARIABLE]
        elif session is not None and os.path.isdir(session):
            path = os.path.join(session, "depthrig")
        else:
            path = f"/tmp/depthrig-{os.getuid()}"
    path = os.path.abspath(os.fspath(path))
    try:
        owner = os.stat(path).st_uid
    except FileNotFoundError:
        return path
    except OSError as e:
        raise BusError(f"runtime folder {path} cannot be read ({e.strerror}); run as the daemon's user") from e
    if owner != os.getuid():
        raise BusError(
            f"runtime folder {path} belongs to user {owner}, you are user {os.getuid()}, and a rig and its "
            "subscribers run as one user: run as the daemon's user"
        )
    return path


def holder(folder: str, rig: str) -> str | None:
    """Return the process that runs `rig` now, in its own words; None without one."""
    return holder_of(os.path.join(folder, f"{rig}.lock"))


def holder_of(path: str) -> str | None:
    """Return the process that holds the lock `path`, in its own words; None if it is free."""
    try:
        with open(path, encoding="utf-8", errors="replace") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                return file.read()
    except OSError:
        pass
    return None


def take_lock(path: str, program: str) -> int | str:
    """Take the lock `path`, which the kernel frees with the process.

    Returns the open file, or the process that holds it in its own words.
    """
    os.makedirs(os.path.dirname(path), mode=0o700, exist_ok=True)
    try:
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    except OSError as e:
        raise BusError(f"{path} cannot be opened ({e.strerror}); run as the daemon's user") from e
    for _ in range(_LOCK_ATTEMPTS):
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            break
        except BlockingIOError:
            time.sleep(_LOCK_PAUSE_S)
    else:
        who = os.pread(file, 4096, 0).decode("utf-8", "replace") or "another process"
        os.close(file)
        return who
    os.ftruncate(file, 0)
    os.pwrite(file, f"process {os.getpid()} ({program})".encode(), 0)
    return file


def running_rigs(runtime_dir: PathLike | None = None) -> list[str]:
    """List the running rigs, sorted: those whose lock is held."""
    return _running(_runtime_dir(runtime_dir))


_runtime_dir = runtime_dir


def _running(folder: str) -> list[str]:
    try:
        names = [entry[: -len(".lock")] for entry in os.listdir(folder) if entry.endswith(".lock")]
    except OSError:
        return []
    return sorted(n for n in names if _NAME.fullmatch(n) and holder(folder, n) is not None)


def not_running(folder: str, rig: str) -> RigNotRunning:
    """Return the error for a rig that does not run."""
    rigs = _running(folder)
    there = f"running there: {', '.join(rigs)}" if rigs else "no rig runs there"
    return RigNotRunning(f"rig {rig!r} is not running in {folder}; {there}. {_HOW_TO_START}")


_HOW_TO_START = (
    "Start one with `depthrig run RIG.toml` or `depthrig demo`, "
    f"as the same user and with the same {RUNTIME_DIR_VARIABLE}"
)


def pick_rig(folder: str, rig: str | None) -> str:
    """Return `rig`, or the only rig that runs when it is None."""
    if rig is not None:
        return check_name(rig, "rig")
    rigs = _running(folder)
    if not rigs:
        raise RigNotRunning(f"no rig is running in {folder}. {_HOW_TO_START}")
    if len(rigs) > 1:
        raise AmbiguousRig(f"several rigs are running in {folder}: {', '.join(rigs)}; say which with rig=…")
    return rigs[0]
