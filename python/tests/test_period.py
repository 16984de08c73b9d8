"""When a steady stream's next frame is due, and that nothing is lost or late when it comes at another time."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

import depthrig
from depthrig import _period
from depthrig._period import LEAD_NS, FramePeriod
from fake_rig import FakeRig
from rig import WAIT_S

MS = 1_000_000


def heard(*times_ms: float, steps: int = 1) -> FramePeriod:
    period = FramePeriod()
    for i, ms in enumerate(times_ms):
        period.observe(1 + i * steps, int(ms * MS))
    return period


def test_a_steady_stream_is_due_after_its_period() -> None:
    period = heard(*(100 + 33 * i for i in range(6)))
    assert period.rest_ns(265 * MS) == 33 * MS - LEAD_NS
    assert period.rest_ns(298 * MS) == 0
    assert period.rest_ns(400 * MS) == 0


def test_frames_that_were_missed_do_not_change_the_period() -> None:
    assert heard(*(100 + 66 * i for i in range(6)), steps=2).rest_ns(430 * MS) == 33 * MS - LEAD_NS


@pytest.mark.parametrize(
    "times_ms",
    [(), (100,), (100, 133, 166), (0, 50, 60, 140, 150, 230, 231), tuple(range(0, 9000, 1000)), (5, 5, 5, 5, 5, 5)],
    ids=["nothing", "one", "three", "irregular", "seldom", "at once"],
)
def test_without_a_period_nothing_is_expected(times_ms: tuple[float, ...]) -> None:
    assert heard(*times_ms).rest_ns(int((times_ms or (0,))[-1] * MS)) == 0


def test_a_restarted_stream_is_learnt_anew() -> None:
    period = heard(*(100 + 33 * i for i in range(6)))
    period.observe(1, 300 * MS)
    assert period.rest_ns(300 * MS) == 0
    for i in range(1, 4):
        period.observe(1 + i, (300 + 100 * i) * MS)
    assert period.rest_ns(600 * MS) == 100 * MS - LEAD_NS


@pytest.fixture
def fake_rig(folder: Path) -> Iterator[FakeRig]:
    with FakeRig(folder) as publisher:
        yield publisher


def test_a_rest_ends_with_its_time_or_with_a_frame(fake_rig: FakeRig, folder: Path) -> None:
    depth = fake_rig.channel("cam/depth")
    s = depthrig.Stream("cam/depth", rig="mount", runtime_dir=folder, timeout=WAIT_S)
    receiver = s._open
    for _ in range(2):
        start = time.monotonic()
        assert receiver.rest(5_300_000)
        assert time.monotonic() - start >= 0.0053
        depth.send(1)
        assert not receiver.rest(60_000_000_000), "a frame that waits is no reason to rest"
        assert s.latest() is not None  # and its notification, which is still there, does not end the next rest
    thread = threading.Timer(0.05, depth.send, (1,))
    thread.start()
    assert not receiver.rest(60_000_000_000)
    thread.join()
    assert s.next(WAIT_S).sequence == 3


@pytest.mark.parametrize("prepare", [True, False])
def test_frames_out_of_time_are_read_at_once_and_none_is_lost(
    fake_rig: FakeRig, folder: Path, monkeypatch: pytest.MonkeyPatch, prepare: bool
) -> None:
    """Twenty frames at a steady rate, then one far too early, and one far too late."""
    monkeypatch.setattr(_period, "_JITTER_NS", 1_000 * MS)  # a loaded computer keeps no better time
    depth = fake_rig.channel("cam/depth")
    s = depthrig.Stream("cam/depth", rig="mount", runtime_dir=folder, timeout=WAIT_S, prepare=prepare)
    rests: list[bool] = []
    rest = s._open.rest
    s._open.rest = lambda ns: rests.append(rest(ns)) or rests[-1]  # type: ignore[method-assign, func-returns-value]

    # The channel keeps four frames that are not read.
    room = threading.Semaphore(4)

    def publish() -> None:
        for after in (*[0.05] * 20, 0.005, 0.295):
            time.sleep(after)
            room.acquire(timeout=WAIT_S)
            depth.send(time.monotonic_ns(), publish_time_ns=time.monotonic_ns())

    thread = threading.Thread(target=publish, daemon=True)
    thread.start()
    waits = []
    for sequence in range(1, 23):
        frame = s.next(WAIT_S)
        room.release()
        waits.append(frame.age_s)
        assert frame.sequence == sequence
        del frame
    thread.join()
    assert s.missed == 0
    if prepare:
        assert rests, "a steady stream is prepared for"
    else:
        assert rests == []
    # Half a period would be a frame that was slept through. A loaded computer wakes threads late, but not each time.
    assert sorted(waits)[len(waits) // 2] < 0.025
