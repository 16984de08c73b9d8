"""Shards: what is written comes back, tar reads it, what was cut is refused by name."""

from __future__ import annotations

import dataclasses
import io
import json
import os
import subprocess
import sys
import tarfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

if sys.version_info < (3, 11):
    pytest.skip("depthrig.lab needs Python 3.11", allow_module_level=True)

from depthrig.lab import LabError, shards
from depthrig.lab.images import encode_png

from made import sample

FACTS = {"sensor": "d435", "sensor_model": "statistical", "seed": 2**64 - 1, "families": ["box"], "scene": "table"}


def make(folder: Path, counts: list[int]) -> list[Path]:
    number = 0
    paths = []
    for i, count in enumerate(counts):
        path = folder / f"made-{i:06d}.tar"
        with shards.ShardWriter(path) as writer:
            for _ in range(count):
                writer.write(number, sample(number), FACTS)
                number += 1
        paths.append(path)
    return paths


def raw_tar(path: Path, members: dict[str, bytes]) -> Path:
    """By Python's own tar, as another program writes it."""
    with tarfile.open(path, "w", format=tarfile.USTAR_FORMAT) as tar:
        for name, data in members.items():
            info = tarfile.TarInfo(name)
            info.size = len(data)
            tar.addfile(info, io.BytesIO(data))
    return path


def members(**changes: Any) -> dict[str, bytes]:
    grey = np.full((2, 3), 1000, np.uint16)
    facts = {"format": 1, "intrinsics": {"fx": 5, "fy": 5, "cx": 1, "cy": 1, "model": "none", "coeffs": [0.0] * 5}}
    facts |= {"truth_unit_m": 1e-4, "raw_unit_m": 1e-3, "width": 3, "height": 2, "licence": "MIT OR Apache-2.0"} | FACTS
    facts |= changes
    key = "0000000007"
    return {
        f"{key}.color.png": encode_png(np.full((2, 3, 3), 9, np.uint8)),
        f"{key}.truth.png": encode_png(grey),
        f"{key}.raw.png": encode_png(grey),
        f"{key}.json": json.dumps(facts).encode(),
    }


def test_samples_come_back(tmp_path: Path) -> None:
    make(tmp_path, [3, 2])
    (tmp_path / "made-000002.tar.part").write_bytes(b"")
    paths = shards.list_shards(tmp_path)
    assert [p.name for p in paths] == ["made-000000.tar", "made-000001.tar"]
    opened = [shards.Shard(p) for p in paths]
    assert [len(s) for s in opened] == [3, 2]
    got, want = opened[1][1], sample(4)
    np.testing.assert_array_equal(got.color, want.color)
    np.testing.assert_array_equal(got.truth, want.truth)
    np.testing.assert_array_equal(got.raw, want.raw)
    np.testing.assert_array_equal(got.material, want.material)
    assert got.intrinsics == want.intrinsics
    assert got.licence.ships
    with tarfile.open(paths[1]) as tar:
        names = tar.getnames()
        assert names[-1] == "0000000004.json"
        assert len(names) == 10
        assert json.load(tar.extractfile("0000000003.json"))["seed"] == 2**64 - 1  # type: ignore[arg-type]


def test_another_writers_shard_is_read(tmp_path: Path) -> None:
    got = shards.Shard(raw_tar(tmp_path / "x-000000.tar", members()))[0]
    assert got.truth is not None
    assert got.raw is not None
    assert got.truth[0, 0] == np.float32(0.1)
    assert got.raw[0, 0] == np.float32(1.0)
    assert got.material is None


