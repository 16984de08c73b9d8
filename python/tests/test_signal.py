"""Signals: publishing and reading between real processes, the limits, and the two sides in Rust."""

from __future__ import annotations

import ctypes
import gc
import json
import math
import os
import signal as signals_of_unix
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import depthrig
from depthrig import SignalField, _layout
from depthrig._bus import Bus
from depthrig._ports import SIGNAL, SIGNALS, Sender
from depthrig._signal import HEAD
from depthrig._signal_description import fnv, parse_description
from rig import ROOT, WAIT_S, build_example, child

ARM = "arm/joint_position"
NAMES = ["shoulder", "elbow", "wrist"]
NOTE = 'say "hi",\n\ttwice 🦾'
MIXED = [
    SignalField("flag", "bool"),
    SignalField("pair", "f64", 2, "N·m"),
    SignalField("single", "f32"),
    SignalField("count", "i64"),
    SignalField("note", "text"),
]
PUBLISH = """
import sys, time
import depthrig
signal = depthrig.Signal("arm/joint_position", ["shoulder", "elbow", "wrist"], runtime_dir=sys.argv[1])
print("ready", flush=True)
while True:
    signal.publish([0.0, 1.0, 2.0])
    time.sleep(0.002)
"""
READ = """
import sys
import depthrig
reader = depthrig.SignalReader("arm/joint_position", sys.argv[1], 60.0)
print("ready", flush=True)
reader.wait()
print("read", flush=True)
sys.stdin.read()
"""


@pytest.fixture(scope="session")
def example() -> str:
    return build_example("signals")


@pytest.fixture
def arm(folder: Path) -> Iterator[depthrig.Signal]:
    with depthrig.Signal(ARM, NAMES, unit="rad", kind="joints", runtime_dir=folder) as arm:
        yield arm


def reader(folder: Path, name: str = ARM, **options: float) -> depthrig.SignalReader:
    return depthrig.SignalReader(name, folder, **options)


def line(process: subprocess.Popen[str], word: str) -> None:
    assert process.stdout is not None
    assert process.stdout.readline().strip() == word


def test_a_header_reads_what_rust_wrote(example: str, tmp_path: Path) -> None:
    subprocess.run([example, "dump", str(tmp_path)], check=True)
    values = json.loads((tmp_path / "header.json").read_text())
    read = HEAD.unpack((tmp_path / "header.bin").read_bytes())
    assert len({json.dumps(v) for v in values.values()}) == len(values), "two fields hold the same value"
    names = [name for name, _, _, _ in _layout.SIGNAL_FIELDS]
    assert sorted(names) == sorted(values)
    expected = [v for name in names for v in (values[name] if name == "reserved" else [values[name]])]
    assert [list(v) if isinstance(v, bytes) else v for v in read] == expected
    at = 0
    for _, offset, kind, count in _layout.SIGNAL_FIELDS:
        assert offset == at
        at += int(kind[1:]) // 8 * count
    assert at == HEAD.size


def test_values_travel_with_all_that_is_needed_to_read_them(folder: Path) -> None:
    with depthrig.Signal("hand/state", MIXED, runtime_dir=folder) as hand, reader(folder, "hand/state") as read:
        assert read.latest() is None
        before = time.monotonic_ns()
        assert hand.publish([True, [1.5, math.nan], 0.25, -(1 << 62), NOTE]) == 1
        stated = time.monotonic_ns()
        named = {"flag": False, "pair": (math.inf, 2), "single": 3, "count": np.int64(5), "note": ""}
        assert hand.publish(named, stated, uncertainty_ns=7, time_uncertain=True) == 2
        newest = read.wait(WAIT_S)
        assert (newest.sequence, newest.session, newest.time_ns, newest.uncertainty_ns) == (2, hand.session, stated, 7)
        assert newest.flags == depthrig.SignalFlags.TIME_UNCERTAIN
        assert newest.description.fields == tuple(MIXED)
        assert [newest[f.name] for f in MIXED if f.count == 1] == [False, 3.0, 5, ""]
        window = read.window(60)
        assert len(window) == 2
        assert before <= window.times_ns[0] < window.times_ns[1]
        assert window["note"] == [NOTE, ""]
        assert window["count"].tolist() == [-(1 << 62), 5]
        assert window["flag"].tolist() == [True, False]
        np.testing.assert_array_equal(window["pair"], [[1.5, math.nan], [math.inf, 2]])
        first = read.at(int(window.times_ns[0]), 0)
        assert first.flags == depthrig.SignalFlags.PUBLISH_TIME
        assert first["note"] == NOTE
        with pytest.raises(ValueError, match="several types or a text; read its fields by name: flag, pair"):
            _ = window.values
        with pytest.raises(KeyError, match="has no field 'x'; it has: flag"):
            _ = newest["x"]


