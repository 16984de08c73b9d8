"""The simulated mount from a printed board to its calibration, against where its cameras really are."""

from __future__ import annotations

import json
import math
import re
import tomllib
from pathlib import Path

import depthrig
import numpy as np
from numpy.typing import NDArray
from test_calibrate_time import command
from test_daemon import WAIT_S, binary, running, runtime

__all__ = ["binary", "runtime"]

RIG = Path(__file__).resolve().parents[2] / "tools" / "demo-calibration.toml"
CAMERAS = ("d435", "d455", "l515")
Matrix = NDArray[np.float64]


def rig(cameras: tuple[str, ...] = CAMERAS) -> str:
    """The demonstration's mount, with fewer cameras and a board that moves on sooner."""
    head, *tables = RIG.read_text().split("[[camera]]")
    chosen = [table for table in tables if tomllib.loads(table)["name"] in cameras]
    text = "[[camera]]".join((head, *chosen))
    return text.replace('motion = "steps"', 'motion = "steps", hold_s = 1.0') + "\n[recording]\nreserve_mb = 64\n"


def matrix(translation_m: list[float], rotation: Matrix) -> Matrix:
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = translation_m
    return pose


def of_quaternion(q: list[float]) -> Matrix:
    x, y, z, w = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def of_file(table: dict) -> Matrix:
    """A pose as the rig's file has it."""
    roll, pitch, yaw = (math.radians(a) for a in table["rotation_rpy_deg"])
    about_x = np.array([[1, 0, 0], [0, math.cos(roll), -math.sin(roll)], [0, math.sin(roll), math.cos(roll)]])
    about_y = np.array([[math.cos(pitch), 0, math.sin(pitch)], [0, 1, 0], [-math.sin(pitch), 0, math.cos(pitch)]])
    about_z = np.array([[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]])
    return matrix(table["translation_m"], about_z @ about_y @ about_x)


def of_header(stream: str, runtime: Path) -> Matrix:
    frame = depthrig.Stream(stream, runtime_dir=runtime, timeout=WAIT_S).next(timeout=WAIT_S)
    assert frame is not None
    pose = frame.header.pose
    return matrix(list(pose.translation_m), of_quaternion(list(pose.rotation_xyzw)))


def difference(a: Matrix, b: Matrix) -> tuple[float, float]:
    """Millimetres and degrees."""
    between = np.linalg.inv(a) @ b
    cosine = (np.trace(between[:3, :3]) - 1) / 2
    return float(np.linalg.norm(between[:3, 3])) * 1e3, math.degrees(math.acos(min(1.0, cosine)))


def test_a_printed_board_gives_the_true_poses(binary: str, runtime: Path, tmp_path: Path) -> None:
    command(binary, runtime, "calibrate", "board", "--paper", "a3", "--name", str(tmp_path / "board"))
    path = tmp_path / "rig.toml"
    path.write_text(rig())
    tables = {table["name"]: table for table in tomllib.loads(rig())["camera"]}
    true: dict[str, Matrix] = {}
    out = tmp_path / "calibration.toml"
    arguments = ("--board", str(tmp_path / "board.toml"), "--out", str(out), "--json")
    # The board rests long enough for several sets in each place; a very busy computer may lose every one of them.
    for tries in (2, 1, 0):
        recording = ("run", str(path), "--record", str(tmp_path / f"boards{tries}"), "--seconds", "30")
        with running(binary, runtime, tmp_path / "log", *recording) as daemon:
            for name in CAMERAS:
                stated = of_file(tables[name]["pose"])
                displaced = of_file(tables[name]["board"]["displaced"])
                color = np.linalg.inv(stated) @ of_header(f"{name}/color", runtime)
                true[name] = stated @ displaced @ color
            daemon.wait(WAIT_S)
        (dataset,) = (tmp_path / f"boards{tries}").iterdir()
        codes = (0, 1, 3) if tries else (0, 3)
        if command(binary, runtime, "calibrate", "solve", str(dataset), *arguments, codes=codes):
            break
    found = {camera["name"]: camera for camera in tomllib.loads(out.read_text())["camera"]}
    assert set(found) == set(CAMERAS)
    for name in CAMERAS:
        pose = found[name]["pose"]
        calibrated = matrix(pose["translation_m"], of_quaternion(pose["rotation_xyzw"]))
        mm, deg = difference(np.linalg.inv(true[CAMERAS[0]]) @ true[name], calibrated)
        assert mm < 0.5 and deg < 0.03, f"{name} is off by {mm:.3f} mm, {deg:.4f} deg"
    # The rig's own poses were wrong by millimetres, which the rig that uses the calibration corrects.
    calibrated_rig = tmp_path / "calibrated.toml"
    calibrated_rig.write_text(f'calibration = "{out.name}"\n' + rig())
    with running(binary, runtime, tmp_path / "log", "run", str(calibrated_rig)):
        first, second = (of_header(f"{name}/color", runtime) for name in CAMERAS[:2])
    mm, deg = difference(np.linalg.inv(true[CAMERAS[0]]) @ true[CAMERAS[1]], np.linalg.inv(first) @ second)
    assert mm < 0.5 and deg < 0.03, f"off by {mm:.3f} mm, {deg:.4f} deg"
    # One camera is bumped by 2 mm.
    at = tables["d455"]["board"]["displaced"]["translation_m"]
    bumped = re.sub(rf"\[{at[0]},", f"[{at[0] + 0.002:.3f},", rig())
    assert bumped != rig()
    path.write_text(bumped)
    for tries in (2, 1, 0):
        recording = ("run", str(path), "--record", str(tmp_path / f"bumped{tries}"), "--seconds", "16")
        with running(binary, runtime, tmp_path / "log", *recording) as daemon:
            daemon.wait(WAIT_S)
        (dataset,) = (tmp_path / f"bumped{tries}").iterdir()
        check = ("calibrate", "check", str(dataset), "--calibration", str(out), "--json")
        checked = json.loads(command(binary, runtime, *check, codes=(0, 1, 3) if tries else (3,)) or '{"moved": []}')
        if checked["moved"]:
            break
    assert [m["camera"] for m in checked["moved"]] == ["d455"]
    assert abs(checked["moved"][0]["mm"] - 2.0) < 0.3
