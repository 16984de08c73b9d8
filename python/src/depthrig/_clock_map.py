"""The clock of a device mapped to the host's clock, from nothing but when its samples arrived.

A sample arrives late by a latency that is never less than some constant and mostly little more. So the points (device time,
arrival) lie above a line, and the fastest samples touch it: the lower convex hull of the last minute is that line. A mean
or a least-squares fit would follow the late ones. The method is that of Moon, Skelly and Towsley (1999) and Zhang, Liu and
Xia (2002), as in `depthrig_driver::clock`, which maps the clocks of cameras and knows more about restarts and heat.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

# The line has the hull's slope once the history is this long; before, that of equal rates.
_WARM_NS = 5_000_000_000
# Largest rate of two crystals against each other.
_MAX_RATE = 500e-6
# How fast a rate may change the line after the newest point that touches it.
_WANDER = 1e-6
# Arrivals this far below the line are no luck: the clock stepped, or the device was restarted.
_STEP_NS = 20_000_000
# Arrivals that far above it for this long: as well.
_HIGH_NS = 1_000_000_000
# The hull keeps the lowest point of each of so many parts of the window.
_SLICES = 256
_RESIDUALS = 512
_FEW = 20
# Samples after which their spread is taken anew.
_EVERY = 32


class _Line(NamedTuple):
    x0: int
    d0: int
    slope: float
    # How fast it may be off beyond `sure`, the newest point of the hull's edge.
    error_rate: float
    sure: int

    def at(self, x: int) -> float:
        return self.d0 + self.slope * (x - self.x0)

    def error_ns(self, x: int) -> float:
        return self.error_rate * (x - self.sure)


@dataclass(frozen=True)
class MappedTime:
    """A device's time on the host's clock."""

    time_ns: int
    """Nanoseconds on the clock of :func:`time.monotonic_ns`."""
    uncertainty_ns: int
    """`time_ns` is right within this much, apart from the least latency that stamps of one direction cannot reveal."""
    is_certain: bool
    """False for the first samples, after a step of the clock, and while one is suspected."""
    epoch: int
    """Counts the starts of the device's clock, from 0."""