def test_values_of_one_type_are_an_array(folder: Path, arm: depthrig.Signal) -> None:
    with reader(folder) as read:
        arm.publish([1, 2, 3])
        arm.publish(np.array([4, 5, 6], np.float32))
        arm.publish({"wrist": 9, "elbow": 8, "shoulder": 7})
        newest = read.wait(WAIT_S)
        assert newest.values.tolist() == [7, 8, 9]
        assert read.window(60).values.tolist() == [[1, 2, 3], [4, 5, 6], [7, 8, 9]]
        assert read.window(60)["elbow"].tolist() == [2, 5, 8]
        assert len(read.window(0)) == 1


@pytest.mark.parametrize(
    ("values", "why"),
    [
        ([1, 2], "there are 2 values for 3 fields"),
        ([1, 2, "x"], "do not fit its fields"),
        ([[1], 2, 3], "do not fit its fields"),
        ({"shoulder": 1}, r"\['elbow', 'wrist'\] are unknown or have no value"),
        (5, "is not a sequence"),
        ("abc", "there are 1 values"),
    ],
)
def test_values_that_do_not_fit_are_refused(folder: Path, arm: depthrig.Signal, values: object, why: str) -> None:
    with reader(folder) as read:
        arm.publish([0, 0, 0])
        with pytest.raises(ValueError, match=f"signal {ARM}: .*{why}"):
            arm.publish(values)  # type: ignore[arg-type]
        arm.publish([0, 0, 0])
        assert read.wait(WAIT_S).sequence == 2
        assert read.missed == 0


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"flag": "no"}, "'no' is not a bool"),
        ({"single": 1e300}, "do not fit"),
        ({"count": 0.5}, "do not fit"),
        ({"note": 5}, "'note' is a text, not 5"),
        ({"note": "x" * 4096}, "4096 is the most"),
        ({"pair": [1]}, "'pair' has 2 elements"),
    ],
)
def test_a_value_of_another_type_is_refused(folder: Path, change: dict[str, object], why: str) -> None:
    good = {"flag": True, "pair": [0, 0], "single": 0, "count": 0, "note": ""}
    with (
        depthrig.Signal("hand/state", MIXED, runtime_dir=folder) as hand,
        pytest.raises(ValueError, match=f"signal hand/state: .*{why}"),
    ):
        hand.publish({**good, **change})


