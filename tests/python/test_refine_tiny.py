"""The engine `tiny` in a running rig: what is published is what the program gives for the same images.

Of what its network was trained to, only steadiness matters here. ONNX Runtime is needed: `tools/onnxruntime.sh`.
"""

from __future__ import annotations

import json
import os
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from test_daemon import DATA, WAIT_S, binary, command, running, runtime

import depthrig

__all__ = ["binary", "runtime"]

RIG = """rig = "tiny"
[cdm]
threads = 1
{cdm}
[[camera]]
name = "table"
backend = "synthetic"
model = "d435"
poses = 1
[[camera.stream]]
name = "color"
width = 640
height = 480
rate_hz = 6
[[camera.stream]]
name = "depth"
rate_hz = 6
[camera.refine]
engine = "{engine}"
rate_hz = 5
align = true
fill_reach = 1.0
"""


@pytest.fixture(scope="module")
def model(binary: str, runtime: Path) -> str:
    """The id of the network, where ONNX Runtime is there."""
    built_in = json.loads(command(binary, runtime, "cdm", "info", "tiny", "--json"))["built_in"]
    rows = json.loads(command(binary, runtime, "cdm", "bench", "--seconds", "0", "--image", "32x32", "--json"))
    assert rows[0]["engine"] == "fill"
    if len(rows) == 1:
        assert "DEPTHRIG_REQUIRE_ONNXRUNTIME" not in os.environ
        pytest.skip("ONNX Runtime is not installed (tools/onnxruntime.sh)")
    assert rows[1]["engine"].startswith("tiny onnxruntime 1."), rows[1]
    assert rows[1]["model"] == built_in["id"]
    assert built_in["id"].endswith("tiny@" + built_in["sha256"][:8])
    return str(built_in["id"])


def recorded_pair() -> tuple[np.ndarray, list[np.ndarray], np.ndarray]:
    """Colour at each pixel of depth, both depth images, and the pixels that colour sees; by the calibration of the bag."""
    bag = DATA / "librealsense_bag" / "single_depth_color_640x480.bag"
    images: dict[str, list[np.ndarray]] = {"Depth": [], "Color": []}
    matrix, of = {}, {}
    with AnyReader([bag], default_typestore=get_typestore(Stores.ROS1_NOETIC)) as reader:
        for connection, _, data in reader.messages():
            name = "Depth" if "/Depth_0/" in connection.topic else "Color"
            message = reader.deserialize(data, connection.msgtype)
            if connection.topic.endswith("/image/data"):
                pixels = np.frombuffer(message.data.tobytes(), np.uint16 if name == "Depth" else np.uint8)
                images[name].append(pixels.reshape(message.height, message.width, -1).squeeze())
            elif connection.topic.endswith("/camera_info"):
                matrix[name] = message.K.reshape(3, 3)
            elif connection.topic.endswith("/tf/0"):
                of[name] = message
    x, y, z, w = (getattr(of["Color"].rotation, axis) for axis in "xyzw")
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    rotation = np.eye(3) + 2 * w * cross + 2 * cross @ cross
    translation = np.array([getattr(of["Color"].translation, axis) for axis in "xyz"])
    (color,) = images["Color"]
    # Where depth is missing, that of the nearest pixel to the left.
    depth = images["Depth"][0] * 0.001
    column = np.maximum.accumulate(np.where(depth > 0, np.arange(depth.shape[1]), 0), axis=1)
    depth = np.maximum(np.take_along_axis(depth, column, axis=1), 0.2)
    v, u = np.indices(depth.shape)
    points = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(matrix["Depth"]).T * depth[..., None]
    seen = (points @ rotation.T + translation) @ matrix["Color"].T
    u, v = (np.round(seen[..., axis] / seen[..., 2]).astype(int) for axis in (0, 1))
    inside = (u >= 0) & (u < color.shape[1]) & (v >= 0) & (v < color.shape[0])
    return color[v.clip(0, color.shape[0] - 1), u.clip(0, color.shape[1] - 1)], images["Depth"], inside


def stream(runtime: Path, name: str) -> depthrig.Stream:
    return depthrig.Stream(f"table/{name}", runtime_dir=runtime, timeout=WAIT_S)


def state(binary: str, runtime: Path) -> dict[str, object]:
    status = json.loads(command(binary, runtime, "status", "--json", codes=(0, 1, 2, 3)))
    return dict(status["cameras"][0]["refine"] or {"state": "not there yet"})


