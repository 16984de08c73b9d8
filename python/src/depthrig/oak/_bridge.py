"""The loop from the SDK's queues to the daemon: derives the modes, forwards the frames."""

from __future__ import annotations

import datetime
import logging
import math
import time
from collections.abc import Callable
from typing import Any

import depthai as dai
import numpy as np
import numpy.typing as npt

from .._external import ExternalCamera
from .._external_mode import ExternalMode
from .._external_session import ExternalSession
from .._layout import ExternalClock, PixelFormat
from . import _lens
from ._errors import Exit, OakError
from ._lossless import LosslessQueue
from ._source import Source

log = logging.getLogger("depthrig.oak")

_FORMATS = {
    "BGR888i": PixelFormat.BGR8,
    "RGB888i": PixelFormat.RGB8,
    "NV12": PixelFormat.NV12,
    "GRAY8": PixelFormat.MONO8,
    "RAW8": PixelFormat.MONO8,
    "RAW16": PixelFormat.Z16,
}
_TICK_PS = 1_000_000
"""The SDK gives times to the microsecond."""
_FIRST_FRAME_S = 8.0
"""How long a pipeline may take to its first frame: less than the daemon's `start_timeout_s`, so that it learns why."""
_WAIT_S = 0.1


def microseconds(value: datetime.timedelta) -> int:
    """Return a time of the SDK in whole microseconds, without rounding."""
    return (value.days * 86_400 + value.seconds) * 1_000_000 + value.microseconds


