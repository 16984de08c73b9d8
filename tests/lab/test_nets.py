"""Networks: names and numbers of the official one, the form of the small one, its ONNX file."""

from __future__ import annotations

import importlib.util
import math
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
from depthrig.lab.nets.planes import GUESSES, RIDGE, planes
from depthrig.lab.nets.tiny import STAY, tiny_inputs
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


def test_a_network_without_weights_answers_above_0_and_so_learns() -> None:
    for seed in range(6):
        torch.manual_seed(seed)
        inverse = Cdm(SIZES["vits"])(torch.rand(1, 4, 56, 56))
        assert (inverse > 0).float().mean() > 0.9, seed


def test_position_embeddings_follow_the_size() -> None:
    net = NoiseNet(SMALL)
    assert net.pretrained.position(37, 37).shape[1] == 1 + 37 * 37
    assert net.pretrained.position(3, 50).shape[1] == 1 + 150


def batch(height: int = 64, width: int = 96, seed: int = 1) -> tuple[Any, Any, Any]:
    g = torch.Generator().manual_seed(seed)
    color = torch.rand(2, 3, height, width, generator=g)
    filled = 0.3 + torch.rand(2, height, width, generator=g)
    hole = torch.rand(2, height // 8, width // 8, generator=g) < 0.3
    raw = torch.where(hole.repeat_interleave(8, 1).repeat_interleave(8, 2), 0, filled)
    return color, filled, raw


def shaken(net: Any) -> Any:
    torch.manual_seed(3)
    with torch.no_grad():
        for p in net.parameters():
            p.add_(0.3 * torch.randn_like(p))
    return net


def test_tiny_multiplies_in_holes_and_keeps_what_was_measured() -> None:
    net = Tiny()
    count = sum(p.numel() for p in net.parameters())
    assert 500_000 <= count <= 1_000_000
    color, filled, raw = batch()
    # Filling took these out.
    raw[0, 16:24, 16:24] = 2 * filled[0, 16:24, 16:24]
    with torch.no_grad():
        net = shaken(net)
        x = tiny_inputs(color, filled, raw)
        out = net(x, filled)
        ratio = (out / filled).log()
        kept = raw == filled
        assert 0.6 < kept.float().mean() < 0.8
        assert (ratio[kept] == 0).all()
        assert ratio[~kept].std() > 0.05
        assert (ratio[0, 16:24, 16:24] != 0).any()
        assert ratio.abs().max() <= 2.0001
        torch.testing.assert_close(net(x, 3 * filled), 3 * out)
        # Inputs are free of the scale of the scene.
        torch.testing.assert_close(tiny_inputs(color, 5 * filled, 5 * raw), x)


def test_tiny_begins_on_the_way_from_filled_depth_to_the_plane_around() -> None:
    y, x = torch.meshgrid(torch.arange(64.0), torch.arange(96.0), indexing="ij")
    plane = (0.5 + 0.004 * x + 0.002 * y)[None]
    hole = torch.zeros(1, 64, 96, dtype=torch.bool)
    hole[:, 16:48, 32:64] = True
    raw = torch.where(hole, 0, plane)
    filled = torch.where(hole, 0.5 * plane, plane)
    with torch.no_grad():
        color = torch.zeros(1, 3, 64, 96)
        out = Tiny(8).eval()(tiny_inputs(color, filled, raw), filled)
        # All three guesses are the plane: 3 parts of sigmoid(-2), less what is too little to move.
        expected = 3 / (1 + math.exp(2)) * math.log(2) - STAY
        torch.testing.assert_close((out / filled).log()[hole], torch.full([32 * 32], expected), atol=0.01, rtol=0)


def test_tiny_leaves_narrow_holes_as_they_were_filled() -> None:
    _, filled, _ = batch()
    holes = torch.zeros_like(filled, dtype=torch.bool)
    holes[:, 8:12, 8:12] = True
    holes[:, 20:24, 30:38] = True
    holes[:, :, 60] = True
    wide = torch.zeros_like(holes)
    wide[:, 40:45, 8:13] = True
    wide[:, 0:5, 80:90] = True
    # A corner of a wide hole that no square of 5x5 reaches.
    holes[:, 43:46, 13:15] = True
    raw = torch.where(holes | wide, 0, filled)
    with torch.no_grad():
        net = shaken(Tiny()).eval()
        x = tiny_inputs(torch.zeros(2, 3, *filled.shape[1:]), filled, raw)
        ratio = net(x, filled) / filled
        learning = net.train()(x, filled) / filled
    assert (ratio[~wide] == 1).all()
    assert (ratio[wide] != 1).float().mean() > 0.5
    assert (learning[holes] != 1).any()


def slow_plane(q: Any, known: Any, y: int, x: int, power: float) -> float:
    """The plane of best fit over cells of 8x8 at one of them, in 64-bit floats and by least squares."""
    rows, wanted = [], []
    for i in range(q.shape[0] // 8):
        for j in range(q.shape[1] // 8):
            at = np.s_[8 * i : 8 * i + 8, 8 * j : 8 * j + 8]
            if known[at].any():
                mean = q[at][known[at]].mean()
                d2 = (i - y) ** 2 + (j - x) ** 2
                near = sum(s**-6.0 * math.exp(-d2 / (2 * s * s)) for s in (0.5, 1, 2, 4, 8, 16, 32))
                w = math.sqrt(known[at].mean() * near * mean**power)
                rows.append([w, w * (i - y) / 64, w * (j - x) / 64])
                wanted.append(w * mean)
    # The ridge is on the slopes.
    rows += [[0, math.sqrt(RIDGE * sum(r[0] ** 2 for r in rows)), 0]]
    rows += [[0, 0, rows[-1][1]]]
    return float(np.linalg.lstsq(np.array(rows), np.array([*wanted, 0, 0]), rcond=None)[0][0])


def test_planes_are_lines_of_best_fit_through_what_was_measured() -> None:
    rng = np.random.default_rng(4)
    q = rng.uniform(0.5, 2, (6, 8)).repeat(8, 0).repeat(8, 1) + rng.normal(0, 0.05, (48, 64))
    known = rng.random((48, 64)) < 0.4
    known[8:24, 16:40] = False
    tensors = [torch.from_numpy((a * known).astype(np.float32))[None, None] for a in (q, np.ones_like(q))]
    got, features = planes(*tensors)
    assert got.shape == (1, 3, 6, 8)
    assert features.shape == (1, 9, 6, 8)
    assert features.isfinite().all()
    for of, power in enumerate(GUESSES):
        for y in range(6):
            for x in range(8):
                assert got[0, of, y, x].item() == pytest.approx(slow_plane(q, known, y, x, power), rel=1e-3)
    nothing = planes(*(torch.zeros(1, 1, 16, 32) for _ in range(2)))
    assert all(n.isfinite().all() for n in nothing)


def test_tiny_as_onnx_has_the_same_numbers_at_other_sizes(tmp_path: Path) -> None:
    onnxruntime = pytest.importorskip("onnxruntime", reason="onnxruntime is not installed (requirements-lab.txt)")
    net = shaken(Tiny(16)).eval()
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
    with pytest.raises(LabError, match=r"w\.pt: tensor apart\.weight is \[16, 7, 8, 8\], \[32"):
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
