"""`depthrig eval` against NumPy, on shards of `depthrig scenes`, in parts, and on input that is damaged."""

from __future__ import annotations

import csv
import json
import re
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from depthrig.lab.metrics import THRESHOLDS, Sums, measure, pooled
from depthrig.lab.shards import Shard
from PIL import Image
from test_daemon import binary

__all__ = ["binary"]

WAIT_S = 120
NEAR_M, FAR_M = 0.1, 6.0
KEYS = {"δ0.5": "delta_05", "δ1": "delta_1", "δ1.05": "delta_105", "δ1.10": "delta_110"}
Depth = npt.NDArray[np.float64]


def run(binary: str, *arguments: object, codes: tuple[int, ...] = (0,)) -> subprocess.CompletedProcess[str]:
    command = [binary, "eval", "-q", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=WAIT_S, check=False)
    assert done.returncode in codes, f"{done.returncode}\n{done.stdout}\n{done.stderr}"
    return done


def evaluated(binary: str, *arguments: object, codes: tuple[int, ...] = (0,)) -> dict[str, Any]:
    evaluation: dict[str, Any] = json.loads(run(binary, *arguments, "--json", codes=codes).stdout)
    return evaluation


def row(evaluation: dict[str, Any], name: str, group: str = "") -> dict[str, Any]:
    (found,) = (r for r in evaluation["rows"] if r["name"] == name and group in ("", r["group"]))
    return dict(found)


def near(ours: float | None, theirs: float) -> bool:
    if ours is None or np.isnan(theirs):
        return ours is None and bool(np.isnan(theirs))
    return abs(ours - theirs) <= 1e-9 * (1 + abs(theirs))


