"""Boards, calibration from real images, and a rig that uses one."""

from __future__ import annotations

import json
import math
import re
import shutil
import subprocess
import tomllib
from pathlib import Path

import depthrig
import numpy as np
import pytest
from PIL import Image
from test_daemon import DATA, WAIT_S, binary, command, environment, running, runtime

__all__ = ["binary", "runtime"]

IMAGES = DATA / "opencv_checkerboard_stereo"
SQUARE_MM = 25.0


def sides(folder: Path) -> list[str]:
    """Each camera's images in a folder of its own, as arguments."""
    arguments = []
    for side in ("left", "right"):
        (folder / side).mkdir()
        for path in sorted(IMAGES.glob(f"{side}[0-9]*.jpg")):
            shutil.copy(path, folder / side)
        arguments += ["--images", f"{side}={folder / side}"]
    return arguments


def chessboard(binary: str, runtime: Path, folder: Path) -> Path:
    arguments = ("--pattern", "chessboard", "--columns", "10", "--rows", "7", "--square-mm", str(SQUARE_MM))
    command(binary, runtime, "calibrate", "board", *arguments, "--name", str(folder / "board"))
    return folder / "board.toml"


def test_real_images_give_the_published_calibration(binary: str, runtime: Path, tmp_path: Path) -> None:
    board = chessboard(binary, runtime, tmp_path)
    out = tmp_path / "stereo.toml"
    arguments = (*sides(tmp_path), "--board", str(board), "--out", str(out), "--json")
    found = json.loads(command(binary, runtime, "calibrate", "solve", *arguments))
    left, right = found["calibration"]["camera"]
    assert (left["quality"]["views"], right["quality"]["views"]) == (13, 13)
    # Every corner was found; at most one in a hundred was left out as wrong.
    for camera, details in zip((left, right), found["cameras"], strict=True):
        assert camera["quality"]["corners"] + details["outliers"] == 13 * 54
        assert details["outliers"] <= 7
    # OpenCV with corners refined in windows of 11x11: 0.195, 0.207 and 0.215 px.
    assert left["quality"]["rms_px"] <= 0.205
    assert right["quality"]["rms_px"] <= 0.215
    assert found["calibration"]["rms_px"] <= 0.225
    assert abs(left["intrinsics"]["fx"] - 533.0) < 2.0
    assert abs(right["intrinsics"]["fx"] - 537.3) < 2.0
    baseline = math.dist(left["pose"]["translation_m"], right["pose"]["translation_m"])
    assert abs(baseline / (SQUARE_MM * 1e-3) - 3.3275) < 0.01
    # The file says the same, and nothing is written twice.
    assert tomllib.loads(out.read_text())["camera"][0]["intrinsics"]["fx"] == left["intrinsics"]["fx"]
    report = out.with_suffix(".html").read_text()
    assert "<svg" in report
    # The report's map of uncertainty is in the file as well, where the live page finds it.
    maps = re.findall(r'aria-label="Uncertainty of projection.*?</figure>', report, re.DOTALL)
    for drawn, camera in zip(maps, tomllib.loads(out.read_text())["camera"], strict=True):
        labels = [float(label) for label in re.findall(r"<title>(.*?)</title>", drawn)]
        assert camera["uncertainty"]["sigma_px"] == pytest.approx(labels, abs=0.0051)
        assert max(camera["uncertainty"]["sigma_px"]) == pytest.approx(camera["quality"]["projection_worst_px"], abs=1e-3)
    again = command(binary, runtime, "calibrate", "solve", *arguments, codes=(2,))
    assert again == ""


