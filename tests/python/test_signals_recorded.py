"""Signals in recordings: every sample, to the bit, as readers that are not ours see it.

The daemon records simulated cameras while this process and others publish signals.
"""

from __future__ import annotations

import csv
import io
import itertools
import json
import math
import os
import shutil
import signal as signals
import struct
import subprocess
import sys
import threading
import time
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import depthrig
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from test_daemon import WAIT_S, binary, command, environment, rig_file, running, runtime  # noqa: F401

JOINTS = ["shoulder", "elbow", "wrist"]
TEXT = 'pick "the cup",\nthen smile 🙂'
ODD = [math.nan, math.inf, -0.0, 5e-324]


@dataclass
class Robot:
    """Publishes three signals from a thread, and keeps what it published."""

    runtime: Path
    sent: dict[str, list[tuple[int, Any]]] = field(default_factory=dict)
    stop: threading.Event = field(default_factory=threading.Event)

    def run(self) -> None:
        fields = [
            depthrig.SignalField("width", unit="m"),
            depthrig.SignalField("small", "f32", 2),
            depthrig.SignalField("count", "i64"),
            depthrig.SignalField("closed", "bool"),
            depthrig.SignalField("task", "text"),
        ]
        arm = depthrig.Signal("arm/joint_position", JOINTS, unit="rad", kind="joints", runtime_dir=self.runtime)
        pose = depthrig.Signal("arm/tool_pose", kind="pose", frame="base", runtime_dir=self.runtime)
        gripper = depthrig.Signal("gripper/state", fields, runtime_dir=self.runtime)
        with arm, pose, gripper:
            number = 0
            while not self.stop.is_set():
                number += 1
                odd = ODD[number % len(ODD)]
                self.publish(arm, [0.1 * number, odd, math.pi / number])
                self.publish(pose, [number, 0.5, 1 / 3, 0.0, 0.0, math.sin(number), math.cos(number)])
                values = [odd, np.float32(number / 3), 2.5, (1 << 62) + number, number % 2 == 0, f"{TEXT} {number}"]
                self.publish(gripper, values)
                time.sleep(0.01)

    def publish(self, signal: depthrig.Signal, values: list[Any]) -> None:
        now = time.monotonic_ns()
        kept = self.sent.setdefault(signal.name, [])
        now = max(now, kept[-1][0] + 1) if kept else now
        given = values
        if signal.name == "gripper/state":
            width, small, other, count, closed, task = values
            given = [width, [small, other], count, closed, task]
        signal.publish(given, time_ns=now, uncertainty_ns=7)
        kept.append((now, values))


@contextmanager
def publishing(runtime: Path) -> Iterator[Robot]:  # noqa: F811
    robot = Robot(runtime)
    thread = threading.Thread(target=robot.run)
    thread.start()
    try:
        yield robot
    finally:
        robot.stop.set()
        thread.join()