@pytest.fixture(scope="module")
def shards(binary: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    folder = tmp_path_factory.mktemp("shards")
    arguments = ("--count", "7", "--per-shard", "3", "--size", "96x72", "--camera", "d435,l515", "--seed", "3")
    command = [binary, "scenes", "-q", *arguments, "--out", str(folder)]
    subprocess.run(command, check=True, capture_output=True, timeout=WAIT_S)
    return folder


def samples(folder: Path) -> list[tuple[str, Any]]:
    """Sensor and sample of every sample of the shards."""
    found = []
    for path in sorted(folder.glob("*.tar")):
        shard = Shard(path)
        for i, entry in enumerate(shard.entries):
            at, size = entry.members["json"]
            facts = json.loads(path.read_bytes()[at : at + size])
            found.append((facts["sensor"], shard[i]))
    return found


def nearest(raw: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Each hole with the least of the depths that are nearest to it, slowly; and the greatest of them."""
    ys, xs = np.nonzero(raw)
    low, high = raw.copy(), raw.copy()
    for y, x in zip(*np.nonzero(raw == 0), strict=True):
        far = (ys - y) ** 2 + (xs - x) ** 2
        values = raw[ys, xs][far == far.min()]
        low[y, x], high[y, x] = values.min(), values.max()
    return np.stack([low, high])


def test_shards_have_the_numbers_of_the_lab(binary: str, shards: Path) -> None:
    got = evaluated(binary, shards, "--refine", "fill", "--refine", "filled")
    groups: dict[str, list[Any]] = {}
    for sensor, sample in samples(shards):
        groups.setdefault(sensor, []).append(sample)
    assert sorted(groups) == ["d435", "l515"]
    assert [r["group"] for r in got["rows"]] == ["d435"] * 3 + ["l515"] * 3
    for sensor, of in groups.items():
        ours = row(got, "raw", sensor)
        assert ours["images"] == len(of)
        theirs = pooled([measure(s.raw, s.truth, NEAR_M, FAR_M, s.material) for s in of])
        materials = {f"pixels, {m['material']}": m for m in ours["by_material"]}
        forms = {"pixels": ours["pixel_pooled"], "images": ours["mean_of_images"]} | materials
        assert set(theirs) == set(forms)
        for form, metrics in theirs.items():
            mine = forms[form]
            for prefix, scores in (("", metrics.plain), ("strict_", metrics.strict)):
                assert near(mine[f"{prefix}l1_m"], scores.l1_m), (form, prefix)
                assert near(mine[f"{prefix}rmse_m"], scores.rmse_m), (form, prefix)
                assert near(mine[f"{prefix}abs_rel"], scores.abs_rel), (form, prefix)
                for name in THRESHOLDS:
                    assert near(mine[prefix + KEYS[name]], scores.within[name]), (form, name)
            assert near(mine["missing_percent"], metrics.missing_percent), form
        filled = row(got, "filled", sensor)
        assert (filled["input"], filled["mean_of_images"]["missing_percent"]) == ("filled", 0)
        # Between the least and the greatest error that ties allow.
        errors = []
        for s in of:
            counts = (s.truth >= NEAR_M) & (s.truth <= FAR_M)
            both = np.abs(nearest(s.raw).astype(np.float64) - s.truth)[:, counts]
            errors.append((both.min(axis=0).mean(), both.max(axis=0).mean()))
        least, most = np.mean(errors, axis=0)
        assert least - 1e-6 <= filled["mean_of_images"]["l1_m"] <= most + 1e-6
        assert row(got, "fill", sensor)["engine"].startswith("fill")


def test_differences_are_image_by_image(binary: str, shards: Path) -> None:
    got = evaluated(binary, shards, "--refine", "filled")
    for sensor in ("d435", "l515"):
        raw, filled = row(got, "raw", sensor), row(got, "filled", sensor)
        assert raw["difference"] is None
        found = filled["difference"]
        of = [s for name, s in samples(shards) if name == sensor]
        assert (found["to"], found["images"], found["sequences"]) == ("raw", len(of), len(of))
        wanted = filled["mean_of_images"]["strict_l1_m"] - raw["mean_of_images"]["strict_l1_m"]
        assert near(found["strict_l1_m"]["mean"], wanted)
        assert found["strict_l1_m"]["low"] <= wanted <= found["strict_l1_m"]["high"] <= 0


def test_parts_are_one_run(binary: str, shards: Path, tmp_path: Path) -> None:
    arguments = (shards, "--refine", "fill", "--threads", 2)
    parts = [tmp_path / f"{k}.jsonl" for k in range(3)]
    for k, part in enumerate(parts):
        run(binary, *arguments, "--shard", f"{k}/3", "--sums", part)
    merged = run(binary, "--merge", *reversed(parts), "--json").stdout
    assert merged == run(binary, *arguments, "--json").stdout
    tables = [tmp_path / "a.csv", tmp_path / "b.csv"]
    run(binary, *arguments, "--json", "--csv", tables[0])
    run(binary, "--merge", *parts, "--json", "--csv", tables[1])
    assert tables[0].read_bytes() == tables[1].read_bytes()
    # A complete part is left alone.
    before = parts[0].stat()
    run(binary, *arguments, "--shard", "0/3", "--sums", parts[0])
    assert parts[0].stat() == before
    # What is missing, given twice, of another run or cut is named.
    said = run(binary, "--merge", parts[0], parts[2], codes=(1,)).stderr
    assert "--shard 1/3" in said
    said = run(binary, "--merge", *parts, parts[1], codes=(2,)).stderr
    assert "are one part" in said
    other = tmp_path / "other.jsonl"
    run(binary, *arguments, "--max-m", 2, "--shard", "1/3", "--sums", other)
    said = run(binary, "--merge", parts[0], other, parts[2], codes=(2,)).stderr
    assert "two runs" in said and "range" in said
    other.unlink()
    run(binary, *arguments, "--scenes", "room,table", "--shard", "1/3", "--sums", other)
    said = run(binary, "--merge", parts[0], other, parts[2], codes=(2,)).stderr
    assert "two runs" in said and "--scenes room,table" in said
    said = run(binary, *arguments, "--shard", "1/3", "--sums", parts[0], codes=(2,)).stderr
    assert "other arguments" in said
    other.write_bytes(b"".join(parts[1].read_bytes().splitlines(keepends=True)[:-1]))
    said = run(binary, "--merge", parts[0], other, parts[2], codes=(1,)).stderr
    assert "not complete" in said


def test_a_killed_part_goes_on_where_it_was(binary: str, shards: Path, tmp_path: Path) -> None:
    arguments = (shards, "--refine", "fill", "--threads", 1)
    whole = tmp_path / "whole.jsonl"
    run(binary, *arguments, "--json", "--sums", whole)
    lines = whole.read_bytes().splitlines(keepends=True)
    assert len(lines) == 1 + 7 + 1
    for keep, cut in ((1, 0), (4, 0), (4, 30), (8, 5)):
        sums = tmp_path / f"{keep}-{cut}.jsonl"
        part = sums.with_name(sums.name + ".part")
        # A record that was changed shows which were measured anew.
        kept = [line.replace(b'"errors":', b'"errors" :') for line in lines[:keep]]
        part.write_bytes(b"".join(kept) + lines[keep][:cut])
        run(binary, *arguments, "--json", "--sums", sums)
        assert not part.exists()
        written = sums.read_bytes().splitlines(keepends=True)
        assert written[:keep] == kept
        assert written[keep:] == lines[keep:]


def test_a_run_that_is_killed_leaves_no_final_name(binary: str, shards: Path, tmp_path: Path) -> None:
    sums = tmp_path / "killed.jsonl"
    part = sums.with_name(sums.name + ".part")
    command = [binary, "eval", "-q", str(shards), "--refine", "fill", "--threads", "1", "--json", "--sums", str(sums)]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
        deadline = time.monotonic() + WAIT_S
        while process.poll() is None and not (part.exists() and part.read_bytes().count(b"\n") > 1):
            assert time.monotonic() < deadline
            time.sleep(0.005)
        process.send_signal(signal.SIGKILL)
    assert sums.exists() != part.exists(), "either complete or not"
    again = run(binary, *command[3:]).stdout
    assert again == run(binary, *command[3:-2]).stdout


def save(path: Path, depth: Depth, unit_m: float = 0.001) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.rint(depth / unit_m).astype(np.uint16)).save(path)


@pytest.fixture
def folders(tmp_path: Path) -> Path:
    """`truth`, `raw`, `rgb`, `material` and predictions `pred`, two scenes of three images each."""
    rng = np.random.default_rng(5)
    for scene in ("kitchen", "office"):
        for i in range(3):
            name = f"{scene}/{i}"
            truth = rng.uniform(0.3, 4.0, (20, 30))
            truth[rng.random(truth.shape) < 0.1] = 0
            raw = truth * rng.uniform(0.9, 1.1, truth.shape)
            raw[rng.random(raw.shape) < 0.2] = 0
            save(tmp_path / f"truth/{name}.png", truth)
            save(tmp_path / f"raw/{name}.png", raw)
            pred = (truth * rng.uniform(0.8, 1.2, truth.shape)).astype(np.float32)
            pred[0, :4] = (np.nan, np.inf, -np.inf, -1)
            (tmp_path / f"pred/{scene}").mkdir(parents=True, exist_ok=True)
            np.save(tmp_path / f"pred/{name}.npy", pred)
            for folder, image in (("rgb", rng.integers(0, 255, (20, 30, 3))), ("material", rng.integers(0, 7, (20, 30)))):
                path = tmp_path / f"{folder}/{name}.png"
                path.parent.mkdir(parents=True, exist_ok=True)
                Image.fromarray(image.astype(np.uint8)).save(path)
    return tmp_path


def pairs(folder: Path) -> tuple[object, ...]:
    return ("--truth", folder / "truth", "--raw", folder / "raw", "--rgb", folder / "rgb", "--pred", folder / "pred")


def depth_of(path: Path) -> npt.NDArray[np.float32]:
    with Image.open(path) as image:
        return (np.asarray(image) * 0.001).astype(np.float32)


def test_folders_have_materials_scenes_and_a_choice(binary: str, folders: Path) -> None:
    arguments = (*pairs(folders), "--material", folders / "material", "--refine", "fill")
    got = evaluated(binary, *arguments)
    assert [r["name"] for r in got["rows"]] == ["raw", "pred", "fill"]
    pred = row(got, "pred")
    assert [s["scene"] for s in pred["by_scene"]] == ["kitchen", "office"]
    assert pred["difference"]["sequences"] == 2
    assert [m["material"] for m in pred["by_material"]][-2:] == ["dark", "material 6"]
    # One material, slowly.
    total = Sums()
    for path in sorted((folders / "truth").rglob("*.png")):
        name = path.relative_to(folders / "truth").with_suffix("")
        with Image.open(folders / f"material/{name}.png") as image:
            chosen = np.asarray(image) == 4
        truth = np.where(chosen, depth_of(path), 0)
        total += measure(np.load(folders / f"pred/{name}.npy"), truth, 1e-9, 1e9).whole
    (glass,) = (m for m in pred["by_material"] if m["material"] == "glass")
    wanted = total.scores()
    assert glass["counted"] == wanted.counted
    assert near(glass["strict_l1_m"], wanted.strict.l1_m) and near(glass["rmse_m"], wanted.plain.rmse_m)
    # One scene is that scene of all.
    one = evaluated(binary, *arguments, "--scenes", "kit*")
    kitchen = {k: v for k, v in pred["by_scene"][0].items() if k != "scene"}
    assert {k: row(one, "pred")[k] for k in kitchen} == kitchen
    said = run(binary, *arguments, "--scenes", "attic", codes=(1,)).stderr
    assert "no scene or sequence attic; there are kitchen, office" in said


def test_like_the_authors_of_cdm(binary: str, folders: Path) -> None:
    far = depth_of(folders / "raw/office/0.png").astype(np.float64)
    far[3, 3:9] = 6.5
    save(folders / "raw/office/0.png", far)
    got = evaluated(binary, *pairs(folders), "--like-cdm")
    wanted: dict[str, list[list[float]]] = {"raw": [], "pred": []}
    for path in sorted((folders / "truth").rglob("*.png")):
        name = path.relative_to(folders / "truth").with_suffix("")
        truth = depth_of(path).astype(np.float64)
        raw = depth_of(folders / f"raw/{name}.png").astype(np.float64)
        raw[raw > FAR_M] = 0
        for key, p in (("raw", raw), ("pred", np.load(folders / f"pred/{name}.npy").astype(np.float64))):
            use = (truth >= NEAR_M) & (truth <= FAR_M) & np.isfinite(p)
            a, b = np.maximum(p[use], 0), truth[use]
            with np.errstate(divide="ignore"):
                factor = np.maximum(a / b, b / a)
            e = np.abs(a - b)
            shares = [float((factor < t).mean()) for t in (1.25**0.5, 1.25)]
            wanted[key].append([e.mean(), np.sqrt((e**2).mean()), (e / b).mean(), *shares])
    for key, each in wanted.items():
        mine = row(got, key)["mean_of_images"]
        names = ("l1_m", "rmse_m", "abs_rel", "delta_05", "delta_1")
        for name, value in zip(names, np.mean(each, axis=0), strict=True):
            assert near(mine[f"strict_{name}"], float(value)), (key, name)
    assert row(got, "pred")["not_finite"] > 0


def test_csv_has_every_number(binary: str, folders: Path) -> None:
    path = folders / "out.csv"
    got = evaluated(binary, *pairs(folders), "--material", folders / "material", "--csv", path)
    with path.open(newline="") as file:
        lines = list(csv.DictReader(file))
    assert {line["part"] for line in lines} == {"all", "distance", "material", "scene"}
    for name in ("raw", "pred"):
        for mean, form in (("images", "mean_of_images"), ("pixels", "pixel_pooled")):
            (line,) = (e for e in lines if (e["prediction"], e["part"], e["mean"]) == (name, "all", mean))
            for key, value in row(got, name)[form].items():
                assert float(line[key]) == value, key


def test_the_report_stands_alone_and_is_small(binary: str, shards: Path, tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    run(binary, shards, "--refine", "filled", "--refine", "fill", "--out", page)
    html = page.read_text()
    assert len(html) < 4_000_000
    assert not re.search(r"(?:src|href)=\"(?!data:)", html) and "<script" not in html
    for title in ("Error by material of d435", "Point clouds", "Worst images", "raw depth", "−0.1 m", "better"):
        assert title in html, title
    assert html.count("<figure>") == 2 * 4, "reference and three rows of two sensors"


def test_without_a_lens_there_is_no_cloud(binary: str, folders: Path) -> None:
    page = folders / "page.html"
    run(binary, *pairs(folders), "--out", page)
    assert "the intrinsics of this image are not known" in page.read_text()
    run(binary, *pairs(folders), "--out", page, "--overwrite", "--intrinsics", "30,30,15,10")
    html = page.read_text()
    assert "not known" not in html and html.count("<figure>") == 3


def test_bad_input_is_named(binary: str, folders: Path, shards: Path, tmp_path: Path) -> None:
    refine = (*pairs(folders), "--json", "--refine")
    # Units.
    said = run(binary, "--truth", folders / "truth", "--raw", folders / "raw", "--unit", 0.01, "--truth-unit", 0.001,
               "--json", "--sums", tmp_path / "sums", codes=(1,)).stderr  # fmt: skip
    assert re.search(r"raw depth is (10\.\d*|9\.\d*) times the truth in the median.*a tenth", said), said
    assert not list(tmp_path.glob("sums*")), "what was measured is of no use"
    # Refiners.
    for name in ("tensorflow", "cdm-d999"):
        said = run(binary, *refine, name, "--models", tmp_path / "models", codes=(1, 2)).stderr
        assert name in said and "is installed" in said and "fill" in said, said
    said = run(binary, *refine, "onnxruntime", codes=(2,)).stderr
    assert "needs a model" in said
    said = run(binary, *refine, "fill", "--refine", "fill", codes=(2,)).stderr
    assert "two rows are called fill" in said
    said = run(binary, "--truth", folders / "truth", "--pred", folders / "pred", "--refine", "fill", codes=(2,)).stderr
    assert "--raw" in said
    without = [a for a in pairs(folders) if a not in ("--rgb", folders / "rgb")]
    said = run(binary, *without, "--json", "--refine", "fill", codes=(1,)).stderr
    assert "no colour image" in said and "--rgb" in said
    # Sizes.
    np.save(folders / "pred/office/1.npy", np.ones((10, 15), np.float32))
    got = run(binary, *pairs(folders), "--json", codes=(3,))
    assert "office/1.npy: it has 15x10 pixels and its reference 30x20" in got.stderr
    assert json.loads(got.stdout)["rows"][0]["images"] == 5
    assert row(evaluated(binary, *pairs(folders), "--resize"), "pred")["images"] == 6
    # Nothing to count.
    said = run(binary, *pairs(folders), "--min-m", 50, "--json", codes=(1,)).stderr
    assert "no reference lies within 50 to inf m" in said
    for path in (folders / "raw").rglob("*.png"):
        save(path, np.zeros((20, 30)))
    said = run(binary, "--truth", folders / "truth", "--raw", folders / "raw", "--json", codes=(1,)).stderr
    assert "raw depth is empty in all of 5 images looked at" in said


def test_damaged_shards_are_named(binary: str, shards: Path, tmp_path: Path) -> None:
    whole = (shards / "scenes-000001.tar").read_bytes()
    shard = tmp_path / "scenes-000000.tar"
    for cut in (len(whole) // 2, len(whole) - 512, 700, 0):
        shard.write_bytes(whole[:cut])
        said = run(binary, tmp_path, "--json", codes=(1,)).stderr
        assert "scenes-000000.tar" in said and "cut short at byte" in said, said
    shard.write_bytes(whole[:100] + b"x" + whole[101:])
    assert "no tar header at byte 0" in run(binary, shard, "--json", codes=(1,)).stderr
    # A damaged image is one image.
    at = whole.index(b"IDAT") + 40
    shard.write_bytes(whole[:at] + bytes(200) + whole[at + 200 :])
    got = run(binary, shard, "--json", codes=(3,))
    assert "color.png" in got.stderr
    assert sum(r["images"] for r in json.loads(got.stdout)["rows"]) == 2
