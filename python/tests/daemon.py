"""The daemon's side of the hand-shake inside a test, so that a test sets the daemon's requests and reads the messages.

The real daemon is in test_external_daemon.py; this one can be silent, faulty or of another version.
"""

from __future__ import annotations

import ctypes
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from depthrig import _layout as layout
from depthrig import _ports as ports
from depthrig._bus import Bus
from depthrig._header import blank_fields, pack_fields, unpack_fields
from rig import WAIT_S

ANSWER = blank_fields(layout.EXTERNAL_ANSWER_FIELDS)
ANSWER |= {"magic": layout.EXTERNAL_ANSWER_MAGIC, "version": layout.EXTERNAL_VERSION}
ANSWER |= {"size": layout.EXTERNAL_ANSWER_SIZE}


class FakeDaemon:
    """Reads offers and frames, and answers; heartbeats come from a thread while `beating`."""

    def __init__(self, folder: Path, camera: str = "front", rig: str = "mount") -> None:
        self._bus = Bus.at(str(folder))
        self._prefix = f"{layout.EXTERNAL_PREFIX}/{rig}/{camera}"
        self._offers = ports.Letters(self._bus, f"{self._prefix}/offer", ports.OFFER, layout.EXTERNAL_OFFER_SIZE)
        self._answers = ports.Sender(self._bus, f"{self._prefix}/answer", ports.ANSWER, 64, 8, ports.TALK)
        self._bell = ports.Bell(self._bus, f"{self._prefix}/answer", ports.TALK)
        self._frames: dict[str, Any] = {}
        self._lock = threading.Lock()
        self._number = 0
        self.offer: dict[str, Any] | None = None
        self.offers = 0
        self.modes: list[dict[str, Any]] = []
        self._said: dict[str, Any] | None = None
        self._payload = b""
        self.beating = True
        self._closed = False
        self._thread = threading.Thread(target=self._beat, daemon=True)
        self._thread.start()

    def _beat(self) -> None:
        while not self._closed:
            if self.beating and self._said is not None:
                self._send()
            time.sleep(0.1)

    def _send(self) -> None:
        with self._lock:
            if self._said is None:
                return
            self._number += 1
            values = {**ANSWER, "number": self._number, "sent_ns": time.monotonic_ns(), **self._said}
            slot = self._answers.loan(len(self._payload))
            assert slot is not None
            head = pack_fields(layout.EXTERNAL_ANSWER_FIELDS, layout.EXTERNAL_ANSWER_SIZE, values)
            ctypes.memmove(slot.header_address, head, len(head))
            ctypes.memmove(slot.address, self._payload, len(self._payload))
            slot.send()
        self._bell.ring()

    def read(self) -> None:
        """Read the offer."""
        while (message := self._offers.take()) is not None:
            self.offer = unpack_fields(layout.EXTERNAL_OFFER_FIELDS, message[0])
            self.offers += 1
            size = layout.EXTERNAL_MODE_SIZE
            records = [message[1][i : i + size] for i in range(0, len(message[1]), size)]
            self.modes = [unpack_fields(layout.EXTERNAL_MODE_FIELDS, r) for r in records]

    def until(self, **expected: Any) -> dict[str, Any]:
        """Wait for an offer with these fields."""
        deadline = time.monotonic() + WAIT_S
        while time.monotonic() < deadline:
            self.read()
            if self.offer is not None and all(self.offer[k] == v for k, v in expected.items()):
                return self.offer
            time.sleep(0.005)
        raise AssertionError(f"no offer with {expected}, the last is {self.offer}")

    def say(
        self, want: int, session: int, modes: bytes | None = None, change: dict[str, Any] | None = None, **fields: Any
    ) -> None:
        """Answer the camera's offer, and again with every heartbeat; `change` makes it wrong."""
        offer = self.until()
        self._payload = bytes([1] * offer["modes"]) if modes is None else modes
        self._said = {
            "instance": offer["instance"],
            "want": int(want),
            "session": session,
            "modes": len(self._payload),
            **fields,
            **(change or {}),
        }
        self._send()

    def subscribe(self, *streams: str) -> None:
        """As the daemon does before it says `run`."""
        for stream in streams:
            name = f"{self._prefix}/frames/{stream}"
            service = ports._service(self._bus, name, ports.FRAME, ports.FRAMES)
            self._frames[stream] = (service, service.subscriber_builder().create())

    def run(self, session: int = 1, streams: tuple[str, ...] = ("color",), **fields: Any) -> None:
        self.subscribe(*streams)
        self.say(layout.ExternalWant.RUN, session, **fields)

    def frame(self, stream: str) -> tuple[dict[str, Any], bytes]:
        """Wait for a frame; returns its header and its bytes."""
        deadline = time.monotonic() + WAIT_S
        while time.monotonic() < deadline:
            sample = self._frames[stream][1].receive()
            if sample is not None:
                head = ctypes.string_at(sample.user_header_ptr, layout.EXTERNAL_FRAME_SIZE)
                values = unpack_fields(layout.EXTERNAL_FRAME_FIELDS, head)
                return values, ctypes.string_at(sample.payload_ptr, sample.header.number_of_elements)
            time.sleep(0.002)
        raise AssertionError(f"no frame of {stream} came")

    def silent(self, stream: str) -> bool:
        return self._frames[stream][1].receive() is None

    def close(self) -> None:
        self._closed = True
        self._thread.join()
        self._frames.clear()


@contextmanager
def fake_daemon(folder: Path, **names: str) -> Iterator[FakeDaemon]:
    daemon = FakeDaemon(folder, **names)
    try:
        yield daemon
    finally:
        daemon.close()