@contextmanager
def publisher(runtime: Path, name: str, fields: str, rate: int) -> Iterator[subprocess.Popen[str]]:  # noqa: F811
    script = Path(__file__).with_name("signal_publisher.py")
    call = [sys.executable, str(script), str(runtime), name, fields, str(rate)]
    with subprocess.Popen(call, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "publishing\n"
            yield process
        finally:
            process.kill()


def status(binary: str, runtime: Path) -> dict[str, Any]:  # noqa: F811
    recording = json.loads(command(binary, runtime, "status", "--json", codes=(0, 3)))["recording"]
    assert isinstance(recording, dict)
    return recording


def wait_for_sets(binary: str, runtime: Path, more: int) -> None:  # noqa: F811
    """Until this many more sets are recorded."""
    begin = status(binary, runtime)["sets"]
    deadline = time.monotonic() + WAIT_S
    while status(binary, runtime)["sets"] < begin + more:
        assert time.monotonic() < deadline, "no more sets are recorded"
        time.sleep(0.1)


def wait_until_recording(binary: str, runtime: Path) -> None:  # noqa: F811
    deadline = time.monotonic() + WAIT_S
    while True:
        asked = [binary, "record", "status", "--json"]
        said = subprocess.run(asked, env=environment(runtime), capture_output=True, text=True, timeout=WAIT_S, check=False)
        if said.returncode == 0 and json.loads(said.stdout):
            return
        assert time.monotonic() < deadline, said.stderr
        time.sleep(0.05)


def record(binary: str, runtime: Path, folder: Path, name: str) -> Path:  # noqa: F811
    wait_until_running(binary, runtime)
    command(binary, runtime, "record", "start", "--name", name)
    return Path(status(binary, runtime)["path"])


def segments(dataset: Path) -> list[Path]:
    return sorted(dataset.glob("seg_*.mcap"))


def decoded(dataset: Path) -> Iterator[tuple[Any, Any, Any]]:
    for segment in segments(dataset):
        with segment.open("rb") as file:
            reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
            for _, channel, message, value in reader.iter_decoded_messages():
                yield channel, message, value


def nanoseconds(stamp: Any) -> int:
    return int(stamp.sec) * 1_000_000_000 + int(getattr(stamp, "nanosec", 0))


def bits(values: Any) -> bytes:
    return struct.pack(f"<{len(values)}d", *values)


def flat(signal: str, message: Any) -> list[Any]:
    """The values of a message for readers that know ROS alone."""
    if signal == "arm/joint_position":
        assert list(message.name) == JOINTS
        assert len(message.velocity) == len(message.effort) == 0
        return list(message.position)
    if signal == "arm/tool_pose":
        assert message.header.frame_id == "base"
        p, q = message.pose.position, message.pose.orientation
        return [p.x, p.y, p.z, q.x, q.y, q.z, q.w]
    values: list[Any] = []
    for f in message.fields:
        values += [*f.floats, *f.integers, *([f.text] if f.type == "text" else [])]
    return values


def same(signal: str, got: list[Any], sent: list[Any]) -> bool:
    if signal != "gripper/state":
        return bits(got) == bits([float(v) for v in sent])
    return bits(got[:3]) == bits([float(v) for v in sent[:3]]) and got[3:] == [sent[3], int(sent[4]), sent[5]]


TOPICS = {
    "arm/joint_position": ("joint_states", "sensor_msgs/msg/JointState"),
    "arm/tool_pose": ("pose", "geometry_msgs/msg/PoseStamped"),
    "gripper/state": ("values", "depthrig_msgs/msg/SignalValues"),
}


@dataclass
class Recorded:
    dataset: Path
    sent: dict[str, list[tuple[int, Any]]]


@pytest.fixture(scope="module")
def rig(rig_file: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:  # noqa: F811
    folder = tmp_path_factory.mktemp("signals")
    path = folder / "rig.toml"
    text = rig_file.read_text()
    first = text.index("[[camera]]")
    second = text.find("[[camera]]", first + 1)
    text = text[:second] if second > 0 else text
    path.write_text(text.replace("[recording]", f"[recording]\ndirectory = {json.dumps(str(folder / 'data'))}"))
    return path, folder


@pytest.fixture(scope="module")
def recorded(binary: str, runtime: Path, rig: tuple[Path, Path]) -> Recorded:  # noqa: F811
    """A recording during which one signal appears, and one has its publisher killed and another one come."""
    path, folder = rig
    with running(binary, runtime, folder / "log", "run", str(path)), publishing(runtime) as robot:
        wait_until_known(robot)
        dataset = record(binary, runtime, folder, "whole")
        wait_for_sets(binary, runtime, 3)
        for _ in range(2):
            with publisher(runtime, "late/joints", "a,b", 100) as process:
                wait_for_sets(binary, runtime, 4)
                os.kill(process.pid, signals.SIGKILL)
        wait_for_sets(binary, runtime, 3)
        command(binary, runtime, "record", "stop", codes=(0, 3))
    return Recorded(dataset, robot.sent)


def wait_until_known(robot: Robot) -> None:
    deadline = time.monotonic() + WAIT_S
    while len(robot.sent.get("gripper/state", [])) < 100:
        assert time.monotonic() < deadline
        time.sleep(0.05)


def wait_until_running(binary: str, runtime: Path) -> None:  # noqa: F811
    """Until every camera streams."""
    asked = [binary, "status", "--json"]
    deadline = time.monotonic() + WAIT_S
    while True:
        said = subprocess.run(
            asked, env=environment(runtime), capture_output=True, text=True, timeout=WAIT_S, check=False
        )
        if said.returncode in (0, 3) and all(c["state"] == "streaming" for c in json.loads(said.stdout)["cameras"]):
            return
        assert time.monotonic() < deadline, said.stdout + said.stderr
        time.sleep(0.1)


def check_all(recorded: Recorded, signal: str, got: list[tuple[int, list[Any]]]) -> None:
    """`got` is what was sent from some sample on without a gap, to the bit."""
    sent = recorded.sent[signal]
    assert len(got) >= 100
    first = next(i for i, (time_ns, _) in enumerate(sent) if time_ns == got[0][0])
    assert [t for t, _ in got] == [t for t, _ in sent[first : first + len(got)]]
    for (_, values), (_, expected) in zip(got, sent[first:], strict=False):
        assert same(signal, values, expected), (values, expected)


@pytest.mark.parametrize("signal", TOPICS)
def test_every_sample_equals_what_was_published(recorded: Recorded, signal: str) -> None:
    name, schema = TOPICS[signal]
    offset = None
    got: list[tuple[int, list[Any]]] = []
    last_tick = 0
    for channel, message, value in decoded(recorded.dataset):
        if channel.topic == "/images/frame_set":
            offset = value.utc_offset_ns
            last_tick = value.tick_ns
        if channel.topic == f"/images/{signal}/{name}":
            assert nanoseconds(value.header.stamp) == message.publish_time
            got.append((message.publish_time, flat(signal, value)))
    assert offset is not None
    got = [(t - offset, values) for t, values in got]
    check_all(recorded, signal, got)
    # The end of the signal is not missing.
    assert got[-1][0] > last_tick - 1_000_000_000
    for segment in segments(recorded.dataset):
        with AnyReader([segment]) as reader:
            connections = [c for c in reader.connections if c.topic == f"/images/{signal}/{name}"]
            assert [c.msgtype for c in connections] == [schema]


@pytest.mark.parametrize("signal", TOPICS)
def test_rosbags_reads_the_same(recorded: Recorded, signal: str) -> None:
    name, _ = TOPICS[signal]
    got: list[tuple[int, list[Any]]] = []
    offset = 0
    for segment in segments(recorded.dataset):
        with AnyReader([segment]) as reader:
            for connection, _, raw in reader.messages():
                if connection.topic == "/images/frame_set":
                    offset = reader.deserialize(raw, connection.msgtype).utc_offset_ns
                if connection.topic == f"/images/{signal}/{name}":
                    message = reader.deserialize(raw, connection.msgtype)
                    got.append((nanoseconds(message.header.stamp), flat(signal, message)))
    check_all(recorded, signal, [(t - offset, values) for t, values in got])


def test_samples_hold_the_bytes_and_the_package_reads_them(recorded: Recorded) -> None:
    messages = []
    description = ""
    for channel, _, value in decoded(recorded.dataset):
        if channel.topic == "/images/gripper/state/samples":
            messages.append(value)
            description = channel.metadata["description"]
    window = depthrig.recorded_signal(description, messages)
    sent = recorded.sent["gripper/state"]
    first = next(i for i, (time_ns, _) in enumerate(sent) if time_ns == window.times_ns[0])
    expected = sent[first : first + len(window)]
    assert window.times_ns.tolist() == [t for t, _ in expected]
    assert window["task"] == [values[5] for _, values in expected]
    assert window["count"].tolist() == [values[3] for _, values in expected]
    assert window["width"].tobytes() == bits([values[0] for _, values in expected])
    assert {s.uncertainty_ns for m in messages for s in m.samples} == {7}
    numbers = [s.sequence for m in messages for s in m.samples]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))


