"""What can go wrong between a printed board and its calibration: each is refused or flagged, with the views and the cure, and nothing is
overwritten."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest
from boards import Camera, Pose, Sheet, places, save
from test_daemon import WAIT_S, binary, command, environment, runtime

__all__ = ["binary", "runtime"]

VIEWS = 8


@pytest.fixture(scope="module")
def board(binary: str, runtime: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    name = tmp_path_factory.mktemp("board") / "board"
    command(binary, runtime, "calibrate", "board", "--name", str(name))
    return name.with_suffix(".toml")


@pytest.fixture(scope="module")
def sheet(board: Path) -> Sheet:
    return Sheet.of(board.with_suffix(".svg"))


@pytest.fixture(scope="module")
def good(sheet: Sheet) -> list[np.ndarray]:
    """Good views of the board."""
    return [Camera().see([(sheet, pose)], seed=n) for n, pose in enumerate(places(VIEWS))]


def folder(path: Path, images: list[np.ndarray]) -> str:
    for n, image in enumerate(images, start=1):
        save(image, path / f"{n:02}.png")
    return f"{path.name}={path}"


def solve(
    binary: str, runtime: Path, board: Path, out: Path, *folders: str
) -> subprocess.CompletedProcess[str]:
    images = [argument for name in folders for argument in ("--images", name)]
    arguments = ("calibrate", "solve", *images, "--board", str(board), "--out", str(out))
    return subprocess.run(
        [binary, *arguments, "--json"],
        env=environment(runtime),
        capture_output=True,
        text=True,
        timeout=WAIT_S,
        check=False,
    )


def test_good_views_are_calibrated(
    binary: str, runtime: Path, board: Path, good: list[np.ndarray], tmp_path: Path
) -> None:
    done = solve(binary, runtime, board, tmp_path / "out.toml", folder(tmp_path / "cam", good))
    assert done.returncode == 0, done.stderr
    (camera,) = json.loads(done.stdout)["calibration"]["camera"]
    assert abs(camera["intrinsics"]["fx"] - 600.0) < 3.0 * camera["intrinsics"]["sigmas"][0] + 0.5
    assert camera["quality"]["rms_px"] < 0.15


def test_a_board_upside_down_is_the_same_board(
    binary: str, runtime: Path, board: Path, good: list[np.ndarray], tmp_path: Path
) -> None:
    turned = [image[::-1, ::-1] for image in good]
    done = solve(binary, runtime, board, tmp_path / "out.toml", folder(tmp_path / "cam", turned))
    assert done.returncode == 0, done.stderr
    (camera,) = json.loads(done.stdout)["calibration"]["camera"]
    assert abs(camera["intrinsics"]["fx"] - 600.0) < 3.0 * camera["intrinsics"]["sigmas"][0] + 0.5
    assert camera["quality"]["rms_px"] < 0.15


def test_a_partly_hidden_board_is_used_as_far_as_it_is_seen(
    binary: str, runtime: Path, board: Path, good: list[np.ndarray], tmp_path: Path
) -> None:
    hidden = [image.copy() for image in good]
    for image in hidden:
        image[170:320, 240:380] = 90
    done = solve(binary, runtime, board, tmp_path / "out.toml", folder(tmp_path / "cam", hidden))
    assert done.returncode in (0, 3), done.stderr
    found = json.loads(done.stdout)
    (camera,) = found["calibration"]["camera"]
    # One of which too little is left is named.
    assert VIEWS - 1 <= camera["quality"]["views"] == VIEWS - len(found["refused"])
    assert all("it may be hidden" in line for line in found["refused"])
    assert camera["quality"]["rms_px"] < 0.2
    assert VIEWS * 20 < camera["quality"]["corners"] < VIEWS * 68


@pytest.mark.parametrize("turn_deg", [0.0, 90.0, 180.0])
def test_a_second_board_in_view_is_named(
    binary: str, runtime: Path, board: Path, sheet: Sheet, good: list[np.ndarray], tmp_path: Path, turn_deg: float
) -> None:
    camera = Camera(width=1280, height=720)
    poses = places(VIEWS)
    alone = [camera.see([(sheet, pose)], seed=n, samples=2) for n, pose in enumerate(poses)]
    for n in (2, 5):
        other = Pose((0.26, 0.02 * n - 0.05, 0.5), (15.0, -20.0, turn_deg))
        moved = Pose((poses[n].place_m[0] - 0.15, *poses[n].place_m[1:]), poses[n].turn_deg)
        alone[n] = camera.see([(sheet, moved), (sheet, other)], seed=n, samples=2)
    done = solve(binary, runtime, board, tmp_path / "out.toml", folder(tmp_path / "cam", alone))
    assert done.returncode == 3, done.stderr
    found = json.loads(done.stdout)
    refused = [line for line in found["refused"] if "second board" in line]
    assert len(refused) == 2 and "03.png" in refused[0] and "06.png" in refused[1], found["refused"]
    assert "cover or remove all but one" in refused[0]
    (result,) = found["calibration"]["camera"]
    assert result["quality"]["views"] == VIEWS - 2
    assert result["quality"]["rms_px"] < 0.25
    assert abs(result["intrinsics"]["fx"] - 600.0) < 3.0 * result["intrinsics"]["sigmas"][0] + 0.5


def test_mirrored_images_are_named(
    binary: str, runtime: Path, board: Path, good: list[np.ndarray], tmp_path: Path
) -> None:
    mirrored = folder(tmp_path / "cam", [image[:, ::-1] for image in good])
    done = solve(binary, runtime, board, tmp_path / "out.toml", mirrored)
    assert done.returncode == 1 and "mirrored" in done.stderr, done.stderr
    assert not (tmp_path / "out.toml").exists()
    # One of two cameras.
    done = solve(binary, runtime, board, tmp_path / "out.toml", folder(tmp_path / "right", good), mirrored)
    assert done.returncode == 1 and "cam" in done.stderr and "mirrored" in done.stderr, done.stderr


def test_blurred_views_are_named(
    binary: str, runtime: Path, board: Path, good: list[np.ndarray], tmp_path: Path
) -> None:
    images = [image.copy() for image in good]
    # Moved by 9 pixels while the shutter was open.
    smear = np.mean([np.roll(images[4].astype(float), shift, axis=1) for shift in range(-4, 5)], axis=0)
    images[4] = smear.astype(np.uint8)
    done = solve(binary, runtime, board, tmp_path / "out.toml", folder(tmp_path / "cam", images))
    found = json.loads(done.stdout)
    said = [line for line in found["refused"] + found["advice"] if "05.png" in line or "view 5" in line]
    assert said and "blur" in said[0], (found["refused"], found["advice"])
    (camera,) = found["calibration"]["camera"]
    assert abs(camera["intrinsics"]["fx"] - 600.0) < 3.0 * camera["intrinsics"]["sigmas"][0] + 0.5


def pair(sheet: Sheet, moved_m: float = 0.0, at: int = -1) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Views of two cameras 80 mm apart; the board moves by so much between the two images of one moment."""
    right = Camera()
    right.world = np.eye(4)
    right.world[0, 3] = -0.08
    lefts, rights = [], []
    for n, pose in enumerate(places(VIEWS)):
        lefts.append(Camera().see([(sheet, pose)], seed=n, samples=2))
        x, y, z = pose.place_m
        shifted = Pose((x + (moved_m if n == at else 0.0), y, z), pose.turn_deg)
        rights.append(right.see([(sheet, shifted)], seed=100 + n, samples=2))
    return lefts, rights


