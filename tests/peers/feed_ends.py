"""One end of a transport that carries images: `feed.py` runs two of these at a time.

feed_ends.py WAY send|receive CONFIG.json

Every sender has the images in memory of its own, as a driver has, and sends one every 1/fps seconds. Every receiver
notes the time when a NumPy array of the image exists; reading the pixels is not part of it. Two times travel with each
image: `begin`, when the sender turned to the image, and `publish`, right before the call that sends it. Where a
transport has shared memory, its buffer is filled between the two.
"""

from __future__ import annotations

import json
import struct
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

now = time.monotonic_ns
TIMES = struct.Struct("<qq")


def images(config: dict[str, Any]) -> list[np.ndarray]:
    random = np.random.default_rng(1)
    return [random.integers(0, 256, config["bytes"], np.uint8) for _ in range(8)]


def paced(config: dict[str, Any]) -> Iterator[np.ndarray]:
    """The images in turns, each at its time."""
    turns = images(config)
    start = time.monotonic()
    for i in range(1, config["frames"] + config["warm_up"] + 31):  # some more for a receiver that joins late
        time.sleep(max(0.0, start + i / config["fps"] - time.monotonic()))
        yield turns[i % len(turns)]


class Samples:
    """A receiver's measurements."""

    def __init__(self, config: dict[str, Any]) -> None:
        self.config = config
        self.publish: list[int] = []
        self.total: list[int] = []
        self.seen = 0

    def add(self, array: np.ndarray, begin: int, published: int) -> bool:
        """Record the current time for an array that exists; return whether that was the last one."""
        at = now()
        assert array.nbytes == self.config["bytes"], array.nbytes
        assert array.shape == tuple(self.config["shape"]), array.shape
        self.seen += 1
        if self.seen > self.config["warm_up"]:
            self.publish.append(at - published)
            self.total.append(at - begin)
        return len(self.publish) >= self.config["frames"]

    def save(self, **more: Any) -> None:
        text = json.dumps({"publish": self.publish, "total": self.total, **more})
        partial = Path(self.config["result"] + ".part")
        partial.write_text(text)
        partial.rename(self.config["result"])


def depthrig_receive(config: dict[str, Any], prepare: bool = True) -> None:
    import depthrig

    samples = Samples(config)
    with depthrig.Stream("feed/image", runtime_dir=config["folder"], timeout=10, prepare=prepare) as stream:
        while True:
            frame = stream.next(timeout=10)
            array = frame.array
            at = now()
            header = frame.header
            # The clock was read before the header was: reading it is what a peer's receiver does not have to.
            late = now() - at
            done = samples.add(array, header.device_time + late, header.publish_time_ns + late)
            del frame, array
            if done:
                return samples.save(missed=stream.missed)


def plain_receive(config: dict[str, Any]) -> None:
    depthrig_receive(config, prepare=False)


def zmq_send(config: dict[str, Any]) -> None:
    import zmq

    socket = zmq.Context().socket(zmq.PUB)
    socket.sndhwm = 4
    socket.bind(f"ipc://{config['folder']}/zmq")
    for image in paced(config):
        t = now()
        socket.send_multipart([TIMES.pack(t, t), image], copy=False)


def zmq_receive(config: dict[str, Any]) -> None:
    import zmq

    socket = zmq.Context().socket(zmq.SUB)
    socket.rcvhwm = 4
    socket.rcvtimeo = 10_000
    socket.subscribe(b"")
    socket.connect(f"ipc://{config['folder']}/zmq")
    samples = Samples(config)
    while True:
        head, body = socket.recv_multipart(copy=False)
        array = np.frombuffer(body.buffer, config["dtype"]).reshape(config["shape"])
        if samples.add(array, *TIMES.unpack(head.bytes)):
            return samples.save()


def zenoh_session(config: dict[str, Any], end: str) -> Any:
    import zenoh

    zenoh.init_log_from_env_or("error")
    settings = zenoh.Config()
    settings.insert_json5("mode", '"peer"')
    settings.insert_json5("scouting/multicast/enabled", "false")
    settings.insert_json5("scouting/gossip/enabled", "false")
    settings.insert_json5("transport/shared_memory/enabled", "true")
    address = json.dumps([f"unixsock-stream/{config['folder']}/zenoh"])
    settings.insert_json5(f"{end}/endpoints", address)
    settings.insert_json5("connect/endpoints" if end == "listen" else "listen/endpoints", "[]")
    return zenoh.open(settings)


def zenoh_send(config: dict[str, Any]) -> None:
    import zenoh

    session = zenoh_session(config, "listen")
    publisher = session.declare_publisher(
        "feed/image", congestion_control=zenoh.CongestionControl.BLOCK, priority=zenoh.Priority.REAL_TIME
    )
    provider = zenoh.shm.ShmProvider.default_backend(config["bytes"] * 16)
    policy = zenoh.shm.BlockOn(zenoh.shm.GarbageCollect())
    # Its buffers take `bytes` only: the image is that already, as a driver would have it for zenoh.
    turns = {id(p): bytes(p) for p in images(config)}
    ready = list(turns.values())
    for i, _ in enumerate(paced(config)):
        begin = now()
        buffer = provider.alloc(config["bytes"], policy=policy)
        buffer[:] = ready[i % len(ready)]
        publisher.put(buffer, attachment=TIMES.pack(begin, now()))


def zenoh_receive(config: dict[str, Any]) -> None:
    session = zenoh_session(config, "connect")
    subscriber = session.declare_subscriber("feed/image")
    samples = Samples(config)
    shared = True
    for sample in subscriber:
        payload = sample.payload
        shared &= payload.as_shm() is not None
        # zenoh-python gives a payload's bytes as a copy; there is no view of them.
        array = np.frombuffer(payload.to_bytes(), config["dtype"]).reshape(config["shape"])
        if samples.add(array, *TIMES.unpack(sample.attachment.to_bytes())):
            assert shared, "zenoh did not use its shared memory"
            return samples.save()


def dora_send(config: dict[str, Any]) -> None:
    import dora
    import pyarrow

    node = dora.Node()
    for image in paced(config):
        array = pyarrow.array(image)
        t = now()
        # The copy into its shared memory happens in here, so its `publish` contains that copy.
        node.send_output("image", array, {"begin": str(t), "publish": str(t)})


def dora_receive(config: dict[str, Any]) -> None:
    import dora

    samples = Samples(config)
    for event in dora.Node():
        if event["type"] == "INPUT":
            array = event["value"].to_numpy(zero_copy_only=True).view(config["dtype"]).reshape(config["shape"])
            times = event["metadata"]
            if samples.add(array, int(times["begin"]), int(times["publish"])):
                return samples.save()


def main() -> None:
    way, end, config = sys.argv[1:]
    globals()[f"{way}_{end}"](json.loads(Path(config).read_text()))


if __name__ == "__main__":
    main()
