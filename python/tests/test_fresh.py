"""Depth that is too old is an error with its age; readers of several streams make groups that belong together."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import depthrig
from depthrig import FrameFlags, PixelFormat, SetReader, Stale, Stream
from fake_rig import FakeRig
from rig import WAIT_S, Publisher

Start = Callable[..., Publisher]
MS = 1_000_000


@pytest.fixture
def fake_rig(folder: Path) -> Iterator[FakeRig]:
    """Publishes what a test wants, with the capture times that it wants."""
    with FakeRig(folder) as publisher:
        yield publisher


def stream(folder: Path, name: str = "cam/depth") -> Stream:
    return Stream(name, rig="mount", runtime_dir=folder, timeout=WAIT_S)


def reader(folder: Path, *names: str, **more: Any) -> SetReader:
    return SetReader(names or ("a/depth", "b/depth"), rig="mount", runtime_dir=folder, timeout=WAIT_S, **more)


def test_a_fresh_frame_comes_at_once_and_the_newest_of_them(fake_rig: FakeRig, folder: Path) -> None:
    depth = fake_rig.channel("cam/depth")
    s = stream(folder)
    for age_ms in (300, 200, 100):
        depth.send(time.monotonic_ns() - age_ms * MS)
    frame = s.wait_fresh(max_age=WAIT_S, timeout=0)
    assert frame.sequence == 3
    assert 0.1 <= frame.age_s < WAIT_S
    assert frame.age_s == pytest.approx(frame.header.age_s, abs=1.0)
    with pytest.raises(Stale):
        s.wait_fresh(max_age=WAIT_S, timeout=0.05)  # each frame is returned once


def test_stale_depth_is_an_error_with_its_age(fake_rig: FakeRig, folder: Path) -> None:
    depth = fake_rig.channel("cam/depth")
    s = stream(folder)
    with pytest.raises(Stale, match="no frame has come yet") as none:
        s.wait_fresh(max_age=0.05)
    assert (none.value.age_s, none.value.max_age_s) == (None, 0.05)
    depth.send(time.monotonic_ns() - 2_000 * MS)
    with pytest.raises(
        Stale, match=r"cam/depth of rig 'mount': its newest frame is \d\.\d+ s old, at most 0\.5 s"
    ) as old:
        s.wait_fresh(max_age=0.5, timeout=0.05)
    assert old.value.age_s is not None
    assert 2.0 <= old.value.age_s < 2.0 + WAIT_S
    assert isinstance(old.value, depthrig.DepthrigError)
    with pytest.raises(ValueError, match="max_age"):
        s.wait_fresh(max_age=0)


def test_waiting_for_a_fresh_frame_skips_stale_ones(fake_rig: FakeRig, folder: Path) -> None:
    depth = fake_rig.channel("cam/depth")
    s = stream(folder)

    def publish() -> None:
        for age_ms in (60_000, 50_000, 0):
            time.sleep(0.03)
            depth.send(time.monotonic_ns() - age_ms * MS)

    thread = threading.Thread(target=publish)
    thread.start()
    frame = s.wait_fresh(max_age=WAIT_S, timeout=WAIT_S)
    thread.join()
    assert frame.sequence == 3


def test_a_stale_frame_holds_no_slot(fake_rig: FakeRig, folder: Path) -> None:
    depth = fake_rig.channel("cam/depth")
    s = stream(folder)
    for _ in range(50):
        depth.send(time.monotonic_ns() - 60_000 * MS)
        with pytest.raises(Stale):
            s.wait_fresh(max_age=1, timeout=0)
    depth.send(time.monotonic_ns())
    assert s.wait_fresh(max_age=WAIT_S).sequence == 51


def test_a_replay_has_no_age(fake_rig: FakeRig, folder: Path) -> None:
    depth = fake_rig.channel("cam/depth")
    s = stream(folder)
    depth.send(time.monotonic_ns(), flags=int(FrameFlags.REPLAYED))
    with pytest.raises(Stale, match="replayed"):
        s.wait_fresh(max_age=WAIT_S)


def test_without_a_publisher_it_is_gone_and_not_stale(start: Start, folder: Path) -> None:
    publisher = start()
    s = Stream("pattern/z16", runtime_dir=folder, timeout=WAIT_S)
    publisher.publish(1)
    s.next(WAIT_S)
    publisher.kill()
    with pytest.raises(depthrig.StreamGone):
        s.wait_fresh(max_age=0.05)
    again = start()
    again.publish(1)
    assert s.next(WAIT_S).sequence == 1
    assert s.restarts == 1


def test_restarts_are_counted(fake_rig: FakeRig, folder: Path) -> None:
    depth = fake_rig.channel("cam/depth")
    s = stream(folder)
    for sequence in (5, 6, 9, 1, 2, 2):
        depth.send(0, sequence=sequence)
        s.next(WAIT_S)
    assert (s.missed, s.restarts) == (2, 2)


def times(group: depthrig.FrameGroup) -> dict[str, int]:
    return {name.split("/")[0]: ns // MS for name, ns in group.capture_times_ns.items()}


def test_frames_nearest_in_time_make_a_group(fake_rig: FakeRig, folder: Path) -> None:
    a, b = fake_rig.channel("a/depth"), fake_rig.channel("b/depth")
    r = reader(folder)
    assert r.latest() is None
    a.send(1000 * MS)
    assert r.latest() is None
    b.send(1005 * MS)
    group = r.next(WAIT_S)
    assert times(group) == {"a": 1000, "b": 1005}
    assert (group.skew_s, group.missing, group.is_complete) == (0.005, (), True)
    assert list(group) == ["a/depth", "b/depth"]
    np.testing.assert_array_equal(group["a/depth"].array, a.pixels(1))
    assert r.latest() is None
    # b is ahead; its frame that is nearest to a's newest is taken, and not its newest.
    for ms in (1035, 1068, 1101):
        b.send(ms * MS)
    a.send(1066 * MS)
    assert times(r.next(WAIT_S)) == {"a": 1066, "b": 1068}
    a.send(1099 * MS)
    assert times(r.next(WAIT_S)) == {"a": 1099, "b": 1101}
    assert "skew" in repr(group)
    assert r.missed == {"a/depth": 0, "b/depth": 0}


def test_the_newest_group_is_given_and_each_once(fake_rig: FakeRig, folder: Path) -> None:
    a, b = fake_rig.channel("a/depth"), fake_rig.channel("b/depth")
    r = reader(folder)
    for ms in (1000, 1033, 1066):
        a.send(ms * MS)
        b.send((ms + 2) * MS)
    assert times(r.next(WAIT_S)) == {"a": 1066, "b": 1068}
    with pytest.raises(depthrig.Timeout, match=r"no group within 0\.05 s: nothing new of a/depth, b/depth"):
        r.next(timeout=0.05)


def test_a_slow_stream_sets_the_rate(fake_rig: FakeRig, folder: Path) -> None:
    """Refined depth comes late and seldom: the raw frame that belongs to it must still be there."""
    raw, refined = fake_rig.channel("a/depth"), fake_rig.channel("a/depth_refined")
    r = reader(folder, "a/depth", "a/depth_refined", max_skew=0.001)
    seen = []
    for i in range(40):
        raw.send((1000 + 33 * i) * MS)
        r.latest()
        if i % 6 == 5:
            refined.send((1000 + 33 * (i - 4)) * MS)
            seen.append(times(r.next(WAIT_S))["a"])
    assert seen == [1000 + 33 * (i - 4) for i in range(5, 40, 6)]


def test_frames_too_far_apart_make_no_group(fake_rig: FakeRig, folder: Path) -> None:
    a, b = fake_rig.channel("a/depth"), fake_rig.channel("b/depth")
    r = reader(folder, max_skew=0.01)
    a.send(1000 * MS)
    b.send(1020 * MS)
    with pytest.raises(depthrig.Timeout, match=r"nearest frames are 20\.0 ms apart, more than 10\.0 ms \(max_skew\)"):
        r.next(timeout=0.05)
    a.send(1025 * MS)
    group = r.next(WAIT_S)
    assert (times(group), group.skew_s) == ({"a": 1025, "b": 1020}, 0.005)


@pytest.mark.many_streams
@pytest.mark.parametrize("lost", ["b", "ab"])
def test_no_stream_stays_a_frame_ahead(fake_rig: FakeRig, folder: Path, lost: str) -> None:
    """Cameras of one rate, of which c comes a period late, so that a and b are ahead at first and after a lost frame."""
    phases = {"a": 0, "b": 6, "c": 7}
    channels = {name: fake_rig.channel(f"{name}/depth") for name in phases}
    r = reader(folder, *(f"{name}/depth" for name in phases))
    captured = [{name: 1000 + 33 * i + phase for name, phase in phases.items()} for i in range(11)]
    seen = []
    for i in range(1, 11):
        for name in "ab":
            if i != 5 or name not in lost:
                channels[name].send(captured[i][name] * MS)
                assert r.latest() is None
        channels["c"].send(captured[i - 1]["c"] * MS)
        if (group := r.latest()) is not None:
            seen.append(times(group))
    # At first, nobody knows how soon the next frame of c comes.
    assert seen == [captured[1] | {"c": captured[0]["c"]}, *captured[2:5], *captured[6:10]]


@pytest.mark.many_streams
def test_a_group_waits_for_a_frame_that_is_much_nearer(fake_rig: FakeRig, folder: Path) -> None:
    """One camera of 15 Hz and one of 30 Hz, each second frame of which comes just behind the other's."""
    a, b = fake_rig.channel("a/depth"), fake_rig.channel("b/depth")
    r, partial = reader(folder), reader(folder, partial_after=0.05)
    for ms in (934, 967):
        a.send(ms * MS)
    for ms in (1000, 1066, 1132):
        b.send((ms - 2) * MS)
        assert r.latest() is None
        a.send(ms * MS)
        assert times(r.next(WAIT_S)) == {"a": ms, "b": ms - 2}
        assert r.latest() is None
        a.send((ms + 33) * MS)
        assert r.latest() is None
    # The frame of a that is due does not come, and what there is was asked for.
    assert times(partial.next(WAIT_S)) == {"a": 1132, "b": 1130}
    b.send(1196 * MS)
    with pytest.raises(depthrig.Timeout, match="nothing new"):
        r.next(timeout=0.1)
    assert times(partial.next(WAIT_S)) == {"a": 1165, "b": 1196}


