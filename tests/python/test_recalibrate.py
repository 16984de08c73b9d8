"""Another calibration for a recorded dataset, read back with MCAP readers that are not ours, and killed on the way."""

from __future__ import annotations

import hashlib
import json
import random
import shutil
import subprocess
import time
import tomllib
from pathlib import Path

import depthrig
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from test_calibrate import CALIBRATION
from test_daemon import WAIT_S, binary, command, environment, running, runtime

__all__ = ["binary", "runtime"]

RIG = """
rig = "two"
[recording]
reserve_mb = 64
segment_max_s = 1
[[camera]]
name = "a"
backend = "synthetic"
model = "d455"
cheap = true
pose = { translation_m = [0.5, 0.0, 0.0] }
[[camera]]
name = "b"
backend = "synthetic"
model = "d435"
cheap = true
pose = { translation_m = [0.08, 0.0, 0.0] }
"""
IMAGES = ("image_raw", "image_compressed", "depth_compressed")
PLACE = {"a": [0.1, 0.2, 0.3], "b": [-0.4, 0.5, 0.6]}


@pytest.fixture(scope="module")
def recorded(binary: str, runtime: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recorded")
    (folder / "rig.toml").write_text(RIG)
    arguments = ("run", str(folder / "rig.toml"), "--record", str(folder / "out"), "--seconds", "4")
    command(binary, runtime, *arguments, codes=(0, 3))
    (dataset,) = (p.parent for p in (folder / "out").rglob("session.toml"))
    assert len(list(dataset.glob("seg_*.mcap"))) >= 2
    return dataset


@pytest.fixture
def dataset(recorded: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(recorded, tmp_path / "dataset"))


def calibration(dataset: Path, path: Path, cameras: str = "ab", **changes: object) -> Path:
    """A calibration of the colour streams of `cameras`."""
    head, entry = CALIBRATION.split("[[camera]]")
    streams = {s["id"]: s for s in tomllib.loads((dataset / "session.toml").read_text())["streams"]}
    for name in cameras:
        stream = streams[f"{name}/color"]
        serial = changes.get("serial", stream["serial"])
        width = changes.get("width", stream["width"])
        text = entry.format(serial=serial, width=width).replace('name = "cam"', f'name = "{name}"')
        text = text.replace("height = 480", f"height = {stream['height']}").replace("[0.1, 0.2, 0.3]", str(PLACE[name]))
        head += "[[camera]]" + text
    path.write_text(head.replace('reference = "cam"', f'reference = "{cameras[0]}"'))
    return path


def messages(dataset: Path) -> dict[str, list]:
    """Decoded messages by topic, of all segments."""
    found: dict[str, list] = {}
    for path in sorted(dataset.glob("seg_*.mcap")):
        with path.open("rb") as file:
            reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
            for _, channel, _, message in reader.iter_decoded_messages():
                found.setdefault(channel.topic, []).append(message)
    return found


def images(dataset: Path) -> dict[tuple[str, int], str]:
    """Checksums of the image messages by topic and log time."""
    found = {}
    for path in sorted(dataset.glob("seg_*.mcap")):
        with path.open("rb") as file:
            for _, channel, message in make_reader(file, validate_crcs=True).iter_messages():
                if channel.topic.rsplit("/", 1)[-1] in IMAGES:
                    found[channel.topic, message.log_time] = hashlib.sha256(message.data).hexdigest()
    return found


def transform(pose) -> np.ndarray:
    """A pose of a message as a matrix."""
    q = pose.rotation
    x, y, z, w = q.x, q.y, q.z, q.w
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, 3] = [pose.translation.x, pose.translation.y, pose.translation.z]
    return matrix


def poses(found: dict[str, list]) -> dict[str, np.ndarray]:
    """Poses of all frames of `/tf_static`, which each segment must state alike."""
    stated = [{t.child_frame_id: transform(t.transform) for t in m.transforms} for m in found["/tf_static"]]
    for other in stated[1:]:
        for name, matrix in stated[0].items():
            np.testing.assert_array_equal(other[name], matrix)
    return stated[0]


def exports_speak_of_it(binary: str, runtime: Path, dataset: Path, tmp_path: Path) -> None:
    """Both exports have the colour cameras' new intrinsics and poses, and no frame that differs from them."""
    for kind, pose in (("bytecameradepth", "pose"), ("lerobot", "pose_on_mount")):
        out = tmp_path / kind
        # An epoch of a few sets may have lost one; that is not the matter here.
        said = command(binary, runtime, "export", kind, str(dataset), str(out), "--json", codes=(0, 3))
        assert not [loss for loss in json.loads(said)["losses"] if "calibration" in loss], said
        (file,) = out.rglob("*calibration.json")
        told = json.loads(file.read_text())
        streams = told["streams"] if "streams" in told else told["episodes"][0]["streams"]
        for name, place in PLACE.items():
            all_ = [s for s in streams if f"{name}/color" in (s.get("stream"), s.get("id"))]
            assert all_, (kind, streams)
            for stream in all_:
                assert (stream["intrinsics"]["fx"], stream["intrinsics"]["cy"]) == (611.5, 241.5)
                np.testing.assert_allclose(stream[pose]["translation_m"], place, atol=1e-12)


