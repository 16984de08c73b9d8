"""`make lab-demo`, with a few scenes and steps: every step works, and its network ends up in the frames of a camera."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

if sys.version_info < (3, 11):
    pytest.skip("depthrig.lab needs Python 3.11", allow_module_level=True)
pytest.importorskip("torch", reason="PyTorch is not installed")
if "DEPTHRIG_BIN" not in os.environ:
    pytest.skip("DEPTHRIG_BIN is not set", allow_module_level=True)

SCRIPT = Path(__file__).resolve().parents[2] / "tools" / "lab-demo.sh"


def test_the_demo_of_the_lab_from_scenes_to_a_live_camera(tmp_path: Path) -> None:
    out = tmp_path / "demo"
    done = subprocess.run([SCRIPT, "--small", out], capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    held_out = (out / "held-out.html").read_text()
    for row in ("raw", "fill", "tiny", "lab-demo"):
        assert f">{row}<" in held_out, row
    (dataset,) = (out / "live").iterdir()
    listed = subprocess.run(
        [os.environ["DEPTHRIG_BIN"], "info", dataset], capture_output=True, text=True, timeout=60, check=False
    )
    # 3: intact, but a busy computer may lose a frame.
    assert listed.returncode in (0, 3), listed.stderr
    # On a busy computer refined images may all come too late for their sets; the stream is there all the same.
    assert "d435/depth_refined" in listed.stdout
    assert ">d435 depth<" in (out / "live.html").read_text()

    again = subprocess.run([SCRIPT, out], capture_output=True, text=True, timeout=60, check=False)
    assert again.returncode == 2
    assert "name a new folder" in again.stderr
