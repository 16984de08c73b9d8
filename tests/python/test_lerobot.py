"""`depthrig export lerobot`: every row, image and number of the result, and the real LeRobot loader on it.

The tables are read with pyarrow, the images with Pillow; what must be in them comes from the source images, from
the golden dataset's bare pixels, and from the recording as Python's mcap reads it. The loader is that of the package
`lerobot`, which lives in an environment of its own (`make test` installs it) because it brings PyTorch.
"""

from __future__ import annotations

import io
import json
import os
import shutil
import signal
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import pyarrow.parquet as pq
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from PIL import Image
from test_daemon import CAMERAS, ROOT, WAIT_S, binary, environment, rig_file, runtime  # noqa: F401

LOADER = ROOT / ".venv-lerobot" / "bin" / "python"
GOLDEN = ["front_color", "front_depth", "front_ir_left", "near_depth"]
MISSING = ("near_depth", 2)
"""The golden dataset's third set lacks this stream."""


ATTEMPTS = 50 if os.environ.get("DEPTHRIG_LONG") else 6
"""How often an export is killed."""


@dataclass(frozen=True)
class Golden:
    dataset: Path
    expected: Path

    def pixels(self, stream: str, row: int) -> np.ndarray:
        """The pixels of a lossless stream in a set."""
        for p in json.loads((self.expected / "index.json").read_text())["images"]:
            if p["set"] == row + 1 and p["base"].removeprefix("/golden/").replace("/", "_") == stream:
                data = (self.expected / p["file"]).read_bytes()
                kind = {"16UC1": "<u2", "mono8": "u1", "rgb8": "u1"}[p["encoding"]]
                return np.frombuffer(data, kind).reshape(p["height"], p["width"], -1).squeeze()
        raise KeyError((stream, row))

    def stored(self, topic: str) -> dict[int, tuple[bytes, int]]:
        """The bytes that the recording holds, and the capture time, by row."""
        found = {}
        for segment in sorted(self.dataset.glob("seg_*.mcap")):
            with segment.open("rb") as file:
                reader = make_reader(file, decoder_factories=[DecoderFactory()])
                for _, _, message, decoded in reader.iter_decoded_messages(topics=[topic]):
                    row = round((message.log_time - 1_700_000_000_000_000_000) / 2e8)
                    found[row] = (bytes(decoded.data), message.publish_time)
        return found


@pytest.fixture(scope="module")
def golden(binary: str, tmp_path_factory: pytest.TempPathFactory) -> Golden:  # noqa: F811
    """The dataset that the example `golden` writes: two segments, JPEG colour, one stream missing once."""
    example = Path(binary).parent / "examples" / "golden"
    if not example.exists():
        subprocess.run(["cargo", "build", "-p", "depthrig-tests", "--example", "golden"], cwd=ROOT, check=True)
    folder = tmp_path_factory.mktemp("golden")
    found = Golden(folder / "golden", folder / "expected")
    subprocess.run([example, found.dataset, found.expected], check=True, timeout=WAIT_S)
    return found


