"""A viewer with Foxglove's own libraries (tests/readers/foxglove.mjs), in a process of its own."""

from __future__ import annotations

import json
import queue
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from test_daemon import ROOT, WAIT_S, command

READERS = ROOT / "tests" / "readers"
SUBPROTOCOLS = ("foxglove.websocket.v1", "foxglove.sdk.v1")


@dataclass
class Viewer:
    """A connected viewer; it is told what to do, and says what happens."""

    process: subprocess.Popen[str]
    said: queue.Queue[dict[str, Any] | None] = field(default_factory=queue.Queue)
    channels: dict[str, dict[str, Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.said.put(json.loads(line))
        self.said.put(None)

    def say(self, **what: object) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(what) + "\n")
        self.process.stdin.flush()

    def hear(self, timeout: float = WAIT_S) -> dict[str, Any]:
        """What happens next."""
        said = self.said.get(timeout=timeout)
        assert said is not None, "the viewer has ended"
        for channel in said.get("advertise", ()):
            self.channels[channel["topic"]] = channel
        return said

    def wait(self, kind: str, which: Callable[[Any], Any] = lambda _: True) -> Any:
        """The next thing of this kind for which `which` is true."""
        deadline = time.monotonic() + WAIT_S
        while True:
            said = self.hear(max(0.01, deadline - time.monotonic()))
            if kind in said and which(said[kind]):
                return said[kind]

    def message(self, topic: str) -> dict[str, Any]:
        """The next message of a topic."""
        return self.wait("message", lambda m: m["topic"] == topic)

    def know(self, *topics: str) -> None:
        """Waits until these topics are announced."""
        while not self.channels.keys() >= set(topics):
            self.wait("advertise")

    def subscribe(self, *topics: str) -> None:
        self.know(*topics)
        self.say(subscribe=topics)

    def during(self, seconds: float) -> list[dict[str, Any]]:
        """The messages that come in the next seconds."""
        deadline = time.monotonic() + seconds
        messages = []
        while (left := deadline - time.monotonic()) > 0:
            try:
                said = self.hear(left)
            except queue.Empty:
                break
            if "message" in said:
                messages.append(said["message"])
        return messages


@contextmanager
def viewer(url: str, protocol: str = SUBPROTOCOLS[0]) -> Iterator[Viewer]:
    """A viewer that connects to `url`."""
    process = subprocess.Popen(
        ["node", "foxglove.mjs", url, protocol],
        cwd=READERS,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        yield Viewer(process)
    finally:
        process.kill()
        process.wait()


def address(binary: str, runtime: Path, rig: str) -> str:
    """The address that `depthrig open --foxglove` prints, as soon as the rig runs."""
    deadline = time.monotonic() + WAIT_S
    while not (text := command(binary, runtime, "open", "--foxglove", "--rig", rig, codes=(0, 1)).strip()):
        assert time.monotonic() < deadline
        time.sleep(0.1)
    return text
