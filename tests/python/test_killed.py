"""Python readers that hold frames of a running daemon and are killed (SIGKILL): the stream is back, nothing is lost."""

from __future__ import annotations

import itertools
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from test_daemon import WAIT_S, binary, environment, runtime  # noqa: F401  (fixtures)

import depthrig

RIG = """
rig = "killed"
[[camera]]
name = "cam"
backend = "synthetic"
model = "generic"
cheap = true
[[camera.stream]]
name = "color"
width = 160
height = 120
[[camera.stream]]
name = "depth"
width = 160
height = 120
"""
HOLD = """
import sys, time, depthrig
held = []
with depthrig.Stream("cam/color", "killed", sys.argv[1], timeout=60) as stream:
    while True:
        try:
            held.append(stream.next(timeout=60))
        except depthrig.DepthrigError:  # it holds all that it may, or no frame comes any more
            print("holding", flush=True)
            time.sleep(0.5)
"""
READERS = 3


def start_reader(folder: Path, *, is_last: bool) -> subprocess.Popen[str]:
    """Start a reader that holds all that it may; readers that read at once would hold the same frames."""
    reader = subprocess.Popen([sys.executable, "-c", HOLD, str(folder)], stdout=subprocess.PIPE, text=True)
    assert reader.stdout is not None
    # The last one may find no more slots.
    ready, _, _ = select.select([reader.stdout], [], [], 5.0 if is_last else WAIT_S)
    assert reader.stdout.readline().strip() == "holding" if ready else is_last
    return reader


def kill(reader: subprocess.Popen[str]) -> None:
    reader.kill()
    reader.wait(WAIT_S)
    assert reader.stdout is not None
    reader.stdout.close()


def wait_for_frame(stream: depthrig.Stream) -> float:
    """Return after how many seconds there was a new frame."""
    began = time.monotonic()
    while stream.latest() is None:
        assert time.monotonic() - began < WAIT_S, "the stream never came back"
        time.sleep(0.005)
    return time.monotonic() - began


def wait_for_silence(stream: depthrig.Stream) -> None:
    """Return when no frame came for half a second, fifteen times as long as one takes."""
    began = last = time.monotonic()
    while time.monotonic() - last < 0.5:
        assert time.monotonic() - began < WAIT_S, "the readers never held every slot"
        if stream.latest() is not None:
            last = time.monotonic()
        time.sleep(0.005)


@pytest.fixture
def rig(binary: str, runtime: Path, tmp_path: Path) -> Iterator[Path]:  # noqa: F811
    path = tmp_path / "rig.toml"
    path.write_text(RIG)
    log = tmp_path / "log"
    with log.open("wb") as out:
        process = subprocess.Popen([binary, "run", str(path)], env=environment(runtime), stdout=out, stderr=out)
    try:
        yield runtime
        process.send_signal(signal.SIGINT)
        # 3 says that frames were lost: those that came while the readers held every slot.
        assert process.wait(WAIT_S) in (0, 3), log.read_text(errors="replace")
    finally:
        process.kill()
        process.wait()


def test_a_stream_is_back_whatever_readers_are_killed(rig: Path) -> None:
    orders = list(itertools.permutations(range(READERS)))
    rounds = 60 if "DEPTHRIG_LONG" in os.environ else 2
    worst = 0.0
    with depthrig.Stream("cam/color", "killed", rig, timeout=WAIT_S) as stream:
        held = [stream.next(timeout=WAIT_S) for _ in range(4)]
        before = [np.array(frame.array) for frame in held]
        for order in itertools.islice(itertools.cycle(orders), rounds):
            readers = [start_reader(rig, is_last=i == READERS - 1) for i in range(READERS)]
            try:
                wait_for_silence(stream)
                for at in order:
                    kill(readers[at])
                    worst = max(worst, wait_for_frame(stream))
            finally:
                for reader in readers:
                    if reader.poll() is None:
                        kill(reader)
        for frame, array in zip(held, before):
            np.testing.assert_array_equal(frame.array, array)
    print(f"{rounds * READERS} kills, back after at most {worst:.3f} s")
