"""Any dataset, opened with Python readers that are not ours: mcap, rosbags and rerun.

usage: python check_open.py DATASET [EXPECTED]

Each reader must open every segment, read every message and verify its checksum, and find images of every stream that
session.toml names, all of the same number. EXPECTED is a JSON list of the images as depthrig itself read them, each with
`topic`, `log_time` (UTC, nanoseconds, as text), `width`, `height`, `encoding` and `crc32` of its pixels: then each reader must
find exactly these, bit by bit. An image that is stored as a JPEG or PNG has the `crc32` of that file, and must be one.
Prints a line for each reader; exits with 1 when one of them finds something else.
"""

import io
import json
import sys
import tomllib
import zlib
from collections import Counter
from pathlib import Path

from mcap.reader import NonSeekingReader, make_reader
from mcap_ros2.decoder import DecoderFactory
from PIL import Image
from rerun.chunk import McapReader
from rosbags.highlevel import AnyReader

IMAGES = ("/image_raw", "/image_compressed", "/depth_compressed")
DEPTH = ("16UC1", "32FC1")


def found(topic, log_time, message):
    """An image as EXPECTED has it."""
    data = bytes(message.data)
    image = {"topic": topic, "log_time": str(log_time), "crc32": zlib.crc32(data)}
    if topic.endswith("/image_raw"):
        assert not message.is_bigendian
        return {**image, "width": message.width, "height": message.height, "encoding": message.encoding}
    if topic.endswith("/image_compressed"):
        size = Image.open(io.BytesIO(data)).convert("RGB").size
        return {**image, "width": size[0], "height": size[1], "encoding": message.format}
    return {**image, "width": message.width, "height": message.height, "encoding": "rank"}


def by_mcap(segments, kind):
    for segment in segments:
        with segment.open("rb") as file:
            reader = kind(file, decoder_factories=[DecoderFactory()], validate_crcs=True)
            for _, channel, message, decoded in reader.iter_decoded_messages():
                if channel.topic.endswith(IMAGES):
                    yield found(channel.topic, message.log_time, decoded)


def by_rosbags(segments):
    for segment in segments:
        with AnyReader([segment]) as reader:
            for connection, log_time, raw in reader.messages():
                message = reader.deserialize(raw, connection.msgtype)
                if connection.topic.endswith(IMAGES):
                    yield found(connection.topic, log_time, message)


def by_rerun(segments):
    """The images that rerun shows. It gives only the bytes, without sizes, and marks depth as depth."""
    for segment in segments:
        for chunk in McapReader(str(segment)).stream():
            batch, topic = chunk.to_record_batch(), str(chunk.entity_path)
            for kind in {"DepthImage:buffer", "EncodedImage:blob", "Image:buffer"} & set(batch.schema.names):
                times = batch.column("message_log_time").cast("int64").to_pylist()
                for log_time, data in zip(times, batch.column(kind), strict=True):
                    data = data.values[0].values.to_numpy().tobytes()
                    yield {"topic": topic, "log_time": str(log_time), "crc32": zlib.crc32(data), "kind": kind.split(":")[0]}


def check(images, streams, expected):
    """Check the images that a reader found; return a summary."""
    counts = Counter(p["topic"].rpartition("/")[0] for p in images)
    missing = streams - counts.keys()
    assert not missing, f"no image of {', '.join(sorted(missing))}"
    if expected is not None:
        key = lambda p: (p["topic"], p["log_time"])  # noqa: E731
        got = {key(p): p for p in images}
        assert len(got) == len(images), "an image came twice"
        for image in expected:
            one = got.pop(key(image), None)
            assert one, f"{image['topic']} at {image['log_time']} is missing"
            wrong = {k for k in image.keys() & one.keys() if image[k] != one[k]}
            assert not wrong, f"{image['topic']} at {image['log_time']}: other {', '.join(sorted(wrong))}"
            depth = image["encoding"] in DEPTH
            assert one.get("kind", "DepthImage") == "DepthImage" or not depth, f"{image['topic']}: not seen as depth"
        assert not got, f"{len(got)} images too many, {next(iter(got))} for one"
    equal = "" if expected is None else ", each bit by bit"
    return f"{len(images)} images of {len(counts)} streams{equal}"


def main():
    if len(sys.argv) not in (2, 3):
        sys.exit(__doc__)
    dataset = Path(sys.argv[1])
    expected = json.loads(Path(sys.argv[2]).read_text()) if len(sys.argv) == 3 else None
    segments = sorted(dataset.glob("seg_*.mcap"))
    assert segments, f"{dataset} has no segments"
    session = tomllib.loads((dataset / "session.toml").read_text())
    streams = {f"/{session['rig']}/{s['id']}" for s in session["streams"]}
    # Formats that rerun has no image for are not its fault, and packed depth is for our own package.
    skipped = ("rank", "mono16")
    readers = {
        "mcap, by its index": lambda: by_mcap(segments, make_reader),
        "mcap, as a stream": lambda: by_mcap(segments, NonSeekingReader),
        "rosbags": lambda: by_rosbags(segments),
        "rerun": lambda: by_rerun(segments),
    }
    failed = False
    for name, read in readers.items():
        wanted, among = expected, streams
        if name == "rerun" and expected is not None:
            wanted = [p for p in expected if p["encoding"] not in skipped]
            among = {p["topic"].rpartition("/")[0] for p in wanted}
        try:
            print(f"ok   {name}: {check(list(read()), among, wanted)}", flush=True)
        except Exception as error:  # whatever a reader raises means that it cannot read this
            failed = True
            print(f"FAIL {name}: {type(error).__name__}: {error}", flush=True)
    sys.exit(failed)


if __name__ == "__main__":
    main()
