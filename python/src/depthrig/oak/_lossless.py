"""Queue for the frames of files that are played once: none is lost, and the player waits."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import depthai as dai

_PARTNER_S = 2.0
"""How long a stream waits for the other streams' frame of the same number; one of a shorter file never comes."""
_LOOK_S = 0.1


class LosslessQueue:
    """Takes frames in the SDK's threads, which wait here: one frame of each stream is queued, one is being taken.

    The SDK's queues drop what they hold when the pipeline ends, and the pipeline ends with the first file that does, so
    a stream also waits for the others to catch up.
    """

    def __init__(self, streams: Iterable[str]) -> None:
        self.came = dict.fromkeys(streams, 0)
        """Frames that came, by stream."""
        self._frames: list[tuple[str, dai.ImgFrame]] = []
        self._behind: set[str] = set()
        self._closed = False
        self._changed = threading.Condition()

    def put(self, stream: str, frame: dai.ImgFrame) -> None:
        """Queue a frame; return when the next one may come."""
        with self._changed:
            self.came[stream] += 1
            number = self.came[stream]
            self._behind.discard(stream)
            self._frames.append((stream, frame))
            self._changed.notify_all()
            deadline = time.monotonic() + _PARTNER_S
            while not self._closed:
                late = {s for s, n in self.came.items() if n < number} - self._behind
                if late and time.monotonic() > deadline:
                    self._behind |= late
                elif not late and not any(s == stream for s, _ in self._frames):
                    return
                self._changed.wait(_LOOK_S)

    def take(self, timeout: float) -> list[tuple[str, dai.ImgFrame]]:
        """Return the queued frames, waiting for one up to `timeout` seconds."""
        with self._changed:
            if not self._frames and not self._closed:
                self._changed.wait(timeout)
            frames, self._frames = self._frames, []
            self._changed.notify_all()
        return frames

    def close(self) -> None:
        """Release the SDK's threads; later frames are lost."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