def test_a_board_is_printed_at_true_scale(binary: str, runtime: Path, tmp_path: Path) -> None:
    name = tmp_path / "board"
    command(binary, runtime, "calibrate", "board", "--name", str(name))
    board = tomllib.loads(name.with_suffix(".toml").read_text())
    svg = name.with_suffix(".svg").read_text()
    assert 'width="297mm" height="210mm"' in svg
    widths = {float(w) for w in re.findall(r"h([\d.]+)v", svg)}
    assert board["square_mm"] in widths
    assert board["ruler_mm"] in widths
    pdf = name.with_suffix(".pdf").read_bytes()
    page = re.search(rb"/MediaBox \[0 0 ([\d.]+) ([\d.]+)\]", pdf)
    assert pdf.startswith(b"%PDF") and page
    assert [round(float(side) * 25.4 / 72, 1) for side in page.groups()] == [297.0, 210.0]
    # A board that does not fit is refused with one that does.
    arguments = ("--square-mm", "40", "--name", str(tmp_path / "large"))
    done = subprocess.run(
        [binary, "calibrate", "board", *arguments], env=environment(runtime), capture_output=True, text=True, check=False
    )
    assert done.returncode == 2 and "use squares of" in done.stderr
    assert not (tmp_path / "large.toml").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("size", "a calibration is of one size"),
        ("blank", "none of 3 images shows the board"),
        ("few", "2 views of the board"),
        ("ruler", "measure the line again"),
    ],
)
def test_bad_input_is_refused(binary: str, runtime: Path, tmp_path: Path, change: str, message: str) -> None:
    board = chessboard(binary, runtime, tmp_path)
    folder = tmp_path / "images"
    folder.mkdir()
    for n in (1, 2, 3):
        if change == "blank":
            Image.fromarray(np.full((480, 640), 128, np.uint8)).save(folder / f"{n}.png")
        elif change != "few" or n < 3:
            shutil.copy(IMAGES / f"left0{n}.jpg", folder / f"{n}.jpg")
    if change == "size":
        Image.open(IMAGES / "left04.jpg").resize((320, 240)).save(folder / "4.jpg")
    if change == "ruler":
        board.write_text(board.read_text() + "measured_ruler_mm = 50.0\n")
    out = tmp_path / "out.toml"
    arguments = ("--images", f"cam={folder}", "--board", str(board), "--out", str(out))
    done = subprocess.run(
        [binary, "calibrate", "solve", *arguments], env=environment(runtime), capture_output=True, text=True, check=False
    )
    assert done.returncode == 1 and message in done.stderr, done.stderr
    assert not out.exists()


CALIBRATION = """
format = "depthrig.calibration/1"
created = "2026-11-25T03:00:00Z"
reference = "cam"
rms_px = 0.2
[board]
pattern = "chessboard"
columns = 10
rows = 7
square_mm = 25.0
[[camera]]
name = "cam"
stream = "color"
serial = "{serial}"
width = {width}
height = 480
source = "calibrated"
[camera.intrinsics]
model = "brown_conrady"
fx = 611.5
fy = 612.5
cx = 321.5
cy = 241.5
coeffs = [0.1, -0.2, 0.001, 0.002, 0.05]
[camera.pose]
translation_m = [0.1, 0.2, 0.3]
rotation_xyzw = [0.0, 0.0, 1.0, 0.0]
sigma_mm = 0.1
sigma_deg = 0.01
[camera.quality]
views = 20
corners = 1000
rms_px = 0.2
projection_middle_px = 0.1
projection_worst_px = 0.3
"""
RIG = """
rig = "calibrated"
calibration = "calibration.toml"
[[camera]]
name = "cam"
backend = "synthetic"
model = "d435"
[[camera.stream]]
name = "color"
width = 640
height = 480
rate_hz = 30.0
"""


def test_frames_carry_the_calibration_of_the_rig(binary: str, runtime: Path, tmp_path: Path) -> None:
    rig = tmp_path / "rig.toml"
    rig.write_text(RIG)
    (tmp_path / "calibration.toml").write_text(CALIBRATION.format(serial="", width=640))
    with running(binary, runtime, tmp_path / "log", "run", str(rig)):
        stream = depthrig.Stream("cam/color", runtime_dir=runtime, timeout=WAIT_S)
        frame = stream.next(timeout=WAIT_S)
        assert frame is not None
        header = frame.header
        assert (header.intrinsics.fx, header.intrinsics.cy) == (611.5, 241.5)
        np.testing.assert_allclose(header.pose.translation_m, [0.1, 0.2, 0.3])
        np.testing.assert_allclose(header.pose.rotation_xyzw, [0.0, 0.0, 1.0, 0.0], atol=1e-12)
        status = json.loads(command(binary, runtime, "status", "--json", codes=(0, 3)))
        (camera,) = status["cameras"]
        assert camera["calibration"].startswith("calibrated 2026-11-25T03:00:00Z")


@pytest.mark.parametrize(
    ("serial", "width", "message"),
    [("other", 640, "is of serial number other"), ("", 1280, "is for 1280x480, the stream has 640x480")],
)
def test_a_calibration_of_another_camera_is_refused(
    binary: str, runtime: Path, tmp_path: Path, serial: str, width: int, message: str
) -> None:
    rig = tmp_path / "rig.toml"
    rig.write_text(RIG)
    (tmp_path / "calibration.toml").write_text(CALIBRATION.format(serial=serial, width=width))
    done = subprocess.run(
        [binary, "run", str(rig), "--seconds", "2"],
        env=environment(runtime),
        capture_output=True,
        text=True,
        timeout=WAIT_S,
        check=False,
    )
    assert message in done.stdout + done.stderr, done.stdout + done.stderr