@pytest.mark.many_streams
def test_partial_groups_are_asked_for_and_say_what_is_missing(fake_rig: FakeRig, folder: Path) -> None:
    a, b = fake_rig.channel("a/depth"), fake_rig.channel("b/depth")
    strict, lenient = reader(folder), reader(folder, partial_after=0.05)
    a.send(1000 * MS)
    with pytest.raises(depthrig.Timeout, match="nothing new of b/depth"):
        strict.next(timeout=0.1)
    group = lenient.next(WAIT_S)
    assert (times(group), group.missing, group.is_complete) == ({"a": 1000}, ("b/depth",), False)
    assert len(group) == 1
    with pytest.raises(KeyError, match="b/depth has no frame in this group"):
        group["b/depth"]
    with pytest.raises(depthrig.Timeout):
        lenient.next(timeout=0.1)  # nothing new at all is no group
    # The late one came: it is no group of its own moment any more, and the next complete one is.
    b.send(1001 * MS)
    a.send(1033 * MS)
    b.send(1034 * MS)
    assert times(lenient.next(WAIT_S)) == {"a": 1033, "b": 1034}
    assert times(strict.next(WAIT_S)) == {"a": 1033, "b": 1034}


@pytest.mark.many_streams
def test_a_waiting_reader_of_groups_is_woken(fake_rig: FakeRig, folder: Path) -> None:
    a, b = fake_rig.channel("a/depth"), fake_rig.channel("b/depth")
    r = reader(folder)
    got: list[dict[str, int]] = []
    thread = threading.Thread(target=lambda: got.extend(times(r.next(WAIT_S)) for _ in range(10)))
    thread.start()
    for i in range(10):
        first, second = (a, b) if i % 2 else (b, a)
        first.send((1000 + 33 * i) * MS)
        second.send((1000 + 33 * i) * MS)
        deadline = time.monotonic() + WAIT_S
        while len(got) <= i and time.monotonic() < deadline:
            time.sleep(0.001)
    thread.join(WAIT_S)
    assert got == [{"a": 1000 + 33 * i, "b": 1000 + 33 * i} for i in range(10)]


