"""Cameras that Python serves to the real daemon: the example, and files through the OAK bridge and its SDK.

The processes are killed, stopped and brought back; how the binary is run is `test_daemon`'s.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from test_daemon import CAMERAS, ROOT, WAIT_S, binary, command, environment, runtime

import depthrig

__all__ = ["binary", "runtime"]

OAK_PYTHON = ROOT / ".venv-oak" / "bin" / "python"
RIG = """
rig = "served"
[recording]
color = "raw"
reserve_mb = 64

[[camera]]
name = "still"
backend = "files"
manifest = MANIFEST
"""


def rig_file(folder: Path, name: str, program: list[str]) -> Path:
    path = folder / "rig.toml"
    more = f'[[camera]]\nname = "{name}"\nbackend = "external"\nheartbeat_timeout_s = 1.0\n'
    still = json.dumps(str(ROOT / "tests" / "data" / "lingbot_0.toml"))
    path.write_text(f"{RIG.replace('MANIFEST', still)}{more}command = {json.dumps(program)}\n")
    return path


def camera(binary: str, runtime: Path, name: str) -> dict[str, Any]:
    asked = [binary, "status", "--json"]
    done = subprocess.run(asked, env=environment(runtime), capture_output=True, text=True, timeout=WAIT_S, check=False)
    assert done.returncode in (0, 3), done.stderr  # 3: a camera has lost frames, as this test provokes
    status = json.loads(done.stdout)
    return next(c for c in status["cameras"] if c["name"] == name)


def until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.1)


def pid_of(runtime: Path, name: str) -> int:
    """The process that holds the camera's lock, or held it last."""
    words: list[str] = []
    while len(words) < 2:  # it may be just writing
        words = (runtime / f"served.{name}.external").read_text().split()
    return int(words[1])


