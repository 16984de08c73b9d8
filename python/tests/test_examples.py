"""The example, the benchmark and the README's lines are run, not only shown."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import depthrig
from daemon import fake_daemon
from depthrig._layout import ExternalState
from rig import ROOT, WAIT_S, Publisher, child, pattern_rows

PYTHON = ROOT / "python"


def run(folder: Path, *arguments: str) -> str:
    env = {**os.environ, "DEPTHRIG_RUNTIME_DIR": str(folder)}
    done = subprocess.run(
        [sys.executable, *arguments], env=env, capture_output=True, text=True, timeout=WAIT_S * 2, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout


@pytest.mark.parametrize(("stream", "dtype", "shape"), [("z16", np.uint16, (48, 64)), ("rgb8", np.uint8, (48, 64, 3))])
def test_the_viewer_saves_the_pixels(live: Path, tmp_path: Path, stream: str, dtype: type, shape: tuple) -> None:
    path = tmp_path / "last.png"
    out = run(live, str(PYTHON / "examples" / "view.py"), f"pattern/{stream}", "--count", "3", "--png", str(path))
    sequences = [int(n) for n in re.findall(rf"<Header pattern/{stream} #(\d+) 64x48", out)]
    assert len(sequences) == 3
    image = np.asarray(Image.open(path)).astype(dtype)
    assert image.shape == shape
    # The header as far as the pattern depends on it, for the frame that was saved.
    with depthrig.Stream(f"pattern/{stream}", runtime_dir=live, timeout=WAIT_S) as s:
        values = s.next(WAIT_S).header.to_dict() | {"sequence": sequences[-1]}
    expected = pattern_rows(depthrig.Header(depthrig.Header.pack(values)))
    np.testing.assert_array_equal(image.view(np.uint8).reshape(48, -1), expected)


def test_frames_are_stacked(start: Callable[..., Publisher], folder: Path) -> None:
    publisher = start("--step")
    script = str(PYTHON / "examples" / "frame_stack.py")
    with ThreadPoolExecutor(1) as beside:
        running = beside.submit(run, folder, script, "pattern/z16", "--frames", "3", "--count", "2")
        while not running.done():
            publisher.publish()
            time.sleep(0.01)
    out = running.result()
    lines = re.findall(r"#(\d+) to #(\d+): \(3, 48, 64\) uint16, ([\d.]+) ms", out)
    assert len(lines) == 2
    for first, last, span_ms in lines:
        # A slow computer may miss frames, a fast one sees each: their times always fit their numbers.
        assert int(last) - int(first) >= 2
        assert span_ms == f"{33.333333 * (int(last) - int(first)):.1f}"


def test_the_benchmark_prints_json(live: Path) -> None:
    script = str(PYTHON / "benchmarks" / "latency.py")
    result = json.loads(run(live, script, "pattern/z16", "--frames", "20", "--warm-up", "2", "--json"))
    assert 0 < result["p50_us"] <= result["p99_us"] <= result["max_us"]
    assert (result["stream"], result["frames"]) == ("pattern/z16", 20)


def test_the_lines_of_the_readme_run(live: Path) -> None:
    code = re.findall(r"```python\n(.*?)```", (PYTHON / "README.md").read_text(), re.DOTALL)[0]
    assert len([line for line in code.splitlines() if line]) <= 5
    # On an image of this size, and not for ever.
    code = code.replace("d435/depth_refined", "pattern/z16").replace("[240, 320]", "[24, 32]") + "    break\n"
    out = run(live, "-c", code)
    assert re.fullmatch(r"\d+ [\d.]+ \(48, 64\) [\d.]+\n", out), out


def test_the_external_camera_serves_until_it_is_stopped(folder: Path) -> None:
    script = str(PYTHON / "examples" / "external_camera.py")
    env = {**os.environ, "DEPTHRIG_RUNTIME_DIR": str(folder)}
    command = [sys.executable, script, "--camera", "front", "--rig", "mount"]
    with fake_daemon(folder) as daemon, child(command, env=env) as process:
        daemon.until(state=ExternalState.IDLE)
        daemon.run(1, ("color", "depth"))
        head, color = daemon.frame("color")
        assert len(set(color)) > 200, "a moving pattern and no plain colour"
        assert 0 <= head["arrival_time_ns"] - head["device_time"] < 1e9
        assert daemon.frame("depth")[0]["payload_len"] == 640 * 480 * 2
        process.terminate()
        daemon.until(state=ExternalState.ENDED)
        out, errors = process.communicate(timeout=WAIT_S)
    assert (process.returncode, errors) == (0, "")
    assert out == "session 1: color 640x480 rgb8 30 Hz, depth 640x480 z16 30 Hz\n"
