"""`depthrig.policy`: observations of a live rig and of a replay, held against what was published and recorded.

The joints move on straight lines in time, so that the true value at the time of an image is known.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace

import depthrig
import numpy as np
import pytest
from depthrig._policy_images import ReplayedImages
from depthrig.policy import Observation, PolicyLoop, Report
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from test_daemon import ROOT, WAIT_S, binary, command, environment, running, runtime, wait_until_answers
from test_signals_recorded import wait_for_sets

__all__ = ["binary", "runtime"]

RIG = """
rig = "policy"
[recording]
directory = {directory}
reserve_mb = 64
color = "raw"
[[camera]]
name = "front"
backend = "synthetic"
model = "d435"
cheap = true
poses = 2
[[camera]]
name = "left"
backend = "synthetic"
model = "d455"
cheap = true
poses = 2
"""
IMAGES = {"front": "front/depth", "left": "left/depth", "color": "front/color"}
SIGNALS = {"joints": "arm/joint_position"}
JOINTS = [f"joint_{i}" for i in range(14)]


def angles(time_ns: int, count: int = len(JOINTS)) -> list[float]:
    """The joints at a time: lines, one steeper than the other."""
    return [i + (i + 1) * (time_ns % 10**12) / 1e9 for i in range(count)]


@contextmanager
def arm(runtime: Path, names: list[str] = JOINTS) -> Iterator[threading.Event]:
    """Publishes the joints from a thread until the event is set."""
    stop = threading.Event()

    def move() -> None:
        with (
            depthrig.Signal("arm/joint_position", names, unit="rad", kind="joints", runtime_dir=runtime) as joints,
            depthrig.Signal("arm/slow", ["count"], runtime_dir=runtime) as slow,
        ):
            last = 0
            while not stop.wait(0.005):
                now = time.monotonic_ns()
                joints.publish(angles(now, len(names)), time_ns=now)
                if now - last > 750_000_000:
                    last = now
                    slow.publish([now], time_ns=now)

    thread = threading.Thread(target=move)
    thread.start()
    try:
        yield stop
    finally:
        stop.set()
        thread.join()


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("policy")
    (folder / "rig.toml").write_text(RIG.format(directory=json.dumps(str(folder / "data"))))
    return folder


@contextmanager
def live(binary: str, runtime: Path, rig: Path) -> Iterator[subprocess.Popen[bytes]]:
    with running(binary, runtime, rig / "log", "run", str(rig / "rig.toml"), "-q") as process:
        with depthrig.SetReader(IMAGES.values(), runtime_dir=runtime, timeout=WAIT_S, max_skew=1.0) as reader:
            reader.next(timeout=WAIT_S)
        yield process


def loop(runtime: Path, **options: object) -> PolicyLoop:
    # A busy computer is late with everything; what is late is not what these tests are about.
    given = {"max_age": WAIT_S, "max_skew": 1.0, "max_gap": WAIT_S, "wait": WAIT_S, "timeout": WAIT_S, **options}
    return PolicyLoop(given.pop("images", IMAGES), given.pop("signals", SIGNALS), runtime_dir=runtime, **given)


def check_joints(seen: Observation) -> None:
    np.testing.assert_allclose(seen["joints"], angles(seen.time_ns), rtol=0, atol=1e-6)
    assert seen.signals["joints"].time_ns == seen.time_ns == seen.frames["front"].capture_time_ns


@dataclass
class Recorded:
    dataset: Path
    sent: list[float] = field(default_factory=list)


def is_heard(binary: str, runtime: Path, signal: str) -> bool:
    """Whether the daemon has read a sample: it looks for new signals five times a second, and records what comes from then on."""
    status = json.loads(command(binary, runtime, "status", "--json", codes=(0, 3)))
    return signal in {s["signal"] for s in status["signals"]}


@pytest.fixture(scope="module")
def recorded(binary: str, runtime: Path, rig: Path) -> Recorded:
    """A recording of a live loop that publishes the time of its images as an action."""
    with live(binary, runtime, rig), arm(runtime):
        done = Recorded(Path())

        def policy(seen: Observation) -> list[float]:
            check_joints(seen)
            assert not seen.replayed
            assert seen["front"].dtype == np.uint16
            assert seen["color"].shape == (*seen["front"].shape, 3)
            assert not seen["color"].flags.writeable
            done.sent.append(seen.time_ns / 1e9)
            return [done.sent[-1]]

        with (
            depthrig.Signal("policy/action", ["time"], unit="s", runtime_dir=runtime) as action,
            loop(runtime, action=action) as running_loop,
        ):
            # The signal is there before the recording. Images from before the arm began have no joints.
            early = running_loop.run(policy, steps=1).no_sample
            before = 1
            until = time.monotonic() + WAIT_S
            while not is_heard(binary, runtime, "policy/action"):
                assert time.monotonic() < until
                early = running_loop.run(policy, steps=1).no_sample
                before += 1
            command(binary, runtime, "record", "start", "--name", "policy")
            path = json.loads(command(binary, runtime, "status", "--json", codes=(0, 3)))["recording"]["path"]
            done.dataset = Path(path)
            done.sent.clear()
            report = running_loop.run(policy, steps=30)
            wait_for_sets(binary, runtime, 30)
            command(binary, runtime, "record", "stop", codes=(0, 3))
    assert (report.observations, report.actions, report.stale) == (before + 30, before + 30, 0)
    assert report.no_sample == early
    return done


def messages(dataset: Path, topic: str) -> list:
    found = []
    for segment in sorted(dataset.glob("seg_*.mcap")):
        with segment.open("rb") as file:
            reader = make_reader(file, decoder_factories=[DecoderFactory()])
            found += [m for _, c, _, m in reader.iter_decoded_messages() if c.topic == topic]
    return found


def test_actions_are_recorded(recorded: Recorded) -> None:
    got = [v.fields[0].floats[0] for v in messages(recorded.dataset, "/policy/policy/action/values")]
    assert [t for t in got if t >= recorded.sent[0]] == recorded.sent


def replayed(
    binary: str, runtime: Path, dataset: Path, log: Path, pause_s: float = 0.0, steps: int | None = None, **options: object
) -> tuple[list[str], Report]:
    """A digest of each observation of a replay, and the report. With `steps` the dataset is replayed again and again."""
    digests: list[str] = []
    numbers: list[int] = []

    def policy(seen: Observation) -> None:
        check_joints(seen)
        assert seen.replayed
        numbers.append(seen.number)
        digest = hashlib.sha256(str(seen.time_ns).encode())
        for name in [*IMAGES, *seen.signals]:
            digest.update(name.encode() + seen[name].tobytes())
        digests.append(digest.hexdigest())
        time.sleep(pause_s)

    call = ["replay", str(dataset), "--as-fast-as-possible", "--paused", "-q", *(["--loop"] if steps else [])]
    with running(binary, runtime, log, *call), loop(runtime, **options) as policy_loop:
        wait_until_answers(runtime, "policy")
        command(binary, runtime, "replay", "resume")
        report = policy_loop.run(policy, steps=steps)
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    return digests, report


def test_two_replays_give_the_same_observations(binary: str, runtime: Path, recorded: Recorded, tmp_path: Path) -> None:
    sets = len(messages(recorded.dataset, "/policy/frame_set"))
    assert sets >= 12
    first, report = replayed(binary, runtime, recorded.dataset, tmp_path / "log", wait=0.05)
    assert report.is_replay
    assert (report.age, report.jitter, report.stale) == (None, None, 0)
    assert set(report.missed.values()) == {0}
    # Each set once: what is not observed is counted with its reason.
    assert report.observations + report.incomplete + report.no_sample["joints"] == sets
    assert len(first) == report.observations >= 5
    again, _ = replayed(binary, runtime, recorded.dataset, tmp_path / "log", wait=0.05)
    assert again == first
    slow, report = replayed(binary, runtime, recorded.dataset, tmp_path / "log", 0.05, wait=0.05)
    assert slow == first
    assert set(report.missed.values()) == {0}


def test_a_sample_is_in_time_or_not_whatever_the_reader_does(
    binary: str, runtime: Path, recorded: Recorded, tmp_path: Path
) -> None:
    """The next sample of a slow signal comes with a later set, which a player that waits for a slow policy has published."""
    options = {"signals": {**SIGNALS, "slow": "arm/slow"}, "wait": 5.0}
    found = []
    for pause_s in (0.0, 0.1, 0.02):
        digests, report = replayed(binary, runtime, recorded.dataset, tmp_path / "log", pause_s, **options)
        assert report.no_sample["slow"] > 0
        found.append(digests)
    assert len(found[0]) > 0
    assert found[0] == found[1] == found[2]


def test_a_replay_in_a_loop_gives_the_same_observations_each_round(
    binary: str, runtime: Path, recorded: Recorded, tmp_path: Path
) -> None:
    once, _ = replayed(binary, runtime, recorded.dataset, tmp_path / "log", wait=0.05)
    thrice, report = replayed(binary, runtime, recorded.dataset, tmp_path / "log", steps=3 * len(once), wait=0.05)
    assert set(report.missed.values()) == {0}
    # The last sets of a round: the samples after them are those of the next round, and they are counted.
    order = [once.index(digest) for digest in thrice]
    ends = [i for i, (a, b) in enumerate(itertools.pairwise(order)) if b != a + 1]
    assert len(ends) >= 2
    assert all(order[i + 1] == 0 and order[i] >= len(once) - 5 for i in ends)
    assert report.no_sample["joints"] > 0


def test_a_rate_thins_a_replay_by_its_recorded_times(binary: str, runtime: Path, recorded: Recorded, tmp_path: Path) -> None:
    every, _ = replayed(binary, runtime, recorded.dataset, tmp_path / "log", wait=0.05)
    few, _ = replayed(binary, runtime, recorded.dataset, tmp_path / "log", wait=0.05, hz=1.0)
    again, _ = replayed(binary, runtime, recorded.dataset, tmp_path / "log", wait=0.05, hz=1.0)
    assert few == again
    assert 2 <= len(few) < len(every) / 2


def test_a_loop_without_samples_does_not_act(binary: str, runtime: Path, rig: Path) -> None:
    with live(binary, runtime, rig), arm(runtime) as stop:
        with loop(runtime, wait=0.02) as policy_loop:
            stop.set()
            while "arm/joint_position" in depthrig.signals(runtime):
                time.sleep(0.02)
            called = []
            until = time.monotonic() + WAIT_S
            # Samples that came before the end may still serve an image or two.
            while policy_loop.report().no_sample["joints"] < 3:
                assert time.monotonic() < until
                policy_loop.step(called.append)
            count = len(called)
            assert not policy_loop.step(called.append)
            assert len(called) == count
        with pytest.raises(depthrig.SignalNotFound, match="arm/none"):
            loop(runtime, signals={"joints": "arm/none"}, timeout=0.1)
        with pytest.raises(depthrig.StreamNotFound, match="front/none"):
            loop(runtime, images={"front": "front/none"}, signals={}, timeout=0.1)


def test_the_example_of_the_documents_runs(binary: str, runtime: Path, rig: Path) -> None:
    text = (ROOT / "docs" / "policies.md").read_text()
    (code, *_) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    code = code.replace("seconds=60", "seconds=60, steps=3").replace("max_age=0.5, max_gap=0.1", "max_age=60, max_gap=60, wait=60, max_skew=1")
    path = str(Path(depthrig.__file__).parents[1])
    with live(binary, runtime, rig), arm(runtime, ["shoulder", "elbow", "wrist"]):
        env = {**environment(runtime), "PYTHONPATH": path}
        call = [sys.executable, "-c", code]
        done = subprocess.run(call, env=env, capture_output=True, text=True, timeout=WAIT_S * 2, check=False)
    assert done.returncode == 0, done.stderr
    assert "observations 3, actions 3" in done.stdout


def test_late_and_stale_are_counted(binary: str, runtime: Path, rig: Path) -> None:
    with live(binary, runtime, rig) as daemon:
        with loop(runtime, signals={}, hz=50.0) as policy_loop:
            report = policy_loop.run(lambda _: time.sleep(0.03), steps=5)
            assert (report.observations, report.actions, report.late) == (5, 0, 5)
        with loop(runtime, signals={}, hz=1000.0) as policy_loop:
            new = []
            until = time.monotonic() + WAIT_S
            # The same images again until newer ones are there.
            while new.count(False) == 0:
                assert time.monotonic() < until
                report = policy_loop.run(lambda seen: new.append(seen.is_new), steps=10)
            assert new[0] is True
            assert json.loads(report.to_json())["observations"] == len(new)
            assert "exposure to the policy's input" in str(report)
        with loop(runtime, signals={}, max_age=1e-6) as policy_loop:
            assert not policy_loop.step(lambda _: pytest.fail("it acts on stale images"))
            assert policy_loop.report().stale == 1
        with loop(runtime, signals={}) as policy_loop:
            policy_loop.step(lambda _: None)
            daemon.send_signal(signal.SIGINT)
            with pytest.raises(depthrig.StreamGone):
                policy_loop.run(lambda _: None, seconds=WAIT_S)


def test_images_of_a_replay_are_those_that_its_sets_name() -> None:
    def frames(*numbers: int) -> SimpleNamespace:
        waiting = [SimpleNamespace(sequence=n) for n in numbers]
        return SimpleNamespace(_take=lambda: waiting.pop(0) if waiting else None)

    def record(tick: int, **members: int | None) -> depthrig.FrameSet:
        return depthrig.FrameSet(tick, tick, 0, 0, {f"c/{name}": n for name, n in members.items()}, {})

    # A begins two frames late, b lost its third.
    streams = {"c/a": frames(3, 4, 5, 6), "c/b": frames(2, 4, 5, 6)}
    records = [record(1, a=2, b=1), record(2, a=3, b=2), record(3, a=4, b=3), record(4, a=None, b=4), record(5, a=6, b=5)]
    sets = SimpleNamespace(_take=lambda: records.pop(0) if records else None, is_live=False, _pause=lambda _: None)
    sets._check_publisher = lambda: None
    images = ReplayedImages(SimpleNamespace(streams=list(streams), _streams=streams), sets, {})
    found = [images.next(lambda: None, WAIT_S) for _ in range(5)]
    numbers = [one.group and {name: f.sequence for name, f in one.group.items()} for one in found]
    assert numbers == [None, {"c/a": 3, "c/b": 2}, None, None, {"c/a": 6, "c/b": 5}]
    assert [(one.tick_ns, one.next_tick_ns) for one in found] == [(1, 2), (2, 3), (3, 4), (4, 5), (5, None)]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"images": {}}, "images is empty"),
        ({"signals": {"front": "arm/joint_position"}}, "front names an image and a signal"),
        ({"hz": 0.0}, "hz is a number"),
        ({"max_age": 0.0}, "max_age is a number"),
        ({"max_gap": {"wrist": 0.1}}, "joints, wrist"),
    ],
)
def test_what_makes_no_sense_is_refused(runtime: Path, options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        loop(runtime, **options)