def test_a_dataset_speaks_of_the_new_calibration_everywhere(
    binary: str, runtime: Path, dataset: Path, tmp_path: Path
) -> None:
    before = messages(dataset)
    pixels = images(dataset)
    session = tomllib.loads((dataset / "session.toml").read_text())
    verify = ("verify", str(dataset), "--decode", "--json")
    # A busy computer may have lost frames before.
    findings = json.loads(command(binary, runtime, *verify, codes=(0, 3)))["findings"]
    file = calibration(dataset, tmp_path / "calibration.toml")
    edited = json.loads(command(binary, runtime, "edit", str(dataset), "--calibration", str(file), "--json"))
    after = messages(dataset)
    # Poses: the calibrated stream is where the file says, and the others of its device moved with it.
    old = poses(before)
    new = poses(after)
    assert old.keys() == new.keys()
    for name, place in PLACE.items():
        color = f"{name}_color_optical_frame"
        np.testing.assert_allclose(new[color][:3, 3], place, atol=1e-12)
        np.testing.assert_allclose(new[color][:3, :3], np.diag([-1.0, -1.0, 1.0]), atol=1e-12)
        mine = [frame for frame in new if frame.startswith(f"{name}_")]
        assert len(mine) >= 2
        for frame in mine:
            relative = np.linalg.inv(old[color]) @ old[frame]
            np.testing.assert_allclose(np.linalg.inv(new[color]) @ new[frame], relative, atol=1e-9)
    # Intrinsics of the calibrated streams, in every message; the depth camera has its own as before.
    for name in PLACE:
        infos = after[f"/two/{name}/color/camera_info"]
        assert len(infos) == len(before[f"/two/{name}/color/camera_info"]) > 5
        for info in infos:
            assert (info.k[0], info.k[4], info.k[2], info.k[5]) == (611.5, 612.5, 321.5, 241.5)
            assert list(info.d) == [0.1, -0.2, 0.001, 0.002, 0.05]
            assert info.distortion_model == "plumb_bob"
        was, now = (m[f"/two/{name}/depth/camera_info"][0] for m in (before, after))
        assert list(was.k) == list(now.k)
        for header in after[f"/two/{name}/color/frame_info"]:
            assert (header.intrinsics_fx, header.intrinsics_cy) == (611.5, 241.5)
            np.testing.assert_allclose(list(header.pose_translation_m), PLACE[name], atol=1e-12)
    # Nothing else changed: the same messages, and not a byte of an image.
    assert {topic: len(all_) for topic, all_ in before.items()} == {topic: len(all_) for topic, all_ in after.items()}
    assert images(dataset) == pixels
    stamps = [[(m.header.stamp.sec, m.header.stamp.nanosec) for m in all_["/two/b/color/camera_info"]] for all_ in (before, after)]
    assert stamps[0] == stamps[1]
    assert json.loads(command(binary, runtime, *verify, codes=(0, 3)))["findings"] == findings
    # The history has what was before.
    now = tomllib.loads((dataset / "session.toml").read_text())
    assert now["calibration"] == file.read_text()
    by_field = {e["field"]: e for e in edited["history"]}
    was = tomllib.loads(f"v = {by_field['streams.a/color.pose']['before']}")["v"]
    (stream,) = (s for s in session["streams"] if s["id"] == "a/color")
    assert was == stream["pose"]
    was = tomllib.loads(f"v = {by_field['streams.a/color.intrinsics']['before']}")["v"]
    assert was["fx"] == stream["intrinsics"]["fx"]
    text = command(binary, runtime, "info", str(dataset))
    assert "calibration: made 2026-11-25T03:00:00Z, attached " in text and "before: none" in text
    assert "calibrated 2026-11-25T03:00:00Z (" in command(binary, runtime, "info", str(dataset), "--json")
    # A replay, so what a policy sees.
    with running(binary, runtime, tmp_path / "log", "replay", str(dataset), "--loop"):
        frame = depthrig.Stream("b/color", runtime_dir=runtime, timeout=WAIT_S).next(timeout=WAIT_S)
        assert frame is not None
        assert (frame.header.intrinsics.fx, frame.header.intrinsics.cy) == (611.5, 241.5)
        np.testing.assert_allclose(frame.header.pose.translation_m, PLACE["b"], atol=1e-12)
    exports_speak_of_it(binary, runtime, dataset, tmp_path)
    # The same again is no change, and touches no segment.
    sizes = {p.name: p.stat().st_mtime_ns for p in dataset.iterdir()}
    again = json.loads(command(binary, runtime, "edit", str(dataset), "--calibration", str(file), "--json"))
    assert again["changed"] == []
    assert {p.name: p.stat().st_mtime_ns for p in dataset.iterdir()} == sizes


