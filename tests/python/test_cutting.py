"""Real images recorded, cut, joined, compared and written out again, with Pillow and NumPy as the judges.

Configuration, cameras and the running of the binary are those of `test_daemon`.
"""

from __future__ import annotations

import csv
import hashlib
import json
import subprocess
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from test_daemon import CAMERAS, WAIT_S, Camera, binary, command, environment, rig_file, running, runtime

__all__ = ["binary", "rig_file", "runtime"]


@pytest.fixture(scope="module")
def dataset(binary: str, runtime: Path, rig_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two seconds of all real images."""
    folder = tmp_path_factory.mktemp("recorded")
    arguments = ("run", str(rig_file), "--record", str(folder), "--seconds", "2")
    with running(binary, runtime, folder / "log", *arguments) as daemon:
        daemon.wait(WAIT_S)
    (found,) = sorted(p.parent for p in folder.rglob("session.toml"))
    return found


def code(binary: str, runtime: Path, *arguments: str) -> tuple[int, str]:
    done = subprocess.run(
        [binary, *arguments], env=environment(runtime), capture_output=True, text=True, timeout=WAIT_S, check=False
    )
    return done.returncode, done.stdout + done.stderr


def rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "frames.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def by_name(name: str) -> Camera:
    return next(c for c in CAMERAS if c.name == name)


def fingerprint(folder: Path) -> dict[str, str]:
    return {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in sorted(folder.iterdir())}


@pytest.mark.parametrize("form", ["png", "npy"])
def test_cat_writes_the_images_that_the_cameras_saw(
    binary: str, runtime: Path, dataset: Path, tmp_path: Path, form: str
) -> None:
    out = tmp_path / "frames"
    command(binary, runtime, "cat", str(dataset), "--every", "3", "--format", form, "--out", str(out))
    listed = rows(out)
    assert {r["stream"] for r in listed} == {f"{c.name}/{s}" for c in CAMERAS for s in ("color", "depth")}
    assert sorted(str(p.relative_to(out)) for p in out.rglob(f"*.{form}")) == sorted(r["file"] for r in listed)
    for row in listed:
        camera, stream = row["stream"].split("/")
        source = by_name(camera).source(stream)
        path = out / row["file"]
        image = np.load(path) if form == "npy" else np.asarray(Image.open(path))
        assert image.shape == source.shape
        if stream == "depth":
            assert image.dtype == np.uint16 or image.dtype == np.int32  # Pillow's name of 16 bits
            assert float(row["depth_unit_m"]) == by_name(camera).depth_unit_m
            np.testing.assert_array_equal(image, source)
        elif by_name(camera).color.endswith(".png"):
            assert image.dtype == np.uint8
            np.testing.assert_array_equal(image, source)
        else:  # two JPEG decoders may round differently
            assert np.abs(image.astype(np.int16) - source).mean() < 2
    returned, text = code(binary, runtime, "cat", str(dataset), "--out", str(out))
    assert returned == 1
    assert "is not empty" in text


def test_a_list_of_frames_is_one_json_object_a_line(binary: str, runtime: Path, dataset: Path) -> None:
    lines = command(binary, runtime, "cat", str(dataset), "--at", "1", "--json").splitlines()
    frames = [json.loads(line) for line in lines]
    (number,) = {f["set"] for f in frames}
    # On a busy computer a set may lack an image.
    listed = [json.loads(line) for line in command(binary, runtime, "cat", str(dataset), "--json").splitlines()]
    assert len({f["stream"] for f in listed}) == 2 * len(CAMERAS)
    assert frames == [f for f in listed if f["set"] == number]
    for frame in frames:
        assert frame["capture_time_ns"] <= frame["arrival_time_ns"] <= frame["publish_time_ns"]


def test_cut_and_joined_it_is_the_same_recording(
    binary: str, runtime: Path, dataset: Path, tmp_path: Path
) -> None:
    before = fingerprint(dataset)
    frames = [json.loads(line) for line in command(binary, runtime, "cat", str(dataset), "--json").splitlines()]
    ids = sorted({frame["set"] for frame in frames})
    middle = ids[len(ids) // 2]
    first, second, joined = (str(tmp_path / name) for name in ("first", "second", "joined"))
    command(binary, runtime, "trim", str(dataset), first, "--to", "1.0")
    command(binary, runtime, "trim", str(dataset), second, "--first-set", str(ids[1]))
    report = json.loads(command(binary, runtime, "merge", joined, second, first, "--json"))
    assert report["sets"] == len(ids)
    assert report["repeated"] > 0
    for part in (first, second, joined):
        command(binary, runtime, "verify", part, "--decode")
    equal = json.loads(
        command(binary, runtime, "compare", str(dataset), joined, "--strict", "--pixels", "stored", "--json")
    )
    assert equal["equal"]
    assert equal["frames"] == len(frames)  # on a busy computer a set may lack an image
    returned, text = code(binary, runtime, "compare", str(dataset), first)
    assert returned == 1
    assert "DIFFERENT" in text
    # A part missing in the middle is reported with an exit code of its own.
    command(binary, runtime, "trim", str(dataset), str(tmp_path / "end"), "--first-set", str(middle + 2))
    command(binary, runtime, "trim", str(dataset), str(tmp_path / "begin"), "--last-set", str(middle))
    parts = (str(tmp_path / "begin"), str(tmp_path / "end"))
    returned, text = code(binary, runtime, "merge", str(tmp_path / "gap"), *parts)
    assert returned == 3, text
    assert "1 sets between set" in text
    assert code(binary, runtime, "verify", str(tmp_path / "gap"))[0] == 3
    # Existing files are not touched, and neither is the source.
    assert code(binary, runtime, "trim", str(dataset), first)[0] == 1
    assert code(binary, runtime, "trim", str(dataset), str(tmp_path / "none"), "--from", "99")[0] == 2
    assert code(binary, runtime, "trim", str(dataset), str(tmp_path / "none"), "--from", "yesterday")[0] == 2
    assert not (tmp_path / "none").exists()
    assert not list(tmp_path.glob("*.part"))
    assert fingerprint(dataset) == before
