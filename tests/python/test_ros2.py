"""A running rig as ROS 2 topics, compared with the frames on the bus.

A zenoh router stands for rmw_zenohd. Messages are decoded by mcap-ros2-support and received by zenoh-ros2-sdk, which share
no code with the program. No ROS 2 is installed here.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import depthrig
from test_daemon import WAIT_S, binary, environment, running, runtime

pytest.importorskip("zenoh", reason="no eclipse-zenoh; tests/readers/requirements.txt has it")
pytest.importorskip("rosbags", reason="no rosbags; tests/readers/requirements.txt has it")

import zenoh

from depthrig._header import Intrinsics
from depthrig.ros2 import _cloud, _images, _names, _session, _types
from depthrig.ros2._inbound_signal import signal_name
from depthrig.ros2._types import CAMERA_INFO, COMPRESSED, DIAGNOSTICS, IMAGE, IMU, JOINTS, POINTS, POSE, TRANSFORMS
from ros2 import STAMP_NS, Bridge, Bus, Heard, Router, bridge, by_stamp, decode, definition, free_port, stamp_ns, until, utc_offset_ns

__all__ = ["binary", "runtime"]

RIG = """
rig = "cell"
[[camera]]
name = "top"
backend = "synthetic"
model = "d455"
cheap = true
motion = true
pose = { translation_m = [0.1, 0.0, 0.2] }
[[camera.stream]]
name = "color"
width = 640
height = 480
rate_hz = 15.0
[[camera.stream]]
name = "depth"
width = 640
height = 480
rate_hz = 15.0
[[camera.stream]]
name = "imu"
"""
CODES = (0, 3, -signal.SIGKILL)
TOP = "/cell/top"
HASHES = {
    IMAGE: "d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47",
    COMPRESSED: "15640771531571185e2efc8a100baf923961a4d15d5569652e6cb6691e8e371a",
    CAMERA_INFO: "b3dfd68ff46c9d56c80fd3bd4ed22c7a4ddce8c8348f2f59c299e73118e7e275",
    IMU: "7d9a00ff131080897a5ec7e26e315954b8eae3353c3f995c55faf71574000b5b",
    JOINTS: "a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e",
    TRANSFORMS: "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
    DIAGNOSTICS: "5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e",
    "std_msgs/msg/String": "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
}
"""Those of the JSON files in ROS 2's own packages (Kilted); String by the packages of PyPI."""


