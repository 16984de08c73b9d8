"""Subscribing to a rig's frame sets: which frames of all cameras belong to one moment."""

from __future__ import annotations

import ctypes
import struct
from dataclasses import dataclass

from . import _layout
from ._bus import SET_HEADER
from ._layout import SetHeaderFields
from ._reader import Reader
from ._runtime import PathLike
from .errors import VersionMismatch

# camera, stream, sequence, capture time, present, zero: `MemberRecord::encode` in bus/src/sets.rs.
_RECORD = struct.Struct("<32s32sQqQQ")


@dataclass(frozen=True)
class FrameSet:
    """A set of frames that belong to one moment. Times are nanoseconds on CLOCK_MONOTONIC."""

    set_id: int
    """Number of the set: 1, 2, 3, …"""
    tick_ns: int
    """The moment the set is for."""
    spread_ns: int
    """Latest minus earliest capture time of its frames."""
    incomplete: int
    """Sets so far that lacked a stream."""
    members: dict[str, int | None]
    """For each stream the `sequence` of its frame, None when it is missing, in the rig's order."""
    capture_times_ns: dict[str, int]
    """Capture time of each frame that is present."""

    @property
    def missing(self) -> list[str]:
        """Streams that have no frame in this set."""
        return [stream for stream, sequence in self.members.items() if sequence is None]

    @property
    def is_complete(self) -> bool:
        """Whether every stream has a frame in this set."""
        return not self.missing


class Sets(Reader[FrameSet]):
    """The frame sets of a rig; `rig`, `runtime_dir` and `timeout` as for :class:`depthrig.Stream`."""

    def __init__(self, rig: str | None = None, runtime_dir: PathLike | None = None, timeout: float = 2.0) -> None:
        super().__init__("sets", SET_HEADER, rig, runtime_dir, timeout)

    def _take(self) -> FrameSet | None:
        receiver = self._open
        sample = receiver.receive()
        if sample is None:
            return None
        header = SetHeaderFields(ctypes.string_at(sample.user_header_ptr, _layout.SET_HEADER_SIZE))
        payload = ctypes.string_at(sample.payload_ptr, sample.header.number_of_elements)
        if len(payload) != header.members * _layout.SET_RECORD_SIZE or _RECORD.size != _layout.SET_RECORD_SIZE:
            raise VersionMismatch(
                f"{receiver.what}: a set has {len(payload)} bytes for {header.members} members, not "
                f"{_RECORD.size} each; install the `depthrig` package of the daemon's version"
            )
        members: dict[str, int | None] = {}
        times: dict[str, int] = {}
        for camera, stream, sequence, capture_time_ns, present, _ in _RECORD.iter_unpack(payload):
            name = f"{camera.rstrip(bytes(1)).decode()}/{stream.rstrip(bytes(1)).decode()}"
            members[name] = sequence if present else None
            if present:
                times[name] = capture_time_ns
        return FrameSet(header.set_id, header.tick_ns, header.spread_ns, header.incomplete, members, times)
