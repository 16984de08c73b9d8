"""`[ros2]` in a rig file: the daemon starts `depthrig-ros2`, starts it again, and ends it."""

from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest
from test_daemon import binary, command, running, runtime, wait_until_answers

__all__ = ["binary", "runtime"]

pytest.importorskip("zenoh", reason="no eclipse-zenoh; tests/readers/requirements.txt has it")
pytest.importorskip("rosbags", reason="no rosbags; tests/readers/requirements.txt has it")

from ros2 import Router, free_port, until

CAMERA = """
[[camera]]
name = "top"
backend = "synthetic"
[[camera.stream]]
name = "color"
width = 64
height = 48
rate_hz = 10
"""


@contextmanager
def rig(binary: str, runtime: Path, folder: Path, program: list[str] | None) -> Iterator[None]:
    """A rig that runs `program`; with None by `--ros2`, without a table in its file."""
    path = folder / "rig.toml"
    table = "" if program is None else f"[ros2]\ncommand = {json.dumps(program)}\n"
    path.write_text(f'rig = "bench"\n[control]\ntcp = "off"\n{table}{CAMERA}')
    with running(binary, runtime, folder / "log", "run", str(path), "-q", *([] if program else ["--ros2"])):
        wait_until_answers(runtime, "bench")
        yield


def status(binary: str, runtime: Path) -> dict[str, Any]:
    return json.loads(command(binary, runtime, "--rig", "bench", "status", "--json", codes=(0, 3)))["ros2"]


def test_the_program_runs_as_long_as_the_rig(binary: str, runtime: Path, tmp_path: Path) -> None:
    port = free_port()
    program = [sys.executable, "-m", "depthrig.ros2", "--router", f"tcp/127.0.0.1:{port}", "--domain", "5"]
    with closing(Router(port)) as router:
        with rig(binary, runtime, tmp_path, program):
            router.wait_for("/bench/top/color/image_raw")
            assert all(token.startswith("@ros2_lv/5/") for token in router.tokens)
            first = status(binary, runtime)["pid"]
            os.kill(first, signal.SIGKILL)
            second = until(lambda: (status(binary, runtime)["pid"] or first) != first, "the program again")
            assert second
            router.wait_for("/bench/top/color/image_raw")
            last = status(binary, runtime)["pid"]
        until(lambda: not Path(f"/proc/{last}").exists(), "its end with the rig")


def test_a_program_that_does_not_exist_is_named_with_its_cure(binary: str, runtime: Path, tmp_path: Path) -> None:
    program = tmp_path / "depthrig-ros2"
    with rig(binary, runtime, tmp_path, [str(program)]):
        found = until(lambda: "pip install" in (status(binary, runtime)["why"] or "") and status(binary, runtime), "the cure")
        assert found["pid"] is None and str(program) in found["why"], found
        command(binary, runtime, "--rig", "bench", "status", codes=(3,))
        assert "pip install" in command(binary, runtime, "--rig", "bench", "status", codes=(3,))
        # It is tried again, and said once.
        program.write_text(f"#!{sys.executable}\nimport time\ntime.sleep(600)\n")
        program.chmod(0o755)
        until(lambda: status(binary, runtime)["pid"], "the program that was installed meanwhile")
        assert "depthrig-ros2 runs" in command(binary, runtime, "--rig", "bench", "status")
    assert (tmp_path / "log").read_text().count("pip install") == 1


def test_an_option_runs_the_program_that_path_has(
    binary: str, runtime: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said = tmp_path / "said"
    program = tmp_path / "bin" / "depthrig-ros2"
    program.parent.mkdir()
    program.write_text(f"#!{sys.executable}\nimport sys, time\nopen({str(said)!r}, 'w').write(' '.join(sys.argv[1:]) + '.')\ntime.sleep(600)\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{program.parent}:{os.environ['PATH']}")
    with rig(binary, runtime, tmp_path, None):
        until(lambda: said.exists() and said.read_text() == "--rig bench.", "the program")
        until(lambda: status(binary, runtime)["pid"], "its process")