@pytest.fixture(scope="module")
def rig(binary: str, runtime: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[subprocess.Popen[bytes]]:
    folder = tmp_path_factory.mktemp("ros2")
    (folder / "rig.toml").write_text(RIG)
    with running(binary, runtime, folder / "log", "run", str(folder / "rig.toml"), "-q", codes=CODES) as daemon:
        depthrig.Stream("top/color", "cell", runtime, timeout=WAIT_S).close()
        yield daemon


@pytest.fixture(scope="module")
def router() -> Iterator[Router]:
    router = Router(free_port())
    yield router
    router.close()


@pytest.fixture(scope="module")
def node(rig: object, runtime: Path, router: Router, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bridge]:
    log = tmp_path_factory.mktemp("ros2") / "log"
    with bridge(runtime, log, router.port, "--subscribe", "/joint_states", "/arm/pose") as started:
        router.wait_for(*(f"{TOP}/{t}/image_raw" for t in ("color", "depth")), f"{TOP}/imu/data_raw", "/tf_static")
        yield started


@pytest.mark.parametrize("ros_type", HASHES)
def test_the_hash_of_a_type_is_that_of_ros(ros_type: str) -> None:
    assert _types.type_hash(ros_type) == f"RIHS01_{HASHES[ros_type]}"


def test_keys_and_tokens_are_written_as_rmw_zenoh_does() -> None:
    about = _types.about("std_msgs/msg/String")
    assert about == f"std_msgs::msg::dds_::String_/RIHS01_{HASHES['std_msgs/msg/String']}"
    assert _names.key(2, "/a/chatter", *about.split("/")) == f"2/a/chatter/{about}"
    token = _names.endpoint_token(2, "aac3178e", "talker", 10, "MP", "/chatter", f"{about}/{_names.Qos.LATCHED.value}")
    assert token == f"@ros2_lv/2/aac3178e/0/10/MP/%/%/talker/%chatter/{about}/:1:,1:,:,:,,"
    assert _names.node_token(2, "aac3178e", "talker") == "@ros2_lv/2/aac3178e/0/0/NN/%/%/talker"
    # Of Lyrical: number 9, a time, and the hash of its token.
    sent = bytes.fromhex("0900000000000000df8ab6f7e735d31810fe98e4a3b54b6e599c5934f4cfc25343")
    utc_ns = int.from_bytes(sent[8:16], "little")
    assert _names.attachment(9, utc_ns, sent[17:]) == sent and 1.7e18 < utc_ns < 1.9e18
    # The published XXH3 of nothing is 99aa06d3014798d8 6001c324468d497f; its lower half comes first, each in the computer's order.
    assert _names.identity("").hex() == "7f498d4624c30160d8984701d306aa99"
    for later in (token, f"{token}/buffers"):
        assert _names.published_types(later) == ("/chatter", "std_msgs::msg::dds_::String_")
    for other in (token.replace("/MP/", "/MS/"), "@ros2_lv/2", "", _names.node_token(2, "a", "b")):
        assert _names.published_types(other) is None


def test_a_router_elsewhere_is_open_to_others_unless_it_is_encrypted() -> None:
    for here in ("tcp/localhost:7447", "tcp/127.0.0.1:7447", "tcp/127.3.2.1:1", "tcp/[::1]:7447", "tls/10.0.0.1:7447"):
        assert not _session.is_open_to_others(here), here
    for there in ("tcp/10.0.0.1:7447", "tcp/robot.local:7447", "udp/[fe80::1%eth0]:7447", "tcp/localhost.evil.org:1"):
        assert _session.is_open_to_others(there), there


def test_nothing_is_read_while_nobody_subscribes(node: Bridge) -> None:
    first = node.wait(lambda s: s["frames_read"] == 3, "one frame of each stream is read for its header")
    time.sleep(2.5)
    later = node.status()
    assert later["frames_read"] == 3
    sent = {topic: count["sent"] for topic, count in later["topics"].items() if count["sent"]}
    assert set(sent) == {"/tf_static"} and sent == {t: first["topics"][t]["sent"] for t in sent}


def test_a_subscriber_of_one_topic_starts_only_that_topic(node: Bridge, router: Router) -> None:
    before = node.status()["topics"]
    with router.hear(f"{TOP}/color/camera_info", CAMERA_INFO) as heard:
        heard.wait(5)
        assert node.wait(lambda s: s["topics"][f"{TOP}/color/camera_info"]["subscribed"], "subscribed")
    after = node.wait(lambda s: not s["topics"][f"{TOP}/color/camera_info"]["subscribed"], "not subscribed any more")
    moved = {topic for topic, count in after["topics"].items() if count["sent"] > before[topic]["sent"]}
    assert moved == {f"{TOP}/color/camera_info"}


def test_images_are_those_of_the_bus(node: Bridge, router: Router, runtime: Path) -> None:
    for name, encoding in (("color", "rgb8"), ("depth", "16UC1")):
        with (
            Bus(runtime, f"top/{name}", "cell") as bus,
            router.hear(f"{TOP}/{name}/camera_info", CAMERA_INFO) as info,
            router.hear(f"{TOP}/{name}/image_raw", IMAGE) as raw,
        ):
            messages = raw.wait(20)
            # One may be under way. On a busy computer a message may be lost on its way to the subscriber, as these are sent at best effort.
            until(lambda: stamp_ns(info.messages()[-1]) >= stamp_ns(messages[-2]), "as many of the other topic")
            infos = by_stamp(info.messages())
            lost = int((np.diff(numbers(info)) - 1).sum())
            assert sum(stamp_ns(m) not in infos for m in messages[1:-1]) <= lost, "same stamps"
            frames = bus.frames_of([stamp_ns(message) for message in messages[1:]])
            compared = [(i, message, frames[stamp_ns(message)]) for i, message in enumerate(messages) if stamp_ns(message) in frames]
            for _, message, seen in compared:
                assert (message.encoding, message.is_bigendian) == (encoding, 0)
                assert (message.height, message.width) == seen.array.shape[:2]
                assert message.step == seen.array.nbytes // message.height
                assert message.header.frame_id == f"top_{name}_optical_frame"
                assert bytes(message.data) == seen.array.tobytes()
            stamp = next(stamp for stamp in frames if stamp in infos)
            one, k = infos[stamp], frames[stamp].header.intrinsics
            assert one.distortion_model == "plumb_bob"
            assert list(one.k) == [k.fx, 0, k.cx, 0, k.fy, k.cy, 0, 0, 1]
            assert list(one.p) == [k.fx, 0, k.cx, 0, 0, k.fy, k.cy, 0, 0, 0, 1, 0]
            assert (list(one.d), list(one.r)) == (list(k.coeffs[:5]), [1, 0, 0, 0, 1, 0, 0, 0, 1])
            # Numbers of what was sent, the time of sending, and one identity. The number of an image that was lost is missed, and so is its frame.
            sent_as = [int.from_bytes(a[:8], "little") for a in raw.attachments[: len(messages)]]
            sent = np.diff([sent_as[i] for i, *_ in compared])
            taken = np.diff([seen.header.sequence for *_, seen in compared])
            assert all((1 <= sent) & (sent <= taken)), (sent, taken)
            token = next(t for t in router.tokens if f"%{name}%image_raw/" in t and "/depthrig_cell/" in t)
            assert {a[16:] for a in raw.attachments} == {b"\x10" + _names.identity(token)}
            sent_ns = int.from_bytes(raw.attachments[-1][8:16], "little")
            assert abs(time.time_ns() - sent_ns) < WAIT_S * 1e9


def test_compressed_images_are_those_of_the_bus(node: Bridge, router: Router, runtime: Path) -> None:
    with (
        Bus(runtime, "top/color", "cell") as color,
        Bus(runtime, "top/depth", "cell") as depth,
        router.hear(f"{TOP}/color/image_raw/compressed", COMPRESSED) as jpeg,
        router.hear(f"{TOP}/depth/image_raw/compressedDepth", COMPRESSED) as png,
    ):
        of_colour = by_stamp(jpeg.wait(8)[1:])
        for stamp, seen in color.frames_of(list(of_colour)).items():
            message = of_colour[stamp]
            assert message.format == "rgb8; jpeg compressed bgr8"
            pixels = np.asarray(Image.open(io.BytesIO(message.data)))
            off = np.abs(pixels.astype(int) - seen.array)
            assert off.mean() < 2
        of_depth = by_stamp(png.wait(8)[1:])
        for stamp, seen in depth.frames_of(list(of_depth)).items():
            message = of_depth[stamp]
            assert message.format == "16UC1; compressedDepth png"
            assert bytes(message.data[:12]) == bytes(12)
            pixels = np.asarray(Image.open(io.BytesIO(message.data[12:])))
            np.testing.assert_array_equal(pixels, seen.array)


def test_points_are_the_geometry_of_depth_and_camera_info(node: Bridge, router: Router) -> None:
    with (
        router.hear(f"{TOP}/depth/image_raw", IMAGE) as raw,
        router.hear(f"{TOP}/depth/camera_info", CAMERA_INFO) as info,
        router.hear(f"{TOP}/depth/points", POINTS) as cloud,
    ):
        until(lambda: len(by_stamp(raw.messages()).keys() & by_stamp(cloud.messages())) >= 2, "points of images that came")
        images = by_stamp(raw.messages())
        lens = info.wait(1)[0]
        compared = 0
        for message in cloud.messages():
            image = images.get(stamp_ns(message))
            if image is None:
                continue
            assert [(f.name, f.offset, f.datatype, f.count) for f in message.fields] == [
                ("x", 0, 7, 1),
                ("y", 4, 7, 1),
                ("z", 8, 7, 1),
            ]
            assert (message.height, message.width) == (image.height, image.width)
            assert (message.point_step, message.row_step) == (12, 12 * image.width)
            assert not message.is_dense and not message.is_bigendian
            assert message.header.frame_id == "top_depth_optical_frame"
            points = np.frombuffer(message.data, "<f4").reshape(image.height, image.width, 3)
            z = np.frombuffer(image.data, "<u2").reshape(image.height, image.width) / 1000.0
            v, u = np.mgrid[: image.height, : image.width]
            expected = np.stack(((u - lens.k[2]) / lens.k[0] * z, (v - lens.k[5]) / lens.k[4] * z, z), axis=2)
            expected[z == 0] = np.nan
            assert (z > 0).any() and (z == 0).any()
            np.testing.assert_allclose(points, expected, rtol=1e-5, atol=1e-6)
            compared += 1
        assert compared >= 2


def shown(model: int, c: tuple[float, ...], x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where a lens shows points of the plane at z = 1, as OpenCV's documentation writes it."""
    r = np.maximum(np.sqrt(x * x + y * y), 1e-12)
    if model == depthrig.Distortion.KANNALA_BRANDT4:
        theta = np.arctan(r)
        theta_d = theta * (1 + c[0] * theta**2 + c[1] * theta**4 + c[2] * theta**6 + c[3] * theta**8)
        return x * theta_d / r, y * theta_d / r
    top = 1 + c[0] * r**2 + c[1] * r**4 + c[4] * r**6
    radial = top / (1 + c[5] * r**2 + c[6] * r**4 + c[7] * r**6)
    return (
        x * radial + 2 * c[2] * x * y + c[3] * (r**2 + 2 * x**2),
        y * radial + c[2] * (r**2 + 2 * y**2) + 2 * c[3] * x * y,
    )


@pytest.mark.parametrize(
    ("model", "coefficients"),
    [
        (depthrig.Distortion.BROWN_CONRADY, (-0.05, 0.06, 0.0007, 0.0002, -0.02, 0, 0, 0)),
        # As of an Azure Kinect's depth camera.
        (depthrig.Distortion.RATIONAL, (5.4, 3.6, -5e-5, -3e-6, 0.19, 5.7, 5.3, 0.98)),
        (depthrig.Distortion.KANNALA_BRANDT4, (0.1, -0.02, 0.003, -0.001, 0, 0, 0, 0)),
    ],
)
def test_rays_are_straightened(model: int, coefficients: tuple[float, ...]) -> None:
    lens = Intrinsics(500.0, 505.0, 319.0, 241.0, coefficients, int(model), 0)
    x, y, z = _cloud._rays(lens, 640, 480).astype(np.float64)
    assert (z == 1).all()
    there = shown(model, coefficients, x, y)
    v, u = np.mgrid[:480, :640]
    np.testing.assert_allclose(there[0] * 500.0 + 319.0, u, atol=2e-3)
    np.testing.assert_allclose(there[1] * 505.0 + 241.0, v, atol=2e-3)
    assert np.abs(x * 500.0 + 319.0 - u).max() > 1, "this lens bends"


def test_a_ray_that_no_lens_has_is_not_a_number() -> None:
    folding = Intrinsics(100.0, 100.0, 320.0, 240.0, (-0.5, 0.0, 0.0, 0.0, 0.0, 0, 0, 0), 2, 0)
    rays = _cloud._rays(folding, 640, 480)
    assert np.isnan(rays[:, 0, 0]).all() and np.isfinite(rays[:, 240, 320]).all()


def test_a_late_subscriber_gets_the_poses(node: Bridge, router: Router, runtime: Path) -> None:
    key = f"0/tf_static/{_types.about(TRANSFORMS)}"
    came: list[bytes] = []
    # As rmw_zenoh subscribes to a latched topic.
    subscriber = zenoh.ext.declare_advanced_subscriber(
        router.session,
        key,
        lambda sample: came.append(sample.payload.to_bytes()),
        history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1),
    )
    until(lambda: came, "the poses come")
    subscriber.undeclare()
    message = decode(TRANSFORMS, came[-1])
    found = {t.child_frame_id: t for t in message.transforms}
    assert len(message.transforms) == len(found) == 3
    for name, frame in (("color", "optical_frame"), ("depth", "optical_frame"), ("imu", "frame")):
        with depthrig.Stream(f"top/{name}", "cell", runtime, timeout=WAIT_S) as stream:
            pose = stream.next(WAIT_S).header.pose
        transform = found[f"top_{name}_{frame}"]
        assert transform.header.frame_id == "cell_mount"
        moved, turned = transform.transform.translation, transform.transform.rotation
        assert (moved.x, moved.y, moved.z) == tuple(pose.translation_m)
        assert (turned.x, turned.y, turned.z, turned.w) == tuple(pose.rotation_xyzw)


def test_every_sample_of_an_imu_is_sent(node: Bridge, router: Router, runtime: Path) -> None:
    topic = f"{TOP}/imu/data_raw"
    late_before = node.status()["topics"][topic]["missed"]
    with Bus(runtime, "top/imu", "cell") as bus, router.hear(topic, IMU) as heard:
        messages: list[Any] = []
        is_there = np.zeros(0, bool)
        while is_there.sum() <= 200:
            messages = heard.wait(len(messages) + 300)
            stamps = np.array([stamp_ns(m) for m in messages])
            offset = utc_offset_ns()
            until(lambda: max(list(bus.frames)) + offset > stamps[-1], "the bus's samples of that time")  # noqa: B023
            batches = [seen.array for _, seen in sorted(bus.frames.items())]
            samples = np.concatenate(batches)
            nearest = np.abs(samples["time_ns"][None] + offset - stamps[:, None]).argmin(axis=1)
            is_there = np.abs(samples["time_ns"][nearest] + offset - stamps) < 2_000_000
            # Samples that the test's own reader was late for have nothing to be compared with.
            absent = (~is_there & (stamps > samples["time_ns"][0] + offset)).sum()
            assert absent <= bus.missed * max(map(len, batches)), (absent, is_there.sum(), bus.missed)
    # On a busy computer messages are lost on their way, and the program's own reader is late; it counts that.
    lost = int((np.diff(numbers(heard)[: len(messages)]) - 1).sum())
    late = node.status()["topics"][topic]["missed"] - late_before
    steps = np.diff(nearest[is_there])
    assert steps.min() > 0 and (steps - 1).sum() <= lost + late, (steps, lost, late)
    for message, sample in zip(np.array(messages)[is_there], samples[nearest[is_there]], strict=True):
        gyro, accel = message.angular_velocity, message.linear_acceleration
        assert (gyro.x, gyro.y, gyro.z) == tuple(sample["gyro_rad_s"].astype(float))
        assert (accel.x, accel.y, accel.z) == tuple(sample["accel_m_s2"].astype(float))
        assert message.header.frame_id == "top_imu_frame"
        assert (message.orientation_covariance[0], message.angular_velocity_covariance[0]) == (-1, 0)


def numbers(heard: Heard) -> np.ndarray:
    """Numbers of the messages that came; those that are missing were lost on their way."""
    return np.array([int.from_bytes(a[:8], "little") for a in list(heard.attachments)])


def stand_still(node: Bridge, seconds: float = 1.5) -> None:
    node.process.send_signal(signal.SIGSTOP)
    time.sleep(seconds)


def skipped(node: Bridge, topic: str, heard: Heard) -> tuple[int, int, int]:
    """A count of the skipped images, the last message before it was made, and the first image after it."""
    earlier = len(heard.payloads) - 1
    # The next status may have been made before that message.
    count = [node.status()["topics"][topic]["skipped"] for _ in range(2)][-1]
    now_ns = time.time_ns()
    until(lambda: stamp_ns(decode(IMAGE, heard.payloads[-1])) > now_ns, "a later image")
    later = len(heard.payloads) - 1
    heard.wait(later + 3)
    return count, earlier, later


def test_after_a_pause_the_newest_image_comes_and_the_others_are_counted(node: Bridge, router: Router, runtime: Path) -> None:
    topic = f"{TOP}/color/image_raw"
    with Bus(runtime, "top/color", "cell") as bus, router.hear(topic, IMAGE) as heard:
        heard.wait(3)
        before, before_from, before_to = skipped(node, topic, heard)
        stand_still(node)
        newest = max(seen.header.sequence for seen in list(bus.frames.values()))
        node.process.send_signal(signal.SIGCONT)
        heard.wait(len(heard.payloads) + 8)
        after, after_from, after_to = skipped(node, topic, heard)
        stamps = [stamp_ns(message) for message in heard.messages()]
        seen = bus.frames_of(stamps)
    frames = {i: seen[stamp].header.sequence for i, stamp in enumerate(stamps) if stamp in seen}
    sequences = np.array(list(frames.values()))
    steps = np.diff(sequences)
    assert steps.max() > 10 and sequences[steps.argmax() + 1] >= newest, (frames, newest)
    # A message that is lost on its way has a number, too: what is left are images that were not sent, which grow with each message.
    absent = {i: sequence - int(numbers(heard)[i]) for i, sequence in frames.items()}
    least = max(absent[i] for i in frames if i <= after_from) - min(absent[i] for i in frames if i >= before_to)
    most = min(absent[i] for i in frames if i >= after_to) - max(absent[i] for i in frames if i <= before_from)
    assert least <= after - before <= most, (least, after - before, most, frames)


def counted(node: Bridge, topic: str, heard: Heard, bus: Bus) -> tuple[int, int, int]:
    """A message, the number of its sample, and the samples that the program missed before it.

    The count was the same before the sample was captured and after its message came.
    """
    while True:
        missed, now_ns = node.status()["topics"][topic]["missed"], time.time_ns()
        until(lambda: stamp_ns(decode(IMU, heard.payloads[-1])) > now_ns, "a later sample")  # noqa: B023
        index = len(heard.payloads) - 1
        # The next status may have been made before the message.
        if [node.status()["topics"][topic]["missed"] for _ in range(2)] != [missed] * 2:
            continue
        time_ns = stamp_ns(decode(IMU, heard.payloads[index])) - utc_offset_ns()
        until(lambda: max(list(bus.frames)) > time_ns, "the batch of the message")  # noqa: B023
        for _, batch in sorted(bus.frames.items()):
            away_ns = np.abs(batch.array["time_ns"] - time_ns)
            # This test's own reader may miss a batch on a busy computer.
            if away_ns.min() < STAMP_NS:
                return index, batch.header.sequence * len(batch.array) + int(away_ns.argmin()), missed


def test_after_a_pause_every_sample_comes_that_the_channel_kept_and_the_others_are_counted(node: Bridge, router: Router, runtime: Path) -> None:
    topic = f"{TOP}/imu/data_raw"
    with Bus(runtime, "top/imu", "cell") as bus, router.hear(topic, IMU) as heard:
        heard.wait(200)
        first, first_number, before = counted(node, topic, heard, bus)
        stand_still(node)
        node.process.send_signal(signal.SIGCONT)
        heard.wait(len(heard.payloads) + 400)
        last, last_number, after = counted(node, topic, heard, bus)
    stamps = np.array([stamp_ns(message) for message in heard.messages()])
    sent_as = numbers(heard)
    lost = int((np.diff(sent_as[first : last + 1]) - 1).sum())
    absent = last_number - first_number - (last - first)
    assert after > before and absent == lost + after - before, (absent, lost, before, after)
    # After each gap the oldest batch comes that the channel kept, which keeps the last four.
    batches = [seen for _, seen in sorted(bus.frames.items())]
    times = np.concatenate([batch.array["time_ns"] for batch in batches]) + utc_offset_ns()
    nearest = np.abs(times[None] - stamps[:, None]).argmin(axis=1)
    is_seen = np.abs(times[nearest] - stamps) < STAMP_NS
    batch_of = np.concatenate([np.full(len(batch.array), batch.header.sequence) for batch in batches])[nearest]
    gaps = [
        i
        for i in range(first + 1, last + 1)
        if is_seen[i - 1] and is_seen[i] and batch_of[i] > batch_of[i - 1] + 1 and sent_as[i] == sent_as[i - 1] + 1
    ]
    assert gaps or lost or bus.missed
    for i in gaps:
        newest = min(b.header.sequence for b in batches if b.header.publish_time_ns > heard.times_ns[i]) - 1
        assert batch_of[i] <= newest - 2, (batch_of[i - 1], batch_of[i], newest)


def test_diagnostics_have_the_cameras_and_this_program(node: Bridge, router: Router) -> None:
    with router.hear("/diagnostics", DIAGNOSTICS) as heard:
        message = heard.wait(2)[-1]
    entries = {s.name: s for s in message.status}
    assert set(entries) == {"cell/top", "cell/ros2"}
    camera = entries["cell/top"]
    values = {v.key: v.value for v in camera.values}
    level = camera.level if isinstance(camera.level, int) else camera.level[0]
    assert (level, camera.message, camera.hardware_id) == (0, "streaming", "sim-top")
    assert 5 < float(values["color.rate_hz"]) < 20 and int(values["depth.captured"]) > 0
    assert any(v.key.endswith("image_raw.sent") for v in entries["cell/ros2"].values)


def test_every_sample_of_a_signal_is_sent(node: Bridge, router: Router, runtime: Path) -> None:
    with (
        depthrig.Signal("arm/joints", ["a", "b"], unit="rad/s", kind="joints", runtime_dir=runtime) as joints,
        depthrig.Signal("arm/tip", kind="pose", frame="base", runtime_dir=runtime) as tip,
    ):
        tokens = ("%cell%arm%joints%joint_states/", "%cell%arm%tip%pose/")

        def announced() -> bool:
            # A reader gets the last sample with the next one.
            joints.publish([0.0, 0.0])
            tip.publish([1, 2, 3, 0, 0, 0, 1])
            return all(any(t in token for token in list(router.tokens)) for t in tokens)

        until(announced, "announced")
        with (
            router.hear("/cell/arm/joints/joint_states", JOINTS) as states,
            router.hear("/cell/arm/tip/pose", POSE) as poses,
        ):
            times: dict[int, int] = {}

            def published(i: int) -> bool:
                joints.publish([float(-i), 0.5])
                tip.publish([1, 2, 3, 0, 0, 0, 1])
                return bool(states.payloads and poses.payloads)

            i = 0
            until(lambda: published(i), "the first")
            for i in range(1, 301):
                times[i] = time.monotonic_ns()
                joints.publish([float(i), 0.5], time_ns=times[i])
                time.sleep(0.001)

            def passed() -> bool:
                joints.publish([301.0, 0.5])
                return decode(JOINTS, states.payloads[-1]).velocity[0] > 300

            until(passed, "all")
            messages = states.messages()
            values = np.array([m.velocity[0] for m in messages]).clip(0)
            # A message that is lost on its way has a number: the numbers of those that came are as far apart as their samples.
            assert (np.diff(numbers(states)[: len(messages)]) >= np.diff(values)).all(), values
            counted_up = [(int(v), m) for v, m in zip(values, messages, strict=True) if 0 < v <= 300]
            assert counted_up and (np.diff([i for i, _ in counted_up]) > 0).all(), values
            offset = utc_offset_ns()
            for i, message in counted_up:
                assert (list(message.name), list(message.position)) == (["a", "b"], [])
                assert abs(stamp_ns(message) - offset - times[i]) < 2_000_000
            pose = poses.messages()[-1]
            assert pose.header.frame_id == "base"
            assert (pose.pose.position.z, pose.pose.orientation.w) == (3, 1)
    until(
        lambda: not any("%joint_states" in t and "/MP/" in t for t in router.tokens), "the topic goes with the signal"
    )


def test_samples_of_a_signal_that_were_replaced_before_they_were_read_are_counted(node: Bridge, router: Router, runtime: Path) -> None:
    topic = "/cell/arm/fast/joint_states"
    with (
        depthrig.Signal("arm/fast", ["n"], unit="rad", kind="joints", runtime_dir=runtime) as fast,
        router.hear(topic, JOINTS) as heard,
    ):
        published = 0

        def publish() -> int:
            nonlocal published
            published += 1
            fast.publish([float(published)])
            return published

        until(lambda: publish() and heard.payloads, "the first")
        stand_still(node, 0)
        while publish() < 3000:
            pass
        node.process.send_signal(signal.SIGCONT)
        # The last one of these may be lost on its way.
        until(lambda: publish() and decode(JOINTS, heard.payloads[-1]).position[0] >= 3000, "a sample after them")
        node.status()
        missed = node.wait(lambda s: s["topics"][topic]["missed"], "samples are missed")["topics"][topic]["missed"]
        values = np.array([message.position[0] for message in heard.messages()])
        lost = int((np.diff(numbers(heard)[: len(values)]) - 1).sum())
    # The channel keeps 512.
    assert len(values) + lost >= 512 and np.all(np.diff(values) > 0)
    assert len(values) + lost + missed == values[-1] - values[0] + 1, (len(values), lost, missed, values[[0, -1]])


def joint_state(names: list[str], values: list[float], utc_ns: int, velocity: tuple[float, ...] = ()) -> bytes:
    arrays = [np.array(a, np.float64) for a in (values, velocity, ())]
    return _types.encode(JOINTS, _types.make(JOINTS, _types.header(utc_ns, ""), names, *arrays))


@pytest.mark.parametrize(
    ("topic", "name"),
    [
        ("/joint_states", "ros/joint_states"),
        ("/arm/joint_states", "arm/joint_states"),
        ("/a/B-2/pose", "a_b_2/pose"),
        ("/2/3", "t2/t3"),
        (f"/{'x' * 40}/{'y' * 40}", f"{'x' * 31}/{'y' * 22}"),
    ],
)
def test_the_signal_of_a_topic_has_a_valid_name(topic: str, name: str) -> None:
    assert signal_name(topic) == name
    depthrig.SignalDescription(f"{name}_velocity", "fields", "", [depthrig.SignalField("a")])


def test_joint_states_of_ros_become_a_signal(node: Bridge, router: Router, runtime: Path) -> None:
    key = f"0/joint_states/{_types.about(JOINTS)}"
    # As a reliable publisher of ROS 2: a message waits for its place on the way.
    publisher = router.session.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK)
    token = router.session.liveliness().declare_token(
        _names.endpoint_token(
            0, "f00d", "robot", 7, "MP", "/joint_states", f"{_types.about(JOINTS)}/{_names.Qos.RELIABLE.value}"
        )
    )
    until(
        lambda: any("/MS/" in t and "/%joint_states/sensor" in t for t in router.tokens), "the subscriber is announced"
    )
    try:
        first = time.monotonic_ns()
        publisher.put(joint_state(["a", "b"], [1.0, 2.0], time.time_ns(), velocity=(0.1, 0.2)))
        with (
            depthrig.SignalReader("ros/joint_states", runtime, timeout=WAIT_S) as position,
            depthrig.SignalReader("ros/joint_states_velocity", runtime, timeout=WAIT_S) as velocity,
        ):

            def put(i: int) -> bool:
                publisher.put(joint_state(["b", "a"], [2.0, float(i)], time.time_ns(), velocity=(0.2, 0.1)))
                return (s := position.latest()) is not None and velocity.latest() is not None and s["a"] == i

            until(lambda: put(7), "a sample comes")
            sample = position.latest()
            assert sample is not None and (sample["a"], sample["b"]) == (7, 2)
            assert [(f.name, f.unit) for f in sample.description.fields] == [("a", "rad"), ("b", "rad")]
            assert first < sample.time_ns <= time.monotonic_ns() and 0 < sample.uncertainty_ns < 10_000_000
            assert velocity.latest()["b"] == 0.2  # type: ignore[index]
            before = node.status()["refused"]["/joint_states"]
            good = joint_state(["a", "b"], [1.0, 2.0], time.time_ns())
            bad = [
                *(good[:n] for n in range(0, len(good), 5)),
                b"",
                b"\xff" * 64,
                good[:16] + b"\xff\xff\xff\xff" + good[20:],
                os.urandom(200),
                bytes(2 << 20),
                joint_state(["a", "c"], [1.0, 2.0], time.time_ns()),
                joint_state(["a"], [1.0], time.time_ns()),
                joint_state(["a", "a"], [1.0, 2.0], time.time_ns()),
                joint_state(["a", "b"], [1.0], time.time_ns()),
                joint_state(["a", "b"], [], time.time_ns()),
                joint_state(["a", "b"], [1.0, 2.0], 12_000_000_000),
                joint_state(["a", "b"], [1.0, 2.0], time.time_ns() + 10**10),
            ]
            for payload in bad:
                publisher.put(payload)
            node.wait(lambda s: s["refused"]["/joint_states"] >= before + len(bad), "each is refused")
            text = node.log.read_text()
            for said in (
                "its joints are a, c, those of signal ros/joint_states are a, b",
                "two joints have the same name",
                "names 2 joints and has 1 values of position",
                "it has no values",
                "stamps are UTC, not simulated time",
                "ahead of the clock",
                "is not a sensor_msgs/msg/JointState in CDR",
            ):
                assert said in text, said
            assert "Traceback" not in text
            until(lambda: put(9), "samples still come")
            assert position.restarts == 0
        # A signal that comes from ROS is not sent back.
        time.sleep(1.2)
        assert not any("%ros%joint_states" in t for t in router.tokens)
    finally:
        token.undeclare()
        publisher.undeclare()


