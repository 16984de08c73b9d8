"""The main job end to end: real images through the real daemon, into a dataset, and out again, bit by bit.

The daemon is the binary `DEPTHRIG_BIN`, else cargo's; the images are below `DEPTHRIG_TEST_DATA`, else in
`shared/data` beside the checkout. The source files are decoded with Pillow, which shares no code with depthrig.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import depthrig

ROOT = Path(__file__).resolve().parents[2]
DATA = Path(os.environ.get("DEPTHRIG_TEST_DATA", ROOT.parent / "shared" / "data")).resolve()
WAIT_S = 60.0
"""Longer than anything takes on a loaded machine: only for tests that would otherwise hang."""


@dataclass(frozen=True)
class Camera:
    name: str
    color: str
    depth: str
    depth_unit_m: float

    def source(self, stream: str) -> np.ndarray:
        return np.asarray(Image.open(DATA / getattr(self, stream)))


CAMERAS = [
    Camera("lingbot_0", "lingbot_depth/0/rgb.png", "lingbot_depth/0/raw_depth.png", 0.001),
    Camera("lingbot_1", "lingbot_depth/1/rgb.jpg", "lingbot_depth/1/raw_depth.png", 0.001),
    Camera("lingbot_2", "lingbot_depth/2/rgb.png", "lingbot_depth/2/raw_depth.png", 0.001),
    Camera("lingbot_3", "lingbot_depth/3/rgb.jpg", "lingbot_depth/3/raw_depth.png", 0.001),
    Camera("cdm_d405", "cdm_d405/color_26.png", "cdm_d405/depth_26.png", 0.0001),
]
STREAMS = [(camera, stream) for camera in CAMERAS for stream in ("color", "depth")]


@pytest.fixture(scope="module")
def binary() -> str:
    if "DEPTHRIG_DATA_MISSING" in os.environ:
        pytest.skip("no real images")
    assert (DATA / "lingbot_depth").is_dir(), f"the real images are not at {DATA}; set DEPTHRIG_TEST_DATA"
    if "DEPTHRIG_BIN" in os.environ:
        return os.environ["DEPTHRIG_BIN"]
    command = ["cargo", "build", "--bin", "depthrig", "--message-format=json"]
    built = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, check=True)
    messages = map(json.loads, built.stdout.splitlines())
    paths = [m["executable"] for m in messages if m.get("target", {}).get("name") == "depthrig" and m.get("executable")]
    assert paths, "cargo built no depthrig"
    return str(paths[-1])


@pytest.fixture(scope="module")
def runtime() -> Iterator[Path]:
    """A runtime folder: short, because sockets live below it."""
    path = Path(tempfile.mkdtemp(prefix="rig", dir="/tmp"))
    yield path
    shutil.rmtree(path, ignore_errors=True)


@pytest.fixture(scope="module")
def rig_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rig of all real images. Colour is recorded raw, so that it can be compared bit by bit as well."""
    lines = ['rig = "images"', "[recording]", 'color = "raw"', "reserve_mb = 64"]
    for camera in CAMERAS:
        manifest = ROOT / "tests" / "data" / f"{camera.name}.toml"
        lines += [
            "[[camera]]",
            f'name = "{camera.name}"',
            'backend = "files"',
            f"manifest = {json.dumps(str(manifest))}",
        ]
    path = tmp_path_factory.mktemp("rig") / "rig.toml"
    path.write_text("\n".join(lines) + "\n")
    return path


def environment(runtime: Path) -> dict[str, str]:
    return {**os.environ, "DEPTHRIG_RUNTIME_DIR": str(runtime), "DEPTHRIG_TEST_DATA": str(DATA)}


