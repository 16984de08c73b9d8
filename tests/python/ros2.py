"""For tests of `depthrig-ros2`: a router in place of rmw_zenohd, the program, and a decoder of another project."""

from __future__ import annotations

import json
import queue
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import zenoh
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory

import depthrig
from depthrig.ros2 import _types
from test_daemon import WAIT_S, environment

STAMP_NS = 2_000_000
"""How far two readings of the clocks' offset may be apart on a loaded machine; frames are further apart."""


def until(condition: Callable[[], Any], what: str) -> Any:
    deadline = time.monotonic() + WAIT_S
    while not (value := condition()):
        assert time.monotonic() < deadline, what
        time.sleep(0.02)
    return value


def definition(ros_type: str) -> str:
    """The text of a type's definition with all that it uses."""
    return str(_types.STORE.generate_msgdef(ros_type, ros_version=2)[0])


_DECODERS: dict[str, Callable[[bytes], Any]] = {}


def decode(ros_type: str, payload: bytes) -> Any:
    """A message, by the decoder of mcap-ros2-support."""
    if ros_type not in _DECODERS:
        text = definition(ros_type).encode()
        decoder = DecoderFactory().decoder_for("cdr", Schema(id=1, name=ros_type, encoding="ros2msg", data=text))
        assert decoder is not None
        _DECODERS[ros_type] = decoder
    return _DECODERS[ros_type](payload)


def stamp_ns(message: Any) -> int:
    return int(message.header.stamp.sec) * 1_000_000_000 + int(message.header.stamp.nanosec)


def by_stamp(messages: list[Any]) -> dict[int, Any]:
    return {stamp_ns(message): message for message in messages}


@dataclass
class Heard:
    """What came on a topic."""

    ros_type: str
    payloads: list[bytes] = field(default_factory=list)
    attachments: list[bytes] = field(default_factory=list)
    times_ns: list[int] = field(default_factory=list)
    subscriber: Any = None

    def came(self, sample: zenoh.Sample) -> None:
        self.times_ns.append(time.monotonic_ns())
        self.attachments.append(sample.attachment.to_bytes() if sample.attachment else b"")
        self.payloads.append(sample.payload.to_bytes())

    def wait(self, count: int = 1) -> list[Any]:
        """The messages, once there are so many."""
        until(
            lambda: len(self.payloads) >= count, f"{count} messages of {self.ros_type}, there are {len(self.payloads)}"
        )
        return self.messages()

    def messages(self) -> list[Any]:
        return [decode(self.ros_type, payload) for payload in list(self.payloads)]


def free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return int(listener.getsockname()[1])


def router_session(port: int) -> zenoh.Session:
    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", f'["tcp/127.0.0.1:{port}"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    return zenoh.open(config)


class Router:
    """A router, at which the tests listen: what is subscribed here is subscribed at the router."""

    def __init__(self, port: int) -> None:
        self.port = port
        self.tokens: set[str] = set()
        self._lock = threading.Lock()
        self.session = router_session(port)
        watched = self.session.liveliness().declare_subscriber("@ros2_lv/**", self._token, history=True)
        self._watched = watched

    def _token(self, sample: zenoh.Sample) -> None:
        token = {str(sample.key_expr)}
        # A new set each time: the tests go through the old one meanwhile.
        with self._lock:
            self.tokens = self.tokens | token if sample.kind == zenoh.SampleKind.PUT else self.tokens - token

    def wait_for(self, *topics: str) -> None:
        """Wait until these topics are announced."""
        marks = [f"/{topic.replace('/', '%')}/" for topic in topics]
        until(lambda: all(any(m in t for t in self.tokens) for m in marks), f"{topics} in {self.tokens}")

    @contextmanager
    def hear(self, topic: str, ros_type: str, domain: int = 0) -> Iterator[Heard]:
        """Subscribe to a topic by its exact key."""
        heard = Heard(ros_type)
        key = f"{domain}{topic}/{_types.dds_name(ros_type)}/{_types.type_hash(ros_type)}"
        heard.subscriber = self.session.declare_subscriber(key, heard.came)
        try:
            yield heard
        finally:
            heard.subscriber.undeclare()

    def close(self) -> None:
        self.session.close()