class ClockMap:
    """Maps a device's counter to the host's clock: one for each stream of samples.

    >>> clock = depthrig.ClockMap(tick_ns=1000, counter_bits=32)
    >>> mapped = clock.observe(device_ticks=robot.stamp, arrival_ns=time.monotonic_ns())
    >>> arm.publish(robot.joints, mapped.time_ns, uncertainty_ns=mapped.uncertainty_ns)

    `tick_ns` is the length of a tick, `counter_bits` after how many bits the counter begins anew (64 for one that does not; a
    round takes longer than twice what a sample may be late), `window` how many seconds of history count. `latency_ns` is the least time from measuring to arrival, if you know
    it; without it mapped times are late by it, by the same amount for every sample.

    Times of an epoch never run backwards, and none is later than its sample's arrival. A counter that goes back, and arrivals
    20 ms before the line, or for a second 20 ms above it, begin a new epoch.
    """

    def __init__(
        self, tick_ns: float = 1.0, counter_bits: int = 64, *, window: float = 60.0, latency_ns: int = 0
    ) -> None:
        if not tick_ns > 0 or not 8 <= counter_bits <= 64 or not window * 1e9 > _WARM_NS or latency_ns < 0:
            raise ValueError(
                f"tick_ns = {tick_ns!r} is above 0, counter_bits = {counter_bits!r} within 8 and 64, window = {window!r} above "
                f"{_WARM_NS / 1e9:g} s, latency_ns = {latency_ns!r} not below 0"
            )
        self._tick_ns = tick_ns
        self._modulus = 1 << counter_bits
        self._window_ns = int(window * 1e9)
        self._slice_ns = self._window_ns // _SLICES
        self._latency_ns = latency_ns
        self._epoch = -1
        self._last_time_ns = -(1 << 63)
        self._high_since: int | None = None
        self._begin(0, 0)

    def observe(self, device_ticks: int, arrival_ns: int) -> MappedTime:
        """Return when a sample with this stamp was measured; `arrival_ns` is `time.monotonic_ns()` when it came."""
        raw = int(device_ticks)
        if not 0 <= raw < self._modulus:
            raise ValueError(f"device_ticks = {raw} is out of range 0..{self._modulus}")
        if self._epoch < 0 or not self._follow(raw, arrival_ns):
            self._epoch += 1
            self._begin(raw, arrival_ns)
        x = round(self._ticks * self._tick_ns)
        d = arrival_ns - self._origin_ns - x
        self._add(x, d)
        above = d - self._line.at(x)
        if above < _STEP_NS:
            self._high_since = None
        elif self._high_since is None:
            self._high_since = arrival_ns
        elif arrival_ns - self._high_since > _HIGH_NS:
            self._epoch += 1
            self._begin(raw, arrival_ns)
            x, above = 0, 0.0
            self._add(0, 0)
        self._take_residual(max(0.0, above))
        time_ns = self._origin_ns + x + round(self._line.at(x)) - self._latency_ns
        # Never backwards, and never later than the arrival.
        self._last_time_ns = min(max(time_ns, self._last_time_ns), arrival_ns)
        is_certain = self._samples >= _FEW and self._high_since is None
        uncertainty_ns = round(self._spread_ns + self._line.error_ns(x)) + 1
        return MappedTime(self._last_time_ns, uncertainty_ns, is_certain, self._epoch)

    def _take_residual(self, above: float) -> None:
        """Half of the samples lie within the spread above the line, which itself is off by much less."""
        self._residuals.append(above)
        self._samples += 1
        if self._samples < _FEW:
            self._spread_ns = max(self._residuals) + 1e6
        elif self._samples < 4 * _FEW or self._samples % _EVERY == 0:
            self._spread_ns = sorted(self._residuals)[len(self._residuals) // 2]

    def _begin(self, raw: int, arrival_ns: int) -> None:
        self._raw = raw
        self._ticks = 0
        self._origin_ns = arrival_ns
        self._arrival_ns = arrival_ns
        # The lowest point of each part of the window: (device time, how much later it arrived).
        self._lowest: deque[tuple[int, int]] = deque()
        self._residuals: deque[float] = deque(maxlen=_RESIDUALS)
        self._samples = 0
        self._spread_ns = 0.0
        self._line = _Line(0, 0, 0.0, 0.0, 0)
        self._high_since = None

    def _follow(self, raw: int, arrival_ns: int) -> bool:
        """Count the ticks since the sample before; False when the device's clock began anew."""
        delta = (raw - self._raw) % self._modulus
        gap = (arrival_ns - self._arrival_ns) / self._tick_ns
        # A counter that came round several times in a pause, or once went back.
        delta += max(-1, round((gap - delta) / self._modulus)) * self._modulus
        if delta < 0:
            return False
        ticks = self._ticks + delta
        x = round(ticks * self._tick_ns)
        above = arrival_ns - self._origin_ns - x - self._line.at(x)
        if self._lowest and above < -_STEP_NS:
            return False
        self._raw, self._ticks, self._arrival_ns = raw, ticks, arrival_ns
        return True

    def _add(self, x: int, d: int) -> None:
        lowest = self._lowest
        if lowest and lowest[-1][0] // self._slice_ns == x // self._slice_ns:
            if d > lowest[-1][1]:
                return
            lowest[-1] = (x, d)
        else:
            lowest.append((x, d))
        # After a pause the old points are the only ones with a lever.
        while len(lowest) > 2 and lowest[0][0] < x - self._window_ns and x - lowest[1][0] >= _WARM_NS:
            lowest.popleft()
        self._line = self._edge()

    def _edge(self) -> _Line:
        """Return the line under the points."""
        hull: list[tuple[int, int]] = []
        for p in self._lowest:
            while len(hull) > 1 and _is_above(hull[-2], hull[-1], p):
                hull.pop()
            hull.append(p)
        first = hull[0][0]
        if hull[-1][0] - first >= _WARM_NS:
            # The edge over the middle: its ends touch the line, and are the furthest apart.
            middle = (first + hull[-1][0]) / 2
            at = min(max(bisect_right([p[0] for p in hull], middle), 1), len(hull) - 1)
            (xa, da), (xb, db) = hull[at - 1], hull[at]
            if abs(db - da) <= _MAX_RATE * (xb - xa):
                return _Line(xa, da, (db - da) / (xb - xa), _WANDER, xb)
        x0, d0 = min(hull, key=lambda p: p[1])
        return _Line(x0, d0, 0.0, _MAX_RATE, first)


def _is_above(a: tuple[int, int], b: tuple[int, int], c: tuple[int, int]) -> bool:
    """Whether b lies on or above the line from a to c."""
    return (b[0] - a[0]) * (c[1] - a[1]) <= (c[0] - a[0]) * (b[1] - a[1])
