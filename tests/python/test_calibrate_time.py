"""Latencies of simulated cameras, found from a waved board, and what they do to a recording."""

from __future__ import annotations

import json
import statistics
import subprocess
import tomllib
from pathlib import Path
from typing import Any

import pytest
from test_daemon import binary, environment, runtime

__all__ = ["binary", "runtime"]

# Corners are looked for in hundreds of images.
LONG_S = 900.0

LATENCY_MS = 4.7
# The cameras expose 14 ms apart, of 33.3: late by 4.7 ms, the second one's frame before looks nearer.
APART_MS = 14.0
PERIOD_MS = 1000 / 30

RIG = """
rig = "wave"
{calibration}
[sets]
rate_hz = 15.0
[recording]
reserve_mb = 64
"""
CAMERA = """
[[camera]]
name = "{name}"
backend = "synthetic"
model = "d435"
phase = {phase}
pose = {{ translation_m = [{x}, 0.0, 0.0] }}
[[camera.stream]]
name = "color"
width = 640
height = 480
rate_hz = 30.0
[camera.board]
file = "board.toml"
motion = "wave"
seed = 3
[camera.clock]
drift_ppm = 0.0
latency_ms = {latency_ms}
"""
ENTRY = """
[[camera]]
name = "{name}"
stream = "color"
width = {width}
height = {height}
source = "factory"
[camera.intrinsics]
model = "{model}"
fx = {fx}
fy = {fy}
cx = {cx}
cy = {cy}
[camera.pose]
translation_m = {translation}
rotation_xyzw = {rotation}
sigma_mm = {sigma_mm}
sigma_deg = {sigma_deg}
[camera.quality]
views = 20
corners = 1000
rms_px = 0.1
projection_middle_px = 0.1
projection_worst_px = 0.3
"""


def command(binary: str, runtime: Path, *arguments: str, codes: tuple[int, ...] = (0,)) -> str:
    done = subprocess.run(
        [binary, *arguments], env=environment(runtime), capture_output=True, text=True, timeout=LONG_S, check=False
    )
    assert done.returncode in codes, done.stderr
    return done.stdout


def record(binary: str, runtime: Path, folder: Path, calibration: str, out: str) -> Path:
    cameras = CAMERA.format(name="a", phase=0.0, x=0.0, latency_ms=3.0)
    late = 3.0 + LATENCY_MS
    cameras += CAMERA.format(name="b", phase=APART_MS / PERIOD_MS, x=0.08, latency_ms=late)
    rig = folder / "rig.toml"
    rig.write_text(RIG.format(calibration=calibration) + cameras)
    command(binary, runtime, "run", str(rig), "--record", str(folder / out), "--seconds", "21", codes=(0, 3))
    (dataset,) = (p.parent for p in (folder / out).rglob("session.toml"))
    return dataset


def calibration_of(dataset: Path, board: Path) -> str:
    """The calibration that the simulation is true to."""
    text = 'format = "depthrig.calibration/1"\ncreated = "2026-11-25T03:00:00Z"\nreference = "a"\nrms_px = 0.1\n'
    text += "[board]\n" + board.read_text()
    for stream in tomllib.loads((dataset / "session.toml").read_text())["streams"]:
        k = stream["intrinsics"]
        name = stream["id"].partition("/")[0]
        text += ENTRY.format(
            name=name,
            width=stream["width"],
            height=stream["height"],
            model=k["model"],
            fx=k["fx"],
            fy=k["fy"],
            cx=k["cx"],
            cy=k["cy"],
            translation=stream["pose"]["translation_m"],
            rotation=stream["pose"]["rotation_xyzw"],
            sigma_mm=0.0 if name == "a" else 0.1,
            sigma_deg=0.0 if name == "a" else 0.005,
        )
    return text


def rows(binary: str, runtime: Path, dataset: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in command(binary, runtime, "cat", str(dataset), "--json").splitlines()]


class Skew:
    """How far apart the two cameras' frames of a set are. Both simulated clocks began at one moment, so that their ticks are the truth."""

    def __init__(self, frames: list[dict[str, Any]]) -> None:
        settled = [f for f in frames if "clock_warmup" not in f["flags"]]
        a = {f["set"]: f for f in settled if f["stream"] == "a/color"}
        b = {f["set"]: f for f in settled if f["stream"] == "b/color"}
        both = sorted(a.keys() & b.keys())
        assert len(both) > 30
        true = [(b[s]["device_time"] - a[s]["device_time"]) * 1e-3 for s in both]
        stamped = [(b[s]["capture_time_ns"] - a[s]["capture_time_ns"]) * 1e-6 for s in both]
        self.apart_ms = statistics.median(abs(t) for t in true)
        self.error_ms = statistics.median(s - t for s, t in zip(stamped, true))