@pytest.mark.many_streams
def test_fresh_groups(fake_rig: FakeRig, folder: Path) -> None:
    a, b = fake_rig.channel("a/depth"), fake_rig.channel("b/depth")
    r = reader(folder, max_skew=10)
    a.send(time.monotonic_ns())
    with pytest.raises(Stale, match="no frame of b/depth has come yet") as none:
        r.wait_fresh(max_age=0.05)
    assert none.value.age_s is None
    b.send(time.monotonic_ns() - 2_000 * MS)
    with pytest.raises(Stale, match=r"newest frame of b/depth is \d\.\d+ s old, at most 1 s is allowed") as old:
        r.wait_fresh(max_age=1, timeout=0.05)
    assert old.value.age_s is not None
    assert old.value.age_s >= 2
    a.send(time.monotonic_ns())
    b.send(time.monotonic_ns())
    assert r.wait_fresh(max_age=WAIT_S).age_s < WAIT_S


@pytest.mark.many_streams
def test_a_reader_of_groups_leaves_half_of_the_slots(fake_rig: FakeRig, folder: Path) -> None:
    a, b = fake_rig.channel("a/depth"), fake_rig.channel("b/depth")
    r = reader(folder)
    held = []
    for i in range(8):
        a.send((1000 + 33 * i) * MS)
        b.send((1000 + 33 * i) * MS)
        held.append(r.next(WAIT_S))
    for i in range(8, 30):
        a.send((1000 + 33 * i) * MS)  # b is silent: eight of a's are kept to choose from
        assert r.latest() is None
    held.pop().release()
    for i in range(30, 40):  # what is given back is for the user, not for the reader
        a.send((1000 + 33 * i) * MS)
        assert r.latest() is None
    assert len(r._kept["a/depth"]) == 8
    b.send((1000 + 33 * 35) * MS)
    assert times(r.next(WAIT_S)) == {"a": 1000 + 33 * 35, "b": 1000 + 33 * 35}
    for i, group in enumerate(held):
        np.testing.assert_array_equal(group["a/depth"].array, a.pixels(i + 1))