def test_a_camera_that_was_moved_is_found(binary: str, runtime: Path, tmp_path: Path) -> None:
    board = chessboard(binary, runtime, tmp_path)
    out = tmp_path / "stereo.toml"
    images = sides(tmp_path)
    command(binary, runtime, "calibrate", "solve", *images, "--board", str(board), "--out", str(out))
    arguments = ("calibrate", "check", *images, "--calibration", str(out), "--json")
    same = json.loads(command(binary, runtime, *arguments))
    assert same["moved"] == [] and same["views"] == 13
    # The right camera 3 mm further to the right than it is.
    text = out.read_text()
    place = tomllib.loads(text)["camera"][1]["pose"]["translation_m"]
    x = repr(place[0])
    out.write_text(text.replace(f"[{x},", f"[{place[0] + 3e-3!r},", 1))
    assert tomllib.loads(out.read_text())["camera"][1]["pose"]["translation_m"][0] == pytest.approx(place[0] + 3e-3)
    moved = json.loads(command(binary, runtime, *arguments, codes=(3,)))
    assert moved["either"] and len(moved["moved"]) == 1
    assert moved["moved"][0]["mm"] == pytest.approx(3.0, abs=0.3)


TWO = """
rig = "two"
[recording]
reserve_mb = 64
[[camera]]
name = "a"
backend = "synthetic"
model = "d435"
poses = 1
[[camera]]
name = "b"
backend = "synthetic"
model = "d435"
poses = 1
pose = { translation_m = [0.08, 0.0, 0.0] }
"""


def test_a_cloud_shows_whether_a_calibration_is_right(binary: str, runtime: Path, tmp_path: Path) -> None:
    rig = tmp_path / "rig.toml"
    rig.write_text(TWO)
    # On a busy computer a frame may be missing.
    recording = ("run", str(rig), "--record", str(tmp_path / "out"), "--seconds", "1")
    command(binary, runtime, *recording, codes=(0, 3))
    (dataset,) = (p.parent for p in (tmp_path / "out").rglob("session.toml"))
    ply = tmp_path / "cloud.ply"
    right = json.loads(command(binary, runtime, "cloud", str(dataset), "--out", str(ply), "--json"))
    assert {(p["points_of"], p["against"]) for p in right["pairs"]} == {("a", "b"), ("b", "a")}
    # The cameras' own noise: there is no bias between them.
    assert all(abs(p["median_mm"]) < 1.0 and p["median_abs_mm"] < 8.0 for p in right["pairs"]), right["pairs"]
    header, _, body = ply.read_bytes().partition(b"end_header\n")
    assert f"element vertex {right['points']}".encode() in header
    assert len(body) == right["points"] * 15
    # The second camera 30 mm ahead of where it is.
    head, entry = CALIBRATION.split("[[camera]]")
    text = head
    for stream in tomllib.loads((dataset / "session.toml").read_text())["streams"]:
        name, _, of = stream["id"].partition("/")
        if of == "color":
            x, y, z = stream["pose"]["translation_m"]
            place = [x, y, z + (0.03 if name == "b" else 0.0)]
            rotation = stream["pose"]["rotation_xyzw"]
            text += "[[camera]]" + entry.format(serial="", width=stream["width"]).replace('name = "cam"', f'name = "{name}"').replace(
                "height = 480", f"height = {stream['height']}"
            ).replace("[0.1, 0.2, 0.3]", str(place)).replace("[0.0, 0.0, 1.0, 0.0]", str(rotation))
    text = text.replace('source = "calibrated"', 'source = "factory"')
    wrong = tmp_path / "wrong.toml"
    wrong.write_text(text)
    arguments = ("cloud", str(dataset), "--calibration", str(wrong), "--out", str(tmp_path / "wrong.ply"), "--json")
    moved = json.loads(command(binary, runtime, *arguments))
    by_pair = {(p["points_of"], p["against"]): p["median_mm"] for p in moved["pairs"]}
    # Along the axis 30 mm on what it sees head-on, less on a slanted table.
    assert 15.0 < by_pair["a", "b"] < 35.0
    assert -35.0 < by_pair["b", "a"] < -15.0
