"""Common base of streams and sets: finding the channel, waiting, iterating."""

from __future__ import annotations

import ctypes
import os
import time
from typing import Generic, TypeVar

from . import _layout
from ._bus import Bus, Receiver
from ._runtime import PathLike, holder, not_running, pick_rig, runtime_dir
from .errors import DepthrigError, RigNotRunning, StreamGone, StreamNotFound, Timeout

T = TypeVar("T")
Self = TypeVar("Self", bound="Reader")  # type: ignore[type-arg]

# How often a waiting reader lets Python handle signals, and checks for a publisher.
SLICE_S = 0.1
LIVENESS_S = 0.5


class Reader(Generic[T]):
    """A channel of a rig, opened for reading. One thread at a time may read."""

    def __init__(
        self,
        channel: str,
        header: type[ctypes.Structure],
        rig: str | None,
        folder: PathLike | None,
        timeout: float,
    ) -> None:
        self._receiver: Receiver | None = None
        path = runtime_dir(folder)
        deadline = time.monotonic() + timeout
        while True:
            try:
                self.rig = pick_rig(path, rig)
                if not os.path.isdir(path):
                    raise not_running(path, self.rig)
                self._receiver = self._receive(Bus.at(path), channel, header)
                return
            except (RigNotRunning, StreamNotFound):
                if time.monotonic() >= deadline:
                    raise
            time.sleep(0.02)

    def _receive(self, bus: Bus, channel: str, header: type[ctypes.Structure]) -> Receiver:
        rig = self.rig
        what = f"stream {channel} of rig {rig!r}"

        def missing() -> DepthrigError:
            streams = bus.streams(rig)
            if streams:
                return StreamNotFound(f"{what}: nobody publishes it; the rig has: {', '.join(streams)}")
            if holder(bus.folder, rig) is None:
                return not_running(bus.folder, rig)
            return StreamNotFound(f"{what}: the rig is running but has no stream yet")

        return Receiver(bus, f"depthrig/{rig}/{channel}", _layout.SCHEMA, header, what, missing)

    @property
    def _open(self) -> Receiver:
        if self._receiver is None:
            raise ValueError("it was closed")
        return self._receiver

    def _take(self) -> T | None:
        raise NotImplementedError

    def _pause(self, seconds: float) -> None:
        """Wait until a frame is published, or up to `seconds`; may return early."""
        self._open.wait(seconds)

    def latest(self) -> T | None:
        """Return the newest unread frame, skipping older ones; None when nothing came since the last call."""
        newest = self._take()
        while newest is not None and self._open.has_unread():
            newest = None  # gives its slot back before the next one is taken
            newest = self._take()
        return newest

    def next(self, timeout: float | None = None) -> T:
        """Return the oldest unread frame, waiting for one up to `timeout` seconds (None: as long as it takes).

        Raises Timeout when none came in time, and StreamGone when the publisher has gone. After StreamGone the
        same object can be asked again: it goes on with the frames of a publisher that came back.
        """
        started = time.monotonic()
        deadline = float("inf") if timeout is None else started + timeout
        look = started + LIVENESS_S
        while True:
            item = self._take()
            if item is not None:
                return item
            now = time.monotonic()
            if now >= look:
                self._check_publisher()
                look = now + LIVENESS_S
            if now >= deadline:
                raise Timeout(
                    f"{self._open.what}: nothing came within {timeout:g} s; `depthrig status` shows what the camera "
                    "is doing"
                )
            self._pause(min(SLICE_S, deadline - now, look - now))

    def _check_publisher(self) -> None:
        """Raise StreamGone when the channel has no publisher any more."""
        if not self._open.has_publisher():
            raise StreamGone(
                f"{self._open.what}: nobody publishes it any more; is the daemon running (`depthrig status`)?"
            )

    @property
    def is_live(self) -> bool:
        """Whether there is a publisher now."""
        return self._open.has_publisher()

    def close(self) -> None:
        """Stop subscribing. Frames and arrays that are held stay valid."""
        if self._receiver is not None:
            self._receiver.close()
            self._receiver = None

    def __enter__(self: Self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __iter__(self: Self) -> Self:
        return self

    def __next__(self) -> T:
        if self._receiver is None:
            raise StopIteration
        return self.next()
