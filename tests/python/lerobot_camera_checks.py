"""Checks the camera plug-in for LeRobot on a running rig, in the environment of the package `lerobot`.

usage: python lerobot_camera_checks.py reads|refuses|outlives
       python lerobot_camera_checks.py dataset DATASET

Called by test_lerobot_camera.py. `outlives` prints `ready`, and goes on when it reads a line: the rig is gone, then back.
The rig's camera is python/examples/external_camera.py, which draws a number into colour and depth.
"""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Callable
from typing import Any

import depthrig
import numpy as np
from lerobot.cameras import make_cameras_from_configs
from lerobot.cameras.configs import CameraConfig
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError
from lerobot.utils.import_utils import register_third_party_plugins

WAIT_S = 60.0


def camera(**options: Any) -> Any:
    """A camera as LeRobot makes it."""
    config = CameraConfig.get_choice_class("depthrig")(**{"camera": "front", "timeout_s": WAIT_S, **options})
    return make_cameras_from_configs({"wrist": config})["wrist"]


def refused(kind: type[Exception], message: str, action: Callable[[], Any]) -> None:
    try:
        action()
    except kind as e:
        assert re.search(message, str(e)), f"{e!r} does not have {message!r}"
        return
    raise AssertionError(f"no {kind.__name__} with {message!r}")


def numbers(color: np.ndarray, depth: np.ndarray) -> tuple[int, int]:
    """The numbers of both images modulo 8, once every pixel is what external_camera.py draws."""
    ramp = np.add.outer(np.arange(480), np.arange(640))
    of_color = int(color[0, 0, 0])
    for channel in range(3):
        np.testing.assert_array_equal(color[..., channel], (ramp + (channel + 1) * of_color).astype(np.uint8))
    of_depth = int(depth.flat[0]) - 1000
    np.testing.assert_array_equal(depth.reshape(480, 640), 1000 + (ramp + of_depth) % 1000)
    return of_color % 8, of_depth % 8


def reads() -> None:
    """Images are those of the rig, to the bit, and colour and depth those of one moment."""
    with camera(use_depth=True, width=640, height=480, fps=10) as front:
        assert (front.width, front.height, front.fps) == (640, 480, 10)
        seen = set()
        # There is an image as soon as it is connected.
        color = front.read_latest(60_000)
        for k in range(60):
            if k % 4 == 0:
                time.sleep(0.05)  # a newer image is there
            depth = front.read_latest_depth(60_000)
            assert (color.shape, color.dtype, depth.shape, depth.dtype) == ((480, 640, 3), np.uint8, (480, 640, 1), np.uint16)
            of_color, of_depth = numbers(color, depth)
            assert of_color == of_depth, "colour and depth are of two moments"
            seen.add(of_color)
            color[:] = 0  # of its own
            color = front.async_read(WAIT_S * 1e3) if k % 2 else front.read()
        assert len(seen) > 1
        sequences = []
        for _ in range(5):
            front.async_read(WAIT_S * 1e3)
            sequences.append(front._group["front/color"].sequence)
        assert sorted(set(sequences)) == sequences, "an image was returned twice"
        # Read after the call, the newest one also if it was read.
        before = time.monotonic_ns()
        front.read_depth()
        assert front._group["front/depth"].header.publish_time_ns > before
        for _ in range(50):
            numbers(front.read_latest(60_000), front.read_latest_depth(60_000))
        time.sleep(0.05)
        refused(TimeoutError, "at most 0 ms", lambda: front.read_latest(0))
        refused(DeviceAlreadyConnectedError, "already connected", front.connect)
    refused(DeviceNotConnectedError, "not connected", front.read_latest)
    rates = []
    # A camera that a busy computer held up has its next frames nearer to each other.
    while not rates or not 1 <= rates[-1] <= 31:
        assert len(rates) < 10, rates
        with camera(use_depth=True) as front:
            rates.append(front.fps)
    with camera(color_mode="bgr", use_depth=True) as front:
        assert (front.width, front.height) == (640, 480)
        color = front.async_read(WAIT_S * 1e3)
        numbers(color[..., ::-1], front.read_latest_depth(60_000))
    with camera(use_rgb=False, use_depth=True) as front:
        assert front.async_read_depth(WAIT_S * 1e3).shape == (480, 640, 1)
        refused(RuntimeError, "use_rgb is false", front.read)
    found = [c for c in type(front).find_cameras() if c["id"] == "front"]
    assert [(c["type"], c["rig"], sorted(c["streams"])) for c in found] == [("depthrig", "lerobot", ["color", "depth"])]
    millimetres()


