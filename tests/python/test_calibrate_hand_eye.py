"""`depthrig calibrate hand-eye` from images and a robot's poses, and poses that are wrong in the ways that robots' poses are."""

from __future__ import annotations

import json
import math
import subprocess
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from boards import Array, Camera, Pose, Sheet, places, save
from test_calibrate_mount import matrix, of_quaternion
from test_daemon import WAIT_S, binary, command, environment, runtime

__all__ = ["binary", "runtime"]

VIEWS = 10
# The camera on the hand, and the board beside the robot; or the camera beside the robot, and the board on the hand.
CAMERA = Pose((0.03, -0.06, 0.05), (4.0, -7.0, 88.0)).matrix()
BOARD = Pose((0.45, 0.1, 0.02), (180.0, 3.0, 20.0)).matrix()


@dataclass
class Folder:
    """Images of a camera, its calibration, and where the board is in each."""

    path: Path
    camera_from_board: list[Array]

    def in_hand(self) -> list[Array]:
        """The hand's poses in the base with the camera on the hand."""
        return [BOARD @ np.linalg.inv(CAMERA @ board) for board in self.camera_from_board]

    def beside(self) -> list[Array]:
        """The hand's poses in the base with the board on the hand."""
        return [CAMERA @ board @ np.linalg.inv(BOARD) for board in self.camera_from_board]


@pytest.fixture(scope="module")
def folder(binary: str, runtime: Path, tmp_path_factory: pytest.TempPathFactory) -> Folder:
    path = tmp_path_factory.mktemp("hand_eye")
    command(binary, runtime, "calibrate", "board", "--name", str(path / "board"))
    sheet = Sheet.of(path / "board.svg")
    poses = places(VIEWS)
    for n, pose in enumerate(poses, start=1):
        save(Camera().see([(sheet, pose)], seed=n), path / "images" / f"{n:02}.png")
    arguments = ("--images", f"wrist={path / 'images'}", "--board", str(path / "board.toml"))
    command(binary, runtime, "calibrate", "solve", *arguments, "--out", str(path / "calibration.toml"), codes=(0, 3))
    return Folder(path, [pose.matrix() for pose in poses])


def vector(r: Array) -> Array:
    """A rotation as its axis times its angle."""
    angle = math.acos(np.clip((np.trace(r) - 1) / 2, -1, 1))
    axis = np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
    return axis / (2 * math.sin(angle)) * angle


def row(n: int, pose: Array, degrees: float = 1.0, metres: float = 1.0) -> str:
    return ",".join(map(str, (n, *pose[:3, 3] * metres, *vector(pose[:3, :3]) * degrees)))


def rows_of(poses: list[Array]) -> list[str]:
    return [row(n, p) for n, p in enumerate(poses, start=1)]


def run(
    binary: str,
    runtime: Path,
    folder: Folder,
    rows: list[str],
    *more: str,
    header: str = "view,x,y,z,rx,ry,rz",
    calibration: Path | None = None,
) -> subprocess.CompletedProcess[str]:
    poses = folder.path / "poses.csv"
    poses.write_text("\n".join([header, *rows]) + "\n")
    files = {"--poses": poses, "--calibration": calibration or folder.path / "calibration.toml", "--board": folder.path / "board.toml"}
    arguments = [str(a) for pair in files.items() for a in pair]
    return subprocess.run(
        [binary, "calibrate", "hand-eye", f"wrist={folder.path / 'images'}", *arguments, *more],
        env=environment(runtime),
        capture_output=True,
        text=True,
        timeout=WAIT_S,
        check=False,
    )


