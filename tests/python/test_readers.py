"""Real images, recorded by the real daemon, read by readers that are not ours: mcap, rosbags, rerun, @mcap/core.

Their results are compared with the source files, decoded by Pillow: no code of depthrig stands on either side.
"""

from __future__ import annotations

import json
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rerun.chunk import McapReader
from rosbags.highlevel import AnyReader
from test_daemon import CAMERAS, ROOT, WAIT_S, binary, command, rig_file, running, runtime, wait_until_answers  # noqa: F401

TYPES = {"rgb8": np.dtype("u1"), "16UC1": np.dtype("<u2")}
SOURCES = {
    f"/images/{camera.name}/{stream}/image_raw": camera.source(stream)
    for camera in CAMERAS
    for stream in ("color", "depth")
}


@pytest.fixture(scope="module")
def segments(binary: str, runtime: Path, rig_file: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:  # noqa: F811
    folder = tmp_path_factory.mktemp("outside")
    with running(binary, runtime, folder / "log", "run", str(rig_file), "--record", str(folder)):
        wait_until_answers(runtime, "images")
        deadline = time.monotonic() + WAIT_S
        sets = 0
        while sets < 15:
            assert time.monotonic() < deadline, f"{sets} sets"
            time.sleep(0.1)
            recording = json.loads(command(binary, runtime, "status", "--json", codes=(0, 3)))["recording"]
            sets = recording["sets"] if recording else 0
    found = sorted(folder.rglob("seg_*.mcap"))
    assert found
    return found


def check(seen: dict[str, int], topic: str, pixels: np.ndarray) -> None:
    source = SOURCES[topic]
    np.testing.assert_array_equal(pixels.reshape(source.shape), source, err_msg=topic)
    seen[topic] = seen.get(topic, 0) + 1


def check_all(seen: dict[str, int]) -> None:
    assert seen.keys() == SOURCES.keys()
    assert min(seen.values()) >= 10, seen


def messages(segments: list[Path]) -> Iterator[tuple[str, object, object]]:
    for segment in segments:
        with segment.open("rb") as file:
            reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
            for _, channel, message, decoded in reader.iter_decoded_messages():
                yield channel.topic, message, decoded


def test_mcap(segments: list[Path]) -> None:
    seen: dict[str, int] = {}
    for topic, _, image in messages(segments):
        if topic in SOURCES:
            check(seen, topic, np.frombuffer(image.data, TYPES[image.encoding]))
    check_all(seen)


def test_rosbags(segments: list[Path]) -> None:
    seen: dict[str, int] = {}
    for segment in segments:
        with AnyReader([segment]) as reader:
            for connection, _, raw in reader.messages():
                if connection.topic in SOURCES:
                    image = reader.deserialize(raw, connection.msgtype)
                    check(seen, connection.topic, image.data.view(TYPES[image.encoding]))
    check_all(seen)


def test_rerun_sees_depth_as_depth(segments: list[Path]) -> None:
    seen: dict[str, int] = {}
    for segment in segments:
        for chunk in McapReader(str(segment)).stream():
            batch, topic = chunk.to_record_batch(), str(chunk.entity_path)
            kind = "Image:buffer" if topic.endswith("/color/image_raw") else "DepthImage:buffer"
            if topic in SOURCES and kind in batch.schema.names:
                for data in batch.column(kind):
                    check(seen, topic, np.frombuffer(data.values[0].values.to_numpy().tobytes(), SOURCES[topic].dtype))
    check_all(seen)


def test_node(segments: list[Path], tmp_path: Path) -> None:
    images, sets = [], []
    for topic, message, decoded in messages(segments):
        if topic.endswith("/frame_set"):
            sets.append(decoded.id)
        if topic not in SOURCES:
            continue
        file = topic.replace("/", "_")
        (tmp_path / file).write_bytes(SOURCES[topic].tobytes())
        images.append(
            {
                "topic": topic,
                "log_time": str(message.log_time),
                "stamp": str(decoded.header.stamp.sec * 10**9 + decoded.header.stamp.nanosec),
                "width": decoded.width,
                "height": decoded.height,
                "encoding": decoded.encoding,
                "compare": "exact",
                "set": len(sets),
                "file": file,
            }
        )
    index = {"sets": len(sets), "first_set": sets[0], "images": images, "motion": []}
    (tmp_path / "index.json").write_text(json.dumps(index))
    program = ["node", "check_node.mjs", str(segments[0].parent), str(tmp_path)]
    done = subprocess.run(program, cwd=ROOT / "tests" / "readers", capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("images agree") == 2, done.stdout
