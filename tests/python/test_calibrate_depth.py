"""Depth of a simulated camera that is wrong by a known scale and offset, from a recorded wall to corrected points."""

from __future__ import annotations

import hashlib
import json
import tomllib
from pathlib import Path

import depthrig
import numpy as np
from numpy.typing import NDArray
from test_calibrate_time import command
from test_daemon import WAIT_S, binary, running, runtime

__all__ = ["binary", "runtime"]

SCALE = 1.004
OFFSET_MM = 3.0
# The second camera has no error.
CAMERAS = f"""
rig = "wall"

[[camera]]
name = "wrong"
backend = "synthetic"
model = "d435"
stream = [{{ name = "color", width = 640, height = 480, rate_hz = 6.0 }}, {{ name = "depth", rate_hz = 6.0 }}]
board = {{ file = "board.toml", motion = "wall", hold_s = 2.0, depth_scale = {SCALE}, depth_offset_mm = {OFFSET_MM} }}
REFINE

[[camera]]
name = "right"
backend = "synthetic"
model = "d415"
pose = {{ translation_m = [0.1, 0.0, 0.0] }}
stream = [{{ name = "color", width = 640, height = 480, rate_hz = 6.0 }}, {{ name = "depth", width = 640, height = 480, rate_hz = 6.0 }}]
board = {{ file = "board.toml", motion = "wall", hold_s = 2.0 }}
seed = 3

[recording]
reserve_mb = 64
"""
REFINE = 'refine = { engine = "fill", rate_hz = 0.0, corrected = true }'


def digests(folder: Path) -> dict[str, str]:
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def points(path: Path) -> NDArray[np.float32]:
    """The points of a binary PLY."""
    head, body = path.read_bytes().split(b"end_header\n", 1)
    names = {"float": "<f4", "uchar": "u1"}
    fields = [line.split()[1:] for line in head.decode().splitlines() if line.startswith("property")]
    vertices = np.frombuffer(body, dtype=[(name, names[kind]) for kind, name in fields])
    return np.stack([vertices["x"], vertices["y"], vertices["z"]], axis=1)


def truth(z: NDArray[np.float64]) -> NDArray[np.float64]:
    return (z - OFFSET_MM * 1e-3) / SCALE


