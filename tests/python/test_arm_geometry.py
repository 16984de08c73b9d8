"""The simulated arm is where its published joints say: forward kinematics, written here a second time in NumPy, give the place of the
fingers and the hand in the world; the dataset's poses and intrinsics give their pixels; depth and colour there are those of the arm.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import depthrig
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from test_daemon import WAIT_S, binary, command, running, runtime
from test_demonstrations import RIG, arm, images, samples, wait_for_sets, wait_until_rendered

__all__ = ["binary", "runtime"]

BASE = np.array([0.44, 0.16, 0.0])
"""Middle of the arm's base in the world, metres; z is up, and the table's top is z = 0."""
SHOULDER, UPPER, FORE, HAND, FINGER = 0.13, 0.30, 0.28, 0.10, 0.06
"""Height of the shoulder, and lengths of the links and the fingers, metres."""
FINGER_RADIUS = 0.005
CAMERA, TARGET = np.array([0.02, -0.60, 0.47]), np.array([-0.01, 0.09, 0.07])
"""Where the mount stands while the arm moves, and the point that it looks at."""
STEP_NS = 1e9 / 6
"""Cameras show the arm where it was at the last multiple of this on the host's clock."""
SAMPLED_NS = 50e6
"""Between samples farther apart, because a busy computer held up the arm's process, its joints are not known well enough."""
LATE_NS = 3e6 + 8e6 / 2
"""The least latency of a simulated d435, and half its exposure: a constant that no clock sees, and that capture times are late by."""


def hand_and_fingers(joints: np.ndarray, opening: float) -> tuple[np.ndarray, np.ndarray]:
    """The middle of the hand's link, and the middle of the lower half of both fingers, in the world."""
    base, shoulder, elbow, wrist = joints
    lengths = np.array([UPPER, FORE, HAND])
    pitch = np.cumsum([shoulder, elbow, wrist])
    radius, height = (lengths * np.cos(pitch)).cumsum(), SHOULDER + (lengths * np.sin(pitch)).cumsum()
    ahead, side = np.array([np.cos(base), np.sin(base), 0]), np.array([-np.sin(base), np.cos(base), 0])
    places = BASE + radius[:, None] * ahead + height[:, None] * np.array([0, 0, 1])
    low = places[2] - [0, 0, 0.75 * FINGER]
    return (places[1] + places[2]) / 2, np.stack([low + side * opening / 2, low - side * opening / 2])


