"""Stages on shards: the parts make what the whole makes, and workers that die are replaced."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import subprocess
import sys
import termios
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="PyTorch is not installed")

from depthrig.lab import LabError, make_shards, ray
from depthrig.lab.config import DataConfig, ModelConfig
from depthrig.lab.data import open_source
from depthrig.lab.nets import NoiseNet, noise_net
from depthrig.lab.nets.vit import SIZES, Size
from depthrig.lab.sample import Licence
from depthrig.lab.shards import ShardWriter, list_shards

from made import sample

FACTS = {"sensor": "d435", "sensor_model": "statistical", "seed": 1, "families": [], "scene": "table"}
DIES = """
import os, pathlib, signal, sys
part = sys.argv[-1].replace("/", "_")
folder = pathlib.Path(sys.argv[1])
first = folder / f"died_{part}"
if not first.exists():
    first.touch()
    if part.startswith("1"): sys.exit(3)
    os.kill(WHOM, signal.SIGKILL)
(folder / f"done_{part}").touch()
"""


def make_config(folder: Path, more: str = "") -> Path:
    (folder / "data").mkdir()
    with ShardWriter(folder / "data/made-000000.tar") as writer:
        for i in range(5):
            writer.write(i, sample(i, 40, 56), FACTS)
    text = 'name = "out"\nfolder = "run"\nships = true\n[[data]]\nkind = "shards"\npath = "data"\n'
    path = folder / "c.toml"
    path.write_text(text + f'[synthesis]\nsensor = "stereo"\nfocal_baseline = 4.0\n{more}')
    return path


def test_parts_make_what_the_whole_makes(tmp_path: Path) -> None:
    path = make_config(tmp_path)
    options = ["--per-shard", "2"]
    assert make_shards.main([str(path), str(tmp_path / "one"), *options]) == 0
    for k in range(2):
        assert make_shards.main([str(path), str(tmp_path / "two"), *options, "--shard", f"{k}/2"]) == 0
    one, two = list_shards(tmp_path / "one"), list_shards(tmp_path / "two")
    assert [p.name for p in one] == [f"out-{i:06d}.tar" for i in range(3)]
    assert [p.read_bytes() for p in one] == [p.read_bytes() for p in two]
    two[1].unlink()
    before = two[0].stat().st_mtime_ns
    assert make_shards.main([str(path), str(tmp_path / "two"), *options]) == 0
    assert two[1].read_bytes() == one[1].read_bytes()
    assert two[0].stat().st_mtime_ns == before
    source = open_source(DataConfig("shards", str(tmp_path / "one")))
    assert len(source) == 5
    for i in range(5):
        assert np.array_equal(source[i].truth, sample(i, 40, 56).truth)
        assert not np.array_equal(source[i].raw, sample(i, 40, 56).raw)


def test_a_folder_holds_shards_of_one_making(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = make_config(tmp_path)
    out = tmp_path / "out"

    def made(text: str, *options: str) -> tuple[int, str]:
        path.write_text(text)
        return make_shards.main([str(path), str(out), *options]), capsys.readouterr().err

    text = path.read_text()
    assert made(text, "--per-shard", "2") == (0, "")
    kept = {p.name: p.read_bytes() for p in out.iterdir()}
    for changed, options, what in (
        (f"seed = 9\n{text}", ("--per-shard", "2"), "seed"),
        (text.replace("4.0", "5.0"), ("--per-shard", "2"), "synthesis"),
        (text, ("--per-shard", "3"), "per shard"),
    ):
        code, said = made(changed, *options)
        assert code == 1 and f"another {what}" in said, said
    assert {p.name: p.read_bytes() for p in out.iterdir()} == kept
    # Another process at the same shard.
    (out / "out-000001.tar").unlink()
    with ShardWriter(out / "out-000001.tar") as writer:
        code, said = made(text, "--per-shard", "2")
        assert code == 1 and "another process writes this shard" in said
        assert writer.part.exists()
    assert not writer.part.exists(), "nothing was written to it"
    assert made(text, "--per-shard", "2") == (0, "")
    assert {p.name: p.read_bytes() for p in out.iterdir()} == kept
    # A shard of which every sample is left out makes no file, and the others are read.
    monkeypatch.setattr(make_shards, "_usable", lambda sample: "0000000004" not in sample.name)
    out = tmp_path / "few"
    assert made(text, "--per-shard", "2") == (0, "")
    assert [p.name for p in list_shards(out)] == ["out-000000.tar", "out-000001.tar"]
    assert len(open_source(DataConfig("shards", str(out)))) == 4


def test_data_of_two_licences_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = make_config(tmp_path)
    other = dataclasses.replace(sample(9, 40, 56), licence=Licence("MIT", ships=True))
    (tmp_path / "more").mkdir()
    with ShardWriter(tmp_path / "more/made-000000.tar") as writer:
        writer.write(0, other, FACTS)
    path.write_text(path.read_text().replace("[synthesis]", '[[data]]\nkind = "shards"\npath = "more"\n[synthesis]'))
    assert make_shards.main([str(path), str(tmp_path / "out")]) == 1
    assert "MIT, MIT OR Apache-2.0; make a folder of each" in capsys.readouterr().err
    assert not list(tmp_path.glob("out/*"))


def test_a_value_model_of_the_other_kind_of_sensor_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = make_config(tmp_path, 'value = "value.pt"\n')
    path.write_text(path.read_text() + '[model]\nkind = "value"\nencoder = "conv"\nwidth = 8\n')
    torch.save(noise_net(ModelConfig("value", "conv", 8)).state_dict(), tmp_path / "value.pt")
    assert make_shards.main([str(path), str(tmp_path / "unknown")]) == 0
    record = {"config": {"synthesis": {"sensor": "tof"}}}
    (tmp_path / "run.json").write_text(json.dumps(record))
    assert make_shards.main([str(path), str(tmp_path / "tof")]) == 1
    assert 'learned from sensor = "tof"' in capsys.readouterr().err
    (tmp_path / "run.json").write_text(json.dumps(record).replace("tof", "stereo"))
    assert make_shards.main([str(path), str(tmp_path / "stereo")]) == 0


def test_noise_models_draw_and_bad_ones_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    small = Size(24, 4, 2, (0, 1, 2, 3), 16, (8, 16, 24, 32))
    monkeypatch.setitem(SIZES, "vits", small)
    monkeypatch.setattr(make_shards, "SIDE", 42)
    torch.manual_seed(0)
    hole = NoiseNet(small)
    with torch.no_grad():
        hole.depth_head.scratch.output_conv2[2].bias.fill_(50)  # type: ignore[union-attr]
    torch.save(hole.state_dict(), tmp_path / "hole.pt")
    torch.save(NoiseNet(small).state_dict(), tmp_path / "value.pt")
    path = make_config(tmp_path, 'hole = "hole.pt"\nvalue = "value.pt"\n')
    with pytest.raises(LabError, match="raw depth is empty"):
        make_shards.main([str(path), str(tmp_path / "out")])
        open_source(DataConfig("shards", str(tmp_path / "out")))
    torch.save({"depth_head.projects.0.bias": torch.zeros(8)}, tmp_path / "hole.pt")
    assert make_shards.main([str(path), str(tmp_path / "other")]) == 1
    assert "hole.pt: no tensor" in capsys.readouterr().err
    for options, words in ((["--shard", "2/2"], "K/N"), (["--per-shard", "0"], "out of range")):
        assert make_shards.main([str(path), str(tmp_path / "x"), *options]) == 1
        assert words in capsys.readouterr().err


def test_parts_that_die_run_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = [sys.executable, "-c", DIES.replace("WHOM", "os.getpid()"), str(tmp_path)]
    assert ray.main(["3", "--local", "2", "--", *command]) == 0
    assert sorted(p.name for p in tmp_path.glob("done_*")) == [f"done_{k}_3" for k in range(3)]
    always = [sys.executable, "-c", "import sys; sys.exit('no such camera' if sys.argv[-1] == '1/3' else 0)"]
    assert ray.main(["3", "--local", "1", "--", *always]) == 1
    said = capsys.readouterr().err
    assert "1 of 3 parts failed" in said
    assert "--shard 1/3 ended with 1: no such camera" in said
    assert ray.main(["0", "--local", "1", "--", "true"]) == 1


def test_a_terminal_shows_how_many_parts_and_samples_are_done(tmp_path: Path) -> None:
    pytest.importorskip("tqdm", reason="tqdm is not installed")
    parts = ["ray", "3", "--local", "2", "--", "true"]
    shards = ["make_shards", str(make_config(tmp_path)), str(tmp_path / "out"), "--per-shard", "2"]
    # The second time all is there.
    for arguments, done in ((parts, "3/3"), (shards, "5/5"), (shards, "5/5")):
        ours, its = os.openpty()
        termios.tcsetwinsize(its, (24, 80))
        command = [sys.executable, "-m", f"depthrig.lab.{arguments[0]}", *arguments[1:]]
        subprocess.run(command, stderr=its, stdout=subprocess.DEVNULL, check=True)
        os.close(its)
        shown = b""
        with contextlib.suppress(OSError):  # the end of a terminal
            while more := os.read(ours, 1 << 16):
                shown += more
        os.close(ours)
        assert done in shown.decode(), shown


def test_parts_on_ray_whose_workers_die(tmp_path: Path) -> None:
    pytest.importorskip("ray", reason="ray is not installed")
    # The parent is Ray's worker.
    command = [sys.executable, "-c", DIES.replace("WHOM", "os.getppid()"), str(tmp_path)]
    ray.run_ray(command, 3)
    assert sorted(p.name for p in tmp_path.glob("done_*")) == [f"done_{k}_3" for k in range(3)]