def pixels(frame: dai.ImgFrame) -> npt.NDArray[Any]:
    """Return a frame's pixels in the SDK's memory, without a copy: `(H, W, 3)` u8, `(H, W)` u8 or u16, rows padded.

    Raises OakError when there are fewer than the frame's header states.
    """
    kind = _FORMATS[frame.getType().name]
    data: npt.NDArray[Any] = np.asarray(frame.getData())
    width, height, stride = frame.getWidth(), frame.getHeight(), frame.getStride()
    size = {PixelFormat.BGR8: 3, PixelFormat.RGB8: 3, PixelFormat.Z16: 2}.get(kind, 1)
    rows = height * 3 // 2 if kind is PixelFormat.NV12 else height
    if kind is PixelFormat.NV12 and frame.getPlaneHeight() != height:
        # The planes are apart: the only layout that is not a single array.
        plane = stride * frame.getPlaneHeight()
        bright, tint = data[: stride * height], data[plane : plane + stride * height // 2]
        data = np.concatenate((bright, tint))
    if stride < width * size or data.size < (rows - 1) * stride + width * size:
        raise OakError(
            f"a frame of {width}x{height} {kind.name.lower()} with rows of {stride} bytes has only {data.size} bytes"
        )
    if data.size < rows * stride:  # the last row has no padding
        array = np.lib.stride_tricks.as_strided(data, (rows, width * size), (stride, 1))
    else:
        array = data[: rows * stride].reshape(rows, stride)[:, : width * size]
    if kind is PixelFormat.Z16:
        return array.view(np.uint16)
    return array.reshape(rows, width, 3) if size == 3 else array


def mode_of(stream: str, frame: dai.ImgFrame, source: Source, undistorted: bool) -> ExternalMode:
    """Return the mode of a stream from its first frame."""
    name = frame.getType().name
    kind = _FORMATS.get(name)
    if kind is None or (kind is PixelFormat.Z16) != (stream == "depth"):
        raise OakError(f"stream {stream} gives frames of type {name}, which the bridge does not know", Exit.USAGE)
    width, height = frame.getWidth(), frame.getHeight()
    lens = _lens.of_frame(frame)
    if lens is None and source.calibration is not None:
        lens = _lens.of_calibration(source.calibration, source.sockets[stream], width, height, undistorted)
    # Without an exposure time the stamp stays where the SDK puts it, at the end of the exposure.
    known = microseconds(frame.getExposureTime()) > 0
    return ExternalMode(
        stream,
        kind,
        width,
        height,
        source.rate_hz,
        depth_unit_m=0.001 if kind is PixelFormat.Z16 else None,
        intrinsics=lens or _lens.unknown(),
        clock=ExternalClock.DEVICE if known else ExternalClock.DEVICE_HEADER,
        tick_ps=_TICK_PS,
        counter_bits=64,
        sequence_bits=64,
    )


class Bridge:
    """A running pipeline, and the camera as which it is served."""

    def __init__(self, source: Source, *, undistorted: bool) -> None:
        self._source = source
        self._undistorted = undistorted
        self.modes: list[ExternalMode] = []
        self.sent = dict.fromkeys(source.outputs, 0)
        """Frames that were sent, by stream."""
        self.confirmed = False
        """Whether the daemon confirmed at the end of the files that it has every frame sent."""
        self._wanted: set[str] = set()
        self._lossless = None if source.frames is None else LosslessQueue(source.outputs)
        self._held: list[tuple[str, dai.ImgFrame]] = []

    def start(self) -> None:
        """Start the pipeline and examine a frame of each stream.

        Raises OakError when a stream gives none, or the pipeline cannot start.
        """
        source = self._source
        source.open_queues()
        if self._lossless is not None:
            for name, queue in source.queues.items():
                queue.addCallback(_into(self._lossless, name))
        try:
            source.pipeline.start()
        except RuntimeError as e:
            raise OakError(f"the camera's pipeline cannot start ({e})") from e
        deadline = time.monotonic() + _FIRST_FRAME_S
        first: dict[str, dai.ImgFrame] = {}
        while len(first) < len(source.queues):
            for stream, frame in self._frames():
                first.setdefault(stream, frame)
                if self._lossless is not None:
                    self._held.append((stream, frame))
            silent = [stream for stream in source.queues if stream not in first]
            if silent and time.monotonic() > deadline:
                raise OakError(f"no frame of {' and '.join(silent)} came within {_FIRST_FRAME_S:g} s", Exit.LOST)
            if silent and not source.pipeline.isRunning():
                raise OakError(
                    f"the pipeline ended before a frame of {' and '.join(silent)} came; the SDK's log has the reason",
                    Exit.LOST,
                )
        self.modes = [mode_of(stream, frame, source, self._undistorted) for stream, frame in first.items()]

    def _frames(self) -> list[tuple[str, dai.ImgFrame]]:
        """Wait a moment for frames; return them with their streams."""
        if self._lossless is not None:
            return self._lossless.take(_WAIT_S)
        queues = self._source.queues
        try:
            dai.MessageQueue.waitAny(list(queues.values()), datetime.timedelta(seconds=_WAIT_S))
            found = [(stream, frame) for stream, queue in queues.items() for frame in queue.tryGetAll()]
        except dai.MessageQueue.QueueException:  # closed: the pipeline is at its end
            return []
        return [(stream, frame) for stream, frame in found if isinstance(frame, dai.ImgFrame)]

    @property
    def is_running(self) -> bool:
        """Whether frames may still come."""
        return bool(self._source.pipeline.isRunning())

    @property
    def missing(self) -> dict[str, int]:
        """Frames of the files that the daemon did not get, of the streams that it wanted; all if it wanted none."""
        frames = self._source.frames or {}
        left = {stream: frames[stream] - self.sent[stream] for stream in self._wanted or frames}
        return {stream: n for stream, n in left.items() if n > 0}

    def serve(self, camera: ExternalCamera) -> None:
        """Send frames as long as the daemon wants them, until the camera is stopped or the pipeline ends."""
        once = self._lossless is not None
        try:
            while not camera.stopped:
                session = camera.wait(_WAIT_S if once else 0.0)
                if session is not None:
                    with session:
                        if not self._play(session, once):
                            return
                # Unwanted frames are taken all the same, or a session would begin with old ones. Those of files
                # that are played once wait for a session.
                elif not once and not self._frames() and not self.is_running:
                    return
        finally:
            if self._lossless is not None:
                self._lossless.close()

    def _play(self, session: ExternalSession, once: bool) -> bool:
        """Send frames while the session lasts; return false when no more will come."""
        log.info("session %d: %s", session.number, ", ".join(map(str, session.streams.values())))
        session.start(lossless=once)
        self._wanted |= set(session.streams)
        while session.wanted:
            if not self._pass_on(session):
                if once:
                    self.confirmed = session.finish("the files are at their end")
                return False
        return True

    def _pass_on(self, session: ExternalSession) -> bool:
        """Send the frames that came; return false when no more will come."""
        running = self.is_running  # before reading: the very last frames are taken too
        frames = self._held or self._frames()
        self._held = []
        arrival_ns = time.monotonic_ns()
        for i, (stream, frame) in enumerate(frames):
            if stream not in session.streams:
                continue
            if not self._send(session, stream, frame, arrival_ns) and self._lossless is not None:
                self._held = frames[i:]  # for the next session
                break
        return bool(frames) or running

    def _send(self, session: ExternalSession, stream: str, frame: dai.ImgFrame, arrival_ns: int) -> bool:
        exposure_us = microseconds(frame.getExposureTime())
        # The SDK stamps the end of the exposure (depthai-core `ImgFrame.cpp`, MIT).
        middle = session.streams[stream].clock is ExternalClock.DEVICE
        temperature = frame.getSensorTemperature()
        sent = session.send(
            stream,
            pixels(frame),
            device_time=microseconds(frame.getTimestampDevice()) - (exposure_us // 2 if middle else 0),
            device_sequence=frame.getSequenceNum(),
            arrival_ns=arrival_ns,
            exposure_ns=exposure_us * 1000,
            # ISO 100 is a gain of 1.
            gain=frame.getSensitivity() / 100,
            temperature_c=math.nan if temperature is None else float(temperature),
        )
        self.sent[stream] += sent
        return sent


def _into(queue: LosslessQueue, stream: str) -> Callable[[str, Any], None]:
    """Return the callback for each message of a queue."""

    def put(_: str, message: Any) -> None:
        if isinstance(message, dai.ImgFrame):
            queue.put(stream, message)

    return put