def test_poses_of_ros_become_a_signal(node: Bridge, router: Router, runtime: Path) -> None:
    def pose(frame: str, x: float) -> bytes:
        point = _types.make("geometry_msgs/msg/Point", x, 2.0, 3.0)
        turned = _types.make("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.6, 0.8)
        inner = _types.make("geometry_msgs/msg/Pose", point, turned)
        return _types.encode(POSE, _types.make(POSE, _types.header(0, frame), inner))

    # Of Humble, which has no hash.
    publisher = router.session.declare_publisher(
        "0/arm/pose/geometry_msgs::msg::dds_::PoseStamped_/TypeHashNotSupported",
        congestion_control=zenoh.CongestionControl.BLOCK,
    )
    publisher.put(pose("base", 1.0))
    with depthrig.SignalReader("arm/pose", runtime, timeout=WAIT_S) as reader:

        def put(x: float) -> bool:
            publisher.put(pose("base", x))
            return (s := reader.latest()) is not None and s.values[0] == x

        until(lambda: put(5.0), "a pose comes")
        sample = reader.latest()
        assert sample is not None and list(sample.values) == [5, 2, 3, 0, 0, 0.6, 0.8]
        assert (sample.description.kind, sample.description.frame) == ("pose", "base")
        publisher.put(pose("world", 1.0))
        publisher.put(pose("base", float("nan")))
        until(lambda: "its pose is in frame 'world'" in node.log.read_text(), "another frame is refused")
        until(lambda: "not finite" in node.log.read_text(), "NaN is refused")
    publisher.undeclare()


def test_an_independent_implementation_receives_every_type(node: Bridge, router: Router, runtime: Path) -> None:
    pytest.importorskip("zenoh_ros2_sdk", reason="no zenoh-ros2-sdk; tests/readers/requirements.txt has it")
    topics = {
        f"{TOP}/color/image_raw": IMAGE,
        f"{TOP}/color/camera_info": CAMERA_INFO,
        f"{TOP}/color/image_raw/compressed": COMPRESSED,
        f"{TOP}/depth/points": POINTS,
        f"{TOP}/imu/data_raw": IMU,
        "/cell/arm/joints/joint_states": JOINTS,
        "/chatter": "std_msgs/msg/String",
    }
    text = json.dumps({t: (definition(t), _types.type_hash(t)) for t in topics.values()})
    arguments = [part for pair in topics.items() for part in pair]
    script = Path(__file__).parent / "ros2_sdk_node.py"
    program = [sys.executable, str(script), str(router.port), *arguments]
    chatter = router.session.declare_publisher(f"0/chatter/{_types.about('std_msgs/msg/String')}")
    with (
        Bus(runtime, "top/color", "cell") as bus,
        depthrig.Signal("arm/joints", ["a", "b"], unit="rad", kind="joints", runtime_dir=runtime) as joints,
        subprocess.Popen(program, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as sdk,
    ):
        assert sdk.stdin is not None and sdk.stdout is not None
        sdk.stdin.write(text)
        sdk.stdin.close()
        hello = _types.encode("std_msgs/msg/String", _types.make("std_msgs/msg/String", "hello"))

        def both() -> bool:
            joints.publish([0.25, -1.0])
            chatter.put(hello, attachment=_names.attachment(1, 1, bytes(16)))
            return sdk.poll() is not None

        until(both, "it receives")
        assert sdk.returncode == 0
        messages = list(map(json.loads, sdk.stdout))
        heard = {m["topic"]: m for m in messages}
        images = {m["stamp"]: m for m in messages if m["topic"] == f"{TOP}/color/image_raw"}
        frames = bus.frames_of(list(images))
    chatter.undeclare()
    assert heard.keys() == topics.keys()
    for stamp, seen in frames.items():
        image = images[stamp]
        assert (image["encoding"], image["width"], image["height"]) == ("rgb8", 640, 480)
        assert image["sha"] == hashlib.sha256(seen.array.tobytes()).hexdigest()
    assert heard[f"{TOP}/color/camera_info"]["distortion_model"] == "plumb_bob"
    assert heard[f"{TOP}/depth/points"]["size"] == 640 * 480 * 12
    assert abs(heard[f"{TOP}/imu/data_raw"]["accel"]) < 50
    assert heard["/cell/arm/joints/joint_states"]["position"] == [0.25, -1.0]
    assert heard["/chatter"]["sha"] == hashlib.sha256(b"hello").hexdigest()


def test_a_killed_subscriber_ends_the_sending(node: Bridge, router: Router) -> None:
    topic = f"{TOP}/color/image_raw"
    program = """import sys, time, zenoh
config = zenoh.Config()
for name, value in {"mode": '"peer"', "connect/endpoints": f'["tcp/127.0.0.1:{sys.argv[1]}"]',
                    "scouting/multicast/enabled": "false"}.items():
    config.insert_json5(name, value)
session = zenoh.open(config)
count = 0
def came(sample):
    global count
    count += 1
    if count == 5:
        print("5", flush=True)
subscriber = session.declare_subscriber(sys.argv[2], came)
time.sleep(600)
"""
    key = f"0{topic}/{_types.about(IMAGE)}"
    with subprocess.Popen(
        [sys.executable, "-c", program, str(router.port), key], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None and process.stdout.readline() == "5\n"
        node.wait(lambda s: s["topics"][topic]["subscribed"], "subscribed")
        process.kill()
    status = node.wait(lambda s: not s["topics"][topic]["subscribed"], "it is gone")
    assert node.wait(lambda s: True, "")["frames_read"] == node.status()["frames_read"], status


def test_a_router_that_is_killed_comes_back(rig: object, runtime: Path, tmp_path: Path) -> None:
    port = free_port()
    program = f"""import time, zenoh
config = zenoh.Config()
for name, value in {{"mode": '"router"', "listen/endpoints": '["tcp/127.0.0.1:{port}"]',
                    "scouting/multicast/enabled": "false"}}.items():
    config.insert_json5(name, value)
session = zenoh.open(config)
time.sleep(600)
"""
    topic = f"{TOP}/depth/camera_info"
    with bridge(runtime, tmp_path / "log", port, "--streams", "top/depth") as started:
        started.wait(lambda s: topic in s["topics"], "it runs without a router")
        until(lambda: "ros2 run rmw_zenoh_cpp rmw_zenohd" in (tmp_path / "log").read_text(), "the cure is named")
        with subprocess.Popen([sys.executable, "-c", program]) as first:
            started.wait(lambda s: s["router"], "connected")
            first.kill()
        started.wait(lambda s: not s["router"], "not connected")
        router = Router(port)
        try:
            router.wait_for(topic, "/tf_static")
            with router.hear(topic, CAMERA_INFO) as heard:
                heard.wait(3)
            streams = {t.split("/")[9] for t in router.tokens if "/MP/" in t}
            assert not any("color" in t for t in streams)
        finally:
            router.close()


def test_a_daemon_that_is_killed_comes_back_and_a_killed_bridge_disturbs_nobody(
    binary: str, runtime: Path, router: Router, tmp_path: Path
) -> None:
    text = RIG.replace('"cell"', '"second"').replace("cheap = true", 'cheap = true\nserial = "sim-second"')
    (tmp_path / "rig.toml").write_text(text.replace("[0.1, 0.0, 0.2]", "[0.5, 0.0, 0.0]"))
    start = ("run", str(tmp_path / "rig.toml"), "-q")
    topic = "/second/top/color/image_raw"
    with bridge(
        runtime, tmp_path / "bridge.log", router.port, "--rig", "second", "--domain", "3", code=-signal.SIGKILL
    ) as started:
        with running(binary, runtime, tmp_path / "log", *start, codes=CODES) as daemon:
            router.wait_for(topic)
            with router.hear(topic, IMAGE, domain=3) as heard:
                heard.wait(3)
                daemon.kill()
                daemon.wait()
                started.wait(
                    lambda s: not s["running"] and "rig second is not running" in started.log.read_text(), "gone"
                )
        with (
            running(binary, runtime, tmp_path / "log", *start, codes=CODES) as daemon,
            router.hear(topic, IMAGE, domain=3) as heard,
        ):
            heard.wait(3)
            with depthrig.Stream("top/color", "second", runtime, timeout=WAIT_S) as stream:
                before = stream.next(WAIT_S).sequence
                started.process.kill()
                started.process.wait()
                for _ in range(15):
                    after = stream.next(WAIT_S)
                # A busy computer's own reader here may come too late.
                assert (after.sequence, stream.restarts) == (before + 15 + stream.missed, 0)
                assert after.header.drops["no_slot"] == 0
                until(lambda: not any("/depthrig_second/" in t for t in router.tokens), "its tokens go")
            assert daemon.poll() is None


def test_it_ends_with_a_signal_and_takes_back_what_it_announced(
    rig: object, runtime: Path, router: Router, tmp_path: Path
) -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        with bridge(runtime, tmp_path / "log", router.port, "--domain", "9") as started:
            until(lambda: any(t.startswith("@ros2_lv/9/") and "%points" in t for t in router.tokens), "announced")
            started.process.send_signal(number)
            assert started.process.wait(WAIT_S) == 0
            until(lambda: not any(t.startswith("@ros2_lv/9/") for t in router.tokens), "taken back")


def test_what_cannot_work_is_named(runtime: Path, rig: object, tmp_path: Path) -> None:
    def run(*options: str, **more: str) -> tuple[int, str]:
        program = [sys.executable, "-m", "depthrig.ros2", *options]
        env = {**environment(runtime), **more}
        done = subprocess.run(program, env=env, capture_output=True, text=True, timeout=WAIT_S, check=False)
        return done.returncode, done.stderr

    code, said = run("--router", "nonsense")
    assert code == 1 and "tcp/HOST:PORT" in said and "Traceback" not in said, said
    code, said = run("--zenoh-config", str(tmp_path / "missing.json5"))
    assert code == 1 and "missing.json5" in said and "Traceback" not in said, said
    code, said = run("--subscribe", "joint_states")
    assert code == 2 and "invalid topic" in said
    code, said = run(ROS_DOMAIN_ID="x")
    assert code == 2 and "domain x is out of range 0..=232" in said


@pytest.mark.parametrize("pixels", ["RGB8", "BGR8", "MONO8", "MONO16", "YUYV", "UYVY", "NV12", "DISPARITY_F32"])
def test_every_pixel_format_becomes_an_image_that_ros_knows(pixels: str) -> None:
    frame = painted(pixels)
    stamp = _types.header(5_000_000_007, "f")
    message = decode(IMAGE, bytes(_images.raw(frame, stamp)))
    known = {"BGR8": "bgr8", "MONO8": "mono8", "MONO16": "mono16", "DISPARITY_F32": "32FC1"}
    assert message.encoding == known.get(pixels, "rgb8")
    assert (message.height, message.width, stamp_ns(message)) == (4, 6, 5_000_000_007)
    if pixels in ("YUYV", "UYVY", "NV12"):
        # Red, by BT.601: 81, 90, 240.
        red = np.frombuffer(message.data, np.uint8).reshape(4, 6, 3)
        assert (np.abs(red.astype(int) - [255, 0, 0]) <= 3).all()
    else:
        assert bytes(message.data) == frame.array.tobytes()
    if _images.is_color(frame.header):
        file = decode(COMPRESSED, bytes(_images.jpeg(frame, stamp))).data
        assert Image.open(io.BytesIO(file)).size == (6, 4)


def painted(pixels: str) -> Any:
    """A frame of one colour in memory of its own, whose rows are padded where the format allows it."""
    import ctypes

    from depthrig import _layout
    from depthrig._frame import Frame
    from depthrig._header import Header, HeaderBytes, blank_fields, essentials

    kind = depthrig.PixelFormat[pixels]
    element, size, channels = _layout.ELEMENTS[kind]
    rows = 6 if pixels == "NV12" else 4
    row = {
        "YUYV": [81, 90, 81, 240] * 3,
        "UYVY": [90, 81, 240, 81] * 3,
    }.get(pixels, list(range(6 * channels)))
    array = np.tile(np.array(row, element), (rows, 1))
    if pixels == "NV12":
        array[:4], array[4:] = 81, [90, 240] * 3
    stride = 6 * size * channels + 8
    raw = np.zeros((rows, stride), np.uint8)
    raw[:, : stride - 8] = array.view(np.uint8).reshape(rows, -1)
    buffer = ctypes.create_string_buffer(raw.tobytes(), raw.nbytes)
    about = {"format": int(kind), "width": 6, "height": 4, "stride": stride, "payload_len": raw.nbytes, "sequence": 1}
    fixed = {"magic": _layout.HEADER_MAGIC, "version": _layout.HEADER_VERSION, "size": _layout.HEADER_SIZE}
    packed = Header.pack(blank_fields(_layout.FIELDS) | fixed | about)
    header = HeaderBytes.from_buffer_copy(packed)
    return Frame(buffer, header, essentials(header), ctypes.addressof(buffer), raw.nbytes)
