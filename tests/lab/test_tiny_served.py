"""The network `tiny` as the program serves it, beside the same file in ONNX Runtime of Python and `tiny_inputs`."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

if sys.version_info < (3, 11):
    pytest.skip("depthrig.lab needs Python 3.11", allow_module_level=True)
torch = pytest.importorskip("torch", reason="PyTorch is not installed")
if "DEPTHRIG_BIN" not in os.environ:
    pytest.skip("DEPTHRIG_BIN is not set", allow_module_level=True)

from depthrig.lab.nets.tiny import MULTIPLE, tiny_inputs
from PIL import Image

ROOT = Path(__file__).resolve().parents[2]
UNIT_M = 0.001


def run(folder: Path, engine: str, reach: str) -> npt.NDArray[np.float32]:
    """Inverse depth, 1/m."""
    out = folder / f"{engine}-{reach}.npy"
    command = [os.environ["DEPTHRIG_BIN"], "cdm", "run", "--rgb", str(folder / "color.png")]
    command += ["--depth", str(folder / "depth.png"), "--depth-unit", str(UNIT_M), "--engine", engine, "--inverse"]
    command += ["--fill-reach", reach, "--threads", "1", "--out", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    if "ONNX Runtime was not found" in done.stderr and "DEPTHRIG_REQUIRE_ONNXRUNTIME" not in os.environ:
        pytest.skip("depthrig finds no ONNX Runtime (tools/onnxruntime.sh)")
    assert done.returncode == 0, done.stderr
    return np.asarray(np.load(out))


@pytest.mark.parametrize(("height", "width"), [(96, 128), (75, 101), (9, 13)])
def test_served_depth_is_the_networks(tmp_path: Path, height: int, width: int) -> None:
    onnxruntime = pytest.importorskip("onnxruntime", reason="onnxruntime is not installed (requirements-lab.txt)")
    rng = np.random.default_rng(height)
    y, x = np.mgrid[:height, :width]
    waves = 128 + 90 * np.sin(np.stack([x / 5, y / 7, (x + y) / 9], -1))
    color = (waves + rng.uniform(-5, 5, waves.shape)).clip(0, 255).astype(np.uint8)
    Image.fromarray(color).save(tmp_path / "color.png")
    depth = (900 + 3 * x + 400 * (y > height // 2) + rng.normal(0, 5, (height, width))).astype(np.uint16)
    depth[rng.random((height, width)) < 0.2] = 0
    depth[:, : width // 4] = 0
    depth[0, -1] = 65535
    Image.fromarray(depth).save(tmp_path / "depth.png")

    filled = torch.from_numpy(run(tmp_path, "fill", "1"))[None]
    measured = (depth > 0) & (depth < 65535)
    raw = torch.from_numpy(np.where(measured, 1 / (UNIT_M * np.where(measured, depth, 1)), 0).astype(np.float32))[None]
    planes = torch.from_numpy(color.astype(np.float32) / 255).permute(2, 0, 1)[None]
    inputs = tiny_inputs(planes, filled, raw)
    bottom, right = -height % MULTIPLE, -width % MULTIPLE
    pad = torch.nn.functional.pad
    inputs = pad(inputs, (0, right, 0, bottom), mode="replicate")
    padded = pad(filled[None], (0, right, 0, bottom), mode="replicate")[0]
    model = ROOT / "cdm_plugin/models/tiny.onnx"
    session = onnxruntime.InferenceSession(str(model), providers=["CPUExecutionProvider"])
    (expected,) = session.run(None, {"x": inputs.numpy(), "filled": padded.numpy()})
    expected = expected[0, :height, :width]

    np.testing.assert_allclose(run(tmp_path, "tiny", "1"), expected, rtol=1e-4)
    # With a reach, what is further away is unknown, and nothing else changes.
    known = run(tmp_path, "fill", "0.05") > 0
    np.testing.assert_allclose(run(tmp_path, "tiny", "0.05"), np.where(known, expected, 0), rtol=1e-4)