@pytest.mark.parametrize("arrangement", ["hand", "base"])
def test_the_camera_is_found_on_the_hand_and_beside_the_robot(
    binary: str, runtime: Path, folder: Folder, arrangement: str
) -> None:
    poses = folder.in_hand() if arrangement == "hand" else folder.beside()
    more = ("--json",) if arrangement == "hand" else ("--json", "--eye-to-hand")
    # The robot's poses are exact: the images' noise and the intrinsics' are left.
    ran = run(binary, runtime, folder, rows_of(poses), *more)
    assert ran.returncode == 0, ran.stderr
    found = json.loads(ran.stdout)
    assert found["camera_in"] == arrangement and found["views"] == VIEWS
    pose = matrix(found["camera"]["translation_m"], of_quaternion(found["camera"]["rotation_xyzw"]))
    between = np.linalg.inv(CAMERA) @ pose
    mm = float(np.linalg.norm(between[:3, 3])) * 1e3
    deg = math.degrees(float(np.linalg.norm(vector(between[:3, :3]))))
    assert mm < 1.0 and deg < 0.1, (mm, deg)
    assert mm < 4 * found["sigma_mm"] and deg < 4 * found["sigma_deg"]
    assert found["held_out_median_mm"] < 1.5


def test_a_view_without_a_pose_is_left_out_and_named(binary: str, runtime: Path, folder: Folder) -> None:
    rows = rows_of(folder.in_hand())
    ran = run(binary, runtime, folder, rows[:3] + rows[4:])
    assert ran.returncode == 3, ran.stderr
    assert "left out  view 4: " in ran.stdout
    # A robot that missed one of its poses by 10 mm: found, and said.
    wrong = folder.in_hand()
    wrong[6][0, 3] += 0.01
    ran = run(binary, runtime, folder, rows_of(wrong))
    assert "doubtful  view 7: " in ran.stdout, ran.stdout


BAD: dict[str, tuple[Callable[[list[Array]], list[str]], str]] = {
    "degrees": (lambda p: [row(n, a, degrees=180 / math.pi) for n, a in enumerate(p, start=1)], "look like degrees"),
    "millimetres": (lambda p: [row(n, a, metres=1e3) for n, a in enumerate(p, start=1)], "look like millimetres"),
    "inverted": (lambda p: rows_of([np.linalg.inv(a) for a in p]), "inverted"),
    "shifted": (lambda p: rows_of(p[1:]), "to the view after it"),
    "shuffled": (lambda p: rows_of([p[(3 * i + 2) % VIEWS] for i in range(VIEWS)]), "which pose belongs to which view"),
    "two views": (lambda p: rows_of(p)[:2], "three or more"),
    "at rest": (lambda p: rows_of([p[0]] * VIEWS), "the hand turned by 0.0 degrees"),
    "no rows": (lambda _: [], "three or more"),
    "a row too short": (lambda _: ["1,0.1,0.2"], "line 2"),
    "not a number": (lambda p: ["1,0.1,0.2,nan,0,0,0", *rows_of(p)[1:]], "line 2"),
}


@pytest.mark.parametrize("what", BAD)
def test_poses_that_are_wrong_are_refused(binary: str, runtime: Path, folder: Folder, what: str) -> None:
    make, message = BAD[what]
    ran = run(binary, runtime, folder, make(folder.in_hand()))
    assert ran.returncode == 1, (ran.stdout, ran.stderr)
    assert message in ran.stderr and ran.stdout == "", ran.stderr


def test_files_that_are_wrong_are_refused(binary: str, runtime: Path, folder: Folder, tmp_path: Path) -> None:
    rows = rows_of(folder.in_hand())
    assert "no columns x, y, z" in run(binary, runtime, folder, rows, header="view,a,b,c,rx,ry,rz").stderr
    both = run(binary, runtime, folder, rows, header="view,x,y,z,qx,qy,qz")
    assert "either the columns qx, qy, qz, qw or the columns rx, ry, rz" in both.stderr
    # Images of another size than the calibration's.
    text = (folder.path / "calibration.toml").read_text()
    other = tmp_path / "other.toml"
    other.write_text(text.replace("width = 640", "width = 1280").replace("height = 480", "height = 720"))
    ran = run(binary, runtime, folder, rows, calibration=other)
    assert ran.returncode == 1 and "the images are 640x480" in ran.stderr, ran.stderr