def test_verify_finds_it_whole_and_names_the_restart(binary: str, runtime: Path, recorded: Recorded) -> None:  # noqa: F811
    report = json.loads(command(binary, runtime, "verify", "--decode", "--json", str(recorded.dataset), codes=(0, 3)))
    said = [f["message"] for f in report["findings"] if f["severity"] != "note"]
    assert said == []
    notes = " ".join(f["message"] for f in report["findings"])
    assert "late/joints was published anew 1 times" in notes
    assert report["signal_samples"] > 300


def test_accounts_balance(recorded: Recorded) -> None:
    last = {}
    for channel, _, value in decoded(recorded.dataset):
        if channel.topic == "/images/accounts":
            last = {a.stream: a for a in value.streams}
    counts: dict[str, int] = {}
    for channel, _, value in decoded(recorded.dataset):
        if channel.topic.endswith("/samples"):
            counts[channel.metadata["stream"]] = counts.get(channel.metadata["stream"], 0) + len(value.samples)
    assert counts.keys() == {*TOPICS, "late/joints"}
    for signal, count in counts.items():
        account = last[signal]
        assert account.delivered == count
        assert account.captured == account.delivered + sum(account.dropped)


def test_a_signal_that_appears_begins_a_segment(recorded: Recorded) -> None:
    with_it = []
    for segment in segments(recorded.dataset):
        with AnyReader([segment]) as reader:
            with_it.append(any(c.topic == "/images/late/joints/joint_states" for c in reader.connections))
    assert with_it[0] is False
    assert with_it[-1] is True


