"""One measurement in a process of its own: `writers.py WRITER FRAMES SETS OUT` prints JSON.

It measures the CPU time, user and system, of all threads, from before the file is created until it is
closed, with the images in memory before. Seven cameras take turns at the images, five times a second.
The measurement favours the writer: messages are put together from bytes without a copy more than its
interface asks for, and nothing is synced.
"""

import json
import resource
import struct
import sys
import time
from pathlib import Path

import frames

CAMERAS = 7
START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 200_000_000


def _cdr_image(width: int, height: int, encoding: bytes, step: int, frame: bytes = b"optical\0") -> bytes:
    """All of a CDR `sensor_msgs/Image` before its pixels; the stamp is not of interest here."""
    out = struct.pack("<4xiII", 0, 0, len(frame)) + frame
    out += struct.pack("<III", height, width, len(encoding) + 1) + encoding + b"\0"
    out += b"\0" + b"\0" * ((-(len(out) + 1 - 4)) % 4)
    return out + struct.pack("<II", step, step * height)


def mcap_python(compression: str, jpeg: bool = False):
    """Python `mcap`: its `Writer` with its own chunk size and level."""
    import cv2
    import numpy as np
    from mcap.writer import CompressionType, Writer

    def write(head, sets, out):
        with (out / "recording.mcap").open("wb") as f:
            writer = Writer(f, compression=CompressionType[compression])
            writer.start("ros2")
            schema = writer.register_schema("sensor_msgs/msg/Image", "ros2msg", b"# as in ROS\n")
            topic = lambda name: writer.register_channel(name, "cdr", schema)  # noqa: E731
            channels = [(topic(f"/rig/cam{i}/color"), topic(f"/rig/cam{i}/depth")) for i in range(CAMERAS)]
            w, h = head["width"], head["height"]
            before = [_cdr_image(w, h, b"rgb8", 3 * w), _cdr_image(w, h, b"16UC1", 2 * w)]
            for n, pairs in enumerate(sets):
                t = START_NS + n * PERIOD_NS
                for ids, pair in zip(channels, pairs):
                    color, depth = pair[:2]
                    if jpeg:
                        bgr = pair[2][0]
                        settings = [cv2.IMWRITE_JPEG_QUALITY, 95, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, 0x111111]
                        color = cv2.imencode(".jpg", bgr, settings)[1].tobytes()
                    writer.add_message(ids[0], t, before[0] + color, t)
                    writer.add_message(ids[1], t, before[1] + depth, t)
            writer.finish()

    return write


