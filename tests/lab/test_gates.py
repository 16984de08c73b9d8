"""Gates of `tiny` and the files that ship: against slow forms, and the whole recipe in five steps."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

if sys.version_info < (3, 11):
    pytest.skip("depthrig.lab needs Python 3.11", allow_module_level=True)
torch = pytest.importorskip("torch")

from depthrig.lab import LabError, config, gates, holes, ship, train
from depthrig.lab.batches import example
from depthrig.lab.fill import filled_of
from depthrig.lab.images import encode_png
from depthrig.lab.nets.tiny import Tiny, tiny_inputs
from depthrig.lab.shards import Shard, ShardWriter

from made import sample

FACTS = {"sensor": "d435", "sensor_model": "statistical", "seed": 1, "families": ["box"], "scene": "table"}


def with_filled(seed: int, height: int = 64, width: int = 96) -> Any:
    """A sample whose filled depth is not that of the stand-in."""
    made = sample(seed, height, width)
    assert made.raw is not None
    filled = np.where(made.raw > 0, made.raw, np.float32(0.7 + 0.01 * seed)).astype(np.float32)
    return dataclasses.replace(made, filled=filled)


def shards(folder: Path, count: int, first: int = 0) -> Path:
    folder.mkdir()
    with ShardWriter(folder / "t-000000.tar") as writer:
        for i in range(count):
            writer.write(first + i, with_filled(first + i), FACTS)
    return folder


def worse_net(seed: int = 0) -> Tiny:
    """A network that is not the identity."""
    torch.manual_seed(seed)
    net = Tiny(8)
    torch.nn.init.normal_(net.together.weight, std=0.02)
    return net.eval()


def identity() -> Tiny:
    """A network that goes no part of the way to any guess."""
    net = Tiny(8)
    assert net.together.bias is not None
    torch.nn.init.constant_(net.together.bias[:-1], -30.0)
    return net.eval()


def test_filled_depth_of_a_shard_is_used(tmp_path: Path) -> None:
    read = Shard(shards(tmp_path / "a", 2) / "t-000000.tar")[1]
    made = with_filled(1)
    assert read.filled is not None
    np.testing.assert_allclose(read.filled, made.filled, atol=5e-4)
    text = 'name = "a"\nfolder = "f"\n[[data]]\nkind = "shards"\npath = "p"\n[train]\ncrop = [32, 48]'
    of = config.parse(text)
    got = example(read, of, np.random.default_rng(3)).planes
    hole = got["raw"] == 0
    assert hole.any()
    np.testing.assert_allclose(got["filled"][hole], 1 / 0.71, rtol=1e-3)
    np.testing.assert_allclose(got["filled"][~hole], 1 / got["raw"][~hole], rtol=1e-5)
    bare = example(dataclasses.replace(read, filled=None), of, np.random.default_rng(3)).planes
    assert abs(bare["filled"][hole] - 1 / 0.71).max() > 0.01
    empty = dataclasses.replace(read, filled=np.zeros((64, 96), np.float32))
    assert read.raw is not None
    assert filled_of(empty, read.raw).max() == 0


def test_refining_pads_as_the_daemon_does_and_unknown_stays_unknown() -> None:
    net = worse_net()
    made = with_filled(3, 37, 50)
    filled = (1 / made.filled).astype(np.float32)
    filled[:5, :5] = 0
    got = gates.refine(net, made.color, made.raw, filled)
    assert got.shape == (37, 50)
    assert (got[:5, :5] == 0).all()
    assert (got[5:] > 0).all()
    # The same by hand: pixel by pixel from the nearest one within.
    rows, columns = np.minimum(np.arange(48), 36), np.minimum(np.arange(64), 49)
    at = np.ix_(rows, columns)
    raw = np.where(made.raw > 0, 1 / np.maximum(made.raw, 1e-9), 0).astype(np.float32)
    planes = [torch.from_numpy(p[at])[None] for p in (raw, filled)]
    color = torch.from_numpy((made.color[at] / np.float32(255)).transpose(2, 0, 1))[None]
    with torch.no_grad():
        want = net(tiny_inputs(color, planes[1], planes[0]), planes[1])[0, :37, :50].numpy()
    np.testing.assert_allclose(got[filled > 0], 1 / want[filled > 0], rtol=1e-5)


def test_held_out_errors_are_those_of_a_slow_form(tmp_path: Path) -> None:
    folder = shards(tmp_path / "a", 3)
    net = worse_net()
    found = gates.held_out(net, folder)
    assert len(found) == 3
    for i, image in enumerate(found):
        one = Shard(folder / "t-000000.tar")[i]
        refined = gates.refine(net, one.color, one.raw, (1 / one.filled).astype(np.float32))
        sums: dict[str, list[float]] = {}
        near_edge = np.zeros(one.truth.shape, bool)
        height, width = one.truth.shape
        for y in range(height):
            for x in range(width):
                for dy, dx in ((0, 1), (1, 0)):
                    if y + dy < height and x + dx < width:
                        a, b = float(one.truth[y, x]), float(one.truth[y + dy, x + dx])
                        if min(a, b) > 0 and abs(a - b) > 0.05 * min(a, b):
                            # The later of the two, and all within three of it.
                            near_edge[max(y + dy - 3, 0) : y + dy + 4, max(x + dx - 3, 0) : x + dx + 4] = True
        for y in range(height):
            for x in range(width):
                t = float(one.truth[y, x])
                if not 0.1 <= t <= 6.0:
                    continue
                kinds = ["all", "holes" if one.raw[y, x] == 0 else "measured"]
                kinds += ["edges"] if near_edge[y, x] and 3 < y < height - 4 and 3 < x < width - 4 else []
                kinds += [{1: "diffuse", 4: "glass"}[int(one.material[y, x])]]
                for kind in kinds:
                    of = sums.setdefault(kind, [0, 0.0, 0.0])
                    of[0] += 1
                    of[1] += abs(float(one.filled[y, x]) - t)
                    of[2] += abs(float(refined[y, x]) - t)
        for kind, (pixels, fill, tiny) in sums.items():
            row = image[kind]
            if kind == "edges":
                assert row.pixels >= pixels > 0  # borders are left out above
                continue
            assert row.pixels == pixels
            assert row.fill_m == pytest.approx(fill, rel=1e-4)
            assert row.tiny_m == pytest.approx(tiny, rel=1e-4)


def test_gates_are_reached_at_their_limits_and_not_beyond() -> None:
    def found(less: float, real: float, worse: float, real_worse: float) -> dict[str, Any]:
        scenes = {"less": less, "worse": worse}
        return {"held-out, mean of images": scenes, "real, mean of regions": {"less": real, "worse": real_worse}}

    assert all(g["reached"] for g in gates.judge(found(0.25, 0.05, 0.199, 0.199)).values())
    for bad in ((0.249, 0.05, 0.1, 0.1), (0.25, 0.049, 0.1, 0.1), (0.25, 0.05, 0.2, 0.1), (0.25, 0.05, 0.1, 0.2)):
        judged = [g["reached"] for g in gates.judge(found(*bad)).values()]
        assert judged.count(False) == 1
    rows = [gates.Row(10, 10.0, 5.0), gates.Row(1000, 100.0, 200.0), gates.Row(0, 0.0, 0.0)]
    line = gates._mean_line(rows)
    assert line["images"] == 2
    assert line["fill"] == pytest.approx((1.0 + 0.1) / 2)
    assert line["tiny"] == pytest.approx((0.5 + 0.2) / 2)
    assert line["worse"] == 0.5


def test_regions_are_of_many_sizes_and_the_same_for_a_seed() -> None:
    for kind in holes.KINDS:
        drawn = [holes.region(kind, (60, 80), np.random.default_rng(i)) for i in range(40)]
        shares = sorted(d.mean() for d in drawn)
        assert shares[0] < 0.1 < shares[-1] < 0.9
        np.testing.assert_array_equal(drawn[7], holes.region(kind, (60, 80), np.random.default_rng(7)))
    border = holes.region("border", (60, 80), np.random.default_rng(1))
    assert (border == border[:1]).all() or (border == border[:, :1]).all()


def fake_program(folder: Path) -> Path:
    """Fills holes with 1 m, as `depthrig cdm run` would write it."""
    path = folder / "depthrig"
    path.write_text(
        f"#!{sys.executable}\n"
        "import sys, numpy as np\n"
        f"sys.path[:0] = {[p for p in sys.path if p]!r}\n"
        "from depthrig.lab import images\n"
        "from pathlib import Path\n"
        "a = dict(zip(sys.argv, sys.argv[1:]))\n"
        "assert a['--engine'] == 'fill' and a['--fill-reach'] == '1' and '--inverse' in sys.argv\n"
        "z = images.grey(Path(a['--depth'])) * float(a['--depth-unit'])\n"
        "np.save(a['--out'], np.where(z > 0, 1 / np.where(z > 0, z, 1), 1).astype(np.float32))\n"
    )
    path.chmod(0o755)
    return path


def real_images(folder: Path) -> Path:
    for i in range(2):
        made = sample(i, 48, 64, holes=False)
        where = folder / "lingbot_depth" / str(i)
        where.mkdir(parents=True)
        (where / "rgb.png").write_bytes(encode_png(made.color))
        (where / "raw_depth.png").write_bytes(encode_png(np.rint(made.truth * 1000).astype(np.uint16)))
    return folder


def test_real_regions_compare_what_was_hidden_with_what_was_measured(tmp_path: Path) -> None:
    of = gates.pairs(real_images(tmp_path / "real"))
    assert [p.name for p in of] == ["lingbot_depth/0", "lingbot_depth/1"]
    # The identity: what the daemon filled comes out.
    found = gates.real(identity(), of, fake_program(tmp_path), draws=2)
    assert len(found) == 2 * len(holes.KINDS) * 2
    for hidden in found:
        assert hidden.row.pixels >= 100
        assert hidden.row.fill_m == pytest.approx(hidden.row.tiny_m, rel=1e-5)
        # Depth lies between 0.5 and 1.5 m, and holes were filled with 1 m.
        assert 0 < hidden.row.fill_m / hidden.row.pixels <= 0.51
    again = gates.real(identity(), of[1:], fake_program(tmp_path), draws=2)
    assert again == found[len(again) :]
    with pytest.raises(LabError, match="no real images"):
        gates.pairs(tmp_path)
    broken = tmp_path / "broken"
    broken.write_text("#!/bin/sh\necho no >&2\nexit 1\n")
    broken.chmod(0o755)
    with pytest.raises(LabError, match="cdm run failed: no"):
        gates.real(identity(), of, broken, draws=1)


def test_the_recipe_writes_both_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("onnx")
    import tomllib

    shards(tmp_path / "train", 4)
    shards(tmp_path / "held-out", 2, first=10)
    arguments = {"generator": "depthrig 1 scenes 2", "arguments": {"seed": 5, "hide": 0.5, "families": ["box"]}}
    (tmp_path / "train" / "t.json").write_text(json.dumps(arguments))
    path = tmp_path / "tiny.toml"
    path.write_text(
        'name = "tiny"\nfolder = "run"\nships = true\nseed = 4\n'
        '[[data]]\nkind = "shards"\npath = "train"\n[[check]]\nkind = "shards"\npath = "held-out"\n'
        '[model]\nwidth = 8\n[train]\nsteps = 5\nbatch = 2\ncrop = [32, 48]\nbf16 = true\nema = 0.5\n'
        'loss.space = "fill"\nloss.worse = 2.0\n'
    )
    real = real_images(tmp_path / "real")
    command = [str(path), "--real", str(real), "--depthrig", str(fake_program(tmp_path))]
    command += ["--out", str(tmp_path / "out")]
    assert ship.main(command) == 1, "before training"
    train.run(config.read(path))
    monkeypatch.setattr(gates, "DRAWS", 1)
    assert ship.main(command) == 0
    record = tomllib.loads((tmp_path / "out" / "tiny.toml").read_text())
    onnx = (tmp_path / "out" / "tiny.onnx").read_bytes()
    assert record["sha256"] == hashlib.sha256(onnx).hexdigest()
    assert record["architecture"] == "tiny"
    assert record["licence"] == "MIT OR Apache-2.0"
    assert set(record["gates"]) == set(gates.GATES)
    assert record["default"] is all(g["reached"] for g in record["gates"].values())
    assert record["data"]["train"]["seed"] == 5
    assert record["data"]["train"]["generator"] == "depthrig 1 scenes 2"
    run = json.loads((tmp_path / "run" / "run.json").read_text())
    assert record["data"]["train"]["sha256"] in run["data"].values()
    assert record["train"]["steps"] == 5
    assert record["train"]["seed"] == 4
    assert record["metrics"]["held-out"]["all"]["pixels"] > 0
    assert "train-before" not in record

    # A second run goes on from the weights of the first.
    after = tmp_path / "after.toml"
    text = path.read_text().replace('folder = "run"', 'folder = "after"').replace("width = 8", 'width = 8\nweights = "run/model.pt"')
    after.write_text(text.replace("steps = 5", "steps = 2\nloss.steady = 0.1"))
    train.run(config.read(after))
    assert ship.main([str(after), *command[1:]]) == 0
    record = tomllib.loads((tmp_path / "out" / "tiny.toml").read_text())
    assert record["train-before"]["steps"] == 5
    assert record["train"]["steps"] == 2
    assert record["train"]["loss"]["steady"] == 0.1
    (tmp_path / "run" / "run.json").rename(tmp_path / "elsewhere.json")
    assert ship.main([str(after), *command[1:]]) == 1
    assert "what ships says how its first weights were made" in capsys.readouterr().err
    (tmp_path / "elsewhere.json").rename(tmp_path / "run" / "run.json")
    monkeypatch.setattr(ship, "BYTES_MAX", 10)
    (tmp_path / "out" / "tiny.toml").unlink()
    assert ship.main(command) == 1, "too large"
    assert os.listdir(tmp_path / "out") == ["tiny.onnx"]
