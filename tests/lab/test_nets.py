"""Networks: names and numbers of the official one, the form of the small one, its ONNX file."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="PyTorch is not installed")

from depthrig.lab import LabError
from depthrig.lab.config import ModelConfig
from depthrig.lab.nets import Cdm, NoiseNet, Tiny, build, load_weights
from depthrig.lab.nets.export import export_tiny
from depthrig.lab.nets.tiny import tiny_inputs
from depthrig.lab.nets.vit import SIZES, Size

torch.set_num_threads(1)
PARITY = Path(os.environ.get("DEPTHRIG_TEST_DATA", "../shared/data")) / "cdm_parity"
needs_parity = pytest.mark.skipif(not PARITY.is_dir(), reason="cdm_parity is not in DEPTHRIG_TEST_DATA")
SMALL = Size(24, 4, 2, (0, 1, 2, 3), 16, (8, 16, 24, 32))


@needs_parity
@pytest.mark.parametrize("encoder", SIZES)
def test_names_and_shapes_are_the_official_ones(encoder: str) -> None:
    with torch.device("meta"):
        net = Cdm(SIZES[encoder])
    ours = {f"{name}\t{list(t.shape)}" for name, t in net.state_dict().items()}
    theirs = set((PARITY / "keys" / f"{encoder}_keys.txt").read_text().splitlines())
    assert ours == theirs


@needs_parity
def test_numbers_are_the_official_ones() -> None:
    from safetensors.torch import load_file

    spec = importlib.util.spec_from_file_location("seeded", PARITY / "make_seeded_weights.py")
    assert spec is not None
    assert spec.loader is not None
    seeded: Any = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(seeded)
    net = Cdm(SIZES["vits"])
    state = {n: torch.from_numpy(seeded.tensor(n, tuple(t.shape), 20260)) for n, t in net.state_dict().items()}
    net.load_state_dict(state)
    parity = load_file(PARITY / "vits_252_d405.safetensors")
    with torch.inference_mode():
        got = net(parity["x"])
    assert parity["y"].std() > 0.01
    torch.testing.assert_close(got, parity["y"], rtol=0, atol=5e-5)


@pytest.mark.skipif("DEPTHRIG_BIN" not in os.environ, reason="DEPTHRIG_BIN is not set")
def test_depthrig_imports_a_saved_state(tmp_path: Path) -> None:
    torch.save(Cdm(SIZES["vits"]).state_dict(), tmp_path / "net.pth")
    command = [os.environ["DEPTHRIG_BIN"], "cdm", "import", str(tmp_path / "net.pth"), "--name", "from-the-lab"]
    command += ["--channel-order", "rgb", "--models", str(tmp_path / "models")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    assert list((tmp_path / "models").rglob("*.toml"))
    shutil.rmtree(tmp_path)  # 400 MB


def test_every_parameter_but_the_unused_learns() -> None:
    torch.manual_seed(0)
    for net, channels in ((Cdm(SMALL), 4), (NoiseNet(SMALL), 3), (NoiseNet(SMALL, 4), 4)):
        out = net(torch.rand(2, channels, 42, 56))
        assert out.shape == (2, 42, 56)
        out.square().mean().backward()
        without = {n for n, p in net.named_parameters() if p.grad is None}
        assert all("mask_token" in n or "refinenet4.resConfUnit1" in n for n in without), without
        assert net.encoder_parameters() < set(net.parameters())


def test_position_embeddings_follow_the_size() -> None:
    net = NoiseNet(SMALL)
    assert net.pretrained.position(37, 37).shape[1] == 1 + 37 * 37
    assert net.pretrained.position(3, 50).shape[1] == 1 + 150


def batch(height: int = 64, width: int = 96, seed: int = 1) -> tuple[Any, Any, Any]:
    g = torch.Generator().manual_seed(seed)
    color = torch.rand(2, 3, height, width, generator=g)
    filled = 0.3 + torch.rand(2, height, width, generator=g)
    raw = torch.where(torch.rand(2, height, width, generator=g) < 0.3, 0, filled)
    return color, filled, raw


def shaken(net: Any) -> Any:
    torch.manual_seed(3)
    with torch.no_grad():
        for p in net.parameters():
            p.add_(0.3 * torch.randn_like(p))
    return net


def test_tiny_begins_as_the_identity_and_multiplies() -> None:
    net = Tiny()
    count = sum(p.numel() for p in net.parameters())
    assert 500_000 <= count <= 1_000_000
    color, filled, raw = batch()
    with torch.no_grad():
        torch.testing.assert_close(net(tiny_inputs(color, filled, raw), filled), filled)
        net = shaken(net)
        x = tiny_inputs(color, filled, raw)
        out = net(x, filled)
        ratio = (out / filled).log()
        assert ratio.std() > 0.05
        assert ratio.abs().max() <= 2.0001
        torch.testing.assert_close(net(x, 3 * filled), 3 * out)
        # Inputs are free of the scale of the scene.
        torch.testing.assert_close(tiny_inputs(color, 5 * filled, 5 * raw), x)


def test_tiny_as_onnx_has_the_same_numbers_at_other_sizes(tmp_path: Path) -> None:
    onnxruntime = pytest.importorskip("onnxruntime", reason="onnxruntime is not installed (requirements-lab.txt)")
    net = shaken(Tiny(16))
    export_tiny(net, tmp_path / "tiny.onnx")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(str(tmp_path / "tiny.onnx"), options, providers=["CPUExecutionProvider"])
    for height, width in ((64, 96), (48, 32)):
        color, filled, raw = batch(height, width)
        x = tiny_inputs(color, filled, raw)
        (got,) = session.run(None, {"x": x.numpy(), "filled": filled.numpy()})
        with torch.no_grad():
            np.testing.assert_allclose(got, net(x, filled).numpy(), rtol=1e-3)


def test_weights_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "w.pt"
    state = Tiny(16).state_dict()
    torch.save({"model": {f"module.{k}": v for k, v in state.items()}}, path)
    assert load_weights(Tiny(16), path) == []
    assert build(ModelConfig(width=16, weights=str(path))).apart.weight.equal(state["apart.weight"])
    with pytest.raises(LabError, match=r"w\.pt: tensor apart\.weight is \[16, 6, 2, 2\], \[32"):
        load_weights(Tiny(32), path)
    with pytest.raises(LabError, match="not of this network"):
        load_weights(NoiseNet(SMALL), path)
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(LabError, match=r"w\.pt: not a file"):
        load_weights(Tiny(16), path)
    torch.save({}, path)
    with pytest.raises(LabError, match="no tensors"):
        load_weights(Tiny(16), path)
    with pytest.raises(LabError, match=r"none\.pt"):
        load_weights(Tiny(16), tmp_path / "none.pt")
