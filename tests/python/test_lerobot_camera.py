"""The plug-in `lerobot_camera_depthrig`: LeRobot's recorder and its camera interface on a running rig.

The package `lerobot` lives in an environment of its own (`make test` installs it). There the plug-in is found by its
name, as an installed one is: this file lays the metadata beside it.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import depthrig
import flatbuffers
import iceoryx2
import pytest
from test_daemon import ROOT, WAIT_S, binary, environment, running, runtime

__all__ = ["binary", "runtime"]

LEROBOT = ROOT / ".venv-lerobot" / "bin" / "python"
PLUGIN = ROOT / "python" / "lerobot_camera_depthrig"
HAS_OPENCV = any(LEROBOT.parents[1].glob("lib/python3*/site-packages/cv2"))
NOT_INSTALLED = "the lerobot package is not installed: make .venv-lerobot/.stamp"
pytestmark = pytest.mark.skipif(not LEROBOT.exists(), reason=NOT_INSTALLED)
EXAMPLE = ROOT / "python" / "examples" / "external_camera.py"
RIG = f"""
rig = "lerobot"
[[camera]]
name = "front"
backend = "external"
command = {json.dumps([sys.executable, str(EXAMPLE)])}
"""


@pytest.fixture(scope="module")
def beside(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the plug-in and the robot of the tests, as pip installs them, and what depthrig imports."""
    folder = tmp_path_factory.mktemp("beside")
    for name, package in (("lerobot_camera_depthrig", PLUGIN), ("lerobot_robot_still", Path(__file__).parent)):
        (folder / name).symlink_to(package / name)
        (folder / f"{name}-0.1.0.dist-info").mkdir()
        (folder / f"{name}-0.1.0.dist-info" / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 0.1.0\n")
    # One wheel of iceoryx2 is for all versions of Python.
    for module in (depthrig, iceoryx2, flatbuffers):
        where = Path(module.__file__).parent
        (folder / where.name).symlink_to(where)
    return folder


def where(runtime: Path, beside: Path, tmp_path: Path) -> dict[str, str]:
    home = str(tmp_path / "home")
    return {**environment(runtime), "PYTHONPATH": str(beside), "HF_HOME": home, "HF_LEROBOT_HOME": home, "HF_HUB_OFFLINE": "1"}


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    (tmp_path / "rig.toml").write_text(RIG)
    return tmp_path / "rig.toml"


@pytest.fixture
def checks(runtime: Path, beside: Path, tmp_path: Path) -> Iterator[object]:
    script = str(Path(__file__).with_name("lerobot_camera_checks.py"))
    begun: list[subprocess.Popen[str]] = []

    def begin(*arguments: str) -> subprocess.Popen[str]:
        call = [str(LEROBOT), script, *arguments]
        begun.append(
            subprocess.Popen(
                call, env=where(runtime, beside, tmp_path), stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
            )
        )
        return begun[-1]

    yield begin
    for process in begun:
        process.kill()
        process.wait()


def finish(process: subprocess.Popen[str]) -> None:
    out, _ = process.communicate(timeout=WAIT_S * 3)
    assert process.returncode == 0, out
    assert out.endswith("done\n"), out


def live(binary: str, runtime: Path, rig: Path):
    return running(binary, runtime, rig.with_name("log"), "run", str(rig), "-q")


@pytest.mark.parametrize("check", ["reads", "refuses"])
def test_the_camera(binary: str, runtime: Path, rig: Path, checks, check: str) -> None:
    with live(binary, runtime, rig):
        depthrig.Stream("front/depth", runtime_dir=runtime, timeout=WAIT_S).next(timeout=WAIT_S)
        finish(checks(check))


def test_a_rig_that_ends_is_a_timeout_and_one_that_comes_back_goes_on(binary: str, runtime: Path, rig: Path, checks) -> None:
    with live(binary, runtime, rig):
        process = checks("outlives")
        assert process.stdout.readline() == "ready\n", process.stdout.read()
    process.stdin.write("gone\n")
    process.stdin.flush()
    assert process.stdout.readline() == "timeout\n", process.stdout.read()
    with live(binary, runtime, rig):
        finish(process)


@pytest.mark.skipif(not HAS_OPENCV, reason="LeRobot's recorder needs OpenCV, which .venv-lerobot lacks: make .venv-lerobot/.stamp")
def test_lerobots_recorder_records_the_rigs_images(binary: str, runtime: Path, rig: Path, beside: Path, checks, tmp_path: Path) -> None:
    out = tmp_path / "dataset"
    cameras = "{wrist: {type: depthrig, camera: front, use_depth: true, width: 640, height: 480, fps: 10, timeout_s: 60}}"
    options = {
        "robot.type": "still",
        "robot.id": "one",
        "robot.cameras": cameras,
        "teleop.type": "still",
        "dataset.repo_id": "depthrig/test",
        "dataset.root": out,
        "dataset.single_task": "stand still",
        "dataset.fps": 10,
        "dataset.num_episodes": 2,
        "dataset.episode_time_s": 2,
        "dataset.reset_time_s": 0,
        "dataset.video": "false",
        "dataset.push_to_hub": "false",
        "play_sounds": "false",
    }
    with live(binary, runtime, rig):
        call = [LEROBOT, "-m", "lerobot.scripts.lerobot_record", *(f"--{key}={value}" for key, value in options.items())]
        done = subprocess.run(call, env=where(runtime, beside, tmp_path), stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=WAIT_S * 3, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
    finish(checks("dataset", str(out)))