def test_the_error_of_depth_is_found_and_corrected(binary: str, runtime: Path, tmp_path: Path) -> None:
    command(binary, runtime, "calibrate", "board", "--paper", "a3", "--name", str(tmp_path / "board"))
    path = tmp_path / "rig.toml"
    path.write_text(CAMERAS.replace("REFINE", ""))
    out = tmp_path / "calibration.toml"
    arguments = ("--board", str(tmp_path / "board.toml"), "-o", str(out), "--json")
    # The board rests long enough for several sets in each place; a very busy computer may lose every one of them.
    for tries in (2, 1, 0):
        recording = ("run", str(path), "--record", str(tmp_path / f"wall{tries}"), "--seconds", "26")
        with running(binary, runtime, tmp_path / "log", *recording) as daemon:
            daemon.wait(WAIT_S)
        (dataset,) = (tmp_path / f"wall{tries}").iterdir()
        raw = digests(dataset)
        out.unlink(missing_ok=True)
        said = command(binary, runtime, "calibrate", "depth", str(dataset), *arguments, codes=(0, 1, 3) if tries else (0, 3))
        found = json.loads(said or '{"streams": [], "left_out": "all"}')
        streams = {stream["camera"]: stream for stream in found["streams"]}
        if set(streams) == {"wrong", "right"}:
            break
    assert set(streams) == {"wrong", "right"}, found["left_out"]
    wrong = streams["wrong"]
    assert wrong["model"] == "scale_offset"
    assert abs(wrong["scale"] - 1 / SCALE) < min(4 * wrong["sigma_scale"], 0.001), wrong
    assert abs(wrong["offset_mm"] + OFFSET_MM / SCALE) < min(4 * wrong["sigma_offset_mm"], 0.5), wrong
    assert wrong["after_mm"] < 0.1 * wrong["before_mm"]
    # The simulated matcher's noise, and its holes.
    for place in wrong["place"]:
        assert 0.05 < place["subpixel_rms_px"] < 0.1 and 0.97 < place["fill"] < 1.0, place
    assert streams["right"]["model"] == "none"
    entries = {entry["camera"]: entry for entry in tomllib.loads(out.read_text())["depth"]}
    assert entries["wrong"]["scale"] == wrong["scale"]
    # Not a second time without being asked to, and never in place of poses.
    command(binary, runtime, "calibrate", "depth", str(dataset), *arguments, codes=(2,))
    command(binary, runtime, "calibrate", "depth", str(dataset), *arguments, "--overwrite", codes=(2,))

    # A few seconds of it show too few distances; they get the whole wall's correction below.
    short = tmp_path / "short"
    command(binary, runtime, "trim", str(dataset), str(short), "--from", "0", "--to", "5")
    command(
        binary,
        runtime,
        *("calibrate", "depth", str(short), "--board", str(tmp_path / "board.toml"), "-o", str(tmp_path / "none.toml")),
        codes=(1,),
    )
    assert not (tmp_path / "none.toml").exists()

    clouds = {}
    for name, options in (("raw", ()), ("corrected", ("--corrected",))):
        file = tmp_path / f"{name}.ply"
        command(
            binary, runtime, "cloud", str(dataset), "--calibration", str(out), "--out", str(file), *options, codes=(0,)
        )
        clouds[name] = points(file)
    assert clouds["raw"].shape == clouds["corrected"].shape
    # The first camera's frame is the mount's, so that its points are those whose depth changed.
    changed = clouds["raw"][:, 2] != clouds["corrected"][:, 2]
    before = clouds["raw"][changed, 2].astype(np.float64)
    after = clouds["corrected"][changed, 2].astype(np.float64)
    assert changed.sum() > 10_000
    # Depth is in millimetres, to which the corrected one is rounded; how far the fit itself is off is another matter.
    fit = before * wrong["scale"] + wrong["offset_mm"] * 1e-3
    assert np.abs(before - truth(before)).min() > 4e-3
    assert np.abs(after - fit).max() < 0.501e-3
    assert np.abs(fit - truth(before)).max() < 0.5e-3

    # A set that has the frame: a busy computer's lacks it now and then.
    rows = command(binary, runtime, "cat", str(short), "--stream", "wrong/depth", "--json").splitlines()
    at = str(json.loads(rows[len(rows) // 2])["set"])
    for name, options in (("stored", ()), ("mended", ("--corrected", "--calibration", str(out)))):
        folder = tmp_path / name
        shot = ("--set", at, "--stream", "wrong/depth", "--format", "npy", "--out", str(folder))
        command(binary, runtime, "cat", str(dataset), *shot, *options)
    (stored,) = (tmp_path / "stored").rglob("*.npy")
    (mended,) = (tmp_path / "mended").rglob("*.npy")
    before = np.load(stored).astype(np.float64) * 1e-3
    after = np.load(mended).astype(np.float64) * 1e-3
    assert np.array_equal(before == 0, after == 0)
    some = before > 0
    assert np.abs(after[some] - truth(before[some])).max() < 2e-3

    # Without a calibration of its own a dataset cannot be corrected; with one it needs no other.
    shot = ("cat", str(short), "--set", at, "--stream", "wrong/depth", "--format", "npy", "--corrected", "--out")
    command(binary, runtime, *shot, str(tmp_path / "refused"), codes=(2,))
    command(binary, runtime, "edit", str(short), "--calibration", str(out))
    command(binary, runtime, *shot, str(tmp_path / "own"))
    (own,) = (tmp_path / "own").rglob("*.npy")
    assert np.array_equal(np.load(own), np.load(mended))

    paper = tmp_path / "paper"
    exported = json.loads(
        command(
            binary,
            runtime,
            *("export", "bytecameradepth", str(dataset), str(paper)),
            *("--corrected", "--calibration", str(out), "--json"),
        )
    )
    assert any("depth corrected: " in loss for loss in exported["losses"])
    # An export of depth as recorded is another one.
    command(binary, runtime, "export", "bytecameradepth", str(dataset), str(paper), codes=(1, 2))
    assert digests(dataset) == raw, "the dataset was changed"


def test_the_refine_stage_gets_corrected_depth(binary: str, runtime: Path, tmp_path: Path) -> None:
    command(binary, runtime, "calibrate", "board", "--paper", "a3", "--name", str(tmp_path / "board"))
    (tmp_path / "rig.toml").write_text(CAMERAS.replace("REFINE", REFINE))
    with running(binary, runtime, tmp_path / "log", "run", str(tmp_path / "rig.toml"), codes=(0, 1, 2, 3)) as daemon:
        daemon.wait(WAIT_S)
    assert "no correction of wrong/depth" in (tmp_path / "log").read_text()

    correction = f"""
[[depth]]
camera = "wrong"
stream = "depth"
width = 1280
height = 720
created = "2026-11-25T03:00:00Z"
model = "scale_offset"
scale = {1 / SCALE}
offset_mm = {-OFFSET_MM / SCALE}
"""
    board = (tmp_path / "board.toml").read_text()
    head = 'format = "depthrig.calibration/1"\ncreated = "2026-11-25T03:00:00Z"\nreference = ""\nrms_px = 0.0\ncamera = []\n'
    calibration = f"{head}\n[board]\n{board}\n{correction}"
    rig = 'calibration = "calibration.toml"\n' + CAMERAS.replace("REFINE", REFINE)
    still = rig.replace("hold_s = 2.0", "hold_s = 600.0")
    assert still != rig
    (tmp_path / "rig.toml").write_text(still)
    (tmp_path / "calibration.toml").write_text(calibration.replace("width = 1280", "width = 1288"))
    with running(binary, runtime, tmp_path / "log", "run", str(tmp_path / "rig.toml"), codes=(1, 2, 3)) as daemon:
        daemon.wait(WAIT_S)
    assert "is for 1288x720, the stream has 1280x720" in (tmp_path / "log").read_text()
    (tmp_path / "calibration.toml").write_text(calibration)
    with running(binary, runtime, tmp_path / "log", "run", str(tmp_path / "rig.toml")):
        streams = {
            name: depthrig.Stream(f"wrong/{name}", runtime_dir=runtime, timeout=WAIT_S)
            for name in ("depth", "depth_refined")
        }
        middles = {}
        for name, stream in streams.items():
            frame = stream.next(timeout=WAIT_S)
            assert frame is not None
            h, w = frame.array.shape
            middle = frame.array[h // 2 - 20 : h // 2 + 20, w // 2 - 20 : w // 2 + 20].astype(np.float64)
            middles[name] = float(np.median(middle[middle > 0])) * frame.header.depth_unit_m
    # Depth is as sensed, refined depth is as corrected: 4.8 mm nearer at 0.45 m.
    assert abs(middles["depth"] - (SCALE * middles["depth_refined"] + OFFSET_MM * 1e-3)) < 2e-3
    assert middles["depth"] - middles["depth_refined"] > 3e-3
