"""A dataset read with Python readers that are not ours: mcap, rosbags and rerun.

usage: python check_python.py DATASET EXPECTED

DATASET is a dataset of depthrig, EXPECTED a folder with index.json and bare pixels as
`tests/src/expected.rs` writes it. Each reader must find every image: lossless ones bit by bit, JPEGs
within 40 dB of what depthrig itself decodes; depth in our own codec by way of the Python package depthrig, which
only rerun cannot ask. Exits with 1 and says which image differs otherwise.
"""

import io
import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from depthrig.codec import decode_depth, unpack_depth
from mcap.reader import NonSeekingReader, make_reader
from mcap_ros2.decoder import DecoderFactory
from PIL import Image
from rerun.chunk import McapReader
from rosbags.highlevel import AnyReader

DTYPES = {
    "16UC1": np.dtype("<u2"),
    "32FC1": np.dtype("<f4"),
    "mono8": np.dtype("u1"),
    "rgb8": np.dtype("u1"),
    "yuv422_yuy2": np.dtype("u1"),
}

CHANNELS = {"rgb8": (3,), "yuv422_yuy2": (2,)}


def shape(image):
    return (image["height"], image["width"], *CHANNELS.get(image["encoding"], ()))


def load(expected):
    """The expected images by (topic, log time in nanoseconds)."""
    index = json.loads((expected / "index.json").read_text())
    images = {}
    for p in index["images"]:
        data = (expected / p["file"]).read_bytes()
        p["pixels"] = np.frombuffer(data, DTYPES[p["encoding"]]).reshape(shape(p))
        images[p["topic"], int(p["log_time"])] = p
    return index, images


def compare(reader, image, got):
    want, name = image["pixels"], f"{reader}: {image['topic']} of set {image['set']}"
    assert got.shape == want.shape, f"{name}: shape {got.shape}, expected {want.shape}"
    if image["compare"] == "exact":
        # As bytes: a hole of a disparity is NaN, which equals nothing.
        wrong = np.count_nonzero(np.ascontiguousarray(got).view(np.uint8) != np.ascontiguousarray(want).view(np.uint8))
        assert wrong == 0, f"{name}: {wrong} of {want.size} values differ"
        return
    error = np.mean((got.astype(float) - want.astype(float)) ** 2)
    psnr = 10 * np.log10(255**2 / max(error, 1e-12))
    assert psnr > 40, f"{name}: {psnr:.1f} dB from what depthrig decodes"


def decode_color(data):
    return np.asarray(Image.open(io.BytesIO(bytes(data))).convert("RGB"))


def from_message(image, message):
    """The pixels in a decoded sensor_msgs Image or CompressedImage."""
    if image["codec"] in ("jpeg", "png"):
        assert message.format == image["codec"], message.format
        return decode_color(message.data)
    if image["codec"] == "rank":
        return unpack_depth(message.data, message.height, message.width, message.step)
    assert message.encoding == image["encoding"], f"{image['topic']}: encoding {message.encoding}"
    assert not message.is_bigendian
    return np.frombuffer(bytes(message.data), DTYPES[message.encoding]).reshape(shape(image))


def nanoseconds(stamp):
    return stamp.sec * 1_000_000_000 + stamp.nanosec


def check_poses(transforms, index):
    """Every stream's optical frame is on the mount, where the session says."""
    poses = {t.child_frame_id: t for t in transforms}
    for p in index["images"]:
        _, _, camera, stream = p["base"].split("/")
        t = poses[f"{camera}_{stream}_optical_frame"]
        assert t.header.frame_id == f"{index['rig']}_mount", t.header.frame_id
        v, q = t.transform.translation, t.transform.rotation
        assert [v.x, v.y, v.z] == p["translation"] and [q.x, q.y, q.z, q.w] == p["rotation"]
    for u in index["units"]:
        t = poses[u["frame_id"]].transform
        v, q = t.translation, t.rotation
        assert [v.x, v.y, v.z] == u["translation"] and [q.x, q.y, q.z, q.w] == u["rotation"]