@dataclass
class Bridge:
    """A running `depthrig-ros2 --json`."""

    process: subprocess.Popen[str]
    log: Path
    lines: queue.Queue[str] = field(default_factory=queue.Queue)

    def __post_init__(self) -> None:
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.lines.put(line)

    def status(self) -> dict[str, Any]:
        """The next status."""
        while not self.lines.empty():
            self.lines.get()
        return dict(json.loads(self.lines.get(timeout=WAIT_S)))

    def wait(self, which: Callable[[dict[str, Any]], Any], what: str) -> dict[str, Any]:
        deadline = time.monotonic() + WAIT_S
        while not which(status := self.status()):
            assert time.monotonic() < deadline, f"{what}: {status}\n{self.log.read_text()}"
        return status

    def cpu_s(self) -> float:
        fields = Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / 100


@contextmanager
def bridge(runtime: Path, log: Path, port: int, *options: str, code: int = 0) -> Iterator[Bridge]:
    """The program, which is ended with SIGTERM and must then end with `code`."""
    program = [sys.executable, "-m", "depthrig.ros2", "--json", "--router", f"tcp/127.0.0.1:{port}", *options]
    with log.open("w") as out:
        process = subprocess.Popen(
            program, env={**environment(runtime), "ROS_DOMAIN_ID": ""}, stdout=subprocess.PIPE, stderr=out, text=True
        )
    running = Bridge(process, log)
    try:
        yield running
        if process.poll() is None:
            process.terminate()
        assert process.wait(WAIT_S) == code, log.read_text()
    finally:
        process.kill()
        process.wait()


@dataclass(frozen=True)
class Seen:
    """A frame as the bus has it."""

    header: depthrig.Header
    array: np.ndarray
    depth_m: np.ndarray | None


def utc_offset_ns() -> int:
    """What to add to this computer's monotonic time for UTC; the reading that was interrupted least."""
    readings = []
    for _ in range(10):
        before_ns = time.monotonic_ns()
        utc_ns = time.time_ns()
        after_ns = time.monotonic_ns()
        readings.append((after_ns - before_ns, utc_ns - (before_ns + after_ns) // 2))
    return min(readings)[1]


class Bus:
    """Keeps all frames of a stream for a while, read beside the program."""

    def __init__(self, runtime: Path, name: str, rig: str) -> None:
        self.frames: dict[int, Seen] = {}
        self._stop = threading.Event()
        self._stream = depthrig.Stream(name, rig, runtime, timeout=WAIT_S)
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        while not self._stop.is_set():
            try:
                frame = self._stream.next(timeout=0.2)
            except (depthrig.Timeout, depthrig.StreamGone):
                continue
            depth = frame.depth_m() if frame.header.is_depth else None
            self.frames[frame.capture_time_ns] = Seen(frame.header, frame.copy(), depth)

    @property
    def missed(self) -> int:
        """Frames for which this reader came too late."""
        return self._stream.missed

    def frames_of(self, stamps_ns: list[int]) -> dict[int, Seen]:
        """The frames of stamps in UTC, once they were read, and by the stamp: all but those for which this reader itself came too late."""
        offset_ns = utc_offset_ns()
        found = {}
        for stamp_ns in stamps_ns:
            time_ns = stamp_ns - offset_ns
            until(lambda: any(t > time_ns - STAMP_NS for t in list(self.frames)), f"a frame of {time_ns} or later")  # noqa: B023
            nearest = min(list(self.frames), key=lambda t: abs(t - time_ns))  # noqa: B023
            if abs(nearest - time_ns) < STAMP_NS:
                found[stamp_ns] = self.frames[nearest]
        begun_ns = min(list(self.frames)) + offset_ns
        absent = sum(stamp_ns > begun_ns for stamp_ns in set(stamps_ns) - found.keys())
        assert found and absent <= self.missed, (absent, self.missed, stamps_ns, sorted(self.frames))
        return found

    def __enter__(self) -> Bus:
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        self._stream.close()
