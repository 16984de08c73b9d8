"""Allocates shared memory in advance: writing where none is left kills the process (SIGBUS)."""

from __future__ import annotations

import errno
import os
import resource

from ._layout import SHM_PREFIX
from .errors import BusError

_SHM = "/dev/shm"
# Free bytes without which nothing is created: iceoryx2 writes some KiB besides the slots when it creates a port.
_ROOM = 1 << 20
# Free bytes that a channel's slots leave for everything else.
_LEFT_OVER = 4 * _ROOM
# A port opens some descriptors at a time, and closes them again when one of them fails.
_DESCRIPTORS = 16
_ENLARGE = f"enlarge it (mount -o remount,size=4G {_SHM}; with Docker --ipc=host or --shm-size=4g)"


def _free() -> int | None:
    try:
        stat = os.statvfs(_SHM)
    except OSError:
        return None
    return stat.f_bavail * stat.f_frsize


def check_room() -> None:
    """Raise BusError if there is too little memory to create a port safely."""
    free = _free()
    if free is not None and free < _ROOM:
        raise BusError(f"{_SHM} is full ({free >> 10} KiB are free); delete what fills it, or {_ENLARGE}")


def back(port: int, slots: int, channel: str) -> None:
    """Allocate the memory of every slot of the port that writes a channel."""
    ending = f"_{port}.data"
    names = [n for n in os.listdir(_SHM) if n.startswith(SHM_PREFIX) and n.endswith(ending)]
    if not names:
        raise BusError(f"channel {channel}: {_SHM} has no memory for it although it was just created")
    file = os.open(os.path.join(_SHM, names[0]), os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW)
    size = os.fstat(file).st_size
    try:
        free = _free()
        if free is not None and size > free:  # the kernel would first take all free memory
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        os.posix_fallocate(file, 0, size)
    except OSError as e:
        if e.errno not in (errno.ENOSPC, errno.ENOMEM):
            raise BusError(f"channel {channel}: its memory cannot be reserved ({e.strerror})") from e
    else:
        free = _free()
        if free is None or free >= _LEFT_OVER:
            return
    finally:
        held = os.fstat(file).st_blocks * 512
        os.close(file)
    fit = max(0, (_free() or 0) + held - _LEFT_OVER) * slots // max(size, 1)
    raise BusError(
        f"channel {channel}: {_SHM} has no room for its {slots} slots ({-(-size >> 20)} MiB), {fit} would fit; "
        f"{_ENLARGE}, or use smaller images"
    )


def out_of_descriptors() -> str | None:
    """Return advice when so few file descriptors are left that opening a port can fail, else None."""
    most = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    try:
        used = len(os.listdir("/proc/self/fd"))
    except OSError as e:
        if e.errno not in (errno.EMFILE, errno.ENFILE):
            return None
        used = most
    if most == resource.RLIM_INFINITY or used + _DESCRIPTORS <= most:
        return None
    return (
        f"this process has {used} of at most {most} file descriptors open; close subscribers or files that are not "
        "needed, or raise the limit (ulimit -n)"
    )