def test_cat_writes_csv_that_reads_back(binary: str, runtime: Path, recorded: Recorded) -> None:  # noqa: F811
    text = command(binary, runtime, "cat", str(recorded.dataset), "--stream", "gripper/state")
    rows = list(csv.DictReader(io.StringIO(text, newline="")))
    sent = dict(recorded.sent["gripper/state"])
    assert len(rows) >= 100
    for row in rows:
        width, small, other, count, closed, task = sent[int(row["time_ns"])]
        assert bits([float(row["width"])]) == bits([width])
        assert [np.float32(row["small[0]"]), np.float32(row["small[1]"])] == [small, other]
        assert (int(row["count"]), row["closed"], row["task"]) == (count, str(int(closed)), task)
    lines = command(binary, runtime, "cat", str(recorded.dataset), "--stream", "arm/tool_pose", "--json").splitlines()
    pose = json.loads(lines[0])
    sent_pose = dict(recorded.sent["arm/tool_pose"])[pose["time_ns"]]
    assert pose["values"]["translation_m"] + pose["values"]["rotation_xyzw"] == pytest.approx(sent_pose, abs=0)


def test_cat_writes_npy(binary: str, runtime: Path, recorded: Recorded, tmp_path: Path) -> None:  # noqa: F811
    call = ["cat", str(recorded.dataset), "--stream", "arm/joint_position", "--format", "npy", "--out", str(tmp_path / "o")]
    command(binary, runtime, *call)
    array = np.load(tmp_path / "o" / "arm" / "joint_position.npy")
    sent = dict(recorded.sent["arm/joint_position"])
    for record in array:
        assert bits([record[j] for j in JOINTS]) == bits(sent[int(record["time_ns"])])


def test_trim_and_merge_give_the_recording_back(binary: str, runtime: Path, recorded: Recorded, tmp_path: Path) -> None:  # noqa: F811
    info = json.loads(command(binary, runtime, "info", "--json", str(recorded.dataset), codes=(0, 3)))
    assert {s["signal"] for s in info["signals"]} == {*TOPICS, "late/joints"}
    cut = f"{info['duration_ns'] / 2e9:.3f}"
    a, b, whole = (str(tmp_path / n) for n in ("a", "b", "whole"))
    command(binary, runtime, "trim", str(recorded.dataset), a, "--to", cut, codes=(0, 3))
    command(binary, runtime, "trim", str(recorded.dataset), b, "--from", cut, codes=(0, 3))
    command(binary, runtime, "verify", "--decode", b, codes=(0, 3))
    command(binary, runtime, "merge", whole, a, b, codes=(0, 3))
    command(binary, runtime, "compare", str(recorded.dataset), whole, "--strict", "--pixels", "stored")
    differ = json.loads(command(binary, runtime, "compare", "--json", str(recorded.dataset), a, codes=(1,)))
    assert differ["signal_samples"] > 100