def test_times_that_cannot_be_are_refused(folder: Path, arm: depthrig.Signal) -> None:
    with reader(folder) as read:
        now = time.monotonic_ns()
        arm.publish([0, 0, 0], now)
        for late in (now, now - 1):
            with pytest.raises(ValueError, match="is not after that of the sample before"):
                arm.publish([0, 0, 0], late)
        with pytest.raises(ValueError, match=r"ahead of the clock, at most 100 ms are possible; .* not UTC"):
            arm.publish([0, 0, 0], time.time_ns())
        with pytest.raises(ValueError, match="ahead of the clock"):
            arm.publish([0, 0, 0], time.monotonic_ns() + 10_000_000_000)
        with pytest.raises(ValueError, match="whole nanoseconds"):
            arm.publish([0, 0, 0], 1.5)  # type: ignore[arg-type]
        arm.publish([0, 0, 0], time.monotonic_ns() + 50_000_000)
        arm.publish([0, 0, 0])
        assert read.wait(WAIT_S).sequence == 3
        assert read.missed == 0


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ({"fields": []}, "has no fields"),
        ({"fields": ["a", "a"]}, "two fields are named 'a'"),
        ({"fields": [SignalField("a", "f16")]}, "unknown type 'f16'"),
        ({"fields": [SignalField("a", "text"), "b"]}, "at the end"),
        ({"fields": [SignalField("a", count=513)]}, "more than 4096 bytes"),
        ({"fields": [f"field_number_{i:030}" for i in range(99)]}, "4096 is the most"),
        ({"fields": ["a"], "kind": "speech"}, "unknown kind"),
        ({"fields": [SignalField("a", "i64")], "kind": "joints"}, "not one float"),
        ({"kind": "pose"}, "frame of its pose is not named"),
        ({"fields": ["a"], "kind": "pose", "frame": "base"}, "translation_m"),
        ({"fields": ["a"], "frame": "base"}, "not a pose"),
    ],
)
def test_a_description_that_breaks_a_rule_is_refused(folder: Path, options: dict[str, object], why: str) -> None:
    with pytest.raises(ValueError, match=f"signal arm/x: .*{why}"):
        depthrig.Signal("arm/x", runtime_dir=folder, **options)  # type: ignore[arg-type]
    for name in ("arm", "Arm/x", "arm/x/y"):
        with pytest.raises(ValueError, match="invalid signal name|cannot be the name"):
            depthrig.Signal(name, ["a"], runtime_dir=folder)


def test_a_second_publisher_is_refused_and_the_holder_named(folder: Path, arm: depthrig.Signal) -> None:
    assert depthrig.signals(folder) == [ARM]
    with pytest.raises(depthrig.SignalTaken, match=f"{ARM} is published already, by process {os.getpid()} "):
        depthrig.Signal(ARM, NAMES, runtime_dir=folder)
    arm.close()
    assert depthrig.signals(folder) == []
    with pytest.raises(ValueError, match="was closed"):
        arm.publish([0, 0, 0])
    depthrig.Signal(ARM, NAMES, runtime_dir=folder).close()


def test_an_unknown_signal_names_those_there_are(folder: Path, arm: depthrig.Signal) -> None:
    with pytest.raises(depthrig.SignalNotFound, match=f"signal arm/x: nobody publishes it; .*: {ARM}"):
        reader(folder, "arm/x", timeout=0)


def test_a_slow_reader_loses_the_oldest_and_knows_it(folder: Path, arm: depthrig.Signal) -> None:
    with reader(folder, keep=1000) as read:
        for k in range(700):
            arm.publish([k, 0, 0])
        assert read.wait(WAIT_S).sequence == 700
        # The first of all set the reference, and it was replaced.
        assert read.missed == 0
        assert read.window(1000)["shoulder"].tolist() == list(range(700 - 512, 700))
        for k in range(600):
            arm.publish([k, 0, 0])
        assert read.wait(WAIT_S).sequence == 1300
        assert read.missed == 600 - 512


def test_what_is_kept_is_bounded_by_time(folder: Path, arm: depthrig.Signal) -> None:
    start = time.monotonic_ns() - 3_000_000_000
    with reader(folder, keep=0.25) as read:
        for k in range(2500):
            arm.publish([k, 0, 0], start + k * 1_000_000)
            if k % 500 == 0:
                read.latest()
        assert read.window(60)["shoulder"].tolist() == list(range(2500 - 251, 2500))
        with pytest.raises(depthrig.SignalOutside, match="1.000 ms before the first sample that is kept"):
            read.at(start + (2500 - 252) * 1_000_000, 1)
        assert len(read._samples) < 2000


