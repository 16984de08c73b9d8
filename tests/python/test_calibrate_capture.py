"""Views of a board, taken from a running rig that shows one and from a recording of it."""

from __future__ import annotations

import http.client
import json
import math
import signal
import socket
import subprocess
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_calibrate_time import command
from test_daemon import WAIT_S, binary, environment, running, runtime

__all__ = ["binary", "runtime"]

# Where the second camera is said to be, and from there where it is.
SIDE_M = [0.15, 0.0, 0.0]
SIDE_DEG = [0.0, -8.0, 0.0]
MOVED_M = [0.003, -0.001, 0.002]
MOVED_DEG = [0.0, 0.3, 0.1]

CAMERA = """
[[camera]]
name = "{name}"
backend = "synthetic"
model = "d435"
pose = {{ translation_m = {at}, rotation_rpy_deg = {turn} }}
[camera.board]
file = "board.toml"
motion = "{motion}"
hold_s = {hold_s}
seed = 5
displaced = {{ translation_m = {moved}, rotation_rpy_deg = {moved_turn} }}
[[camera.stream]]
name = "color"
width = 640
height = 480
rate_hz = 15.0
[[camera.stream]]
name = "depth"
width = 640
height = 480
rate_hz = 15.0
"""


def rig_text(name: str, motion: str, hold_s: float) -> str:
    nothing = [0.0, 0.0, 0.0]
    front = CAMERA.format(
        name="front", at=nothing, turn=nothing, motion=motion, hold_s=hold_s, moved=nothing, moved_turn=nothing
    )
    side = CAMERA.format(
        name="side", at=SIDE_M, turn=SIDE_DEG, motion=motion, hold_s=hold_s, moved=MOVED_M, moved_turn=MOVED_DEG
    )
    return f'rig = "{name}"\n[recording]\nreserve_mb = 64\n{front}{side}'


def start(binary: str, runtime: Path, folder: Path, name: str, motion: str, hold_s: float) -> Path:
    command(binary, runtime, "calibrate", "board", "--paper", "a3", "--name", str(folder / "board"))
    rig = folder / "rig.toml"
    rig.write_text(rig_text(name, motion, hold_s))
    return rig


def until_streaming(binary: str, runtime: Path, name: str) -> None:
    # The first one renders the scenes.
    deadline = time.monotonic() + 5 * WAIT_S
    while time.monotonic() < deadline:
        asked = [binary, "--rig", name, "status", "--json"]
        done = subprocess.run(asked, env=environment(runtime), capture_output=True, text=True, check=False)
        if done.returncode in (0, 3):
            status = json.loads(done.stdout)
            if status["preparing"] is None and all(c["state"] == "streaming" for c in status["cameras"]):
                return
        time.sleep(0.2)
    raise TimeoutError(f"rig {name} does not stream")


# Before the other rig runs: two are too much for a small computer.
@pytest.mark.parametrize(("motion", "hold_s", "wanted"), [("steps", 600.0, 1), ("away", 1.0, 0)])
def test_a_board_that_is_not_moved_is_taken_once(
    binary: str, runtime: Path, tmp_path: Path, motion: str, hold_s: float, wanted: int
) -> None:
    rig = start(binary, runtime, tmp_path, "still", motion, hold_s)
    with running(binary, runtime, tmp_path / "log", "run", str(rig)):
        until_streaming(binary, runtime, "still")
        views = tmp_path / "views"
        capture = subprocess.Popen(
            [binary, "calibrate", "capture", "still", "--board", str(tmp_path / "board.toml"), "-o", str(views)],
            env=environment(runtime),
            stdout=subprocess.PIPE,
            text=True,
        )
        time.sleep(8.0)
        capture.send_signal(signal.SIGINT)
        text, _ = capture.communicate(timeout=WAIT_S)
        assert capture.returncode == 3, text
        assert f"{wanted} view{'' if wanted == 1 else 's'} in {views}" in text
        assert ("depthrig calibrate solve" in text) == (wanted > 0)
        assert views.exists() == (wanted > 0), "nothing is written before there is a view"
        if wanted > 0:
            command(binary, runtime, "verify", str(views))


