"""The policy in closed loop; it needs PyTorch."""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from rig import ROOT, WAIT_S

pytestmark = pytest.mark.skipif(importlib.util.find_spec("torch") is None, reason="PyTorch is not installed")
LOOP = str(ROOT / "python" / "examples" / "policy_loop.py")


def run(folder: Path, *options: str) -> subprocess.CompletedProcess[str]:
    env = {**os.environ, "DEPTHRIG_RUNTIME_DIR": str(folder), "CUDA_VISIBLE_DEVICES": ""}
    command = [sys.executable, LOOP, *options]
    return subprocess.run(command, env=env, capture_output=True, text=True, timeout=WAIT_S * 8, check=False)


def test_the_loop_acts_on_fresh_depth_and_says_where_its_time_goes(live: Path) -> None:
    done = run(live, "pattern/z16", "--seconds", "3", "--hz", "20", "--max-age", "10", "--threads", "1", "--json")
    assert (done.returncode, done.stderr) == (0, "")
    result = json.loads(done.stdout)
    assert "random" in result["weights"]
    assert (result["stream"], result["image"], result["stale"]) == ("pattern/z16", "64x48 z16", 0)
    assert result["actions"] == result["observations"] >= result["plans"] >= 1
    spent = {name: result[name]["p50_ms"] for name in ("age", "policy", "age_at_action", "torch_copy")}
    assert all(ms >= 0 for ms in spent.values()), spent
    assert spent["age_at_action"] >= spent["policy"] >= spent["torch_copy"]
    assert spent["age_at_action"] >= spent["age"]
    assert any(joint != 0 for joint in result["joints"]), "the arm moved"


def test_the_loop_does_not_act_on_stale_depth(live: Path) -> None:
    done = run(live, "pattern/z16", "--seconds", "0.5", "--max-age", "0.000001", "--threads", "1")
    assert (done.returncode, done.stderr) == (0, "")
    assert "plans 0" in done.stdout
    assert "observations 0, actions 0, late 0, stale " in done.stdout
    assert "stale 0" not in done.stdout
    assert "the actions mean nothing" in done.stdout