def test_a_calibration_of_some_cameras_leaves_the_others(
    binary: str, runtime: Path, dataset: Path, tmp_path: Path
) -> None:
    old = poses(messages(dataset))
    file = calibration(dataset, tmp_path / "calibration.toml", "b")
    done = subprocess.run(
        [binary, "edit", str(dataset), "--calibration", str(file)],
        env=environment(runtime),
        capture_output=True,
        text=True,
        check=True,
        timeout=WAIT_S,
    )
    assert "has no entry of a" in done.stderr
    new = poses(messages(dataset))
    np.testing.assert_array_equal(new["a_color_optical_frame"], old["a_color_optical_frame"])
    np.testing.assert_allclose(new["b_color_optical_frame"][:3, 3], PLACE["b"], atol=1e-12)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"serial": "other"}, "is of serial number other, the dataset was recorded with"),
        ({"width": 320}, "is for 320x"),
        ({"names": True}, "has none of the dataset's streams"),
    ],
)
def test_a_calibration_that_does_not_fit_changes_nothing(
    binary: str, runtime: Path, dataset: Path, tmp_path: Path, changes: dict, message: str
) -> None:
    files = {p.name: p.read_bytes() for p in dataset.iterdir()}
    file = calibration(dataset, tmp_path / "calibration.toml", **changes)
    if "names" in changes:
        file.write_text(file.read_text().replace('name = "a"', 'name = "x"').replace('name = "b"', 'name = "y"'))
    done = subprocess.run(
        [binary, "edit", str(dataset), "--calibration", str(file)],
        env=environment(runtime),
        capture_output=True,
        text=True,
        check=False,
        timeout=WAIT_S,
    )
    assert done.returncode == 2 and message in done.stderr, done.stderr
    assert {p.name: p.read_bytes() for p in dataset.iterdir()} == files


def test_a_kill_loses_nothing_and_the_same_command_completes_it(
    binary: str, runtime: Path, recorded: Path, tmp_path: Path
) -> None:
    pixels = images(recorded)
    file = calibration(recorded, tmp_path / "calibration.toml")
    arguments = [binary, "edit", "--calibration", str(file)]
    began = time.monotonic()
    trial = Path(shutil.copytree(recorded, tmp_path / "trial"))
    subprocess.run([*arguments, str(trial)], env=environment(runtime), check=True, capture_output=True)
    takes_s = time.monotonic() - began
    chance = random.Random(1)
    killed = 0
    for _ in range(6):
        shutil.rmtree(trial)
        shutil.copytree(recorded, trial)
        process = subprocess.Popen([*arguments, str(trial)], env=environment(runtime), stderr=subprocess.DEVNULL)
        time.sleep(chance.uniform(0.0, takes_s))
        process.kill()
        killed += process.wait(WAIT_S) < 0
        assert images(trial) == pixels
        command(binary, runtime, "edit", str(trial), "--calibration", str(file))
        np.testing.assert_allclose(poses(messages(trial))["a_color_optical_frame"][:3, 3], PLACE["a"], atol=1e-12)
        assert images(trial) == pixels
        assert not list(trial.glob("*.recalibrated"))
        history = tomllib.loads((trial / "session.toml").read_text())["history"]
        assert [e["field"] for e in history].count("calibration") == 1
    assert killed > 0


def test_segments_that_were_left_behind_are_named(binary: str, runtime: Path, dataset: Path, tmp_path: Path) -> None:
    """As a kill between two renames leaves it: the session is new, a segment is old."""
    kept = tmp_path / "kept"
    shutil.copy(dataset / "seg_0001.mcap", kept)
    file = calibration(dataset, tmp_path / "calibration.toml")
    command(binary, runtime, "edit", str(dataset), "--calibration", str(file))
    shutil.copy(kept, dataset / "seg_0001.mcap")
    for name in ("info", "verify"):
        text = command(binary, runtime, name, str(dataset), codes=(1, 3))
        assert "seg_0001.mcap has another calibration than session.toml" in text
    command(binary, runtime, "edit", str(dataset), "--calibration", str(file))
    command(binary, runtime, "verify", str(dataset), codes=(0, 3))
    np.testing.assert_allclose(poses(messages(dataset))["b_color_optical_frame"][:3, 3], PLACE["b"], atol=1e-12)