def check_motion(reader, index, singles, batches):
    """Every sample of an IMU, one by one and in its batch. Numbers are compared exactly; None stands for NaN."""

    def same(want, got):
        return all((w is None and np.isnan(g)) or w == g for w, g in zip(want, got, strict=True))

    def xyz(v):
        return [v.x, v.y, v.z]

    wanted = index["motion"]
    assert len(singles) == len(wanted), f"{reader}: {len(singles)} of {len(wanted)} samples"
    for want, (topic, time, imu) in zip(wanted, singles, strict=True):
        what = f"{reader}: sample {want['sequence']}"
        assert (topic, time) == (want["base"] + "/data_raw", int(want["log_time"])), f"{what}: {topic} at {time}"
        assert nanoseconds(imu.header.stamp) == int(want["stamp"]), f"{what}: stamp"
        _, _, camera, unit = want["base"].split("/")
        assert imu.header.frame_id == f"{camera}_{unit}_frame", f"{what}: {imu.header.frame_id}"
        assert same(want["gyro"], xyz(imu.angular_velocity)), f"{what}: {imu.angular_velocity}"
        assert same(want["accel"], xyz(imu.linear_acceleration)), f"{what}: {imu.linear_acceleration}"
        assert imu.orientation_covariance[0] == -1, f"{what}: it has no orientation"
        assert imu.linear_acceleration_covariance[0] == (-1 if want["accel"][0] is None else 0), what
    samples = [(topic, time, batch.sequence, s) for topic, time, batch in batches for s in batch.samples]
    assert len(samples) == len(wanted), f"{reader}: {len(samples)} of {len(wanted)} samples in batches"
    for want, (topic, time, batch, s) in zip(wanted, samples, strict=True):
        what = f"{reader}: sample {want['sequence']} of batch {batch}"
        assert (topic, time, batch) == (want["base"] + "/samples", int(want["log_time"]), want["batch"]), what
        assert s.time_ns == int(want["time_ns"]), what
        for field in ("device_time", "sequence", "uncertainty_ns", "accel_offset_ns", "flags"):
            assert getattr(s, field) == want[field], f"{what}: {field}"
        assert same(want["gyro"], s.gyro_rad_s) and same(want["accel"], s.accel_m_s2), what
        assert same([want["temperature_c"]], [s.temperature_c]), what
    if wanted:
        print(f"{reader}: {len(wanted)} IMU samples agree")


def check_projection(info):
    """Images are as the camera sent them: nothing is rectified, and a baseline is in the poses alone."""
    k = list(info.k)
    assert list(info.r) == [1, 0, 0, 0, 1, 0, 0, 0, 1], info.r
    assert list(info.p) == [*k[0:3], 0, *k[3:6], 0, *k[6:9], 0], info.p


def check_mcap(segments, index, images):
    """mcap + mcap-ros2-support: through the index and as a stream, with every checksum."""
    for kind in (make_reader, NonSeekingReader):
        seen, infos, sets, notes, frames = set(), {}, [], [], set()
        singles, batches = [], []
        for segment in segments:
            with segment.open("rb") as f:
                reader = kind(f, decoder_factories=[DecoderFactory()], validate_crcs=True)
                if kind is make_reader:
                    assert reader.get_header().profile == "ros2"
                for _, channel, message, ros in reader.iter_decoded_messages():
                    topic, key = channel.topic, (channel.topic, message.log_time)
                    if key in images:
                        p = images[key]
                        compare("mcap", p, from_message(p, ros))
                        if p["codec"] == "rank":
                            compare("mcap, undecoded", p, decode_depth(message.data))
                        assert nanoseconds(ros.header.stamp) == message.publish_time == int(p["stamp"])
                        assert float(channel.metadata["depth_unit_m"]) == p["depth_unit_m"]
                        seen.add(key)
                    elif topic.endswith("/camera_info"):
                        infos[topic.removesuffix("/camera_info"), message.log_time] = ros
                    elif topic.endswith("/frame_info"):
                        frames.add((topic.removesuffix("/frame_info"), message.log_time, ros.sequence, ros.set_id))
                    elif topic.endswith("/data_raw"):
                        assert nanoseconds(ros.header.stamp) == message.publish_time
                        singles.append((topic, message.log_time, ros))
                    elif topic.endswith("/samples"):
                        batches.append((topic, message.log_time, ros))
                    elif topic.endswith("/frame_set"):
                        sets.append(ros)
                    elif topic.endswith("/notes"):
                        notes.append(ros.msg)
                    elif topic == "/tf_static":
                        check_poses(ros.transforms, index)
                    elif topic == "/diagnostics":
                        status, disk = ros.status
                        assert disk.name == "golden/disk" and disk.level in (0, 1), disk
                        assert status.level == 0 and status.message == "streaming", status
                        assert [(v.key, v.value) for v in status.values] == [("drift_ppm", "1.5")]
        assert seen == images.keys(), f"mcap: {len(images.keys() - seen)} images are missing"
        wanted = [index["note"]] if index["note"] is not None else []
        assert len(sets) == index["sets"] and notes == wanted, (len(sets), notes)
        for (_, time), p in images.items():
            assert list(infos[p["base"], time].k) == p["k"], f"intrinsics of {p['base']}"
            assert list(infos[p["base"], time].d) == p["d"], f"distortion of {p['base']}"
            check_projection(infos[p["base"], time])
            assert (p["base"], time, p["sequence"], p["set"]) in frames, f"frame_info of {p['base']}"
        print(f"mcap {kind.__name__}: {len(seen)} images agree")
        check_motion(f"mcap {kind.__name__}", index, singles, batches)


