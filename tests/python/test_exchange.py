"""Real images to the folders of ByteCameraDepth and back, a real bag against another reader, exports that are killed."""

from __future__ import annotations

import csv
import json
import os
import random
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from PIL import Image
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from test_daemon import CAMERAS, DATA, WAIT_S, binary, command, rig_file, running, runtime

__all__ = ["binary", "rig_file", "runtime"]

BAG = DATA / "librealsense_bag" / "single_depth_color_640x480.bag"


def test_real_images_come_back_as_they_were(binary: str, runtime: Path, rig_file: Path, tmp_path: Path) -> None:
    arguments = ("run", str(rig_file), "--record", str(tmp_path / "recorded"), "--seconds", "1")
    with running(binary, runtime, tmp_path / "log", *arguments) as daemon:
        daemon.wait(WAIT_S)
    (recorded,) = sorted(p.parent for p in (tmp_path / "recorded").rglob("session.toml"))
    out = tmp_path / "out"
    report = json.loads(command(binary, runtime, "export", "bytecameradepth", str(recorded), str(out), "--json"))
    assert report["lost"] == 0
    # All that was recorded; on a busy machine a set may lack a frame.
    info = json.loads(command(binary, runtime, "info", str(recorded), "--json", codes=(0, 3)))
    assert report["frames"] == sum(stream["frames"] for stream in info["streams"]) > 0
    (session,) = (p for p in out.iterdir() if p.is_dir())
    calibration = json.loads((session / "calibration.json").read_text())
    described = {s["id"]: s for s in calibration["streams"]}
    with (session / "frames.csv").open(newline="") as file:
        # A frame that its set lacks has no file.
        rows = [row for row in csv.DictReader(file) if row["file"]]
    assert len(rows) == report["frames"]
    # The images of the first and the last set, as another decoder sees them.
    for row in (r for r in rows if r["n"] in {"0", str(report["sets"] - 1)}):
        name, stream = row["stream"].split("/")
        camera = next(c for c in CAMERAS if c.name == name)
        with Image.open(session / row["file"]) as file:
            assert file.mode == ("RGB" if stream == "color" else "I;16")
            image = np.asarray(file)
        source = camera.source(stream)
        if stream == "depth":
            assert float(row["depth_unit_m"]) == described[row["stream"]]["depth_unit_m"] == camera.depth_unit_m
        np.testing.assert_array_equal(image, source)
    back = str(tmp_path / "back")
    report = json.loads(command(binary, runtime, "import", "bytecameradepth", str(session), back, "--json"))
    assert report["facts"]["lost"] == 0
    equal = json.loads(command(binary, runtime, "compare", str(recorded), back, "--strict", "--json"))
    assert equal["equal"], equal
    assert equal["frames"] == len(rows)
    # One unit of one pixel is a difference.
    victim = next(r for r in rows if r["stream"].endswith("/depth"))
    pixels = np.asarray(Image.open(session / victim["file"])).copy()
    pixels[7, 9] += 1
    Image.fromarray(pixels).save(session / victim["file"])
    command(binary, runtime, "import", "bytecameradepth", str(session), str(tmp_path / "changed"))
    compared = subprocess.run([binary, "compare", recorded, tmp_path / "changed"], timeout=WAIT_S, check=False)
    assert compared.returncode == 1


@pytest.fixture(scope="module")
def dataset(binary: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("bag") / "d435"
    subprocess.run([binary, "import", "rosbag", BAG, out], check=True, timeout=WAIT_S)
    return out


def messages(dataset: Path, topic: str) -> Iterator[Any]:
    for segment in sorted(dataset.glob("seg_*.mcap")):
        with segment.open("rb") as f:
            reader = make_reader(f, decoder_factories=[DecoderFactory()])
            yield from (m for *_, m in reader.iter_decoded_messages(topics=[topic]))


@pytest.mark.parametrize(("stream", "topic"), [("depth", "sensor_0/Depth_0"), ("color", "sensor_1/Color_0")])
def test_a_bag_is_what_another_reader_says(dataset: Path, stream: str, topic: str) -> None:
    originals, metadata = [], []
    with AnyReader([BAG], default_typestore=get_typestore(Stores.ROS1_NOETIC)) as reader:
        wanted = [c for c in reader.connections if c.topic.startswith(f"/device_0/{topic}/image/")]
        for connection, _, raw in reader.messages(wanted):
            message = reader.deserialize(raw, connection.msgtype)
            if connection.topic.endswith("/image/data"):
                originals.append(message)
                metadata.append({})
            else:
                metadata[-1][message.key] = message.value
    images = list(messages(dataset, f"/rig/d435/{stream}/image_raw"))
    infos = list(messages(dataset, f"/rig/d435/{stream}/frame_info"))
    assert len(images) == len(infos) == len(originals) > 0
    for image, info, original, facts in zip(images, infos, originals, metadata, strict=True):
        assert (image.width, image.height, image.step) == (original.width, original.height, original.step)
        assert bytes(image.data) == original.data.tobytes()
        assert info.device_sequence == int(facts["Frame Counter"])
        assert info.device_time == int(facts.get("Sensor Timestamp", facts["Frame Timestamp"]))
        whole, part = facts["system_time"].split(".")
        assert info.arrival_time_ns == int(whole) * 10**6 + int(part.ljust(6, "0")[:6])
        assert info.exposure_ns == int(facts.get("Actual Exposure", 0)) * 1000


def tree(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def paper_session(folder: Path, sets: int) -> Path:
    """A session as the recorder of the published dataset writes it."""
    session = folder / "20250314_1512"
    camera = session / "camera_realsense_455"
    camera.mkdir(parents=True)
    noise = np.random.default_rng(7)
    for n in range(sets):
        Image.fromarray(noise.integers(0, 5000, (240, 320), dtype=np.uint16)).save(camera / f"depth_{n}.png")
        Image.fromarray(noise.integers(0, 255, (240, 320, 3), dtype=np.uint8)).save(camera / f"color_{n}.png")
    return session


def test_an_export_that_is_killed_ends_as_one_that_is_not(binary: str, tmp_path: Path) -> None:
    session = paper_session(tmp_path, 150)
    recorded = tmp_path / "recorded"
    subprocess.run([binary, "import", "bytecameradepth", session, recorded], check=True, timeout=WAIT_S)
    export = [binary, "export", "bytecameradepth", recorded]
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    began = time.monotonic()
    subprocess.run([*export, whole], check=True, timeout=WAIT_S)
    took = time.monotonic() - began
    for name, pixels in tree(session).items():
        ours = whole / "20250314_1512" / name.replace("realsense_455", "d455")
        assert np.array_equal(np.asarray(Image.open(ours)), np.asarray(Image.open(session / name))), name
        assert pixels
    expected = tree(whole)
    chance, kills = random.Random(3), 0
    for _ in range(40 if os.environ.get("DEPTHRIG_LONG") else 5):
        process = subprocess.Popen([*export, killed], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            process.wait(chance.uniform(0.2, 0.8) * took)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            process.wait()
            kills += 1
        for name, data in tree(killed).items() if killed.exists() else ():
            assert Path(name).name.startswith(".") or expected[name] == data, f"{name} is in pieces"
    subprocess.run([*export, killed], check=True, timeout=WAIT_S)
    assert kills > 0
    found = {name: data for name, data in tree(killed).items() if not name.endswith(".tmp")}
    assert found == expected
    assert not any(name.endswith(".tmp") for name in tree(killed))