def test_the_value_at_a_time_between_two_samples(folder: Path) -> None:
    with depthrig.Signal("hand/state", MIXED, runtime_dir=folder) as hand, reader(folder, "hand/state") as read:
        with pytest.raises(depthrig.SignalOutside, match="no sample has come yet"):
            read.at(0, 1)
        start = time.monotonic_ns() - 1_000_000_000
        hand.publish([True, [1, math.nan], 1, 1, NOTE], start, uncertainty_ns=3)
        hand.publish([False, [5, 1], 2, 5, ""], start + 10_000_000, uncertainty_ns=9)
        middle = read.at(start + 5_000_000, 0.01)
        assert middle.interpolated
        assert (middle.time_ns, middle.uncertainty_ns) == (start + 5_000_000, 9)
        np.testing.assert_array_equal(middle["pair"], [3, math.nan])
        assert (middle["flag"], middle["single"], middle["count"], middle["note"]) == (True, 1.5, 1, NOTE)
        exact = read.at(start + 10_000_000, 0)
        assert not exact.interpolated
        assert exact["pair"].tolist() == [5, 1]
        with pytest.raises(depthrig.SignalGap, match=r"10\.000 ms apart, at most 9\.000 ms") as gap:
            read.at(start + 5_000_000, 0.009)
        assert gap.value.gap_s == 0.01
        with pytest.raises(depthrig.SignalOutside, match=r"1\.000 ms after the newest sample"):
            read.at(start + 11_000_000, 1)
        with pytest.raises(depthrig.SignalOutside, match=r"1\.000 ms before the first"):
            read.at(start - 1_000_000, 1)


def test_a_sine_is_met_within_the_bound_of_its_curvature(folder: Path, arm: depthrig.Signal) -> None:
    rng = np.random.default_rng(7)
    turn = 2 * math.pi * 3.0
    with reader(folder, keep=1000) as read:
        steps = rng.integers(1_000_000, 30_000_000, 300)
        times = time.monotonic_ns() - int(steps.sum()) + np.cumsum(steps)
        for t in times.tolist():
            arm.publish([math.sin(turn * t / 1e9), 0, 0], t)
        read.latest()
        gap = float(steps.max()) / 1e9
        asked = rng.integers(times[0], times[-1], 500)
        got = np.array([read.at(int(t), gap)["shoulder"] for t in asked])
        off = np.abs(got - np.sin(turn * asked / 1e9))
        assert off.max() <= turn**2 * gap**2 / 8 + 1e-9


def test_the_pose_between_two_poses_turns_evenly(folder: Path) -> None:
    pose = depthrig.Signal("arm/tool_pose", kind="pose", frame="base", runtime_dir=folder)
    with pose, reader(folder, "arm/tool_pose") as read:
        start = time.monotonic_ns() - 1_000_000_000
        pose.publish([0, 0, 0, 0, 0, 0, 1], start)
        # A turn of 2 rad about z, written as the quaternion of the other sign.
        pose.publish([[1, 2, 3], [0, 0, -math.sin(1), -math.cos(1)]], start + 1000)
        for share in (0.25, 0.5, 0.9):
            got = read.at(start + int(1000 * share), 1)
            assert got["translation_m"].tolist() == pytest.approx([share, 2 * share, 3 * share])
            expected = [0, 0, math.sin(share), math.cos(share)]
            assert got["rotation_xyzw"].tolist() == pytest.approx(expected, abs=1e-12)
        assert read.description is not None
        assert read.description.frame == "base"


@pytest.mark.parametrize("turn", [0.001, 0.05, 0.5, 3.0])
def test_small_and_large_turns_are_even_and_quaternions_of_any_length_are_rotations(folder: Path, turn: float) -> None:
    pose = depthrig.Signal("arm/tool_pose", kind="pose", frame="base", runtime_dir=folder)
    with pose, reader(folder, "arm/tool_pose") as read:
        start = time.monotonic_ns() - 1_000_000_000
        pose.publish([0, 0, 0, 0, 0, 0, 2.0], start)
        pose.publish([0, 0, 0, 0.5 * math.sin(turn / 2), 0, 0, 0.5 * math.cos(turn / 2)], start + 1000)
        for share in (0.125, 0.25, 0.75):
            got = read.at(start + int(1000 * share), 1)["rotation_xyzw"]
            expected = [math.sin(share * turn / 2), 0, 0, math.cos(share * turn / 2)]
            assert got.tolist() == pytest.approx(expected, abs=1e-6 * turn)


