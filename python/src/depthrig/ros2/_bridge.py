"""Looks once a second which streams and signals there are, and keeps a feed for each."""

from __future__ import annotations

import fnmatch
import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import zenoh

from .._recording import Recording
from .._runtime import holder, pick_rig
from .._signal import signals
from .._stream import streams
from ..errors import DepthrigError, RigNotRunning
from . import _messages, _types
from ._clock import Clock
from ._feed import Feed
from ._inbound import Inbound
from ._names import Qos
from ._node import Node
from ._poses import Poses
from ._signal_feed import SignalFeed
from ._stream_feed import StreamFeed

log = logging.getLogger("depthrig.ros2")

_LOOK_S = 1.0
REMIND_S = 10.0
_STATUS_TIMEOUT_S = 2.0
_NO_ROUTER = (
    "no router at the configured address yet; start one with `ros2 run rmw_zenoh_cpp rmw_zenohd`, or give the address "
    "of one that runs with --router tcp/HOST:PORT"
)


def wait_for_rig(folder: str, rig: str | None, stop: threading.Event) -> str | None:
    """Return the rig's name, waiting until one runs; None once `stop` is set. Raises AmbiguousRig if several do."""
    remind = Reminder()
    while not stop.is_set():
        try:
            return pick_rig(folder, rig)
        except RigNotRunning as e:
            remind.say("rig", str(e))
        stop.wait(_LOOK_S)
    return None


class Reminder:
    """Logs what is still missing, each thing every 10 s."""

    def __init__(self) -> None:
        self._due: dict[str, float] = {}

    def say(self, what: str, text: str) -> None:
        """Log it unless it was logged within the last 10 s."""
        now = time.monotonic()
        if now >= self._due.get(what, 0.0):
            self._due[what] = now + REMIND_S
            log.warning("%s", text)

    def settle(self, what: str, text: str) -> None:
        """Log that it is there now, if it was missing."""
        if self._due.pop(what, None) is not None:
            log.info("%s", text)


class Bridge:
    """A rig in a zenoh session."""

    def __init__(
        self,
        session: zenoh.Session,
        rig: str,
        folder: str,
        domain: int,
        patterns: Sequence[str] = (),
        subscribe: Sequence[str] = (),
    ) -> None:
        self._session = session
        self._rig = rig
        self._folder = folder
        self._patterns = patterns
        self._clock = Clock()
        self._node = Node(session, domain, f"depthrig_{rig}")
        self._poses = Poses(self._node, rig)
        self._changed = threading.Event()
        self._diagnostics = self._node.publisher("/diagnostics", _types.DIAGNOSTICS, Qos.RELIABLE, self._changed.set)
        self._inbound = Inbound(self._node, list(subscribe), folder) if subscribe else None
        self._feeds: dict[tuple[str, str], Feed] = {}
        self._holder: str | None = None
        self._read = 0
        self._remind = Reminder()

    def run(self, stop: threading.Event, report: Callable[[Mapping[str, Any]], None]) -> None:
        """Publish until `stop` is set; `report` gets the status about once a second."""
        while not stop.is_set():
            self._look()
            self._check_router()
            if self._diagnostics.wanted:
                self._diagnose()
            report(self.status())
            stop.wait(_LOOK_S)

    def close(self) -> None:
        """Take back all that was announced."""
        self._end(list(self._feeds))
        if self._inbound is not None:
            self._inbound.close()
        self._diagnostics.close()
        self._poses.close()
        self._node.close()

    def status(self) -> dict[str, Any]:
        """Return what was read and sent so far."""
        feeds = list(self._feeds.values())
        wanted = {p.topic for feed in feeds for p in feed.publishers if p.wanted}
        wanted |= {"/diagnostics"} if self._diagnostics.wanted else set()
        read = self._read + sum(feed.read for feed in feeds if isinstance(feed, StreamFeed))
        topics = {
            topic: {"subscribed": topic in wanted, **vars(count)} for topic, count in sorted(self._node.counts.items())
        }
        inbound = self._inbound
        return {
            "rig": self._rig,
            "running": self._holder is not None,
            "router": bool(self._session.info.routers_zid()),
            "frames_read": read,
            "topics": topics,
            "signals": {} if inbound is None else dict(inbound.published),
            "refused": {} if inbound is None else dict(inbound.refused),
            "overrun": 0 if inbound is None else inbound.overrun,
        }

    def _look(self) -> None:
        """Begin feeds of what has come, end those of what has gone."""
        runs = holder(self._folder, self._rig)
        if runs != self._holder:
            # Another daemon may have other formats, sizes and poses.
            self._end([key for key in self._feeds if key[0] == "stream"])
            if self._holder is not None:
                self._poses.forget()
            self._holder = runs
        if runs is None:
            self._remind.say("rig", f"rig {self._rig} is not running; its topics come back with it")
        else:
            self._remind.settle("rig", f"rig {self._rig} runs")
        present = self._present(runs is not None)
        self._end([key for key, feed in self._feeds.items() if key not in present or not feed.is_alive])
        for key in present - self._feeds.keys():
            kind, name = key
            common = (self._node, self._rig, self._folder, name, self._clock)
            feed: Feed = StreamFeed(*common, self._poses) if kind == "stream" else SignalFeed(*common)
            self._feeds[key] = feed
            feed.start()

    def _present(self, runs: bool) -> set[tuple[str, str]]:
        """Return the streams and signals to publish, as kind and name."""
        try:
            found = {("stream", name) for name in streams(self._rig, self._folder)} if runs else set()
            own = set() if self._inbound is None else self._inbound.signal_names()
            found |= {("signal", name) for name in signals(self._folder) if name not in own}
        except DepthrigError as e:
            self._remind.say("bus", str(e))
            return set()
        if self._patterns:
            return {key for key in found if any(fnmatch.fnmatchcase(key[1], pattern) for pattern in self._patterns)}
        return found

    def _end(self, keys: list[tuple[str, str]]) -> None:
        ended = [self._feeds.pop(key) for key in keys]
        for feed in ended:
            feed.stop()
        for feed in ended:
            feed.join()
            self._read += feed.read if isinstance(feed, StreamFeed) else 0

    def _check_router(self) -> None:
        if self._session.info.routers_zid():
            self._remind.settle("router", "connected to a router")
        else:
            self._remind.say("router", _NO_ROUTER)

    def _diagnose(self) -> None:
        own = {
            f"{topic}.{name}": str(n)
            for topic, count in list(self._node.counts.items())
            for name, n in vars(count).items()
            if n
        }
        try:
            asked = Recording(self._rig, self._folder)
            status: Mapping[str, Any] = asked._call("GET", "/v1/status", None, _STATUS_TIMEOUT_S)
        except (DepthrigError, ValueError):
            status = {"rig": self._rig}
        self._diagnostics.put(_messages.diagnostics(status, own, time.time_ns()))