@pytest.fixture(scope="module")
def mount(binary: str, runtime: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A running rig before which a board rests at one place after the other; its folder."""
    folder = tmp_path_factory.mktemp("mount")
    rig = start(binary, runtime, folder, "mount", "steps", 1.2)
    with running(binary, runtime, folder / "log", "run", str(rig)):
        until_streaming(binary, runtime, "mount")
        yield folder


def captured(binary: str, runtime: Path, *arguments: str, codes: tuple[int, ...] = (0,)) -> list[dict[str, Any]]:
    lines = command(binary, runtime, "calibrate", "capture", *arguments, "--json", codes=codes).splitlines()
    return [json.loads(line) for line in lines]


def info(binary: str, runtime: Path, path: Path) -> dict[str, Any]:
    return json.loads(command(binary, runtime, "info", str(path), "--json"))


def matrix(translation: list[float], rotation_xyzw: list[float]) -> np.ndarray:
    x, y, z, w = rotation_xyzw
    pose = np.eye(4)
    pose[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    pose[:3, 3] = translation
    return pose


def turned(translation: list[float], rpy_deg: list[float]) -> np.ndarray:
    """A pose from roll, pitch and yaw: about x, then y, then z, axes that stay."""
    roll, pitch, yaw = (math.radians(a) for a in rpy_deg)
    about_x = np.array([[1, 0, 0], [0, math.cos(roll), -math.sin(roll)], [0, math.sin(roll), math.cos(roll)]])
    about_y = np.array([[math.cos(pitch), 0, math.sin(pitch)], [0, 1, 0], [-math.sin(pitch), 0, math.cos(pitch)]])
    about_z = np.array([[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]])
    pose = np.eye(4)
    pose[:3, :3] = about_z @ about_y @ about_x
    pose[:3, 3] = translation
    return pose


def test_views_of_a_running_rig_give_its_true_poses(binary: str, runtime: Path, mount: Path, tmp_path: Path) -> None:
    board = str(mount / "board.toml")
    views = tmp_path / "views"
    events = captured(binary, runtime, "mount", "--board", board, "-o", str(views))
    last = events[-1]
    count = last["progress"]["views"]
    assert last["is_finished"] and last["progress"]["missing"] == [] and last["progress"]["hint"] is None
    assert 10 <= count <= 30
    assert [e["progress"]["views"] for e in events] == sorted(e["progress"]["views"] for e in events)
    assert {"hold_still", "taken"} <= {e["progress"]["state"] for e in events}
    assert all(c["views"] >= 10 and c["worst_px"] <= 0.5 for c in last["progress"]["cameras"])
    assert any("tilted" in (e["progress"]["hint"] or {"text": ""})["text"] for e in events)
    # It is a dataset as any other.
    command(binary, runtime, "verify", str(views))
    assert info(binary, runtime, views)["sets"] == count
    out = tmp_path / "calibration.toml"
    command(binary, runtime, "calibrate", "solve", str(views), "--board", board, "--out", str(out), codes=(0, 3))
    front, side = tomllib.loads(out.read_text())["camera"]
    assert (front["name"], side["name"]) == ("front", "side")
    found = matrix(side["pose"]["translation_m"], side["pose"]["rotation_xyzw"])
    # Colour sits beside the camera's origin: of the first camera, which is the mount's, its pose says where.
    color = tomllib.loads((views / "session.toml").read_text())["streams"][0]["pose"]
    beside = matrix(color["translation_m"], color["rotation_xyzw"])
    truth = np.linalg.inv(beside) @ turned(SIDE_M, SIDE_DEG) @ turned(MOVED_M, MOVED_DEG) @ beside
    said = np.linalg.inv(beside) @ turned(SIDE_M, SIDE_DEG) @ beside
    between = np.linalg.inv(truth) @ found
    off_mm = 1e3 * np.linalg.norm(between[:3, 3])
    off_deg = math.degrees(math.acos(min(1.0, (np.trace(between[:3, :3]) - 1) / 2)))
    said_mm = 1e3 * np.linalg.norm((np.linalg.inv(said) @ truth)[:3, 3])
    print(f"off by {off_mm:.3f} mm, {off_deg:.4f} degrees; the rig file by {said_mm:.3f} mm")
    assert off_mm < 0.5 and off_deg < 0.05
    # The same rig checked live: as calibrated, and not as somebody else calibrated it.
    arguments = ("calibrate", "check", "mount", "--seconds", "15", "--json", "--calibration")
    checked = json.loads(command(binary, runtime, *arguments, str(out)))
    assert checked["moved"] == [] and checked["views"] >= 2
    text = out.read_text()
    x = side["pose"]["translation_m"][0]
    assert repr(x) in text
    moved = tmp_path / "moved.toml"
    moved.write_text(text.replace(repr(x), repr(x + 0.005)))
    checked = json.loads(command(binary, runtime, *arguments, str(moved), codes=(3,)))
    assert abs(checked["moved"][0]["mm"] - 5.0) < 1.0


def test_a_killed_capture_goes_on_where_it_was(binary: str, runtime: Path, mount: Path, tmp_path: Path) -> None:
    views = tmp_path / "views"
    arguments = ["mount", "--board", str(mount / "board.toml"), "-o", str(views)]
    for wanted in (2, 4):
        killed = subprocess.Popen(
            [binary, "calibrate", "capture", *arguments, "--json"],
            env=environment(runtime),
            stdout=subprocess.PIPE,
            text=True,
        )
        assert killed.stdout
        for line in killed.stdout:
            if json.loads(line)["progress"]["views"] >= wanted:
                break
        killed.send_signal(signal.SIGKILL)
        assert killed.wait(WAIT_S) == -signal.SIGKILL
    events = captured(binary, runtime, *arguments, "--views", "6")
    assert events[0]["progress"]["views"] >= 4
    assert events[-1]["progress"]["views"] == 6
    command(binary, runtime, "verify", str(views))
    assert info(binary, runtime, views)["sets"] == 6
    # Complete, it still grows; with enough views it ends at once.
    before = {p.name: p.read_bytes() for p in views.glob("*.mcap")}
    assert captured(binary, runtime, *arguments, "--views", "6")[-1]["progress"]["views"] == 6
    captured(binary, runtime, *arguments, "--views", "7")
    assert info(binary, runtime, views)["sets"] == 7
    assert all((views / name).read_bytes() == was for name, was in before.items())
    command(binary, runtime, "verify", str(views))


def test_a_recording_gives_the_views_that_it_has(binary: str, runtime: Path, mount: Path, tmp_path: Path) -> None:
    board = str(mount / "board.toml")
    # On a very busy computer few frames show the board at rest.
    for attempt in range(6):
        recording = mount / "datasets" / f"recording_{attempt}"
        command(binary, runtime, "--rig", "mount", "record", "start", "--name", recording.name)
        time.sleep(9)
        command(binary, runtime, "--rig", "mount", "record", "stop", codes=(0, 3))
        views = tmp_path / f"views_{attempt}"
        # Something is missing, and it says what.
        events = captured(binary, runtime, str(recording), "--board", board, "-o", str(views), codes=(3,))
        count = events[-1]["progress"]["views"]
        if count >= 3:
            break
    assert 3 <= count <= 9
    assert any("of 10 views" in m for m in events[-1]["progress"]["missing"])
    command(binary, runtime, "verify", str(views))
    # The same recording again has nothing new.
    again = captured(binary, runtime, str(recording), "--board", board, "-o", str(views), codes=(3,))
    assert again[-1]["progress"]["views"] == count
    arguments = ("calibrate", "solve", str(views), "--board", board, "--out", str(tmp_path / "c.toml"))
    solved = command(binary, runtime, *arguments, codes=(0, 3))
    assert "front" in solved


class Unix(http.client.HTTPConnection):
    """HTTP over a Unix socket."""

    def __init__(self, path: Path) -> None:
        super().__init__("localhost", timeout=WAIT_S)
        self.path = path

    def connect(self) -> None:
        self.sock = socket.socket(socket.AF_UNIX)
        self.sock.settimeout(WAIT_S)
        self.sock.connect(str(self.path))


def test_a_page_can_follow_a_capture(binary: str, runtime: Path, mount: Path, tmp_path: Path) -> None:
    arguments = ["mount", "--board", str(mount / "board.toml"), "-o", str(tmp_path / "v"), "--views", "3"]
    capture = subprocess.Popen(
        [binary, "calibrate", "capture", *arguments],
        env=environment(runtime),
        stdout=subprocess.PIPE,
        text=True,
    )
    follower = Unix(runtime / "mount.sock")
    follower.request("GET", "/v1/calibration/events")
    answer = follower.getresponse()
    assert (answer.status, answer.getheader("content-type")) == (200, "text/event-stream")
    ours = []
    while not ours or not ours[-1]["is_finished"]:
        line = answer.readline()
        assert line, "the stream ended"
        if line.startswith(b"data: "):
            event = json.loads(line[len(b"data: ") :])
            # Those of an earlier capture come first.
            ours += [event] if event["out"] == str(tmp_path / "v") else []
    assert ours[-1]["progress"]["views"] == 3
    assert {c["name"] for c in ours[-1]["progress"]["cameras"]} == {"front", "side"}
    assert any(c["at"] for e in ours for c in e["progress"]["cameras"])
    assert capture.wait(WAIT_S) == 0
    # One who comes later gets the last one, and the events stay what they are.
    late = Unix(runtime / "mount.sock")
    late.request("GET", "/v1/calibration/events")
    assert json.loads(late.getresponse().readline()[len(b"data: ") :]) == ours[-1]
    for body, status in (("{}", 400), ('{"utc_ns": 1}', 400), ("x" * 70_000, 413)):
        wrong = Unix(runtime / "mount.sock")
        wrong.request("POST", "/v1/calibration/events", body, {"content-type": "application/json"})
        assert wrong.getresponse().status == status


def test_what_exists_is_not_touched(binary: str, runtime: Path, mount: Path, tmp_path: Path) -> None:
    board = mount / "board.toml"

    def refused(*arguments: str, code: int = 2) -> str:
        asked = [binary, "calibrate", "capture", *arguments]
        done = subprocess.run(
            asked, env=environment(runtime), capture_output=True, text=True, timeout=WAIT_S, check=False
        )
        assert done.returncode == code, done.stderr
        return done.stderr

    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "thesis.txt").write_text("precious")
    assert "holds no views" in refused("mount", "--board", str(board), "-o", str(mine))
    assert (mine / "thesis.txt").read_text() == "precious"
    views = tmp_path / "views"
    captured(binary, runtime, "mount", "--board", str(board), "-o", str(views), "--views", "1")
    other = tmp_path / "other.toml"
    other.write_text(board.read_text() + "measured_ruler_mm = 99.5\n")
    assert "views of another board" in refused("mount", "--board", str(other), "-o", str(views))
    assert "views of front/color" in refused("mount", "--board", str(board), "-o", str(views), "--stream", "side/depth")
    assert "is the input" in refused(str(views), "--board", str(board), "-o", str(views))
    assert "no rig of this name" in refused("nobody", "--board", str(board), "-o", str(tmp_path / "n"), code=1)
    nothing = ("-o", str(tmp_path / "n"), "--stream", "front/nothing")
    assert "has no stream front/nothing" in refused("mount", "--board", str(board), *nothing)
    assert not (tmp_path / "n").exists()


def test_the_cloud_of_a_running_rig_is_of_all_cameras(
    binary: str, runtime: Path, mount: Path, tmp_path: Path
) -> None:
    out = tmp_path / "cloud.ply"
    cloud = json.loads(command(binary, runtime, "cloud", "mount", "--out", str(out), "--json"))
    assert cloud["set"] is None and {c["camera"] for c in cloud["cameras"]} == {"front", "side"}
    assert out.read_bytes().startswith(b"ply") and cloud["points"] > 100_000
    assert {(p["points_of"], p["against"]) for p in cloud["pairs"]} == {("front", "side"), ("side", "front")}
    refused = [binary, "cloud", "mount", "--set", "3", "--out", str(tmp_path / "x.ply")]
    assert subprocess.run(refused, env=environment(runtime), capture_output=True, check=False).returncode == 2
