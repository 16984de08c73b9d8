"""Noise models that learn from nothing, the measure of holes, and the comparison of kinds of raw depth."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="PyTorch is not installed")

from depthrig.lab import LabError, ablation, hole_iou, synthesis, train
from depthrig.lab.config import Config, DataConfig, ModelConfig, SynthesisConfig, TrainConfig, parse
from depthrig.lab.data import open_source
from depthrig.lab.nets import NoiseConv, noise_net
from depthrig.lab.shards import ShardWriter

import made

torch.set_num_threads(1)
FACTS = {"sensor": "d435", "sensor_model": "stereo", "seed": 1, "families": [], "scene": "table"}


def shards(folder: Path, count: int = 4, first: int = 0, filled: bool = False) -> DataConfig:
    folder.mkdir()
    with ShardWriter(folder / "made-000000.tar") as writer:
        for number in range(count):
            sample = made.sample(first + number)
            writer.write(number, dataclasses.replace(sample, filled=sample.truth if filled else None), FACTS)
    return DataConfig("shards", str(folder))


def config(folder: Path, data: tuple[DataConfig, ...], check: tuple[DataConfig, ...], kind: str = "hole") -> Config:
    crop = (28, 42) if kind == "hole" else (32, 48)
    model = ModelConfig(kind=kind, encoder="conv" if kind == "hole" else "vits", width=8)
    return Config(
        "made", str(folder), data, check=check, model=model, train=TrainConfig(steps=2, batch=2, crop=crop)
    )


def test_the_measure_is_that_of_a_slow_count() -> None:
    rng = np.random.default_rng(1)
    counts = hole_iou.Counts()
    images = [(rng.random((9, 7)), rng.random((9, 7)) < 0.3, rng.random((9, 7)) < 0.8) for _ in range(3)]
    for score, hole, seen in images:
        counts.add(score, hole, seen)
    for threshold in (0, 64, 200):
        said = [(s >= threshold / 256) & seen for s, _, seen in images]
        holes = [h & seen for _, h, seen in images]
        both = [(a & b).sum() / (a | b).sum() for a, b in zip(said, holes, strict=True)]
        joint = sum((a & b).sum() for a, b in zip(said, holes, strict=True))
        whole = sum((a | b).sum() for a, b in zip(said, holes, strict=True))
        found = counts.at(threshold)
        assert found["iou"] == pytest.approx(joint / whole)
        assert found["image_iou"] == pytest.approx(np.mean(both))
        assert found["precision"] == pytest.approx(joint / sum(a.sum() for a in said))
        assert found["recall"] == pytest.approx(joint / sum(b.sum() for b in holes))
    assert counts.iou()[counts.best()] == counts.iou().max()


def test_what_the_right_camera_misses_lies_left_of_near_things() -> None:
    truth = np.full((3, 60), 2.0, np.float32)
    truth[:, 30:40] = 1.0
    truth[1, 5] = 0
    hidden = hole_iou.shadow(truth, 20.0)
    # Disparities of 20 and 10 px.
    assert [list(np.flatnonzero(row)) for row in hidden] == [list(range(20, 30))] * 3


def test_shadows_are_those_of_a_slow_search() -> None:
    rng = np.random.default_rng(2)
    truth = (1 + rng.random((4, 50))).astype(np.float32)
    truth[rng.random(truth.shape) < 0.1] = 0
    hidden = hole_iou.shadow(truth, 12.0)
    for y, x in np.ndindex(*truth.shape):
        at = [u - 12.0 / z if z > 0 else np.inf for u, z in enumerate(truth[y].astype(float))]
        expected = truth[y, x] > 0 and any(at[u] <= at[x] for u in range(x + 1, 50))
        assert hidden[y, x] == expected, (y, x)


@pytest.mark.parametrize("size", [(32, 64), (37, 45)])
def test_the_small_model_takes_any_size_and_all_of_it_learns(size: tuple[int, int]) -> None:
    torch.manual_seed(0)
    net = noise_net(ModelConfig(kind="hole", encoder="conv", width=8, refined_input=True))
    assert isinstance(net, NoiseConv)
    out = net(torch.rand(2, 4, *size))
    assert out.shape == (2, *size)
    out.square().mean().backward()
    assert not [n for n, p in net.named_parameters() if p.grad is None]


def test_the_small_model_is_none_of_cdm() -> None:
    with pytest.raises(LabError, match="line 8.*conv"):
        parse('name = "a"\nfolder = "a"\n[[data]]\nkind = "shards"\npath = "a"\n[model]\nkind = "cdm"\nencoder = "conv"')


def test_a_trained_model_is_measured_beside_trivial_ones(tmp_path: Path) -> None:
    data, check = shards(tmp_path / "train"), shards(tmp_path / "check", first=10)
    of = config(tmp_path / "run", (data,), (check,))
    with pytest.raises(LabError, match="train first"):
        hole_iou.measure(of)
    train.run(of)
    found = hole_iou.measure(of, [open_source(check)])["found"]
    share = [(s.raw <= 0).mean() for s in (open_source(check)[i] for i in range(4))]
    assert found["everything"]["iou"] == pytest.approx(np.mean(share), rel=0.2)
    assert found["everything"]["recall"] == 1.0
    assert found["one other measurement"]["iou"] == 1.0, "the same measurement again"
    assert all(0 <= m["iou"] <= 1 for m in found.values())
    with pytest.raises(LabError, match="another colour"):
        hole_iou.measure(of, [open_source(data)])


def test_value_noise_without_its_filter_is_the_aligned_relative_depth() -> None:
    truth = made.sample(3).truth
    # Relative inverse depth that is wrong in one half.
    relative = 3 / np.maximum(truth, 0.1) + 5
    relative[:, 24:] += 0.5
    results = {}
    for filtered in (True, False):
        found = [
            synthesis.value_noise(truth, relative, True, np.random.default_rng(seed), filtered) for seed in range(12)
        ]
        results[filtered] = [float(np.abs(f - truth)[truth > 0].mean()) for f in found]
    exact = [e for e in results[False] if e == 0]
    rest = {e for e in results[False] if e > 0}
    assert len(exact) <= 4 and len(rest) == 1, "but for the share without noise, all are the same"
    assert len(set(results[True])) > 4
    assert np.mean(results[True]) < np.mean(results[False])


def test_an_ablation_trains_what_is_missing_and_compares(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    physics, statistical = shards(tmp_path / "physics"), shards(tmp_path / "statistical")
    check = shards(tmp_path / "check", count=2, first=20, filled=True)
    monkeypatch.setattr(ablation, "NOISE_WIDTH", 8)
    for kind in ("hole", "value"):
        torch.save(noise_net(ModelConfig(kind=kind, encoder="conv", width=8)).state_dict(), tmp_path / f"{kind}.pt")
    of = config(tmp_path / "runs", (physics, statistical), (check,), kind="tiny")
    with pytest.raises(LabError, match="hole and value"):
        ablation.run_all(of, 1)
    noise = SynthesisConfig("stereo", value=str(tmp_path / "value.pt"), hole=str(tmp_path / "hole.pt"))
    of = dataclasses.replace(of, synthesis=noise)
    found = ablation.run_all(of, 1)
    assert set(found["variants"]) == set(ablation.VARIANTS)
    assert all(len(v) == 1 for v in found["variants"].values())
    assert found["fill"] == pytest.approx(0, abs=1e-3), "the held-out data's own filled depth is the truth here"
    assert found["filled"] > 0.001
    # Holes of synthetic depth are there or not, as the variant says; data of other variants differ.
    data = tmp_path / "runs" / "data"

    def raws(name: str) -> list[np.ndarray]:
        return [open_source(DataConfig("shards", str(data / name)))[i].raw for i in range(4)]

    assert all(np.array_equal(a, b) for a, b in zip(raws("physics"), [made.sample(i).raw for i in range(4)], strict=True))
    for name in ("no-guided-filter", "no-hole-noise", "no-value-noise", "physics"):
        assert any(not np.array_equal(a, b) for a, b in zip(raws("synthetic"), raws(name), strict=True)), name
    runs = tmp_path / "runs" / "runs"
    kept = {p: p.stat().st_mtime_ns for p in runs.glob("*/metrics.json")}
    assert len(kept) == 6
    again = runs / "no-hole-noise-1"
    for file in again.iterdir():
        if file.is_file():
            file.unlink()
    assert ablation.run_all(of, 1) == found
    changed = [p.parent for p, t in kept.items() if p.stat().st_mtime_ns != t]
    assert changed == [again]


def test_the_summary_compares_runs_of_one_seed() -> None:
    variants = {name: [0.10, 0.12, 0.14] for name in ablation.VARIANTS} | {"statistical": [0.11, 0.13, 0.16]}
    found = {"variants": variants, "raw": 0.5, "filled": 0.2, "fill": None}
    s = ablation.summary(found)
    assert s["statistical"]["mean"] == pytest.approx(0.4 / 3)
    assert s["physics"]["spread"] == pytest.approx(0.02)
    assert s["statistical"]["difference"] == pytest.approx(0.04 / 3)
    assert s["statistical"]["difference_error"] == pytest.approx(np.std([0.01, 0.01, 0.02], ddof=1) / np.sqrt(3))
    text = ablation.table(found)
    assert "| statistical | 0.1333 | 0.0252 | +0.0133 | 0.0033 |" in text
    assert "| not trained: raw | 0.5000 |" in text and "`fill`" not in text
    json.dumps(s)