def test_a_latency_is_found_applied_and_gone(binary: str, runtime: Path, tmp_path: Path) -> None:
    board = tmp_path / "board.toml"
    command(binary, runtime, "calibrate", "board", "--name", str(tmp_path / "board"))
    calibration = tmp_path / "calibration.toml"
    timed = tmp_path / "timed.toml"
    for tries in (2, 1, 0):
        before = record(binary, runtime, tmp_path, "", f"before{tries}")
        calibration.write_text(calibration_of(before, board))
        arguments = ("calibrate", "time", str(before), "--calibration", str(calibration), "--board", str(board), "-o", str(timed))
        # On a busy computer clocks may be known too late for 21 s.
        said = command(binary, runtime, *arguments, "--json", codes=(0, 1) if tries else (0,))
        if said:
            break
    found = json.loads(said)
    assert found["reference"] == "a" and found["refused"] == []
    a, b = found["cameras"]
    assert (a["camera"], b["camera"], b["measured"], b["subtracted_ms"]) == ("a", "b", False, 0.0)
    assert b["found_ms"] == pytest.approx(LATENCY_MS, abs=0.5)
    assert b["found_ms"] == pytest.approx(LATENCY_MS, abs=5 * b["sigma_ms"])
    assert (a["latency_ms"], b["latency_ms"]) == (0.0, pytest.approx(b["found_ms"]))
    entry = tomllib.loads(timed.read_text())["camera"][1]["latency"]
    assert entry["latency_ms"] == pytest.approx(b["latency_ms"], abs=1e-3)
    assert (entry["reference"], entry["dataset"], entry["board"]) == ("a", before.name, "charuco 11x8, 22 mm")
    # What exists is kept, and an entry is added to a file, not the file made anew.
    kept = timed.read_bytes()
    assert command(binary, runtime, *arguments, codes=(2,)) == ""
    assert timed.read_bytes() == kept

    for tries in (2, 1, 0):
        after = record(binary, runtime, tmp_path, 'calibration = "timed.toml"', f"after{tries}")
        again = ("calibrate", "time", str(after), "--calibration", str(timed), "-o", str(timed), "--overwrite")
        rest = command(binary, runtime, *again, "--json", codes=(0, 1) if tries else (0,))
        if rest:
            break
    frames = rows(binary, runtime, after)
    assert all("latency_calibrated" in f["flags"] for f in frames)
    assert not any("latency_calibrated" in f["flags"] for f in rows(binary, runtime, before))
    streams = tomllib.loads((after / "session.toml").read_text())["streams"]
    assert streams[1]["calibration"].startswith(f"simulated, latency {entry['latency_ms']:.2f} ms")
    # The truth: stamps no longer lie, so that frames are paired that were exposed nearest to each other.
    lying = Skew(rows(binary, runtime, before))
    true = Skew(frames)
    assert lying.error_ms == pytest.approx(LATENCY_MS, abs=0.3)
    assert true.error_ms == pytest.approx(0.0, abs=0.3)
    assert lying.apart_ms == pytest.approx(PERIOD_MS - APART_MS, abs=0.1)
    assert true.apart_ms == pytest.approx(APART_MS, abs=0.1)
    # Nothing is left to find, and nothing is added twice.
    b = json.loads(rest)["cameras"][1]
    assert b["found_ms"] == pytest.approx(0.0, abs=0.5)
    assert b["subtracted_ms"] == pytest.approx(entry["latency_ms"], abs=1e-3)
    assert b["latency_ms"] == pytest.approx(LATENCY_MS, abs=0.5)
    assert tomllib.loads(timed.read_text())["camera"][1]["latency"]["dataset"] == after.name

    # A dataset without a waved board, a camera that is not there, a calibration of something else.
    def refused(*arguments: str) -> str:
        done = subprocess.run(
            [binary, "calibrate", "time", *arguments], env=environment(runtime), capture_output=True, text=True, check=False
        )
        assert done.returncode in (1, 2) and done.stdout == "", done
        return done.stderr

    assert "no camera z; there are a, b" in refused(str(after), "--calibration", str(timed), "--reference", "z")
    other = tmp_path / "other.toml"
    other.write_text(timed.read_text().replace('name = "b"', 'name = "d"'))
    assert "has no camera b" in refused(str(after), "--calibration", str(other))
    negative = tmp_path / "negative.toml"
    negative.write_text(timed.read_text().replace("latency_ms = 4", "latency_ms = -4"))
    assert "out of range" in refused(str(after), "--calibration", str(negative))