def on_camera(points: np.ndarray, stream: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Pixels of points of the world in a stream's images, and their depths in metres."""
    forward = (TARGET - CAMERA) / np.linalg.norm(TARGET - CAMERA)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    on_mount = (points - CAMERA) @ np.stack([right, np.cross(forward, right), forward]).T
    pose = stream["pose"]
    x, y, z = ((on_mount - pose["translation_m"]) @ turned(pose["rotation_xyzw"])).T
    k = stream["intrinsics"]
    return np.stack([k["fx"] * x / z + k["cx"], k["fy"] * y / z + k["cy"]], axis=1), z


def turned(rotation_xyzw: list[float]) -> np.ndarray:
    """The matrix of a unit quaternion."""
    v, w = np.array(rotation_xyzw[:3]), rotation_xyzw[3]
    across = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.eye(3) + 2 * w * across + 2 * across @ across


def offsets(dataset: Path) -> int:
    """UTC minus the host's clock, nanoseconds."""
    for segment in sorted(dataset.glob("seg_*.mcap")):
        with segment.open("rb") as file:
            reader = make_reader(file, decoder_factories=[DecoderFactory()])
            for _, _, _, decoded in reader.iter_decoded_messages(topics=["/cell/frame_set"]):
                return int(decoded.utc_offset_ns)
    raise AssertionError("the dataset has no sets")


def uncertainties(dataset: Path, topic: str) -> dict[int, int]:
    """By how much a frame's capture time may be off, nanoseconds, as the dataset states it; at the time of its image."""
    found = {}
    for segment in sorted(dataset.glob("seg_*.mcap")):
        with segment.open("rb") as file:
            reader = make_reader(file, decoder_factories=[DecoderFactory()])
            for _, _, message, decoded in reader.iter_decoded_messages(topics=[topic]):
                found[message.publish_time] = decoded.capture_uncertainty_ns
    return found


def gap(at: np.ndarray, when: float) -> float:
    """Between the samples before and after a moment, nanoseconds; infinite where one of them is not there."""
    after = int(np.searchsorted(at, when))
    return float(at[after] - at[after - 1]) if 0 < after < len(at) else np.inf


def middle_of(alike: np.ndarray, column: int) -> float:
    """The middle of the run of alike columns around one."""
    assert alike[column]
    edges = np.flatnonzero(~np.concatenate([[False], alike, [False]])) - 1
    return float(edges[edges < column].max() + edges[edges > column].min()) / 2


@pytest.fixture(scope="module")
def dataset(binary: str, runtime: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:  # noqa: F811
    folder = tmp_path_factory.mktemp("arm")
    rig = folder / "rig.toml"
    # Depth as it is, without a sensor's noise and holes.
    rig.write_text(RIG.replace("arm = true", "arm = true\ntruth = true"))
    with arm(binary, runtime), running(binary, runtime, folder / "log", "run", str(rig)):
        wait_until_rendered(binary, runtime)
        with depthrig.SignalReader("arm/action", runtime_dir=runtime, timeout=WAIT_S) as reader:
            reader.wait(timeout=WAIT_S)
        recording = depthrig.Recording("cell", runtime)
        dataset = Path(recording.start()["path"])
        wait_for_sets(recording, 40)
        recording.stop()
    return dataset


def test_the_arm_in_the_images_is_where_its_joints_say(dataset: Path) -> None:
    streams = {s["id"]: s for s in tomllib.loads((dataset / "session.toml").read_text())["streams"]}
    offset = offsets(dataset)
    at, joints = samples(dataset, "/cell/arm/joint_position/joint_states", "position")
    gripper_at, opening = samples(dataset, "/cell/arm/gripper/values", "fields")
    fingers = visible = hands = 0
    for topic, name in [("/cell/top/depth/image_raw", "top/depth"), ("/cell/top/color/image_compressed", "top/color")]:
        uncertainty = uncertainties(dataset, f"/cell/{name}/frame_info")
        for capture, pixels in images(dataset, topic).items():
            taken = capture - LATE_NS
            since = (taken - offset) % STEP_NS
            shown = taken - since
            # So near to a step the one before or after it may be shown. Frames this early may all have come a little later than the least.
            near = uncertainty[capture] + 0.5e6
            if not near < since < STEP_NS - near or max(gap(at, shown), gap(gripper_at, shown)) > SAMPLED_NS:
                continue
            now = np.array([np.interp(shown - at[0], at - at[0], column) for column in joints.T])
            hand, tips = hand_and_fingers(now, float(np.interp(shown - at[0], gripper_at - at[0], opening[:, 0])))
            where, depths = on_camera(np.vstack([hand, tips]), streams[name])
            (hand_at, *tips_at), (hand_m, *tips_m) = where, depths
            if name == "top/color":
                column, row = np.rint(hand_at).astype(int)
                red, _, blue = pixels[row].T.astype(int)
                # The stand behind it is as brown, but dark.
                off_px = middle_of((red > 2 * blue) & (red > 110), column) - hand_at[0]
                assert abs(off_px) < 3, f"the orange link is {off_px} pixels beside {hand_at}"
                hands += 1
                continue
            metres = pixels[..., 0] * streams[name]["depth_unit_m"]
            for (x, y), expected in zip(tips_at, tips_m):
                column, row = round(x), round(y)
                # The surface is a radius nearer than the middle of the finger.
                off_m = metres[row, column] - (expected - FINGER_RADIUS)
                assert off_m < 0.004, f"depth behind the finger at {column}, {row}: {off_m} m"
                fingers += 1
                # Something nearer hides it, or there is no depth, as at edges.
                if off_m < -0.015:
                    continue
                visible += 1
                off_px = middle_of(np.abs(metres[row] - expected) < 0.02, column) - x
                assert off_m > -0.004 and abs(off_px) < 2, f"the finger at {column}, {row} is off by {off_m} m, {off_px} pixels"
    assert fingers >= 12 and visible >= 0.75 * fingers and hands >= 6
