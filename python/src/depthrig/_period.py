"""Predicts when a stream's next frame is due, so that a reader can wake and warm its caches before.

A process that slept for 33 ms finds other programs' data in the caches, and spends the first microseconds after it is
woken on fetching its own code: most of the time from publishing to an array. A reader of a steady stream therefore
wakes a little before its frame is due and runs the same code path once in advance.
"""

from __future__ import annotations

LEAD_NS = 500_000
"""How long before a frame is due its reader wakes."""
_JITTER_NS = 2_000_000
"""A stream whose frames miss their time by more than this on average has no period."""
_LONGEST_NS = 500_000_000
_SHARE = 0.125
"""Weight of a new frame in the averages."""


class FramePeriod:
    """The period of a stream, from the times at which its frames were published."""

    __slots__ = ("_error_ns", "_frames", "_last_ns", "_period_ns", "_sequence")

    def __init__(self) -> None:
        self._frames = 0
        self._sequence = 0
        self._last_ns = 0
        self._period_ns = 0.0
        self._error_ns = 0.0

    def observe(self, sequence: int, published_ns: int) -> None:
        """Add a frame to the averages."""
        steps = sequence - self._sequence
        since = published_ns - self._last_ns
        self._sequence, self._last_ns = sequence, published_ns
        if steps < 1 or since <= 0 or self._frames == 0:
            self._frames = 1
            return
        period = since / steps
        if self._frames == 1:
            self._period_ns, self._error_ns = period, 0.0
        else:
            self._error_ns += _SHARE * (abs(period - self._period_ns) - self._error_ns)
            self._period_ns += _SHARE * (period - self._period_ns)
        self._frames += 1

    def rest_ns(self, now_ns: int) -> int:
        """Return for how many nanoseconds no frame is expected; 0 when unknown, or when a frame is due."""
        if self._frames < 4 or self._error_ns > _JITTER_NS or self._period_ns > _LONGEST_NS:
            return 0
        return max(0, int(self._last_ns + self._period_ns) - LEAD_NS - now_ns)
