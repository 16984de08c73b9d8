"""`depthrig.ClockMap` on generated clocks whose truth is known."""

from __future__ import annotations

import math
import random
from collections.abc import Iterator
from dataclasses import dataclass

import pytest

import depthrig

TICK_NS = 1000
LEAST_NS = 3_000_000
START_NS = 10**15


@dataclass
class Stamp:
    ticks: int
    arrival_ns: int
    truth_ns: float
    """When it was measured, plus the least latency, which nobody can know."""
    at_s: float


@dataclass
class Device:
    """A clock that is off by a rate, and a transport that is late by a little, and sometimes by much."""

    rate: float = 30e-6
    jitter_ns: float = 300e3
    heavy: float = 0.02
    hz: float = 100.0
    heat: float = 0.0
    bits: int = 32
    first: int = 0xFFFF_0000
    seconds: float = 70.0
    seed: int = 1

    def stamps(self) -> Iterator[Stamp]:
        draw = random.Random(self.seed)
        device_ns, last_ns = 0.0, START_NS
        for k in range(int(self.seconds * self.hz)):
            t = k / self.hz * 1e9
            if k:
                device_ns += 1e9 / self.hz * (1 + self.rate + self.heat * math.sin(t / 3e11 * 2 * math.pi))
            late = draw.expovariate(1 / self.jitter_ns)
            late += draw.expovariate(1 / 20e6) if draw.random() < self.heavy else 0.0
            # One after the other, as they were sent.
            last_ns = max(last_ns, int(START_NS + t + LEAST_NS + late))
            ticks = (self.first + int(device_ns / TICK_NS)) % (1 << self.bits)
            yield Stamp(ticks, last_ns, START_NS + t + LEAST_NS, t / 1e9)


def play(stamps: list[Stamp], bits: int = 32) -> list[tuple[Stamp, depthrig.MappedTime]]:
    clock = depthrig.ClockMap(TICK_NS, bits)
    found = [(stamp, clock.observe(stamp.ticks, stamp.arrival_ns)) for stamp in stamps]
    for (_, before), (stamp, mapped) in zip(found, found[1:]):
        assert mapped.time_ns <= stamp.arrival_ns
        assert mapped.time_ns >= before.time_ns
    return found


def check(found: list[tuple[Stamp, depthrig.MappedTime]], most_ns: float, after_s: float = 30.0) -> None:
    """The truth lies within the stated uncertainty, and after the warm-up within `most_ns`."""
    certain = [(s, m) for s, m in found if m.is_certain]
    assert len(certain) > 0.8 * len(found)
    inside = [abs(m.time_ns - s.truth_ns) <= m.uncertainty_ns for s, m in certain]
    assert sum(inside) >= 0.999 * len(inside)
    errors = sorted(abs(m.time_ns - s.truth_ns) for s, m in certain if s.at_s >= after_s)
    assert errors[int(len(errors) * 0.99)] <= most_ns


@pytest.mark.parametrize(
    ("device", "most_ns"),
    [
        (Device(), 25e3),
        (Device(rate=-300e-6), 25e3),
        (Device(jitter_ns=2e6, heavy=0.1, hz=200), 50e3),
        (Device(jitter_ns=500e3, heavy=0.0, hz=10), 50e3),
        (Device(heat=2e-6), 40e3),
        (Device(hz=1000, jitter_ns=100e3, seconds=40), 25e3),
        (Device(bits=24, first=0xFF_0000), 25e3),
    ],
)
def test_the_truth_lies_within_the_stated_uncertainty(device: Device, most_ns: float) -> None:
    found = play(list(device.stamps()), device.bits)
    assert {m.epoch for _, m in found} == {0}
    check(found, most_ns)


def test_a_known_latency_is_taken_off() -> None:
    clock = depthrig.ClockMap(TICK_NS, 32, latency_ns=LEAST_NS)
    found = [(stamp, clock.observe(stamp.ticks, stamp.arrival_ns)) for stamp in Device(seconds=60).stamps()]
    errors = [abs(m.time_ns - (s.truth_ns - LEAST_NS)) for s, m in found if s.at_s > 30]
    assert max(errors) <= 25e3


def test_a_stall_is_late_and_nothing_else() -> None:
    stamps = list(Device().stamps())
    for stamp in stamps:
        if 50.0 <= stamp.at_s < 50.7:
            stamp.arrival_ns = max(stamp.arrival_ns, int(START_NS + 50.7e9 + LEAST_NS))
    found = play(stamps)
    assert {m.epoch for _, m in found} == {0}
    check(found, 25e3)


def test_a_counter_comes_round_in_a_pause() -> None:
    stamps = [s for s in Device(bits=24, seconds=100).stamps() if not 20 < s.at_s < 60]
    found = play(stamps, 24)
    assert {m.epoch for _, m in found} == {0}
    check(found, 25e3, 70.0)


@pytest.mark.parametrize("bits", [32, 64])
@pytest.mark.parametrize(("step_s", "lost"), [(-50.0, 0), (-0.1, 0), (0.1, 0), (5.0, 0), (None, 0), (None, 300), (-0.1, 30)])
def test_a_clock_that_steps_or_starts_anew_is_a_new_epoch(step_s: float | None, lost: int, bits: int) -> None:
    """Its times are called certain only when they are right again."""
    stamps = list(Device(seconds=90, bits=bits, first=10**8).stamps())
    at = 4_000
    zero = stamps[at].ticks
    for stamp in stamps[at:]:
        ticks = stamp.ticks - zero if step_s is None else stamp.ticks + int(step_s * 1e9 / TICK_NS)
        stamp.ticks = ticks % (1 << bits)
    del stamps[at : at + lost]
    found = play(stamps, bits)
    assert [m.epoch for _, m in found[:at]] == [0] * at
    assert found[-1][1].epoch == 1
    # A clock that is behind cannot be told from a transport that is late, for a second.
    begins = next(s.at_s for s, m in found if m.epoch == 1)
    assert begins <= 41.1 + lost / 100
    check([(s, m) for s, m in found if m.epoch == 1], 25e3, begins + 30)
    wrong = [m for s, m in found if m.is_certain and abs(m.time_ns - s.truth_ns) > 3e6]
    assert wrong == []


def test_wrong_arguments_are_refused() -> None:
    for options in ({"tick_ns": 0.0}, {"counter_bits": 65}, {"window": 1.0}, {"latency_ns": -1}):
        with pytest.raises(ValueError, match=next(iter(options))):
            depthrig.ClockMap(**options)
    clock = depthrig.ClockMap(counter_bits=16)
    for ticks in (-1, 1 << 16):
        with pytest.raises(ValueError, match="out of range"):
            clock.observe(ticks, 0)