def test_a_rig_publishes_what_tiny_gives(binary: str, runtime: Path, model: str, tmp_path: Path) -> None:
    rig = tmp_path / "rig.toml"
    rig.write_text(RIG.format(engine="tiny", cdm=""))
    with (
        running(binary, runtime, tmp_path / "log", "run", str(rig)),
        stream(runtime, "depth_refined") as refined,
        stream(runtime, "depth_aligned") as aligned,
        stream(runtime, "color") as color,
    ):
        colors: dict[int, np.ndarray] = {}
        views: dict[int, np.ndarray] = {}
        deadline = time.monotonic() + WAIT_S
        while True:
            assert time.monotonic() < deadline, (list(colors), list(views))
            for source, kept in ((color, colors), (aligned, views)):
                if (found := source.latest()) is not None:
                    h = found.header
                    kept[h.sequence if kept is colors else h.source_sequence] = found.array.copy()
            frame = refined.latest()
            if frame is not None:
                header = frame.header
                if header.source_color_sequence in colors and header.source_sequence in views:
                    break
            time.sleep(0.005)
        refinement = header.refinement
        assert refinement is not None
        engine = refinement.engine
        assert engine.startswith("tiny onnxruntime 1.") and engine.endswith(" cpu fp32") and len(engine) <= 31
        assert refinement.model == model
        assert (header.height, header.width, header.format_name) == (480, 640, "z16")
        is_known = state(binary, runtime)
        assert (is_known["state"], is_known["engine"], is_known["model"]) == ("running", engine, model)
        Image.fromarray(colors[header.source_color_sequence]).save(tmp_path / "color.png")
        raw = views[header.source_sequence]
        Image.fromarray(raw).save(tmp_path / "depth.png")
        unit_m = header.depth_unit_m
        published = frame.array.copy()
    assert (published > 0).all(), "with a reach of 1 every hole is filled"
    assert (raw == 0).any()

    def run(engine: str) -> np.ndarray:
        out = tmp_path / f"{engine}.png"
        arguments = ["--rgb", str(tmp_path / "color.png"), "--depth", str(tmp_path / "depth.png")]
        arguments += ["--depth-unit", repr(unit_m), "--out-unit", repr(unit_m), "--engine", engine]
        arguments += ["--threads", "1", "--fill-reach", "1", "--out", str(out), "--json"]
        report = command(binary, runtime, "cdm", "run", *arguments)
        assert json.loads(report)["warnings"] == []
        return np.asarray(Image.open(out))

    np.testing.assert_array_equal(published, run("tiny"))
    assert (published != run("fill")).any(), "the network does something"


@pytest.mark.parametrize("size", ["640x480", "1280x720"])
def test_depth_of_a_still_scene_is_as_steady_as_that_of_fill(binary: str, runtime: Path, model: str, size: str) -> None:
    words = ("--seconds", "0", "--threads", "1", "--image", size, "--flicker", "12", "--json")
    fill, tiny = (row["flicker"] for row in json.loads(command(binary, runtime, "cdm", "bench", *words)))
    assert tiny["refined_mm"] <= 1.001 * fill["refined_mm"], (fill, tiny)
    assert tiny["holes_mm"] <= fill["holes_mm"], (fill, tiny)


def test_depth_of_a_recorded_camera_is_as_steady_as_that_of_fill(
    binary: str, runtime: Path, model: str, tmp_path: Path
) -> None:
    """Two depth images of a D435 that stood still; its one colour image is seen from where depth is."""
    color, depths, seen_by_color = recorded_pair()
    rows, columns = (np.flatnonzero(seen_by_color.mean(axis) > 0.5) for axis in (1, 0))
    cut = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
    Image.fromarray(np.ascontiguousarray(color[cut])).save(tmp_path / "color.png")
    raw = [np.ascontiguousarray(depth[cut]) for depth in depths]
    hole = (raw[0] == 0) | (raw[1] == 0)
    assert hole.sum() > 3000
    change_mm = {}
    for engine in ("fill", "tiny"):
        refined = []
        for depth in raw:
            Image.fromarray(depth).save(tmp_path / "depth.png")
            arguments = ["--rgb", str(tmp_path / "color.png"), "--depth", str(tmp_path / "depth.png"), "--threads", "1"]
            arguments += ["--depth-unit", "0.001", "--out-unit", "0.001", "--engine", engine, "--fill-reach", "1"]
            command(binary, runtime, "cdm", "run", *arguments, "--out", str(tmp_path / "refined.png"), "--overwrite")
            refined.append(np.asarray(Image.open(tmp_path / "refined.png")).astype(float))
            assert (refined[-1] > 0).all()
        change_mm[engine] = np.abs(refined[0] - refined[1])[hole].mean() / np.sqrt(2)
    assert change_mm["tiny"] <= change_mm["fill"], change_mm


def test_without_the_library_the_reason_and_the_cure_are_in_the_status(
    binary: str, runtime: Path, tmp_path: Path
) -> None:
    rig = tmp_path / "rig.toml"
    rig.write_text(RIG.format(engine="tiny", cdm='library = "/none/such.so"'))
    found = json.loads(command(binary, runtime, "doctor", str(rig), "--json", codes=(0, 1, 2, 3)))
    missing = [f for f in found["findings"] if f["id"] == "engine_missing"]
    assert len(missing) == 1 and "pip install onnxruntime" in missing[0]["what"], found
    with (
        running(binary, runtime, tmp_path / "log", "run", str(rig), codes=(3,)),  # depth was not refined
        stream(runtime, "color") as color,
    ):
        while (seen := state(binary, runtime))["state"] != "failed":
            color.next(timeout=WAIT_S)
        message = str(seen["message"])
        assert "/none/such.so" in message and "pip install onnxruntime" in message and "tried again" in message