def check_rosbags(segments, index, images):
    """rosbags: ROS 2 types, our own included, taken from the file alone."""
    seen, ours, singles, batches = set(), 0, [], []
    for segment in segments:
        with AnyReader([segment]) as reader:
            for connection, time, raw in reader.messages():
                message = reader.deserialize(raw, connection.msgtype)
                ours += connection.msgtype.startswith("depthrig_msgs/")
                key = (connection.topic, time)
                if key in images:
                    compare("rosbags", images[key], from_message(images[key], message))
                    seen.add(key)
                elif connection.topic.endswith("/data_raw"):
                    singles.append((connection.topic, time, message))
                elif connection.topic.endswith("/samples"):
                    batches.append((connection.topic, time, message))
    check_motion("rosbags", index, singles, batches)
    assert seen == images.keys(), f"rosbags: {len(images.keys() - seen)} images are missing"
    assert ours > 0
    print(f"rosbags: {len(seen)} images agree, {ours} messages of our own types")


def check_rerun(segments, images):
    """rerun's MCAP loader: depth must be a DepthImage in front of a Pinhole, not just numbers."""
    known = {k: p for k, p in images.items() if p["codec"] != "rank"}
    seen, pinholes = set(), set()
    for segment in segments:
        for chunk in McapReader(str(segment)).stream():
            batch, entity = chunk.to_record_batch(), str(chunk.entity_path)
            columns = set(batch.schema.names)
            if "Pinhole:image_from_camera" in columns:
                pinholes.add(entity.removesuffix("/camera_info"))
            for kind in ("DepthImage:buffer", "EncodedImage:blob", "Image:buffer"):
                if kind not in columns:
                    continue
                times = batch.column("message_log_time").cast("int64").to_pylist()
                for time, data in zip(times, batch.column(kind), strict=True):
                    p = images[entity, time]
                    data = data.values[0].values.to_numpy()
                    if p["codec"] in ("jpeg", "png"):
                        assert kind == "EncodedImage:blob", kind
                        got = decode_color(data)
                    else:
                        if p["encoding"] == "16UC1":
                            assert kind == "DepthImage:buffer", f"{entity} is a {kind}, not depth"
                        got = np.frombuffer(data.tobytes(), DTYPES[p["encoding"]]).reshape(shape(p))
                    compare("rerun", p, got)
                    seen.add((entity, time))
    assert seen == known.keys(), f"rerun: {len(known.keys() - seen)} images are missing"
    bases = {p["base"] for p in images.values()}
    assert pinholes == bases, f"rerun: no Pinhole for {bases - pinholes}"
    print(f"rerun: {len(seen)} images agree, {len(pinholes)} cameras are pinholes")
    # The command line's converter takes the file as well.
    command = shutil.which("rerun", path=str(Path(sys.executable).parent)) or shutil.which("rerun")
    with tempfile.TemporaryDirectory() as folder:
        for i, segment in enumerate(segments):
            out = Path(folder) / f"{i}.rrd"
            subprocess.run([command, "mcap", "convert", str(segment), "-o", str(out)], check=True, capture_output=True)
            printed = subprocess.run([command, "rrd", "print", "-v", str(out)], check=True, capture_output=True, text=True)
            assert "@Pinhole:image_from_camera" in printed.stdout
            assert len(known) < len(images) or "@DepthImage:buffer" in printed.stdout
    print("rerun mcap convert: depth images and pinholes")


def main():
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    dataset, expected = map(Path, sys.argv[1:])
    segments = sorted(dataset.glob("seg_*.mcap"))
    assert segments, f"{dataset} has no segments"
    index, images = load(expected)
    check_mcap(segments, index, images)
    check_rosbags(segments, index, images)
    check_rerun(segments, images)


if __name__ == "__main__":
    main()