@contextmanager
def running(
    binary: str, runtime: Path, log: Path, *arguments: str, codes: tuple[int, ...] = (0, 3)
) -> Iterator[subprocess.Popen[bytes]]:
    """A depthrig process that is ended with Ctrl-C and must then end with one of `codes`. A busy computer may lose a frame (3)."""
    with log.open("wb") as out:
        process = subprocess.Popen([binary, *arguments], env=environment(runtime), stdout=out, stderr=out)
    try:
        yield process
    except BaseException:
        process.kill()
        process.wait()
        print(log.read_text(errors="replace"))
        raise
    if process.poll() is None:
        process.send_signal(signal.SIGINT)
    try:
        code = process.wait(WAIT_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
        code = None
    assert code in codes, f"{arguments[0]} ended with {code}:\n{log.read_text(errors='replace')}"


def command(binary: str, runtime: Path, *arguments: str, codes: tuple[int, ...] = (0,)) -> str:
    done = subprocess.run(
        [binary, *arguments], env=environment(runtime), capture_output=True, text=True, timeout=WAIT_S, check=False
    )
    assert done.returncode in codes, f"{arguments} ended with {done.returncode}:\n{done.stdout}\n{done.stderr}"
    return done.stdout


def wait_until_answers(runtime: Path, rig: str) -> None:
    """Wait for the daemon's socket; one that is there may be another daemon's, or not listen yet."""
    deadline = time.monotonic() + WAIT_S
    with socket.socket(socket.AF_UNIX) as asking:
        while asking.connect_ex(str(runtime / f"{rig}.sock")):
            assert time.monotonic() < deadline, f"{rig} does not answer"
            time.sleep(0.02)


def thread_named(process_id: int, name: str) -> Path | None:
    """The folder in /proc of the process's thread of that name."""
    for thread in Path(f"/proc/{process_id}/task").iterdir():
        with suppress(FileNotFoundError, ProcessLookupError):  # it has just ended
            if (thread / "comm").read_text().strip() == name:
                return thread
    return None


def open_stream(runtime: Path, camera: Camera, stream: str) -> depthrig.Stream:
    return depthrig.Stream(f"{camera.name}/{stream}", runtime_dir=runtime, timeout=WAIT_S)


def check_image(frame: depthrig.Frame, camera: Camera, stream: str) -> None:
    source = camera.source(stream)
    header = frame.header
    assert (header.rig, header.stream_id) == ("images", f"{camera.name}/{stream}")
    assert (header.height, header.width) == source.shape[:2]
    assert header.intrinsics.is_known
    if stream == "color":
        assert header.format_name == "rgb8"
        np.testing.assert_array_equal(frame.array, source)
        return
    assert header.format_name == "z16"
    assert header.depth_unit_m == camera.depth_unit_m
    assert source.dtype == np.uint16
    assert (source > 0).any()
    np.testing.assert_array_equal(frame.array, source)
    metres = frame.depth_m()
    np.testing.assert_array_equal(np.isnan(metres), source == 0)
    np.testing.assert_allclose(np.nan_to_num(metres), source * camera.depth_unit_m, rtol=1e-6)


def test_live_arrays_equal_the_source_images(binary: str, runtime: Path, rig_file: Path, tmp_path: Path) -> None:
    with running(binary, runtime, tmp_path / "log", "run", str(rig_file)):
        streams = [(open_stream(runtime, camera, stream), camera, stream) for camera, stream in STREAMS]
        assert depthrig.running_rigs(runtime) == ["images"]
        assert set(depthrig.streams(runtime_dir=runtime)) == {f"{c.name}/{s}" for c, s in STREAMS}
        for reader, camera, stream in streams:
            previous = None
            for _ in range(3):
                frame = reader.next(timeout=WAIT_S)
                check_image(frame, camera, stream)
                h = frame.header
                assert not h.replayed
                assert h.captured == h.sequence + sum(h.drops.values())
                assert h.capture_time_ns <= h.arrival_time_ns <= h.publish_time_ns
                assert previous is None or h.capture_time_ns > previous
                previous = h.capture_time_ns
        sets = depthrig.Sets(runtime_dir=runtime, timeout=WAIT_S)
        assert set(sets.next(timeout=WAIT_S).members) == {f"{c.name}/{s}" for c, s in STREAMS}
    with pytest.raises(depthrig.StreamGone):
        while True:
            streams[0][0].next(timeout=WAIT_S)


def test_record_verify_replay(binary: str, runtime: Path, rig_file: Path, tmp_path: Path) -> None:
    live: dict[str, set[int]] = {f"{c.name}/{s}": set() for c, s in STREAMS}
    ids: list[int] = []
    recordings = tmp_path / "recordings"
    arguments = ("run", str(rig_file), "--record", str(recordings), "--seconds", "3")
    with running(binary, runtime, tmp_path / "record.log", *arguments) as daemon:
        sets = depthrig.Sets(runtime_dir=runtime, timeout=WAIT_S)
        ended = False
        while True:
            try:
                frame_set = sets.next(timeout=0 if ended else 1)
            except (depthrig.Timeout, depthrig.StreamGone):
                if ended:  # and everything that was published before has been read
                    break
                ended = daemon.poll() is not None
                continue
            ids.append(frame_set.set_id)
            for name, time_ns in frame_set.capture_times_ns.items():
                live[name].add(time_ns)
    assert all(len(times) >= 5 for times in live.values()), {n: len(t) for n, t in live.items()}

    found = sorted(p.parent for p in recordings.rglob("session.toml"))
    assert len(found) == 1, f"one dataset was to be written below {recordings}, not {found}"
    dataset = str(found[0])
    command(binary, runtime, "verify", dataset, codes=(0, 3))
    json.loads(command(binary, runtime, "verify", dataset, "--json", codes=(0, 3)))
    json.loads(command(binary, runtime, "info", dataset, "--json"))

    replayed: dict[str, set[int]] = {name: set() for name in live}
    with running(binary, runtime, tmp_path / "replay.log", "replay", dataset, "--loop"):
        readers = [(open_stream(runtime, camera, stream), camera, stream) for camera, stream in STREAMS]
        for reader, camera, stream in readers:
            for _ in range(3):
                frame = reader.next(timeout=WAIT_S)
                assert frame.header.replayed
                check_image(frame, camera, stream)
        # More than one full round: every image of the recording, with its original time.
        for _ in range(25):
            for reader, _, _ in readers:
                header = reader.next(timeout=WAIT_S).header
                assert header.replayed
                replayed[header.stream_id].add(header.capture_time_ns)
    for name, times in replayed.items():
        recorded = {t for t in times if t >= min(live[name])}
        assert len(recorded) >= 5, f"{name}: of {len(times)} times only {len(recorded)} are of the watched part"
        # This test itself may have come too late for a set, on a busy computer.
        unread = ids[-1] - ids[0] + 1 - len(ids)
        assert len(recorded - live[name]) <= unread, f"{name}: a replayed frame has a capture time that was never live"