@pytest.mark.many_streams
def test_times_that_go_back_begin_anew(fake_rig: FakeRig, folder: Path) -> None:
    a, b = fake_rig.channel("a/depth"), fake_rig.channel("b/depth")
    r = reader(folder)
    for base in (5000, 1000):
        for i in range(3):
            a.send((base + 33 * i) * MS)
            b.send((base + 33 * i) * MS)
            assert times(r.next(WAIT_S)) == {"a": base + 33 * i, "b": base + 33 * i}


@pytest.mark.many_streams
def test_a_group_reader_says_who_is_gone(start: Start, folder: Path) -> None:
    publisher = start()
    r = SetReader(["pattern/z16", "pattern/rgb8"], runtime_dir=folder, timeout=WAIT_S)
    publisher.publish(1)
    group = r.next(WAIT_S)
    assert {f.sequence for f in group.values()} == {1}
    assert r.rig == "example"
    publisher.kill()
    with pytest.raises(depthrig.StreamGone, match=r"pattern/z16, pattern/rgb8 of rig 'example': nobody publishes"):
        r.next(WAIT_S)
    again = start()
    again.publish(1)
    assert r.next(WAIT_S)["pattern/z16"].sequence == 1
    assert r.restarts == {"pattern/z16": 1, "pattern/rgb8": 1}
    r.close()
    with pytest.raises(ValueError, match="closed"):
        r.next()
    assert list(r) == []
    np.testing.assert_equal(group["pattern/z16"].header.pixel_format, PixelFormat.Z16)


@pytest.mark.parametrize("names", ["a/depth", [], ["a/depth", "a/depth"]])
def test_streams_are_a_list_of_different_ones(folder: Path, names: Any) -> None:
    with pytest.raises(ValueError, match="give a list of streams"):
        SetReader(names, rig="mount", runtime_dir=folder, timeout=0)


def test_an_unknown_stream_closes_the_others(start: Start, folder: Path) -> None:
    start()
    with pytest.raises(depthrig.StreamNotFound, match="pattern/colour"):
        SetReader(["pattern/z16", "pattern/colour"], runtime_dir=folder, timeout=0)