@contextmanager
def rig(binary: str, runtime: Path, log: Path, *arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    """As `running`, for rigs that lose frames on a loaded computer, or because the test provokes it."""
    with log.open("wb") as out:
        process = subprocess.Popen([binary, *arguments], env=environment(runtime), stdout=out, stderr=out)
    try:
        yield process
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        assert process.wait(WAIT_S) in (0, 3)
    except BaseException:
        print(log.read_text(errors="replace"))
        raise
    finally:
        process.kill()
        process.wait()


def lost(stream: depthrig.Stream) -> dict[str, int]:
    return {k: n for k, n in stream.next(WAIT_S).header.drops.items() if n}


def test_the_example_is_a_camera_of_the_rig(binary: str, runtime: Path, tmp_path: Path) -> None:
    program = [sys.executable, str(ROOT / "python" / "examples" / "external_camera.py")]
    with rig(binary, runtime, tmp_path / "log", "run", str(rig_file(tmp_path, "front", program))):
        with (
            depthrig.Stream("front/depth", runtime_dir=runtime, timeout=WAIT_S) as depth,
            depthrig.Stream("still/depth", runtime_dir=runtime, timeout=WAIT_S) as other,
        ):
            for _ in range(5):
                header = depth.next(WAIT_S).header
                assert (header.model, header.serial, header.format_name) == ("Pattern", "1", "z16")
                assert (header.width, header.height, header.depth_unit_m) == (640, 480, 0.001)
                assert header.intrinsics.fx == 600.0
                assert header.synthetic
                array = depth.next(WAIT_S).array
                number = (int(array[0, 0]) - 1000) % 1000
                ramp = np.add.outer(np.arange(480), np.arange(640))
                np.testing.assert_array_equal(array, 1000 + (ramp + number) % 1000)
                assert header.capture_time_ns <= header.arrival_time_ns <= header.publish_time_ns
            # Killed: another one is started, and the camera comes back under the same name.
            first = pid_of(runtime, "front")
            os.kill(first, signal.SIGKILL)
            until(lambda: pid_of(runtime, "front") != first)
            until(lambda: camera(binary, runtime, "front")["state"] == "streaming")
            assert camera(binary, runtime, "front")["reconnects"] >= 1
            # Stopped: its heartbeat is missed, it is killed and started again.
            second = pid_of(runtime, "front")
            os.kill(second, signal.SIGSTOP)
            until(lambda: pid_of(runtime, "front") != second)
            until(lambda: camera(binary, runtime, "front")["state"] == "streaming")
            while depth.latest() is not None:
                pass
            depth.next(WAIT_S)
            assert lost(other) == {}, "the other camera noticed nothing"
        last = pid_of(runtime, "front")
        reconnects = camera(binary, runtime, "front")["reconnects"]
    until(lambda: not Path(f"/proc/{last}").exists())
    log = (tmp_path / "log").read_text()
    said = r"session \d+: color 640x480 rgb8 30 Hz, depth 640x480 z16 30 Hz"
    assert len(re.findall(said, log)) == 1 + reconnects >= 3, "what it prints is in the log"


def test_a_program_started_by_hand_outlives_the_daemon(binary: str, runtime: Path, tmp_path: Path) -> None:
    path = rig_file(tmp_path, "front", [])
    path.write_text(path.read_text().replace("command = []\n", ""))
    program = [sys.executable, str(ROOT / "python" / "examples" / "external_camera.py")]
    arguments = ["--camera", "front", "--rig", "served"]
    process = subprocess.Popen([*program, *arguments], env=environment(runtime))
    try:
        for i in range(2):
            with (
                rig(binary, runtime, tmp_path / f"log{i}", "run", str(path)),
                depthrig.Stream("front/color", runtime_dir=runtime, timeout=WAIT_S) as color,
            ):
                assert color.next(WAIT_S).array.shape == (480, 640, 3)
            assert process.poll() is None
        process.terminate()
        assert process.wait(WAIT_S) == 0
    finally:
        process.kill()
        process.wait()


@pytest.mark.skipif(not OAK_PYTHON.exists(), reason="the OAK SDK is not in .venv-oak; make test puts it there")
def test_an_oak_of_real_images_is_recorded_as_it_is(binary: str, runtime: Path, tmp_path: Path) -> None:
    source = [c for c in CAMERAS if c.name in ("lingbot_0", "lingbot_2")]
    folder = tmp_path / "oak_images"
    for stream in ("color", "depth"):
        (folder / stream).mkdir(parents=True)
        for i, c in enumerate(source):
            Image.fromarray(c.source(stream)).save(folder / stream / f"{i}.png")
    shutil.copy(ROOT / "python" / "tests" / "data" / "oak_calibration.json", folder / "calibration.json")
    program = ["env", f"PYTHONPATH={ROOT / 'python' / 'src'}", str(OAK_PYTHON), "-m", "depthrig.oak"]
    program += ["--replay", str(folder), "--fps", "30", "--serial", "184430"]
    recordings = tmp_path / "recordings"
    arguments = ("run", str(rig_file(tmp_path, "oak", program)), "--record", str(recordings), "--seconds", "6")
    with rig(binary, runtime, tmp_path / "log", *arguments) as daemon:
        with (
            depthrig.Stream("oak/color", runtime_dir=runtime, timeout=WAIT_S) as color,
            depthrig.Stream("oak/depth", runtime_dir=runtime, timeout=WAIT_S) as depth,
        ):
            for _ in range(10):
                frame = color.next(WAIT_S)
                header = frame.header
                assert (header.model, header.serial, header.format_name) == ("OAK-D-TEST", "184430", "bgr8")
                assert header.clock is depthrig.ClockDomain.DEVICE
                image = source[header.device_sequence % 2].source("color")
                np.testing.assert_array_equal(frame.array[..., ::-1], image)
                frame = depth.next(WAIT_S)
                image = source[frame.header.device_sequence % 2].source("depth")
                np.testing.assert_array_equal(frame.array, image)
                assert frame.header.intrinsics.fx == pytest.approx(500.5)
        daemon.wait(WAIT_S)
    (dataset,) = sorted(p.parent for p in recordings.rglob("session.toml"))
    command(binary, runtime, "verify", str(dataset), codes=(0, 3))
    out = tmp_path / "frames"
    command(binary, runtime, "cat", str(dataset), "--format", "npy", "--out", str(out))
    kept = sorted((out / "oak" / "depth").glob("*.npy")) or sorted(p for p in out.rglob("*.npy") if "oak" in str(p))
    depths = [np.load(p) for p in kept if np.load(p).ndim == 2]
    assert len(depths) >= 5
    for array in depths:
        assert any(np.array_equal(array, c.source("depth")) for c in source)
