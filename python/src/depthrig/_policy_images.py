"""Images of a policy's observations: of a live rig the newest that fit together, of a replay each set once.

**A replay is followed set by set**, so that two replays of a dataset give the same observations. Its player publishes the
samples of a set, then its images, then the set's record, and with `--as-fast-as-possible` waits until they are read. A
set is observed when the records of the two sets after it have come, or the replay has ended: by then every
sample up to the time of the next set is there, because a sample is recorded at the latest with the set after the one that
follows it. Later samples are left out even if they have come, so the outcome does not depend on how far the player is ahead.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from ._frame import Frame
from ._group import FrameGroup, SetReader
from ._reader import LIVENESS_S, SLICE_S
from ._sets import FrameSet, Sets
from .errors import StreamGone, StreamNotFound

# Records that have come before a set is observed. A subscriber that holds more than three frames stops the player.
_AHEAD = 2
# How often samples are taken in meanwhile: 512 of each signal wait.
_POLL_S = 0.005


@dataclass(frozen=True)
class ReplayedSet:
    """A set of a replay."""

    group: FrameGroup | None
    """Its images; None when one of them is missing."""
    tick_ns: int
    """Its moment."""
    next_tick_ns: int | None
    """The moment of the set after it; None for the last one."""


class ReplayedImages:
    """Reads each set of a replay in order."""

    def __init__(self, reader: SetReader, sets: Sets, first: dict[str, Frame]) -> None:
        self._reader = reader
        self._sets = sets
        self._first = first
        self._records: deque[FrameSet] = deque()

    def next(self, take_samples: Callable[[], None], timeout: float) -> ReplayedSet | None:
        """Return the next set, or None when none came within `timeout` seconds; StreamGone at the end of the replay.

        `take_samples` is called while it waits, and at the end.
        """
        deadline = time.monotonic() + timeout
        look = time.monotonic() + LIVENESS_S
        while len(self._records) <= _AHEAD:
            record = self._sets._take()
            if record is not None:
                self._records.append(record)
                continue
            take_samples()
            now = time.monotonic()
            if now >= look:
                look = now + LIVENESS_S
                if not self._sets.is_live:
                    # What was published before the end is there now.
                    while (record := self._sets._take()) is not None:
                        self._records.append(record)
                    if self._records:
                        break
                    self._sets._check_publisher()
            if now >= deadline:
                return None
            self._sets._pause(_POLL_S)
        take_samples()
        record = self._records.popleft()
        following = self._records[0].tick_ns if self._records else None
        if following is not None and following <= record.tick_ns:  # it went back
            following = None
        return ReplayedSet(self._frames(record), record.tick_ns, following)

    def _frames(self, record: FrameSet) -> FrameGroup | None:
        frames: dict[str, Frame] = {}
        for name in self._reader.streams:
            wanted = record.members.get(name)
            frame = self._frame(name, wanted) if wanted is not None else None
            if frame is not None:
                frames[name] = frame
        return FrameGroup(frames, ()) if len(frames) == len(self._reader.streams) else None

    def _frame(self, name: str, wanted: int) -> Frame | None:
        """Return the frame of a number. The player publishes it before the set's record."""
        while True:
            frame = self._first.pop(name, None) or self._reader._streams[name]._take()
            if frame is None or frame.sequence == wanted:
                return frame
            if frame.sequence > wanted:
                self._first[name] = frame
                return None
            del frame  # gives its slot back before the next one is taken


def open_images(reader: SetReader, sets: Sets | None, timeout: float) -> ReplayedImages | SetReader | None:
    """Wait up to `timeout` seconds for an image and return the reader for its kind of rig; None when none came."""
    deadline = time.monotonic() + timeout
    while True:
        for name, stream in reader._streams.items():
            frame = stream._take()
            if frame is not None:
                if frame.replayed:
                    if sets is None:
                        raise StreamNotFound(f"rig {reader.rig!r} is a replay without frame sets, which cannot be followed")
                    return ReplayedImages(reader, sets, {name: frame})
                if sets is not None:
                    sets.close()
                return reader
        now = time.monotonic()
        if now >= deadline:
            gone = [name for name, stream in reader._streams.items() if not stream.is_live]
            if gone:
                raise StreamGone(f"{', '.join(gone)} of rig {reader.rig!r}: nobody publishes it any more")
            return None
        next(iter(reader._streams.values()))._pause(min(SLICE_S, deadline - now))