def foxglove_sdk(compression: str | None, level: int = 0):
    """`foxglove-sdk`: Rust inside, protobuf `RawImage`, its own chunk size; `level` 0 is its own level."""
    import foxglove
    from foxglove.channels import RawImageChannel
    from foxglove.mcap import MCAPCompression, MCAPWriteOptions
    from foxglove.messages import RawImage, Timestamp

    def write(head, sets, out):
        packed = {"zstd": MCAPCompression.Zstd, "lz4": MCAPCompression.Lz4, None: None}[compression]
        # Compressing in other threads costs CPU time of this process all the same.
        options = MCAPWriteOptions(compression=packed, compression_level=level, compression_threads=0)
        writer = foxglove.open_mcap(out / "recording.mcap", writer_options=options)
        topic = lambda name: RawImageChannel(name)  # noqa: E731
        channels = [(topic(f"/rig/cam{i}/color"), topic(f"/rig/cam{i}/depth")) for i in range(CAMERAS)]
        w, h = head["width"], head["height"]
        kinds = (("rgb8", 3 * w), ("16UC1", 2 * w))
        for n, pairs in enumerate(sets):
            t = START_NS + n * PERIOD_NS
            stamp = Timestamp(t // 10**9, t % 10**9)
            for topics, pair in zip(channels, pairs):
                for channel, (encoding, step), pixels in zip(topics, kinds, pair):
                    message = RawImage(
                        timestamp=stamp,
                        frame_id="optical",
                        width=w,
                        height=h,
                        encoding=encoding,
                        step=step,
                        data=pixels,
                    )
                    channel.log(message, log_time=t)
        writer.close()

    return write


def rosbag_python(compression: str):
    """Debian's `rosbag`: `Bag.write` of `sensor_msgs/Image`, its own chunk size."""
    import rosbag
    from genpy import Time
    from sensor_msgs.msg import Image

    def write(head, sets, out):
        w, h = head["width"], head["height"]
        with rosbag.Bag(str(out / "recording.bag"), "w", compression=compression) as bag:
            for n, pairs in enumerate(sets):
                t = START_NS + n * PERIOD_NS
                stamp = Time(t // 10**9, t % 10**9)
                for i, pair in enumerate(pairs):
                    kinds = (("color", "rgb8", 3 * w), ("depth", "16UC1", 2 * w))
                    for (name, encoding, step), pixels in zip(kinds, pair):
                        message = Image(height=h, width=w, encoding=encoding, step=step, data=pixels)
                        message.header.stamp, message.header.frame_id = stamp, "optical"
                        bag.write(f"/rig/cam{i}/{name}", message, stamp)

    return write


def png_files():
    """The method of the paper's recorder: `cv2.imwrite` of one PNG per image, numbered, in a folder per camera."""
    import cv2

    def write(_head, sets, out):
        folders = [out / f"camera_{i}" for i in range(CAMERAS)]
        for folder in folders:
            folder.mkdir()
        for n, pairs in enumerate(sets):
            for folder, pair in zip(folders, pairs):
                bgr, depth = pair[2]
                cv2.imwrite(f"{folder}/color_{n}.png", bgr)
                cv2.imwrite(f"{folder}/depth_{n}.png", depth)

    return write


WRITERS = {
    "mcap, none": lambda: mcap_python("NONE"),
    "mcap, lz4": lambda: mcap_python("LZ4"),
    "mcap, zstd": lambda: mcap_python("ZSTD"),
    "foxglove-sdk, none": lambda: foxglove_sdk(None),
    "foxglove-sdk, lz4": lambda: foxglove_sdk("lz4"),
    "foxglove-sdk, zstd": lambda: foxglove_sdk("zstd"),
    "foxglove-sdk, zstd level 1": lambda: foxglove_sdk("zstd", 1),
    "rosbag, none": lambda: rosbag_python("none"),
    "rosbag, lz4": lambda: rosbag_python("lz4"),
    "PNG files (cv2)": png_files,
    "mcap, zstd, JPEG by cv2": lambda: mcap_python("ZSTD", jpeg=True),
}


def cpu_s() -> float:
    """User and system time of this process, all threads."""
    r = resource.getrusage(resource.RUSAGE_SELF)
    return r.ru_utime + r.ru_stime


def main() -> None:
    import cv2
    import numpy as np

    cv2.setNumThreads(1)
    writer, path, count, out = sys.argv[1], Path(sys.argv[2]), int(sys.argv[3]), Path(sys.argv[4])
    head, pool = frames.load(path)
    shape = (head["height"], head["width"])
    pool = [
        (c, d, (np.ascontiguousarray(np.frombuffer(c, np.uint8).reshape(*shape, 3)[..., ::-1]), np.frombuffer(d, "<u2").reshape(shape)))
        for c, d in pool
    ]
    sets = [[pool[(n + i) % len(pool)] for i in range(CAMERAS)] for n in range(count)]
    write = WRITERS[writer]()
    out.mkdir()
    wall, cpu = time.monotonic(), cpu_s()
    write(head, sets, out)
    cpu, wall = cpu_s() - cpu, time.monotonic() - wall
    disk = sum(f.stat().st_size for f in out.rglob("*") if f.is_file())
    if writer.startswith("PNG"):
        read = cv2.imread(str(out / "camera_1/color_0.png")), cv2.imread(str(out / "camera_1/depth_0.png"), -1)
        assert all(np.array_equal(a, b) for a, b in zip(read, sets[0][1][2])), "PNG changed an image"
    pairs = count * CAMERAS
    raw = pairs * sum(len(p) for p in pool[0][:2])
    print(json.dumps({"cpu_s": cpu, "wall_s": wall, "raw_bytes": raw, "disk_bytes": disk, "pairs": pairs}))


if __name__ == "__main__":
    main()