def test_the_report_has_a_plot_for_each_signal(binary: str, runtime: Path, recorded: Recorded, tmp_path: Path) -> None:  # noqa: F811
    copy = tmp_path / "copy"
    shutil.copytree(recorded.dataset, copy)
    command(binary, runtime, "report", str(copy), "--overwrite", codes=(0, 3))
    page = (copy / "report.html").read_text()
    for signal in [*TOPICS, "late/joints"]:
        assert f"<h3>{signal}</h3>" in page
        assert f"{signal} over time" in page


def test_replay_publishes_every_sample_again(binary: str, runtime: Path, recorded: Recorded, tmp_path: Path) -> None:  # noqa: F811
    again = tmp_path / "again"
    call = ["replay", str(recorded.dataset), "--paused", "--record", str(again)]
    got: dict[int, bytes] = {}
    with running(binary, runtime, tmp_path / "log", *call) as process:
        wait_until_recording(binary, runtime)
        reader = open_reader(runtime, "arm/joint_position")
        command(binary, runtime, "replay", "resume")
        while process.poll() is None:
            try:
                sample = reader.wait(timeout=0.5)
            except (TimeoutError, depthrig.StreamGone, depthrig.BusError):
                continue
            assert sample.replayed
            got[sample.time_ns] = bits(sample.values)
    sent = dict(recorded.sent["arm/joint_position"])
    assert len(got) >= 3
    assert all(values == bits(sent[t]) for t, values in got.items())
    dataset = next(p.parent for p in again.rglob("session.toml"))
    command(binary, runtime, "compare", str(recorded.dataset), str(dataset))


def open_reader(runtime: Path, name: str) -> depthrig.SignalReader:  # noqa: F811
    deadline = time.monotonic() + WAIT_S
    while True:
        try:
            return depthrig.SignalReader(name, runtime_dir=runtime)
        except depthrig.SignalNotFound:
            assert time.monotonic() < deadline
            time.sleep(0.05)


def test_ten_kilohertz_are_recorded_and_what_a_stopped_daemon_misses_is_counted(
    binary: str,  # noqa: F811
    runtime: Path,  # noqa: F811
    rig: tuple[Path, Path],
) -> None:
    path, folder = rig
    with running(binary, runtime, folder / "fast.log", "run", str(path)) as daemon:
        # Samples from before a recording's begin may have gaps that it does not count.
        dataset = record(binary, runtime, folder, "fast")
        with publisher(runtime, "fast/joints", "a,b", 10_000):
            wait_for_sets(binary, runtime, 5)
            # The channel keeps 512 samples, which are 51 ms.
            os.kill(daemon.pid, signals.SIGSTOP)
            time.sleep(0.3)
            os.kill(daemon.pid, signals.SIGCONT)
            wait_for_sets(binary, runtime, 5)
        # Samples that are lost behind the last recorded one are in no gap.
        wait_for_sets(binary, runtime, 2)
        command(binary, runtime, "record", "stop", codes=(0, 3))
    numbers = [round(v.position[0]) for c, _, v in decoded(dataset) if c.topic.endswith("/joint_states")]
    gaps = [b - a - 1 for a, b in itertools.pairwise(numbers)]
    assert len(numbers) > 1000
    assert min(gaps) >= 0
    assert sum(gaps) > 0
    said = json.loads(command(binary, runtime, "info", "--json", str(dataset)))["signals"]
    assert [s["lost"] for s in said if s["signal"] == "fast/joints"] == [sum(gaps)]
    accounts = [a for c, _, v in decoded(dataset) if c.topic == "/images/accounts" for a in v.streams]
    account = [a for a in accounts if a.stream == "fast/joints"][-1]
    assert (account.delivered, sum(account.dropped)) == (len(numbers), sum(gaps))