def test_between_two_samples_what_does_not_change_stays_and_flags_are_those_of_both(folder: Path, arm: depthrig.Signal) -> None:
    with reader(folder) as read:
        start = time.monotonic_ns() - 1_000_000_000
        arm.publish([math.inf, 0.1, -math.inf], start)
        arm.publish([math.inf, 0.1, 1.0], start + 1000, time_uncertain=True)
        got = read.at(start + 300, 1)
        assert got["shoulder"] == math.inf
        assert got["elbow"] == 0.1, "to the last bit"
        assert got["wrist"] == -math.inf
        assert depthrig.SignalFlags.TIME_UNCERTAIN in got.flags
        assert depthrig.SignalFlags.TIME_UNCERTAIN not in read.at(start, 1).flags


def test_an_old_sample_is_stale(folder: Path, arm: depthrig.Signal) -> None:
    with reader(folder) as read:
        with pytest.raises(depthrig.Stale, match="no sample has come yet") as none:
            read.latest(max_age=1)
        assert none.value.age_s is None
        arm.publish([0, 0, 0], time.monotonic_ns() - 5_000_000_000)
        with pytest.raises(depthrig.Stale, match="at most 1 s is allowed") as old:
            read.latest(max_age=1)
        assert old.value.age_s is not None
        assert old.value.age_s >= 5
        newest = read.latest(max_age=3600)
        assert newest is not None
        assert read.latest() is newest, "the newest one is returned again"


def test_waiting_ends_in_time_and_with_the_publisher(folder: Path, arm: depthrig.Signal) -> None:
    with reader(folder) as read:
        with pytest.raises(depthrig.Timeout, match="nothing came within 0.05 s"):
            read.wait(0.05)
        arm.close()
        with pytest.raises(depthrig.StreamGone, match=f"signal {ARM}: nobody publishes it any more"):
            read.wait(WAIT_S)


def test_a_late_reader_gets_the_newest_sample(folder: Path, arm: depthrig.Signal) -> None:
    arm.publish([1, 0, 0])
    arm.publish([2, 0, 0])
    with reader(folder) as read:
        arm.welcome()
        assert read.wait(WAIT_S)["shoulder"] == 2


def test_eight_readers_find_room_and_a_ninth_is_refused(folder: Path, arm: depthrig.Signal) -> None:
    readers = [reader(folder) for _ in range(8)]
    with pytest.raises(depthrig.BusError, match=f"signal {ARM}: all of its 8 places for subscribers are taken"):
        reader(folder)
    for _ in range(2000):
        arm.publish([0, 0, 0])
    assert {r.wait(WAIT_S).sequence for r in readers} == {2000}
    readers.pop().close()
    gc.collect()
    reader(folder).close()
    for r in readers:
        r.close()