def millimetres() -> None:
    """Of depth in other units."""
    from lerobot_camera_depthrig.depthrig_camera import millimetres

    class Of:
        def __init__(self, metres: list[float], unit: float) -> None:
            self.metres = np.array([metres], np.float32)
            self.header = type("Header", (), {"format": int(depthrig.PixelFormat.DEPTH_F32), "depth_unit_m": unit})

        def depth_m(self) -> np.ndarray:
            return self.metres

    got = millimetres(Of([0.1234, 0.1236, np.nan, 65.535, 65.536, 7.0], 0.0))
    np.testing.assert_array_equal(got[..., 0], [[123, 124, 0, 65535, 0, 7000]])


def refuses() -> None:
    """What the rig does not deliver is refused when the camera is connected."""
    none = {"timeout_s": 0.2}
    refused(ConnectionError, r"side/color.*the rig has: front/color, front/depth", camera(camera="side", **none).connect)
    refused(ConnectionError, "front/depth_refined", camera(use_depth=True, depth_stream="depth_refined", **none).connect)
    refused(ConnectionError, "no rig 'other'|rig 'other'", camera(rig="other", **none).connect)
    refused(ConnectionError, "no rig|not running", camera(runtime_dir="/nonexistent", **none).connect)
    refused(ValueError, r"width = 320, height = 240.*640x480", camera(width=320, height=240).connect)
    refused(ValueError, r"fps = 60, but the camera delivers", camera(fps=60, timeout_s=5.0).connect)
    refused(ValueError, "carries rgb8, which is not depth", camera(use_depth=True, depth_stream="color", use_rgb=False, color_stream="none").connect)
    refused(ValueError, "carries z16", camera(color_stream="depth").connect)
    refused(ValueError, "both false", lambda: camera(use_rgb=False))
    refused(ValueError, "invalid camera name 'front/color'", lambda: camera(camera="front/color"))
    refused(ValueError, "color_mode", lambda: camera(color_mode="grey"))


def outlives() -> None:
    """A rig that goes away is a timeout; when it is back, so are the images."""
    with camera(use_depth=True) as front:
        front.async_read(WAIT_S * 1e3)
        front.async_read_depth(0)
        print("ready", flush=True)
        sys.stdin.readline()
        until = time.monotonic() + WAIT_S
        while True:  # the last images may be unread
            try:
                front.async_read(200)
            except TimeoutError:
                break
            assert time.monotonic() < until
        refused(TimeoutError, "ms old, at most 1 ms", lambda: front.read_latest(1))
        refused(TimeoutError, "nobody publishes", front.read)
        print("timeout", flush=True)
        sys.stdin.readline()
        while True:
            try:
                front.async_read(200)
                break
            except TimeoutError:
                assert time.monotonic() < until + WAIT_S


def dataset(root: str) -> None:
    """LeRobot's loader finds the images that the rig had, to the bit."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    ds = LeRobotDataset("depthrig/test", root=root, depth_output_unit="mm")
    assert (ds.num_episodes, ds.fps) == (2, 10)
    assert ds.meta.depth_keys == ["observation.images.wrist_depth"]
    seen = set()
    for i in range(len(ds)):
        row = ds[i]
        assert row["task"] == "stand still"
        assert row["observation.state"].tolist() == row["action"].tolist() == [0.25, -0.5]
        planes = row["observation.images.wrist"].numpy()
        color = np.rint(np.moveaxis(planes, 0, -1) * 255).astype(np.uint8)
        of_color, of_depth = numbers(color, row["observation.images.wrist_depth"].numpy())
        assert of_color == of_depth, "colour and depth are of two moments"
        seen.add(of_color)
    assert len(seen) > 1


register_third_party_plugins()
{"reads": reads, "refuses": refuses, "outlives": outlives, "dataset": dataset}[sys.argv[1]](*sys.argv[2:])
print("done", flush=True)
