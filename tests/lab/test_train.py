"""Training: the same bits after a kill, what stops it, what it keeps; losses and metrics against slow ones."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import random
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="PyTorch is not installed")

from depthrig.lab import LabError, batches, config, losses, metrics, train
from depthrig.lab.data import open_source
from depthrig.lab.fill import fill
from depthrig.lab.nets.vit import SIZES, Size
from depthrig.lab.sample import MATERIALS, Sample
from depthrig.lab.shards import ShardWriter

from made import sample

torch.set_num_threads(1)
FACTS = {"sensor": "d435", "sensor_model": "statistical", "seed": 1, "families": [], "scene": "table"}
WAIT_S = 300


def make_shards(folder: Path, count: int = 6, holes: bool = True) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    with ShardWriter(folder / "made-000000.tar") as writer:
        for i in range(count):
            writer.write(i, sample(i, 40, 56, holes), FACTS)
    return folder


def make_config(folder: Path, run: str = "run", **changes: Any) -> Path:
    if not (folder / "data").exists():
        make_shards(folder / "data", holes=changes.pop("holes", True))
    values = {"steps": 12, "batch": 2, "crop": [32, 32], "checkpoint_every": 3, "ema": 0.9} | changes
    lines = [f"{k} = {json.dumps(v)}" for k, v in values.items()]
    data = '[[data]]\nkind = "shards"\npath = "data"\n[[check]]\nkind = "shards"\npath = "data"\n'
    text = f'name = "x"\nfolder = "{run}"\nships = true\n{data}[model]\nwidth = 8\n[train]\n' + "\n".join(lines) + "\n"
    path = folder / f"{run}.toml"
    path.write_text(text)
    return path


def start(path: Path, **env: str) -> subprocess.Popen[str]:
    environment = {**os.environ, "OMP_NUM_THREADS": "1", **env}
    command = [sys.executable, "-m", "depthrig.lab.train", str(path)]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def weights(folder: Path) -> dict[str, Any]:
    return torch.load(folder / "model.pt", weights_only=True)


def lines(folder: Path) -> list[str]:
    path = folder / "log.jsonl"
    return path.read_text().splitlines() if path.exists() else []


def test_a_killed_run_ends_with_the_same_bits(tmp_path: Path) -> None:
    whole, killed = make_config(tmp_path, "whole", steps=40), make_config(tmp_path, "killed", steps=40)
    assert train.main([str(whole)]) == 0
    at = random.randrange(4, 20)
    process = start(killed)
    try:
        end = time.monotonic() + WAIT_S
        while len(lines(tmp_path / "killed")) < at and process.poll() is None and time.monotonic() < end:
            time.sleep(0.005)
        process.send_signal(signal.SIGKILL)
    finally:
        process.kill()
        process.communicate()
    assert process.returncode == -signal.SIGKILL, f"it was complete before it was killed at step {at}"
    assert not (tmp_path / "killed/model.pt").exists()
    assert train.main([str(killed)]) == 0
    one, two = weights(tmp_path / "whole"), weights(tmp_path / "killed")
    assert one.keys() == two.keys()
    different = [name for name in one if not torch.equal(one[name], two[name])]
    assert not different, f"killed at step {at}"
    assert lines(tmp_path / "whole") == lines(tmp_path / "killed")
    for name in ("tiny.onnx", "metrics.json", "run.json"):
        assert (tmp_path / "killed" / name).stat().st_size > 100
    found = json.loads((tmp_path / "killed/metrics.json").read_text())
    assert {"raw: images", "filled: pixels", "net: pixels, glass"} <= found.keys()
    kept = json.loads((tmp_path / "killed/run.json").read_text())
    assert kept["config"]["train"]["steps"] == 40
    assert kept["config"]["processes"] == 1
    assert len(next(iter(kept["data"].values()))) == 64


def test_it_learns_and_reading_ahead_changes_nothing(tmp_path: Path) -> None:
    path = make_config(tmp_path, "a", steps=30, rate=5e-3, batch=4)
    first = train.run(config.read(path))
    found = json.loads((first / "metrics.json").read_text())
    for error in ("l1_m", "rmse_m"):
        assert found["net: images"]["strict"][error] < 0.95 * found["filled: images"]["strict"][error]
    ahead = train.run(config.read(make_config(tmp_path, "b", steps=4, rate=5e-3, batch=4, workers=1, ema=0)))
    without = train.run(config.read(make_config(tmp_path, "c", steps=4, rate=5e-3, batch=4, ema=0)))
    assert lines(ahead) == lines(without)


def test_two_processes_share_a_step(tmp_path: Path) -> None:
    options = {"steps": 3, "holes": False, "schedule": "constant", "rate": 1e-4}
    alone = make_config(tmp_path, "alone", batch=4, **options)
    train.run(config.read(alone))
    options.pop("holes")
    both = make_config(tmp_path, "both", batch=2, **options)
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        port = str(s.getsockname()[1])
    env = {"WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port}
    started = [start(both, RANK=str(r), **env) for r in range(2)]
    try:
        for process in started:
            _, errors = process.communicate(timeout=WAIT_S)
            assert process.returncode == 0, errors
    finally:
        for process in started:
            process.kill()
    one, two = ([json.loads(line)["loss"] for line in lines(tmp_path / n)] for n in ("alone", "both"))
    np.testing.assert_allclose(one, two, rtol=1e-3)


def test_a_number_that_is_none_stops_the_run_and_names_the_batch(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = make_config(tmp_path)
    real = losses.refine_loss
    monkeypatch.setattr(
        losses, "refine_loss", lambda *a: real(*a) * (math.nan if len(lines(tmp_path / "run")) == 5 else 1)
    )
    assert train.main([str(path)]) == 1
    said = capsys.readouterr().err
    assert "step 5: the loss is not finite" in said
    assert said.count("made-000000.tar: sample 00000000") == 2
    monkeypatch.setattr(losses, "refine_loss", real)
    assert train.main([str(path)]) == 0
    monkeypatch.setattr(losses, "refine_loss", lambda p, *a: (p - p.detach()).abs().sqrt().mean())
    assert train.main([str(make_config(tmp_path, "other"))]) == 1
    assert "the gradient is not finite" in capsys.readouterr().err


FULL = """
import resource, signal, sys
from depthrig.lab import train
real = train.checkpoint.save
def save(path, state):
    if path.name == "checkpoint.pt" and state["step"] == 6:
        resource.setrlimit(resource.RLIMIT_FSIZE, (4096, resource.RLIM_INFINITY))
    try:
        real(path, state)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    if state.get("step") == 6: sys.exit("written")