def test_a_cut_shard_is_refused_wherever_it_is_cut(tmp_path: Path) -> None:
    (path,) = make(tmp_path, [2])
    data = path.read_bytes()
    cut = tmp_path / "cut-000000.tar"
    for size in [0, 100, 512, 700, len(data) // 2, len(data) - 1024, len(data) - 512, len(data) - 1]:
        cut.write_bytes(data[:size])
        with pytest.raises(LabError, match=r"cut-000000\.tar"):
            shards.Shard(cut)
        with pytest.raises(LabError, match=r"cut-000000\.tar"):
            list(shards.stream([cut], 1))


def test_damage_is_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "x-000000.tar"
    key = "0000000007"
    cases: list[tuple[dict[str, bytes], str]] = [
        (members(format=2), "format 2"),
        (members(width=4), "its json says 4x2"),
        (members(truth_unit_m=0), "depth unit"),
        (members(raw_unit_m="x"), "invalid json"),
        (members(intrinsics={"fx": 0, "fy": 1, "cx": 1, "cy": 1}), "intrinsics"),
        (members(intrinsics={"fx": 1}), "fy"),
        ({**members(), f"{key}.raw.png": b"no png"}, r"raw\.png: damaged"),
        ({**members(), f"{key}.raw.png": encode_png(np.zeros((2, 3), np.uint8))}, "uint8 pixels"),
        ({**members(), f"{key}.json": b"{"}, "invalid json"),
        ({**members(), f"{key}.json": b"[]"}, "invalid json"),
    ]
    for made, words in cases:
        with pytest.raises(LabError, match=words) as e:
            shards.Shard(raw_tar(path, made))[0]
        assert "x-000000.tar: sample 0000000007" in str(e.value)
    for gone, words in ((f"{key}.raw.png", "no raw.png"), (f"{key}.json", "no json")):
        made = members()
        del made[gone]
        with pytest.raises(LabError, match=words):
            shards.Shard(raw_tar(path, made))
        with pytest.raises(LabError, match=words):
            list(shards.stream([path], 1))
    with pytest.raises(LabError, match="unknown member"):
        shards.Shard(raw_tar(path, {**members(), "notes.txt": b""}))
    with pytest.raises(LabError, match="no samples"):
        shards.Shard(raw_tar(path, {}))
    with pytest.raises(LabError, match="no shards"):
        shards.list_shards(tmp_path / "..")


def test_an_exception_leaves_no_shard(tmp_path: Path) -> None:
    path = tmp_path / "x-000000.tar"
    bare = dataclasses.replace(sample(), intrinsics=None)
    with pytest.raises(LabError, match="no intrinsics"), shards.ShardWriter(path) as writer:
        writer.write(0, sample(), FACTS)
        writer.write(1, bare, FACTS)
    assert not list(tmp_path.iterdir())


def test_the_order_is_seeded_and_parts_are_disjoint(tmp_path: Path) -> None:
    paths = make(tmp_path, [4, 3, 5, 2])

    def names(**options: Any) -> list[str]:
        return [s.name for s in shards.stream(paths, buffer=3, **options)]

    every = sorted(names(seed=1))
    assert len(every) == 14
    assert names(seed=1) == names(seed=1)
    assert names(seed=1) != names(seed=2)
    assert names(seed=1) != names(seed=1, epoch=1)
    for n in (2, 3, 4, 7):
        of_parts = [names(seed=1, part=(k, n)) for k in range(n)]
        assert sorted(name for part in of_parts for name in part) == every
        assert all(of_parts)


def test_a_part_is_k_of_n() -> None:
    assert shards.part_of("3/4") == (3, 4)
    for bad in ("4/4", "1", "a/b", "-1/2", "1/0", ""):
        with pytest.raises(LabError, match="K/N"):
            shards.part_of(bad)


def test_depth_beyond_16_bits_is_none() -> None:
    units = shards.to_units(np.array([[0, 1e-5, 1e-4, 6.5535, 6.5536, 1e9]], np.float32), 1e-4)
    assert units.tolist() == [[0, 0, 1, 65535, 0, 0]]


@pytest.mark.skipif("DEPTHRIG_BIN" not in os.environ, reason="DEPTHRIG_BIN is not set")
def test_shards_of_the_generator_are_read(tmp_path: Path) -> None:
    command = [os.environ["DEPTHRIG_BIN"], "scenes", "--count", "4", "--camera", "d435,l515", "--out", str(tmp_path)]
    subprocess.run(command, check=True, capture_output=True, timeout=300)
    (shard,) = [shards.Shard(path) for path in shards.list_shards(tmp_path)]
    assert len(shard) == 4
    for got in (shard[i] for i in range(4)):
        assert got.raw is not None
        assert got.truth is not None
        assert got.material is not None
        assert got.color.shape == (*got.truth.shape, 3)
        assert got.raw.shape == got.truth.shape
        assert got.intrinsics is not None
        assert got.licence.ships
        both = (got.raw > 0) & (got.truth > 0)
        assert both.mean() > 0.3
        # In the same unit, and of the same pixels.
        assert np.median(np.abs(got.raw - got.truth)[both] / got.truth[both]) < 0.02