def test_a_killed_publisher_is_followed_by_another(folder: Path) -> None:
    beside = depthrig.Signal("hand/position", ["thumb"], runtime_dir=folder)
    with beside, reader(folder, "hand/position", keep=3600) as steady:
        read = None
        for round_ in range(_layout.SIGNAL_MAX_PUBLISHERS + 2):
            with child([sys.executable, "-c", PUBLISH, str(folder)]) as process:
                line(process, "ready")
                read = read or reader(folder)
                while read.restarts < round_ or read.latest() is None:
                    beside.publish([0])
                    read.wait(WAIT_S)
                os.kill(process.pid, signals_of_unix.SIGKILL)
                process.wait(WAIT_S)
            assert depthrig.signals(folder) == ["hand/position"]
        assert read is not None
        with pytest.raises(depthrig.StreamGone):
            while True:
                read.wait(WAIT_S)
        old = read.latest()
        assert old is not None
        with depthrig.Signal(ARM, NAMES, runtime_dir=folder) as arm:
            arm.publish([0, 1, 2])
            new = read.wait(WAIT_S)
            assert new.sequence == 1
            assert new.session > old.session
            with pytest.raises(depthrig.SignalOutside):
                read.at((old.time_ns + new.time_ns) // 2, 3600)
        read.close()
        last = beside.publish([0])
        assert steady.wait(WAIT_S).sequence == last
        assert steady.missed + len(steady.window(3600)) == last


def test_killed_readers_cost_nobody_a_sample(folder: Path, arm: depthrig.Signal) -> None:
    with reader(folder) as steady:
        for _ in range(_layout.SIGNAL_MAX_SUBSCRIBERS + 2):
            with child([sys.executable, "-c", READ, str(folder)], stdin=subprocess.PIPE) as process:
                line(process, "ready")
                for _ in range(100):
                    arm.publish([0, 0, 0])
                    steady.latest()
                line(process, "read")
                os.kill(process.pid, signals_of_unix.SIGKILL)
                process.wait(WAIT_S)
            for _ in range(700):
                arm.publish([0, 0, 0])
                steady.latest()
        newest = steady.latest()
        assert newest is not None
        assert (newest.sequence, steady.missed) == (800 * (_layout.SIGNAL_MAX_SUBSCRIBERS + 2), 0)


def test_other_fields_are_reported_once_and_then_read(folder: Path, arm: depthrig.Signal) -> None:
    with reader(folder) as read:
        arm.publish([0, 0, 0])
        read.wait(WAIT_S)
        arm.close()
        with depthrig.Signal(ARM, ["shoulder"], runtime_dir=folder) as other:
            other.publish([5])
            message = r"different description: shoulder \(fields\); before: shoulder, elbow, wrist \(joints\)"
            with pytest.raises(depthrig.SignalChanged, match=message):
                read.latest()
            newest = read.latest()
            assert newest is not None
            assert newest.values.tolist() == [5]
            assert (read.restarts, read.missed) == (1, 0)


def test_a_channel_of_another_version_is_refused(folder: Path) -> None:
    bus = Bus.at(str(folder))
    sender = Sender(bus, f"{_layout.SIGNAL_PREFIX}/{ARM}", SIGNAL, 64, 8, SIGNALS._replace(schema="depthrig.signal/2"))
    with pytest.raises(depthrig.VersionMismatch, match="another version of depthrig or iceoryx2"):
        reader(folder)
    with pytest.raises(depthrig.VersionMismatch, match="another version of depthrig or iceoryx2"):
        depthrig.Signal(ARM, NAMES, runtime_dir=folder)
    assert depthrig.signals(folder) == [], "a refused one is free again"
    del sender


@pytest.mark.parametrize(
    ("change", "error", "why"),
    [
        ({1: 2}, depthrig.VersionMismatch, "header version 2"),
        ({8: 1}, depthrig.BadSignal, "another hash"),
        ({9: 5000}, depthrig.BadSignal, "length"),
        ({10: 8}, depthrig.BadSignal, "length"),
        ({9: 8}, depthrig.BadSignal, "invalid description"),
    ],
)
def test_a_sample_that_breaks_the_contract_is_refused(
    folder: Path, arm: depthrig.Signal, change: dict[int, int], error: type[Exception], why: str
) -> None:
    with reader(folder) as read:
        fields = list(HEAD.unpack(arm._head.raw))
        for place, value in change.items():
            fields[place] = value
        body = arm._body.raw[: arm._start + 24]
        fields[10] = change.get(10, len(body))
        head = HEAD.pack(*fields)
        sender = arm._sender
        assert sender is not None
        slot = sender.loan(len(body))
        assert slot is not None
        ctypes.memmove(slot.header_address, head, len(head))
        ctypes.memmove(slot.address, body, len(body))
        slot.send()
        with pytest.raises(error, match=f"signal {ARM}: .*{why}"):
            read.latest()
        arm.publish([1, 2, 3])
        newest = read.latest()
        assert newest is not None
        assert newest.values.tolist() == [1, 2, 3]


def test_payloads_lie_where_their_numbers_are_aligned(folder: Path, arm: depthrig.Signal) -> None:
    sender = arm._sender
    assert sender is not None
    for _ in range(20):
        arm.publish([0, 0, 0])
        slot = sender.loan(arm._start + 24)
        assert slot is not None
        assert slot.address % 8 == 0
        assert slot.address - slot.header_address == _layout.SIGNAL_HEADER_SIZE


def test_a_forked_child_publishes_nothing(folder: Path, arm: depthrig.Signal) -> None:
    pid = os.fork()
    if pid == 0:
        code = 1
        try:
            arm.publish([0, 0, 0])
        except depthrig.BusError:
            arm.close()
            code = 42
        finally:
            os._exit(code)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 42
    assert depthrig.signals(folder) == [ARM]
    assert arm.publish([0, 0, 0]) == 1


def test_signals_of_rust_are_read(example: str, folder: Path) -> None:
    with child([example, "publish", str(folder)], stdin=subprocess.PIPE) as process:
        line(process, "ready")
        assert depthrig.signals(folder) == ["test/arm", "test/mixed", "test/tool_pose"]
        arm, mixed, pose = (reader(folder, f"test/{name}") for name in ("arm", "mixed", "tool_pose"))
        assert process.stdin is not None
        process.stdin.write("3\n")
        process.stdin.flush()
        line(process, "3")
        newest = arm.wait(WAIT_S)
        assert (newest.sequence, newest.time_ns, newest.uncertainty_ns) == (3, 1_030_000_000, 3000)
        assert arm.window(1).values.tolist() == [[1, 0.5, -1], [2, 1, -2], [3, 1.5, -3]]
        assert arm.at(1_015_000_000, 0.01)["wrist"] == -1.5
        mixed.wait(WAIT_S)
        window = mixed.window(1)
        assert window["note"] == [f'sample {k} "quoted"\n🦾' for k in (1, 2, 3)]
        assert window["flag"].tolist() == [True, False, True]
        assert window["single"].tolist() == [0.25, 0.5, 0.75]
        assert window["count"].tolist() == [1, 4, 9]
        np.testing.assert_array_equal(window["pair"], [[1, math.nan], [2, math.nan], [3, math.nan]])
        pose.wait(WAIT_S)
        turned = pose.at(1_015_000_000, 0.01)["rotation_xyzw"]
        assert turned.tolist() == pytest.approx([0, 0, math.sin(0.075), math.cos(0.075)])
        for read in (arm, mixed, pose):
            # What Python would have written for these fields is what Rust wrote.
            description = read.description
            assert description is not None
            again = depthrig.SignalDescription(
                description.name, description.kind, description.frame, description.fields
            )
            assert again.json == description.json
            assert fnv(again.json.encode()) == description.hash
            read.close()
        process.stdin.close()
        process.wait(WAIT_S)


def test_signals_of_python_are_read_in_rust(example: str, folder: Path) -> None:
    with (
        depthrig.Signal("hand/state", MIXED, runtime_dir=folder) as hand,
        child([example, "read", str(folder), "hand/state", "2"]) as process,
    ):
        line(process, "ready")
        stated = time.monotonic_ns()
        hand.publish([True, [1.5, math.nan], 0.25, -5, NOTE], stated, uncertainty_ns=11)
        hand.publish([False, [0, 0], 0, 0, ""])
        out, err = process.communicate(timeout=WAIT_S)
        assert not err
        first, second = map(json.loads, out.splitlines())
        assert first["values"] == [True, 1.5, None, 0.25, -5, NOTE]
        assert first["description"] == hand.description.json
        assert first["hash"] == hand.description.hash
        facts = [first[name] for name in ("sequence", "session", "time_ns", "uncertainty_ns", "flags")]
        assert facts == [1, hand.session, stated, 11, 0]
        assert (second["sequence"], second["flags"]) == (2, int(depthrig.SignalFlags.PUBLISH_TIME))


@pytest.mark.parametrize(
    "raw",
    [
        b"{",
        b"\xff",
        b"[]",
        b'{"version":1}',
        b'{"version":1,"name":5,"kind":"fields","fields":[]}',
        b'{"version":1,"name":"a/b","kind":"fields","fields":[5]}',
        b'{"version":1,"name":"a/b","kind":"fields","fields":[{"name":"x","type":"f64","count":true}]}',
        b'{"version":1,"name":"a/b","kind":"fields","fields":[{"name":5,"type":"f64"}]}',
        b'{"version":1,"name":"a/b","kind":[],"fields":[{"name":"x","type":"f64"}]}',
        b'{"version":1,"name":"a/b","kind":"fields","fields":[{"name":"x","type":["f64"]}]}',
    ],
)
def test_a_description_that_is_none_is_refused(raw: bytes) -> None:
    with pytest.raises(depthrig.BadSignal, match="signal a/b: invalid description"):
        parse_description(raw, "signal a/b")


def test_a_description_of_a_later_version_is_refused() -> None:
    with pytest.raises(depthrig.VersionMismatch, match="description has version 2"):
        parse_description(b'{"version":2,"name":"a/b"}', "signal a/b")


def test_the_hash_is_fnv_1a() -> None:
    assert fnv(b"foobar") == 0x85944171F73967E8


def test_with_little_shared_memory_a_signal_is_refused() -> None:
    script = "mount -t tmpfs -o size=6m depthrig-test /dev/shm || exit 99; exec \"$0\" \"$@\""
    code = """
import tempfile, depthrig
with tempfile.TemporaryDirectory(dir="/tmp") as folder:
    arm = depthrig.Signal("arm/position", ["elbow"], runtime_dir=folder)
    read = depthrig.SignalReader("arm/position", folder)
    try:
        depthrig.Signal("arm/note", [depthrig.SignalField("note", "text")], runtime_dir=folder)
        print("no error")
    except depthrig.BusError as e:
        print(e)
    for _ in range(2000):
        arm.publish([0])
        read.latest()
    print(read.latest().sequence, read.missed, depthrig.signals(folder))
    read.close(); arm.close()
"""
    command = ["unshare", "--user", "--map-root-user", "--mount", "sh", "-c", script, sys.executable, "-c", code]
    environment = {**os.environ, "PYTHONPATH": str(Path(depthrig.__file__).parents[1])}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=WAIT_S * 10)
    if done.returncode == 99 or "unshare: " in done.stderr:
        assert "DEPTHRIG_REQUIRE_TMPFS" not in os.environ, done.stderr
        pytest.skip(f"a small /dev/shm cannot be mounted here: {done.stderr.strip()}")
    assert done.returncode == 0, done.stderr
    refusal, after = done.stdout.splitlines()
    assert f"has no room for its {_layout.SIGNAL_SLOTS} slots" in refusal
    assert "enlarge it" in refusal
    assert after == "2000 0 ['arm/position']"


def test_the_examples_of_the_documents_run(folder: Path) -> None:
    """Each block of Python in docs/signals.md, in order, as one program."""
    text = (ROOT / "docs" / "signals.md").read_text()
    blocks = [part.split("```", 1)[0] for part in text.split("```python\n")[1:]]
    assert blocks
    environment = {**os.environ, _layout.RUNTIME_DIR_VARIABLE: str(folder)}
    environment["PYTHONPATH"] = str(Path(depthrig.__file__).parents[1])
    done = subprocess.run(
        [sys.executable, "-c", "\n".join(blocks)], capture_output=True, text=True, env=environment, timeout=WAIT_S * 10
    )
    assert done.returncode == 0, done.stderr