def test_a_board_that_moved_between_two_cameras_is_named(
    binary: str, runtime: Path, board: Path, sheet: Sheet, tmp_path: Path
) -> None:
    lefts, rights = pair(sheet, moved_m=0.006, at=3)
    folders = (folder(tmp_path / "left", lefts), folder(tmp_path / "right", rights))
    done = solve(binary, runtime, board, tmp_path / "out.toml", *folders)
    found = json.loads(done.stdout)
    said = [line for line in found["refused"] + found["advice"] if "view 4" in line]
    assert said and "moved" in said[0], (found["refused"], found["advice"])
    assert not [line for line in found["advice"] if line.startswith("view") and "view 4" not in line]
    place = found["calibration"]["camera"][1]["pose"]
    assert np.linalg.norm(np.array(place["translation_m"]) - [0.08, 0.0, 0.0]) * 1e3 < 1.0, place


def test_cameras_that_share_no_view_are_named(
    binary: str, runtime: Path, board: Path, sheet: Sheet, good: list[np.ndarray], tmp_path: Path
) -> None:
    lefts, rights = pair(sheet)
    folders = [folder(tmp_path / "left", lefts), folder(tmp_path / "right", rights)]
    for n, image in enumerate(good, start=1):
        save(image, tmp_path / "far" / f"{n + 50:02}.png")
    done = solve(binary, runtime, board, tmp_path / "out.toml", *folders, f"far={tmp_path / 'far'}")
    assert done.returncode == 1 and "[left, right] and [far]" in done.stderr, done.stderr
    assert not (tmp_path / "out.toml").exists()


def test_a_ruler_that_was_not_measured_or_does_not_fit_is_asked_for(
    binary: str, runtime: Path, board: Path, good: list[np.ndarray], tmp_path: Path
) -> None:
    images = folder(tmp_path / "cam", good)
    arguments = ("calibrate", "solve", "--images", images, "--out", str(tmp_path / "out.toml"), "--board")
    text = command(binary, runtime, *arguments, str(board))
    assert "the board's ruler was not measured" in text
    # A sheet that the printer made 4 % smaller: every distance follows the ruler.
    small = tmp_path / "small.toml"
    small.write_text(board.read_text() + "measured_ruler_mm = 96.0\n")
    done = solve(binary, runtime, small, tmp_path / "small_out.toml", images)
    full = solve(binary, runtime, board, tmp_path / "full_out.toml", images)
    distances = [json.loads(d.stdout)["cameras"][0]["distance_m"] for d in (done, full)]
    assert abs(distances[0] / distances[1] - 0.96) < 1e-3
    wrong = tmp_path / "wrong.toml"
    wrong.write_text(board.read_text() + "measured_ruler_mm = 70.0\n")
    done = solve(binary, runtime, wrong, tmp_path / "wrong_out.toml", images)
    assert done.returncode == 1 and "measure the line again" in done.stderr


def test_nothing_is_overwritten_by_a_failure(
    binary: str, runtime: Path, board: Path, good: list[np.ndarray], tmp_path: Path
) -> None:
    out = tmp_path / "out.toml"
    out.write_text("mine")
    done = solve(binary, runtime, board, out, folder(tmp_path / "cam", good))
    assert done.returncode == 2 and out.read_text() == "mine"
    few = solve(binary, runtime, board, tmp_path / "few.toml", folder(tmp_path / "few", good[:2]))
    assert few.returncode == 1 and "2 views of the board" in few.stderr, few.stderr
    assert not (tmp_path / "few.toml").exists() and not (tmp_path / "few.html").exists()