@pytest.fixture(scope="module")
def recorded(binary: str, runtime: Path, rig_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:  # noqa: F811
    """Four seconds of the real images, colour without loss."""
    folder = tmp_path_factory.mktemp("real")
    command = [binary, "run", str(rig_file), "--record", str(folder), "--seconds", "4"]
    done = subprocess.run(
        command, env=environment(runtime), timeout=WAIT_S, capture_output=True, text=True, check=False
    )
    # 3: intact, but a busy computer may lose a frame.
    assert done.returncode in (0, 3), done.stdout + done.stderr
    (session,) = folder.rglob("session.toml")
    return session.parent


def export(binary: str, *arguments: object, code: int = 0, layout: str = "lerobot") -> dict:  # noqa: F811
    command = [binary, "export", layout, *map(str, arguments), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=WAIT_S, check=False)
    assert done.returncode == code, f"{command} ended with {done.returncode}:\n{done.stdout}\n{done.stderr}"
    return json.loads(done.stdout) if code in (0, 3) else {"error": done.stderr}


def rows(out: Path) -> list[dict]:
    """All rows in the order in which LeRobot concatenates the files."""
    files = sorted((out / "data").glob("*/*.parquet"))
    return [row for file in files for row in pq.read_table(file).to_pylist()]


def image(cell: dict) -> np.ndarray:
    """An image as Pillow decodes it, after a check against its file name."""
    magic = {".jpg": b"\xff\xd8", ".png": b"\x89PNG", ".tiff": b"II*\0"}[Path(cell["path"]).suffix]
    assert cell["bytes"].startswith(magic)
    return np.asarray(Image.open(io.BytesIO(cell["bytes"])))


def load(path: Path) -> dict:
    return json.loads(path.read_text())


def tree(out: Path) -> dict[str, bytes]:
    """Every file but the report, which names the folder."""
    files = [p for p in out.rglob("*") if p.is_file() and p.name != "export.json"]
    return {str(p.relative_to(out)): p.read_bytes() for p in files}


def test_two_episodes_of_a_dataset_with_a_missing_camera(binary: str, golden: Golden, tmp_path: Path) -> None:  # noqa: F811
    out = tmp_path / "out"
    report = export(binary, golden.dataset, golden.dataset, out)
    assert report == load(out / "export.json")
    counts = [(s["stream"], s["frames"], s["missing"]) for s in report["streams"]]
    missing = [int(stream == MISSING[0]) for stream in GOLDEN]
    assert counts == [(s.replace("_", "/", 1), 6 - m, m) for s, m in zip(GOLDEN, missing, strict=True)] * 2
    assert report["files"] == len(tree(out))
    assert report["bytes"] == sum(map(len, tree(out).values()))
    info = load(out / "meta" / "info.json")
    assert (info["codebase_version"], info["fps"], info["splits"]) == ("v3.0", 5, {"train": "0:2"})
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (2, 12, 1)
    assert info["video_path"] is None

    jpegs = golden.stored("/golden/front/color/image_compressed")
    depth_stamps = golden.stored("/golden/front/depth/image_raw")
    found = rows(out)
    assert len(found) == 12
    assert list(found[0]) == list(info["features"]), "columns and features are in the same order"
    for i, row in enumerate(found):
        n = i % 6
        assert (row["index"], row["frame_index"], row["episode_index"], row["task_index"]) == (i, n, i // 6, 0)
        assert row["timestamp"] == np.float32(n / 5)
        assert row["capture.utc_ns"] == 1_700_000_000_000_000_000 + n * 200_000_000
        assert row["capture.set_id"] == n + 1
        assert row["capture.utc_ns.front_depth"] == depth_stamps[n][1]
        assert row["capture.utc_ns.front_color"] == jpegs[n][1]
        assert row["observation.images.front_color"]["bytes"] == jpegs[n][0], "a stored JPEG stays what it is"
        for stream in GOLDEN[1:]:
            cell = row[f"observation.images.{stream}"]
            missing = (stream, n) == MISSING
            assert row[f"missing.{stream}"] is missing
            assert (row[f"capture.utc_ns.{stream}"] == 0) is missing
            pixels = image(cell)
            if missing:
                assert pixels.shape == (72, 128)
                assert not pixels.any()
            else:
                assert Path(cell["path"]).suffix == (".tiff" if stream.endswith("depth") else ".png")
                assert pixels.dtype == golden.pixels(stream, n).dtype
                np.testing.assert_array_equal(pixels, golden.pixels(stream, n))
        assert row["missing.front_color"] is False

    depth = info["features"]["observation.images.front_depth"]
    assert depth["shape"] == [120, 160, 1]
    assert (depth["info"]["is_depth_map"], depth["info"]["depth_unit"]) == (True, "mm")
    near = info["features"]["observation.images.near_depth"]["info"]
    assert (near["is_depth_map"], near["depthrig.depth_unit_m"]) == (True, 0.0001)
    assert "depth_unit" not in near, "LeRobot has no name for tenths of a millimetre"
    assert not info["features"]["observation.images.front_color"]["info"]["is_depth_map"]
    (stream,) = [s for s in load(out / "calibration.json")["episodes"][1]["streams"] if s["stream"] == "near/depth"]
    assert stream["intrinsics"]["fx"] == pytest.approx(1.1 * 128)
    assert stream["pose_on_mount"]["translation_m"] == [0.25, 0.0, 0.5]

    episodes = pq.read_table(out / "meta" / "episodes" / "chunk-000" / "file-000.parquet").to_pylist()
    assert [(e["length"], e["dataset_from_index"], e["dataset_to_index"]) for e in episodes] == [(6, 0, 6), (6, 6, 12)]
    assert [e["tasks"] for e in episodes] == [["a gradient with an edge"]] * 2
    assert episodes[0]["stats/observation.images.near_depth/count"] == [5], "a blank image is in no statistics"
    # For the libraries that know images by the footer alone.
    footer = pq.read_metadata(out / "data" / "chunk-000" / "file-000.parquet").metadata
    assert json.loads(footer[b"huggingface"])["info"]["features"]["observation.images.near_depth"]["_type"] == "Image"


def test_incomplete_sets_can_be_left_out(binary: str, golden: Golden, tmp_path: Path) -> None:  # noqa: F811
    out = tmp_path / "out"
    report = export(binary, "--incomplete", "leave-out", golden.dataset, out)
    assert any("1 sets that lack a frame are left out" in loss for loss in report["losses"])
    assert any("1 gaps in time (1 sets)" in loss for loss in report["losses"])
    assert (report["sets"], report["counters"], report["lost"]) == (5, {"sets that were left out": 1}, 0)
    missing = [int(stream == MISSING[0]) for stream in GOLDEN]
    assert [(s["frames"], s["missing"]) for s in report["streams"]] == [(5, m) for m in missing]
    assert report["frames"] == 5 * len(GOLDEN)
    found = rows(out)
    assert [row["capture.set_id"] for row in found] == [1, 2, 4, 5, 6]
    assert [row["frame_index"] for row in found] == [0, 1, 2, 3, 4]
    # A set that lacks only streams that are not exported is complete.
    arguments = ["--incomplete", "leave-out", "--stream", "front/depth"]
    report = export(binary, *arguments, golden.dataset, tmp_path / "one")
    assert len(rows(tmp_path / "one")) == report["sets"] == 6
    assert report["counters"] == {}
    assert [k for k in rows(tmp_path / "one")[0] if k.startswith("observation")] == ["observation.images.front_depth"]


def test_real_images_are_bit_equal(binary: str, recorded: Path, tmp_path: Path) -> None:  # noqa: F811
    out = tmp_path / "out"
    # On a busy machine a set may lack a frame.
    report = export(binary, "--incomplete", "leave-out", recorded, out)
    found = rows(out)
    assert 3 <= len(found) == report["sets"]
    lost = sum(report["counters"].values())
    assert sum(dataset["sets"] for dataset in report["datasets"]) == report["sets"] + lost
    for row in found:
        for camera in CAMERAS:
            depth = image(row[f"observation.images.{camera.name}_depth"])
            np.testing.assert_array_equal(depth, camera.source("depth"))
            if camera.color.endswith(".png"):
                color = image(row[f"observation.images.{camera.name}_color"])
                np.testing.assert_array_equal(color, camera.source("color"))


def test_a_set_that_cannot_be_read_is_blank_and_told(binary: str, golden: Golden, tmp_path: Path) -> None:  # noqa: F811
    damaged = tmp_path / "golden"
    shutil.copytree(golden.dataset, damaged)
    segment = damaged / "seg_0000.mcap"
    data = bytearray(segment.read_bytes())
    jpeg, _ = golden.stored("/golden/front/color/image_compressed")[1]
    data[data.index(jpeg) + len(jpeg) // 2] ^= 1
    segment.write_bytes(data)
    out = tmp_path / "out"
    report = export(binary, damaged, out, code=3)
    assert (report["sets"], report["lost"]) == (5, 1)
    assert any("seg_0000.mcap" in problem for problem in report["problems"])
    found = rows(out)
    assert [row["frame_index"] for row in found] == list(range(6))
    for row in found:
        n = row["frame_index"]
        lost = [row[f"missing.{stream}"] for stream in GOLDEN]
        assert lost == [n == 1 or (stream, n) == MISSING for stream in GOLDEN]
        assert row["capture.utc_ns"] == 1_700_000_000_000_000_000 + n * 200_000_000
        blank = image(row["observation.images.front_color"])
        assert blank.shape == (120, 160, 3)
        assert blank.any() != (n == 1)
        if n != 1:
            depth = image(row["observation.images.front_depth"])
            np.testing.assert_array_equal(depth, golden.pixels("front_depth", n))


def test_hdf5_of_a_dataset_with_a_missing_camera(binary: str, golden: Golden, tmp_path: Path) -> None:  # noqa: F811
    out, without = tmp_path / "out", tmp_path / "without"
    report = export(binary, golden.dataset, golden.dataset, out, layout="hdf5")
    assert report["bytes"] == (out / "demo.hdf5").stat().st_size
    jpegs = golden.stored("/golden/front/color/image_compressed")
    with h5py.File(out / "demo.hdf5") as file:
        assert (list(file), list(file["data"])) == (["data"], ["demo_0", "demo_1"]), "nobody judged an episode"
        assert "no actions" in " ".join(report["losses"]) and "actions" not in file["data/demo_0"]
        for demo in file["data"].values():
            assert list(demo["obs"]) == GOLDEN
            for row in range(6):
                for stream in GOLDEN:
                    image = demo["obs"][stream][row]
                    assert demo["missing"][stream][row] == ((stream, row) == MISSING)
                    if (stream, row) == MISSING:
                        assert not image.any() and demo["capture_utc_ns"][stream][row] == 0
                    elif stream == "front_color":
                        expected = np.asarray(Image.open(io.BytesIO(jpegs[row][0])))
                        np.testing.assert_array_equal(image, expected)
                        assert demo["capture_utc_ns"][stream][row] == jpegs[row][1]
                    else:
                        np.testing.assert_array_equal(image[..., 0], golden.pixels(stream, row))
            kinds = {stream: demo["obs"][stream].dtype for stream in GOLDEN}
        assert [kinds[stream] for stream in GOLDEN] == [np.uint8, np.uint16, np.uint8, np.uint16]
        facts = json.loads(file.attrs["depthrig"])
        assert {s["array"]: s["depth_unit_m"] for s in facts["streams"]}["near_depth"] == 0.0001
    export(binary, "--incomplete", "leave-out", golden.dataset, without, layout="hdf5")
    with h5py.File(out / "demo.hdf5") as full, h5py.File(without / "demo.hdf5") as less:
        kept = [row for row in range(6) if row != MISSING[1]]
        for stream in GOLDEN:
            before, after = full["data/demo_0/obs"][stream][:], less["data/demo_0/obs"][stream][:]
            np.testing.assert_array_equal(after, before[kept])
            assert not less["data/demo_0/missing"][stream][:].any()


@pytest.mark.parametrize("layout", ["lerobot", "hdf5"])
def test_nothing_is_overwritten(binary: str, golden: Golden, tmp_path: Path, layout: str) -> None:  # noqa: F811
    out = tmp_path / "out"
    out.mkdir()
    (out / "mine.txt").write_text("mine")
    assert "is not empty" in export(binary, golden.dataset, out, code=1, layout=layout)["error"]
    assert [p.name for p in out.iterdir()] == ["mine.txt"]
    done = tmp_path / "done"
    export(binary, golden.dataset, done, layout=layout)
    before = {name: (done / name).stat().st_mtime_ns for name in tree(done)}
    export(binary, golden.dataset, done, layout=layout)
    assert {name: (done / name).stat().st_mtime_ns for name in tree(done)} == before, "it was complete already"
    refused = export(binary, "--task", "another", golden.dataset, done, code=1, layout=layout)
    assert "differs in its options" in refused["error"]
    assert {name: (done / name).stat().st_mtime_ns for name in tree(done)} == before


def test_datasets_that_do_not_fit_are_refused(binary: str, golden: Golden, recorded: Path, tmp_path: Path) -> None:  # noqa: F811
    error = export(binary, golden.dataset, recorded, tmp_path / "out", code=2)["error"]
    assert "cannot be episodes of one export" in error
    assert "front/color" in error
    assert not (tmp_path / "out").exists()
    error = export(binary, "--stream", "front/nothing", golden.dataset, tmp_path / "out", code=2)["error"]
    assert "no stream front/nothing" in error
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("layout", ["lerobot", "hdf5"])
def test_a_killed_export_goes_on(binary: str, recorded: Path, tmp_path: Path, layout: str) -> None:  # noqa: F811
    """Killed at many moments, the export ends with the same result as in one run."""
    arguments = ["--stream", "lingbot_1/color", "--stream", "lingbot_1/depth", recorded, recorded]
    whole = tmp_path / "whole"
    started = time.monotonic()
    export(binary, *arguments, whole, layout=layout)
    length = time.monotonic() - started
    expected = tree(whole)
    resumed = 0
    for attempt in range(ATTEMPTS):
        out = tmp_path / f"killed{attempt}"
        for _ in range(3):
            command = [binary, "export", layout, *map(str, arguments), str(out)]
            process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            time.sleep(length * (attempt + 0.5) / ATTEMPTS)
            process.send_signal(signal.SIGKILL)
            if process.wait(WAIT_S) == 0:
                break
        else:
            resumed += any(out.glob(".part_*"))
            export(binary, *arguments, out, layout=layout)
        assert tree(out) == expected, f"attempt {attempt}"
        assert load(out / "export.json") == load(whole / "export.json")
    assert resumed > 0, "no attempt was killed in the middle"


@pytest.mark.skipif(not LOADER.exists(), reason="the lerobot package is not installed: make .venv-lerobot/.stamp")
def test_the_real_loader_finds_the_same(binary: str, golden: Golden, recorded: Path, tmp_path: Path) -> None:  # noqa: F811
    """The expectations are handed over as files, because the loader's Python has no reader of ours nor of MCAP."""
    real = [CAMERAS[0], CAMERAS[-1]]
    chosen = [f"--stream={camera.name}/{stream}" for camera in real for stream in ("color", "depth")]
    command, lengths, blank = [str(LOADER), str(Path(__file__).with_name("lerobot_loader.py"))], [], []
    for name, arguments in (("golden", [golden.dataset] * 2), ("real", [*chosen, recorded])):
        out, expected = tmp_path / name, tmp_path / f"{name}.expected"
        export(binary, *arguments, out)
        expected.mkdir()
        if name == "golden":
            jpegs = golden.stored("/golden/front/color/image_compressed")
            for n in range(6):
                (expected / f"front_color.{n}.jpg").write_bytes(jpegs[n][0])
                for stream in GOLDEN[1:]:
                    if (stream, n) != MISSING:
                        np.save(expected / f"{stream}.{n}.npy", golden.pixels(stream, n))
        else:
            for camera in real:
                np.save(expected / f"{camera.name}_depth.npy", camera.source("depth"))
                np.save(expected / f"{camera.name}_color.npy", camera.source("color"))
        command += [str(out), str(expected)]
        table = pq.read_table(out / "meta" / "episodes" / "chunk-000" / "file-000.parquet")
        lengths.append(table.column("length").to_pylist())
        rows = [row for file in (out / "data").rglob("*.parquet") for row in pq.read_table(file).to_pylist()]
        blank.append(sum(bool(value) for row in rows for key, value in row.items() if key.startswith("missing.")))
    env = {**os.environ, "HF_HOME": str(tmp_path / "hf"), "HF_HUB_OFFLINE": "1"}
    done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    said = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    assert len(said) == 2
    for found, episodes in zip(said, lengths, strict=True):
        assert (found["frames"], found["episodes"], found["fps"]) == (sum(episodes), len(episodes), 5)
    # All but the blank ones; four of each row. On a busy computer sets of the real images may lack some, too.
    assert blank[0] == 2
    assert [s["images_compared"] for s in said] == [2 * 6 * 4 - 2, 4 * sum(lengths[1]) - blank[1]]
