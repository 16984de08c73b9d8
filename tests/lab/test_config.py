"""The configuration: every key is checked, errors name the line."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import pytest

if sys.version_info < (3, 11):
    pytest.skip("depthrig.lab needs Python 3.11", allow_module_level=True)

from depthrig.lab import LabError, config, record

GOOD = """\
name = "run"
folder = "runs/one"
[[data]]
kind = "shards"
path = "a"
[[data]]
kind = "hypersim"
path = "/b"
weight = 2
[model]
kind = "tiny"
[train]
crop = [64, 96]
loss.gradient = 1
"""


def test_a_configuration_is_read_and_defaults_fill_it() -> None:
    got = config.parse(GOOD)
    assert [d.path for d in got.data] == ["a", "/b"]
    assert got.data[1].weight == 2.0
    assert isinstance(got.data[1].weight, float)
    assert got.train.crop == (64, 96)
    assert got.train.loss == config.LossConfig(gradient=1.0)
    assert got.train.rate == config.TrainConfig().rate
    with pytest.raises(dataclasses.FrozenInstanceError):
        got.name = "other"  # type: ignore[misc]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (('kind = "tiny"', 'kind = "tiny"\nwidht = 3'), ["line 12", "model.widht", "width"]),
        (("weight = 2", "wieght = 2"), ["line 9", "data.1.wieght"]),
        (('name = "run"', 'nam = "run"'), ["line 1", "nam"]),
        (("crop = [64, 96]", "crop = [64]"), ["line 13", "train.crop", "2 are wanted"]),
        (("crop = [64, 96]", "crop = 64"), ["line 13", "not a list"]),
        (("crop = [64, 96]", "crop = [64, 90]"), ["multiples of 16"]),
        (('kind = "tiny"', 'kind = "giant"'), ["line 11", "giant", "tiny, cdm"]),
        (("weight = 2", "weight = true"), ["line 9", "bool", "float"]),
        (("weight = 2", "weight = -1"), ["line 9", "out of range"]),
        (("loss.gradient = 1", "loss.gradiant = 1"), ["line 14", "train.loss.gradiant"]),
        (('path = "/b"', ""), ["data.1.path is missing", "line 6"]),
        (("crop = [64, 96]", "crop = [64, 96]\nflip = true"), ["stereo"]),
        (
            ('kind = "tiny"\n[train]\ncrop = [64, 96]', 'kind = "cdm"\n[train]\nloss.space = "fill"\ncrop = [56, 98]'),
            ["loss.space", "tiny alone"],
        ),
        (("loss.gradient = 1", "loss.steady = 0.1"), ["loss.steady", 'loss.space = "fill"']),
        (("[model]", "[model"), ["line 10"]),
        (("[model]", "[modle]"), ["line 10", "modle"]),
    ],
)
def test_an_error_names_the_line_and_the_key(change: tuple[str, str], words: list[str]) -> None:
    text = GOOD.replace(*change)
    assert text != GOOD
    with pytest.raises(LabError) as e:
        config.parse(text, "x.toml")
    for word in ["x.toml", *words]:
        assert word in str(e.value)


def test_no_data_is_refused_and_paths_are_of_the_file(tmp_path: Path) -> None:
    with pytest.raises(LabError, match="no \\[\\[data\\]\\]"):
        config.parse('name = "a"\nfolder = "b"\ndata = []\n')
    (tmp_path / "c.toml").write_text(GOOD)
    got = config.read(tmp_path / "c.toml")
    assert got.folder == str(tmp_path / "runs/one")
    assert [d.path for d in got.data] == [str(tmp_path / "a"), "/b"]
    with pytest.raises(LabError, match=r"missing\.toml"):
        config.read(tmp_path / "missing.toml")
    (tmp_path / "c.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(LabError, match=r"c\.toml"):
        config.read(tmp_path / "c.toml")


def test_a_fingerprint_sees_names_sizes_and_bytes(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"1" * 100)
    (tmp_path / "b").write_bytes(b"2")
    files = [tmp_path / "a", tmp_path / "b"]
    first = record.fingerprint(files, tmp_path)
    assert record.fingerprint(reversed(files), tmp_path) == first
    (tmp_path / "a").write_bytes(b"1" * 99 + b"x")
    second = record.fingerprint(files, tmp_path)
    (tmp_path / "b").rename(tmp_path / "c")
    third = record.fingerprint([tmp_path / "a", tmp_path / "c"], tmp_path)
    assert len({first, second, third}) == 3


def test_a_folder_keeps_one_run(tmp_path: Path) -> None:
    pytest.importorskip("torch", reason="PyTorch is not installed")
    folder = tmp_path / "run"
    as_dict = dataclasses.asdict(config.parse(GOOD))
    record.keep(folder, as_dict, {"a": "1"})
    record.keep(folder, as_dict, {"a": "1"})
    with pytest.raises(LabError, match="data hashes"):
        record.keep(folder, as_dict, {"a": "2"})
    with pytest.raises(LabError, match="another seed"):
        record.keep(folder, {**as_dict, "seed": 9}, {"a": "1"})
    (folder / "run.json").write_text("{")
    with pytest.raises(LabError, match="not the record of a run"):
        record.keep(folder, as_dict, {"a": "1"})
