"""Times of the host as UTC and back."""

from __future__ import annotations

import threading
import time
from typing import NamedTuple

_STEP_NS = 200_000
"""Both clocks are slewed alike; a larger difference is a step of UTC."""


class Offset(NamedTuple):
    """UTC minus the monotonic clock."""

    ns: int
    uncertainty_ns: int


def read_offset() -> Offset:
    """Read both clocks; of three readings the narrowest."""
    readings = []
    for _ in range(3):
        before = time.monotonic_ns()
        utc = time.time_ns()
        after = time.monotonic_ns()
        readings.append((after - before, utc - (before + after) // 2))
    width, offset = min(readings)
    return Offset(offset, (width + 1) // 2)


class Clock:
    """The offset for stamps, which changes only when UTC steps: equal capture times have equal stamps."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._held = read_offset()

    def utc_ns(self, time_ns: int) -> int:
        """Return a time of :func:`time.monotonic_ns` as nanoseconds since 1970."""
        now = read_offset()
        with self._lock:
            if abs(now.ns - self._held.ns) > _STEP_NS + now.uncertainty_ns:
                self._held = now
            return time_ns + self._held.ns