def test_a_publisher_with_other_fields_is_refused_by_name(binary: str, runtime: Path, rig: tuple[Path, Path]) -> None:  # noqa: F811
    path, folder = rig
    log = folder / "changed.log"
    with running(binary, runtime, log, "run", str(path)):
        with publisher(runtime, "late/joints", "a,b", 100):
            dataset = record(binary, runtime, folder, "changed")
            wait_for_sets(binary, runtime, 3)
        with publisher(runtime, "late/joints", "a,b,c", 100):
            wait_for_sets(binary, runtime, 5)
        command(binary, runtime, "record", "stop", codes=(0, 3))
    assert "signal late/joints has other fields than when the recording began" in log.read_text()
    report = json.loads(command(binary, runtime, "verify", "--decode", "--json", str(dataset), codes=(0, 3)))
    assert all(f["severity"] != "broken" for f in report["findings"])
    assert any("samples of late/joints were lost live" in f["message"] for f in report["findings"])
    lengths = {len(v.position) for c, _, v in decoded(dataset) if c.topic.endswith("/joint_states")}
    assert lengths == {2}


def test_a_recording_begins_with_the_second_before_and_the_last_sample_however_old(
    binary: str,  # noqa: F811
    runtime: Path,  # noqa: F811
    rig: tuple[Path, Path],
) -> None:
    path, folder = rig

    def heard(name: str) -> int:
        said = json.loads(command(binary, runtime, "status", "--json", codes=(0, 3)))["signals"]
        return sum(s["samples"] for s in said if s["signal"] == name)

    with (
        running(binary, runtime, folder / "before.log", "run", str(path)),
        depthrig.Signal("slow/mode", ["mode"], runtime_dir=runtime) as slow,
        publisher(runtime, "fast/before", "a,b", 100),
    ):
        wait_until_running(binary, runtime)
        deadline = time.monotonic() + WAIT_S
        for number in range(1, 4):
            slow.publish([number])
            while heard("slow/mode") < number or heard("fast/before") < 100 * number:
                assert time.monotonic() < deadline
                time.sleep(0.1)
        time.sleep(1.5)
        dataset = record(binary, runtime, folder, "before")
        wait_for_sets(binary, runtime, 3)
        command(binary, runtime, "record", "stop", codes=(0, 3))
    values, fast, first_set = [], [], 0
    for channel, message, value in decoded(dataset):
        if channel.topic == "/images/frame_set":
            first_set = first_set or message.log_time
        if channel.topic == "/images/slow/mode/values":
            values.append(value.fields[0].floats[0])
        if channel.topic == "/images/fast/before/joint_states":
            fast.append(message.publish_time)
    assert values == [3]
    # The first set has its moment some images after the recording began.
    before_s = (first_set - fast[0]) / 1e9
    assert 0.05 < before_s < 1.9, "one second, and the time until the first set"
    assert len(fast) > 50


def test_a_signal_with_the_name_of_a_stream_is_refused_once_and_costs_nothing(
    binary: str,  # noqa: F811
    runtime: Path,  # noqa: F811
    rig: tuple[Path, Path],
) -> None:
    path, folder = rig
    log = folder / "clash.log"
    with running(binary, runtime, log, "run", str(path)):
        dataset = record(binary, runtime, folder, "clash")
        stream = tomllib.loads((dataset / "session.toml").read_text())["streams"][0]["id"]
        with publisher(runtime, stream, "a,b", 100), publisher(runtime, "beside/it", "a,b", 100):
            wait_for_sets(binary, runtime, 6)
        command(binary, runtime, "record", "stop", codes=(0, 3))
    why = f"signal {stream} is not recorded: a stream of a camera has the same name"
    assert log.read_text().count(why) == 1
    report = json.loads(command(binary, runtime, "verify", "--decode", "--json", str(dataset), codes=(0, 3)))
    assert [f["message"] for f in report["findings"] if f["severity"] != "note"] == []
    assert {s["signal"] for s in json.loads(command(binary, runtime, "info", "--json", str(dataset)))["signals"]} == {"beside/it"}