train.checkpoint.save = save
step = train._Trainer.one
def one(self, batch):
    if self.step == 8: sys.exit(7)
    return step(self, batch)
train._Trainer.one = one
sys.exit(train.main(sys.argv[1:]))
"""


def test_a_full_disk_keeps_the_last_checkpoint(tmp_path: Path) -> None:
    path = make_config(tmp_path)
    env = {**os.environ, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-c", FULL, str(path)]
    done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=WAIT_S, check=False)
    assert done.returncode == 7, done.stderr
    assert "warning: step 6" in done.stderr
    assert "the last one is kept" in done.stderr
    assert torch.load(tmp_path / "run/checkpoint.pt", weights_only=True)["step"] == 3
    assert not list((tmp_path / "run").glob(".*.tmp"))
    assert train.main([str(path)]) == 0


def test_a_full_disk_costs_lines_of_the_log_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    begin = train._Log.__init__

    def full(self: Any, *arguments: Any) -> None:
        begin(self, *arguments)
        self.file.close()
        self.file = open("/dev/full", "w")  # noqa: SIM115

    monkeypatch.setattr(train._Log, "__init__", full)
    assert train.main([str(make_config(tmp_path))]) == 0
    said = capsys.readouterr().err
    assert said.count("No space left") == 1
    assert "it lacks lines from here on" in said
    assert (tmp_path / "run/model.pt").exists()


def test_a_run_goes_on_with_the_same_processes_and_held_out_data(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = make_config(tmp_path)
    path.write_text(path.read_text().replace('[[check]]\nkind = "shards"\npath = "data"', '[[check]]\nkind = "shards"\npath = "more"'))
    make_shards(tmp_path / "more", 2)
    assert train.main([str(path)]) == 0
    record = tmp_path / "run/run.json"
    kept = record.read_text()
    record.write_text(kept.replace('"processes": 1', '"processes": 2'))
    assert train.main([str(path)]) == 1
    assert "another processes" in capsys.readouterr().err
    record.write_text(kept)
    make_shards(tmp_path / "more", 3)
    assert train.main([str(path)]) == 1
    assert "another data hashes" in capsys.readouterr().err


class Made:
    """A dataset of made samples; those of `blank` have an empty truth."""

    def __init__(self, count: int, blank: set[int]):
        self.data = config.DataConfig("shards", "made")
        self.count, self.blank = count, blank

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> Sample:
        one = sample(index, 40, 56, name=str(index))
        return dataclasses.replace(one, truth=np.zeros_like(one.truth)) if index in self.blank else one


def test_samples_without_truth_are_left_out_and_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    read = config.read(make_config(tmp_path, batch=3, steps=20))
    drawn = [n for step in range(8) for n in batches.Batches([Made(6, {2, 5})], read)[step]["names"]]
    again = batches.Batches([Made(6, {2, 5})], read)
    assert [n for step in (7, 1) for n in again[step]["names"]] == drawn[21:24] + drawn[3:6]
    assert set(drawn) == {"0", "1", "3", "4"}
    whole = [n for step in range(8) for n in batches.Batches([Made(6, set())], read)[step]["names"]]
    assert all(a == b for a, b in zip(whole, drawn, strict=True) if a not in "25"), "the others stay where they were"
    assert "warning: 2: the true depth is empty" in capsys.readouterr().err
    with pytest.raises(LabError, match="is empty, and so is that of 100 others"):
        batches.Batches([Made(4, {0, 1, 2, 3})], read)[0]
    of_holes = dataclasses.replace(read, model=config.ModelConfig(kind="hole", encoder="conv"))
    assert "2" in [n for step in range(2) for n in batches.Batches([Made(6, {2})], of_holes)[step]["names"]]


def test_what_cannot_be_trained_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def refused(path: Path, *words: str) -> None:
        assert train.main([str(path)]) == 1
        said = capsys.readouterr().err
        for word in ("error: ", *words):
            assert word in said

    refused(make_config(tmp_path, "big", crop=[48, 48]), "56x40 is smaller than the crop of 48x48")
    path = make_config(tmp_path, "turned", flip=True)
    path.write_text(path.read_text() + '[synthesis]\nsensor = "tof"\n')
    refused(path, "raw depth of its own, whose holes have a side")
    path.write_text(path.read_text().replace("flip = true", "").replace("width = 8", 'kind = "value"').replace("tof", "none"))
    refused(path, "what measured raw depth")
    path = make_config(tmp_path, "gpu", device="cuda")
    if not torch.cuda.is_available():
        refused(path, "no GPU")
    path = make_config(tmp_path, "kept", steps=3)
    assert train.main([str(path)]) == 0
    refused(make_config(tmp_path, "kept", steps=4), "another train")
    checkpoint = tmp_path / "kept/checkpoint.pt"
    checkpoint.write_bytes(checkpoint.read_bytes()[:500])
    refused(make_config(tmp_path, "kept", steps=3), "checkpoint.pt: damaged checkpoint")
    checkpoint.write_bytes(b"")
    refused(path, "checkpoint.pt: damaged checkpoint")
    torch.save({"step": 1}, checkpoint)
    refused(path, "not a checkpoint")
    refused(tmp_path / "none.toml", "none.toml")
    bare = sample(0, 40, 56)
    read = config.read(path)
    rng = np.random.default_rng(0)
    with pytest.raises(LabError, match="no raw depth; set sensor"):
        batches.example(dataclasses.replace(bare, raw=None), read, rng)
    blind = dataclasses.replace(bare, truth=None)
    read = dataclasses.replace(read, train=config.TrainConfig(crop=(28, 28)), model=config.ModelConfig(kind="cdm"))
    of_holes = dataclasses.replace(read, model=config.ModelConfig(kind="hole"))
    for c in (read, dataclasses.replace(read, model=config.ModelConfig(kind="hole", refined_input=True))):
        with pytest.raises(LabError, match="no true depth"):
            batches.example(blind, c, rng)
    assert not batches.example(blind, of_holes, rng).planes["truth"].any()


def test_each_sample_comes_once_in_an_epoch(tmp_path: Path) -> None:
    make_shards(tmp_path / "data")
    make_shards(tmp_path / "more", 4)
    read = config.read(make_config(tmp_path, batch=5, steps=100))
    sources = [
        open_source(config.DataConfig("shards", str(tmp_path / n), weight=w)) for n, w in (("data", 1), ("more", 0.5))
    ]

    def names(rank: int, world: int, steps: int) -> list[str]:
        drawn = batches.Batches(sources, dataclasses.replace(read), rank, world)
        return [n for step in range(steps) for n in drawn[step]["names"]]

    of_8 = names(0, 1, 8)[:8]
    assert len(set(of_8)) == 8
    assert sum("/more/" in n for n in of_8) == 2
    both = names(0, 1, 4)[8:16]
    assert {n for n in of_8 if "/more/" in n}.isdisjoint(n for n in both if "/more/" in n)
    parts = [names(r, 2, 2) for r in range(2)]
    assert parts[0][:5] + parts[1][:5] + parts[0][5:] + parts[1][5:] == names(0, 1, 4)


def test_crops_flip_all_planes_together_and_only_if_permitted(tmp_path: Path) -> None:
    text = make_config(tmp_path, color_jitter=0, crop=[32, 48], flip=True).read_text()
    read = config.parse(text + '\n[synthesis]\nsensor = "tof"\n')
    whole = sample(0, 32, 48)
    seen = set()
    for seed in range(12):
        planes = batches.example(whole, read, np.random.default_rng(seed)).planes
        back = np.array_equal(planes["truth"], whole.truth[:, ::-1])
        turn = slice(None, None, -1 if back else 1)
        np.testing.assert_array_equal(planes["truth"], whole.truth[:, turn])
        np.testing.assert_array_equal(planes["raw"], whole.raw[:, turn])
        np.testing.assert_allclose(planes["color"].transpose(1, 2, 0), whole.color[:, turn] / 255, atol=1e-6)
        seen.add(back)
    assert seen == {True, False}


def test_what_the_sensor_sees() -> None:
    raw = np.zeros((5, 6), np.float32)
    assert not batches.seen_of(raw).any()
    raw[1, 2] = raw[3, 4] = 1
    want = np.zeros((5, 6), bool)
    want[1:4, 2:5] = True
    np.testing.assert_array_equal(batches.seen_of(raw), want)


def slow_refine(p: np.ndarray, t: np.ndarray, raw: np.ndarray, c: config.LossConfig) -> float:
    total = weight = gradient = pairs = 0.0
    n, h, w = p.shape

    def ok(i: int, y: int, x: int) -> bool:
        return c.near_m <= t[i, y, x] <= c.far_m

    for i in range(n):
        for y in range(h):
            for x in range(w):
                if not ok(i, y, x):
                    continue
                e = p[i, y, x] - 1 / t[i, y, x]
                one = c.missing if abs(raw[i, y, x] - t[i, y, x]) > 0.05 * t[i, y, x] else 1
                total, weight = total + one * abs(e), weight + one
                for yy, xx in ((y + 1, x), (y, x + 1)):
                    if yy < h and xx < w and ok(i, yy, xx):
                        gradient += abs(p[i, yy, xx] - 1 / t[i, yy, xx] - e)
                        pairs += 1
    return total / max(weight, 1e-6) + c.gradient * gradient / max(pairs, 1)


@pytest.mark.parametrize("missing", [1.0, 3.0])
def test_the_refine_loss_is_its_definition(missing: float) -> None:
    rng = np.random.default_rng(1)
    t = np.where(rng.random((2, 7, 9)) < 0.3, 0, rng.uniform(0.05, 7, (2, 7, 9)))
    raw = np.where(rng.random(t.shape) < 0.3, 0, t * rng.uniform(0.9, 1.1, t.shape))
    p = rng.random(t.shape)
    c = config.LossConfig(missing=missing)
    got = losses.refine_loss(*(torch.from_numpy(a) for a in (p, t, raw)), c)
    assert got.item() == pytest.approx(slow_refine(p, t, raw, c), abs=1e-12)
    nothing = torch.zeros(1, 4, 4, requires_grad=True)
    empty = losses.refine_loss(nothing, torch.zeros(1, 4, 4), torch.zeros(1, 4, 4), c)
    empty.backward()
    assert empty.item() == 0
    assert not nothing.grad.any()


def test_the_loss_beside_fill_is_its_definition() -> None:
    rng = np.random.default_rng(3)
    t = np.where(rng.random((4, 7, 9)) < 0.3, 0, rng.uniform(0.05, 7, (4, 7, 9)))
    filled, p = rng.uniform(0.2, 2, t.shape), rng.uniform(0.2, 2, t.shape)
    filled[0, :2] = 0
    p[1] = filled[1] + 0.8 * (1 / np.maximum(t[1], 0.2) - filled[1])  # better
    t[3] = 0
    c = config.LossConfig(space="fill", worse=2.0, off_m=0.3)
    losses_of = []
    for i in range(4):
        at = (t[i] >= 0.1) & (t[i] <= 6) & (filled[i] > 0)
        before, now = (abs(1 / of[i][at] - t[i][at]).sum() / max(at.sum(), 1) for of in (filled, p))
        change = now - before
        losses_of.append(change / (before + 0.3) + 2 * max(change, 0) / (before + 0.01))
    assert min(losses_of) < -0.1
    assert max(losses_of) > 0.05
    of = [torch.from_numpy(a) for a in (p, t, filled)]
    of[0].requires_grad_()
    got = losses.beside_fill_loss(*of, c)
    assert got.item() == pytest.approx(np.mean(losses_of), abs=1e-9)
    got.backward()
    assert of[0].grad.isfinite().all()


def test_the_loss_of_unsteady_depth_is_its_definition() -> None:
    rng = np.random.default_rng(5)
    filled, p = rng.uniform(0.3, 2, (6, 7, 9)), rng.uniform(0.2, 2, (6, 7, 9))
    raw = np.where(rng.random(filled.shape) < 0.4, 0, 1.0)
    raw[2] = 1.0  # without a hole
    filled[4, :3] = 0
    c = config.LossConfig(space="fill", steady=1.0, far_m=2.5)
    parts = []
    for i in range(3):
        changes: dict[str, list[float]] = {"filled": [], "p": []}
        for y, x in np.argwhere(raw[i] == 0):
            if min(filled[i, y, x], filled[3 + i, y, x]) * 2.5 >= 1:
                for name, of in (("filled", filled), ("p", p)):
                    changes[name].append(abs(1 / of[i, y, x] - 1 / of[3 + i, y, x]))
        mean = {name: sum(each) / max(len(each), 1) for name, each in changes.items()}
        parts.append(max(mean["p"] / (mean["filled"] + 0.002) - 0.8, 0))
    assert max(parts) > 0.05
    assert parts[2] == 0
    of = [torch.from_numpy(a) for a in (p, raw, filled)]
    of[0].requires_grad_()
    got = losses.unsteady_loss(*of, c)
    assert got.item() == pytest.approx(np.mean(parts), abs=1e-9)
    got.backward()
    assert of[0].grad.isfinite().all()


def test_a_crop_comes_twice_with_the_noise_of_the_sensor(tmp_path: Path) -> None:
    make_shards(tmp_path / "data")
    options = {"crop": [32, 48], "batch": 3, "loss.space": "fill"}
    first = config.read(make_config(tmp_path, "first", **options))
    twice = config.read(make_config(tmp_path, "twice", **options, **{"loss.steady": 0.1}))
    sources = [open_source(config.DataConfig("shards", str(tmp_path / "data")))]
    alone, both = batches.Batches(sources, first)[5], batches.Batches(sources, twice)[5]
    assert both["names"] == 2 * alone.pop("names")
    for name, plane in alone.items():
        torch.testing.assert_close(both[name][:3], plane, rtol=0, atol=0)
    once, again = ({n: p.numpy()[of] for n, p in both.items() if n != "names"} for of in (np.s_[:3], np.s_[3:]))
    np.testing.assert_array_equal(once["truth"], again["truth"])
    assert not np.array_equal(once["color"], again["color"])
    np.testing.assert_allclose(once["color"], again["color"], atol=2.001 / 255)
    assert not (again["raw"][once["raw"] == 0] > 0).any()
    same = batches.Batches(sources, twice)[5]
    assert all(torch.equal(both[n], same[n]) for n in once)

    # A wall of many cells: as much noise as is said, and filled depth as filling the other image gives it.
    wall = np.full((400, 600), 2.0, np.float32)
    wall[100:180, 100:220] = 0
    planes = {"raw": wall, "filled": fill(np.where(wall > 0, 0.5, 0)), "truth": wall, "color": np.zeros((3, *wall.shape), np.float32)}
    noisy = batches.again(batches.Example("wall", planes), np.random.default_rng(1)).planes
    left = noisy["raw"] > 0
    assert (1 / noisy["raw"][left]).std() == pytest.approx(0.1 / (0.05 * 385), rel=0.03)
    assert left[wall > 0].mean() == pytest.approx(0.99, abs=0.004)
    np.testing.assert_allclose(noisy["filled"], fill(np.where(left, 1 / np.where(left, noisy["raw"], 1), 0)), rtol=1e-4)
    # Behind a covered lens nothing becomes known.
    empty = {**planes, "raw": np.zeros_like(wall), "filled": np.zeros_like(wall)}
    dark = batches.again(batches.Example("dark", empty), np.random.default_rng(1)).planes
    assert not dark["raw"].any() and not dark["filled"].any()
    off = noisy["raw"][0::4, 0::4]
    for y, x in ((1, 2), (3, 3)):
        np.testing.assert_array_equal(noisy["raw"][y::4, x::4], off)


def test_the_losses_of_noise_models() -> None:
    rng = np.random.default_rng(2)
    logits, raw = (
        rng.standard_normal((2, 5, 6)),
        np.where(rng.random((2, 5, 6)) < 0.4, 0, rng.uniform(0.5, 3, (2, 5, 6))),
    )
    seen = rng.random(raw.shape) < 0.7
    p = 1 / (1 + np.exp(-logits))
    want = -np.mean(np.where(raw == 0, np.log(p), np.log(1 - p))[seen])
    tensors = [torch.from_numpy(a) for a in (logits, raw, seen)]
    assert losses.hole_loss(*tensors).item() == pytest.approx(want)
    assert losses.hole_loss(tensors[0], tensors[1], torch.zeros(2, 5, 6, dtype=torch.bool)).item() == 0
    for stereo in (True, False):
        perfect = torch.where(tensors[1] > 0, 1 / tensors[1] if stereo else tensors[1], 9.0)
        assert losses.value_loss(0.3 * perfect + 7, tensors[1], stereo).item() == pytest.approx(0, abs=1e-5)
        assert losses.value_loss(-perfect, tensors[1], stereo).item() > 0.5
    holes = torch.zeros(1, 3, 3, requires_grad=True)
    losses.value_loss(holes, torch.zeros(1, 3, 3), True).backward()
    assert not holes.grad.any()


def slow_metrics(p: np.ndarray, t: np.ndarray, chosen: np.ndarray) -> dict[str, dict[str, float]]:
    pairs = [
        (float(p[i]), float(t[i]))
        for i in np.ndindex(t.shape)
        if chosen[i] and math.isfinite(t[i]) and 0.1 <= t[i] <= 6
    ]
    has = [(a, b) for a, b in pairs if math.isfinite(a) and a > 0]
    both = {"plain": has, "strict": [(a if math.isfinite(a) and a > 0 else 0.0, b) for a, b in pairs]}
    out: dict[str, dict[str, float]] = {}
    for name, each in both.items():
        n = len(each)
        out[name] = {
            "l1_m": sum(abs(a - b) for a, b in each) / n,
            "rmse_m": math.sqrt(sum((a - b) ** 2 for a, b in each) / n),
            "abs_rel": sum(abs(a - b) / b for a, b in each) / n,
        }
        for delta, limit in (("δ0.5", 1.25**0.5), ("δ1", 1.25), ("δ1.05", 1.05), ("δ1.10", 1.1)):
            out[name][delta] = sum(a > 0 and max(a / b, b / a) < limit for a, b in each) / n
    return out


def test_metrics_are_their_definition() -> None:
    rng = np.random.default_rng(3)
    images = []
    for _ in range(3):
        t = np.where(rng.random((9, 11)) < 0.2, 0, rng.uniform(0.05, 8, (9, 11)))
        t[0, 0] = np.nan
        p = t * np.exp(0.1 * rng.standard_normal(t.shape))
        p = np.where(rng.random(t.shape) < 0.2, rng.choice([0, -1, np.nan, np.inf], t.shape), p)
        images.append((p, t, rng.integers(0, 6, t.shape).astype(np.uint8)))

    def same(got: metrics.Metrics, want: dict[str, dict[str, float]]) -> None:
        for kind, scores in (("plain", got.plain), ("strict", got.strict)):
            flat = {"l1_m": scores.l1_m, "rmse_m": scores.rmse_m, "abs_rel": scores.abs_rel, **scores.within}
            for name, value in flat.items():
                assert value == pytest.approx(want[kind][name], abs=1e-9), (kind, name)

    measured = [metrics.measure(p, t, material=m) for p, t, m in images]
    rows = metrics.pooled(measured)
    p, t, m = (np.concatenate(each) for each in zip(*images, strict=True))
    same(rows["pixels"], slow_metrics(p, t, np.ones(t.shape, bool)))
    for number, name in enumerate(MATERIALS):
        same(rows[f"pixels, {name}"], slow_metrics(p, t, m == number))
    single = [slow_metrics(p, t, np.ones(t.shape, bool)) for p, t, _ in images]
    mean = {k: {n: float(np.mean([s[k][n] for s in single])) for n in single[0][k]} for k in ("plain", "strict")}
    same(rows["images"], mean)
    assert "missing" in metrics.table(rows)


def test_metrics_at_their_limits() -> None:
    one = np.ones((2, 2))
    empty = metrics.pooled([metrics.measure(one, 0 * one)])["pixels"]
    assert math.isnan(empty.plain.l1_m)
    assert math.isnan(empty.strict.l1_m)
    none = metrics.measure(0 * one, one).whole.scores()
    assert math.isnan(none.plain.l1_m)
    assert (none.strict.l1_m, none.strict.within["δ1"], none.missing_percent) == (1, 0, 100)
    # The threshold itself is not within.
    assert metrics.measure(1.25 * one, one).whole.scores().plain.within["δ1"] == 0
    for bad in ((one[1:], one), (one, one, 0.0, 1.0), (one, one, 2.0, 1.0)):
        with pytest.raises(LabError):
            metrics.measure(*bad)


def test_filling_keeps_what_was_measured_and_leaves_no_hole() -> None:
    rng = np.random.default_rng(4)
    plane = np.fromfunction(lambda y, x: 0.5 + 0.002 * x + 0.003 * y, (45, 61))
    holes = rng.random(plane.shape) < 0.5
    holes[10:20, 10:25] = True
    got = fill(np.where(holes, 0, plane))
    np.testing.assert_array_equal(got[~holes], plane[~holes].astype(np.float32))
    assert np.abs(got - plane).max() < 0.03
    assert not fill(np.zeros((5, 7))).any()
    lone = np.zeros((33, 70))
    lone[3, 4] = 0.7
    np.testing.assert_allclose(fill(lone), 0.7, rtol=1e-6)


def test_nan_is_null_in_json() -> None:
    assert train._without_nan({"a": {"b": math.nan, "c": 1.5}, "d": 2}) == {"a": {"b": None, "c": 1.5}, "d": 2}


def test_schedules() -> None:
    def rates(**options: Any) -> list[float]:
        base = config.Config("a", "b", (config.DataConfig("shards", "x"),))
        c = dataclasses.replace(base, train=config.TrainConfig(steps=100, **options))
        return [train.rate_at(c, s) for s in range(100)]

    one = rates(schedule="onecycle")
    assert np.argmax(one) == 30
    assert one[30] == 1
    assert one[0] == pytest.approx(0.04)
    assert one[-1] < 0.01
    assert rates(schedule="cosine", warmup=10)[:10] == pytest.approx([(i + 1) / 10 for i in range(10)])
    assert set(rates(schedule="constant")) == {1.0}


def test_each_kind_of_model_trains(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    small = Size(24, 4, 2, (0, 1, 2, 3), 16, (8, 16, 24, 32))
    monkeypatch.setitem(SIZES, "vits", small)
    path = make_config(tmp_path, steps=3, crop=[28, 42], rate=1e-3, head_rate=10.0)
    for i, (kind, more) in enumerate((("cdm", ""), ("hole", ""), ("value", ""), ("value", "refined_input = true\n"))):
        text = path.read_text().replace("[model]\nwidth = 8\n", f'[model]\nkind = "{kind}"\n{more}')
        text = text.replace("[train]\n", f"[train]\nbf16 = {str(i == 0).lower()}\n")
        read = config.parse(text + '[synthesis]\nsensor = "stereo"\n')
        data = dataclasses.replace(read.data[0], path=str(tmp_path / "data"))
        folder = train.run(dataclasses.replace(read, folder=str(tmp_path / f"{i}"), data=(data,), check=(data,)))
        first = lines(folder)[0]
        assert json.loads(first)["loss"] > 0
        found = json.loads((folder / "metrics.json").read_text())
        assert bool(found) == (kind == "cdm")
        # Encoders learn more slowly than the rest.
        net = train._Trainer(read, folder, [open_source(data)], [])
        rates = {g["factor"]: len(g["params"]) for g in net.optimizer.param_groups}
        assert set(rates) == {1.0, 10.0}
        assert net.step == 3


def test_raw_depth_is_made_where_there_is_none(tmp_path: Path) -> None:
    read = config.parse(make_config(tmp_path).read_text() + '\n[synthesis]\nsensor = "stereo"\nfocal_baseline = 3.0\n')
    bare = dataclasses.replace(sample(0, 40, 56), raw=None)
    made = [batches.raw_of(bare, read, np.random.default_rng(seed)) for seed in (1, 1, 2)]
    np.testing.assert_array_equal(made[0], made[1])
    assert not np.array_equal(made[0], made[2])
    own = sample(0, 40, 56)
    assert batches.raw_of(own, read, np.random.default_rng(1)) is own.raw