def test_a_killed_recorder_loses_a_second_at_most(binary: str, runtime: Path, rig: tuple[Path, Path]) -> None:  # noqa: F811
    path, folder = rig
    with publishing(runtime) as robot:
        with (folder / "killed.log").open("wb") as out:
            process = subprocess.Popen([binary, "run", str(path)], env=environment(runtime), stdout=out, stderr=out)
        try:
            wait_until_known(robot)
            dataset = record(binary, runtime, folder, "killed")
            wait_for_sets(binary, runtime, 12)
        finally:
            process.kill()
            process.wait()
    recovered = command(binary, runtime, "recover", str(dataset), codes=(0, 3))
    assert recovered
    report = json.loads(command(binary, runtime, "verify", "--decode", "--json", str(dataset), codes=(0, 3)))
    assert all(f["severity"] != "broken" for f in report["findings"])
    got = []
    offset = 0
    for channel, message, value in decoded(dataset):
        if channel.topic == "/images/frame_set":
            offset = value.utc_offset_ns
        if channel.topic == "/images/arm/joint_position/joint_states":
            got.append((message.publish_time, flat("arm/joint_position", value)))
    check_all(Recorded(dataset, robot.sent), "arm/joint_position", [(t - offset, v) for t, v in got])


def wait_for_line(log: Path, text: str) -> None:
    deadline = time.monotonic() + WAIT_S
    while text not in log.read_text():
        assert time.monotonic() < deadline, log.read_text()
        time.sleep(0.05)


def test_a_required_signal_must_come_before_a_recording_begins(
    binary: str,  # noqa: F811
    runtime: Path,  # noqa: F811
    rig: tuple[Path, Path],
    tmp_path: Path,
) -> None:
    path = tmp_path / "required.toml"
    listed = '[[signal]]\nname = "late/joints"\nrequired = true\nsilent_s = 2.0\n[[signal]]\nname = "never/there"\n'
    path.write_text(f"{rig[0].read_text()}\n{listed}")

    def the_signal(state: str) -> dict[str, Any]:
        """Wait for the signal's state, and the exit code that belongs to it."""
        deadline = time.monotonic() + WAIT_S
        while True:
            call = [binary, "status", "--json"]
            done = subprocess.run(call, env=environment(runtime), capture_output=True, text=True, check=False)
            if done.returncode in (0, 3):
                said = json.loads(done.stdout)
                signal, other = said["signals"]
                assert (other["signal"], other["required"], other["state"]) == ("never/there", False, "missing")
                has_lost = any((said["recording"] or {"dropped": {}})["dropped"].values())
                if signal["state"] == state and done.returncode == (3 if state != "live" or has_lost else 0):
                    return dict(signal)
            assert time.monotonic() < deadline, done.stdout + done.stderr
            time.sleep(0.1)

    log = tmp_path / "log"
    with running(binary, runtime, log, "run", str(path)):
        missing = the_signal("missing")
        assert (missing["signal"], missing["age_s"]) == ("late/joints", None)
        call = [binary, "record", "start", "--force"]
        refused = subprocess.run(call, env=environment(runtime), capture_output=True, text=True, check=False)
        assert refused.returncode == 1
        assert "nobody publishes signal late/joints, which this rig requires; start the robot's process" in refused.stderr
        with publisher(runtime, "late/joints", "a,b", 100) as process:
            the_signal("live")
            dataset = record(binary, runtime, rig[1], "required")
            wait_for_sets(binary, runtime, 2)
            os.kill(process.pid, signals.SIGSTOP)
            assert the_signal("silent")["age_s"] > 2.0
            wait_for_line(log, "signal late/joints, which this rig requires, has been silent for")
            os.kill(process.pid, signals.SIGCONT)
            the_signal("live")
            wait_for_line(log, "signal late/joints comes again")
            command(binary, runtime, "record", "stop", codes=(0, 3))
    assert len(list(decoded(dataset))) > 0

    # `run --record` waits for it.
    again = tmp_path / "again"
    call = ["run", str(path), "--record", str(again), "--force"]
    with running(binary, runtime, tmp_path / "again.log", *call):
        the_signal("missing")
        assert not again.exists()
        with publisher(runtime, "late/joints", "a,b", 100):
            deadline = time.monotonic() + WAIT_S
            while not list(again.rglob("session.toml")):
                assert time.monotonic() < deadline
                time.sleep(0.1)
