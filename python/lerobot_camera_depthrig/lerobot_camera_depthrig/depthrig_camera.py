"""A camera of a depthrig rig as LeRobot reads cameras."""

from __future__ import annotations

import time
from collections.abc import Mapping
from threading import Lock
from typing import Any

import depthrig
import numpy as np
from depthrig import Frame, PixelFormat, SetReader, Stream
from lerobot.cameras.camera import Camera
from lerobot.cameras.configs import ColorMode
from lerobot.utils.decorators import check_if_already_connected, check_if_not_connected
from numpy.typing import NDArray

from .config_depthrig import DepthrigCameraConfig

_READ_TIMEOUT_S = 10.0
"""As long as LeRobot's own cameras wait in `read()`."""
_RATE_FRAMES = 5
"""Frames over which `connect()` measures the camera's rate."""
_FASTER = 1.1
"""`fps` may exceed the measured rate by this factor."""
# Numbers, because a conversion to the enumeration takes 30 µs when its code is not in the caches.
_RGB8 = int(PixelFormat.RGB8)
_Z16 = int(PixelFormat.Z16)
_MOST = np.iinfo(np.uint16).max


class _SingleReader:
    """Reads one stream as a `SetReader` reads several; a fifth of its cost."""

    def __init__(self, stream: Stream) -> None:
        self._stream = stream
        self.close = stream.close

    def latest(self) -> Mapping[str, Frame] | None:
        frame = self._stream.latest()
        return None if frame is None else {self._stream.name: frame}

    def next(self, timeout: float) -> Mapping[str, Frame]:
        return self.latest() or {self._stream.name: self._stream.next(timeout)}


class DepthrigCamera(Camera):
    """Reads colour and depth of one camera of a running rig, out of shared memory.

    Images of one moment belong together: depth that is read after colour was taken with it. Reading never disturbs the rig
    nor other readers. No thread runs in between: a read takes the newest image from shared memory and copies it.
    """

    config_class = DepthrigCameraConfig

    def __init__(self, config: DepthrigCameraConfig) -> None:
        super().__init__(config)
        self.config = config
        self.use_rgb = config.use_rgb
        self.use_depth = config.use_depth
        self.color_mode = config.color_mode
        self._color = f"{config.camera}/{config.color_stream}"
        self._depth = f"{config.camera}/{config.depth_stream}"
        self._lock = Lock()
        self._reader: SetReader | _SingleReader | None = None
        self._group: Mapping[str, Frame] | None = None
        self._came = 0.0
        # Streams whose image of the newest group was returned.
        self._read: set[str] = set()

    def __str__(self) -> str:
        return f"{type(self).__name__}({self.config.camera})"

    @property
    def is_connected(self) -> bool:
        """Whether `connect()` was called; also while the rig is away."""
        return self._reader is not None

    @staticmethod
    def find_cameras() -> list[dict[str, Any]]:
        """List the cameras of all running rigs of this user, with `id` for `camera` and `rig`."""
        found: dict[tuple[str, str], dict[str, Any]] = {}
        for rig in depthrig.running_rigs():
            for name in depthrig.streams(rig):
                camera, _, stream = name.partition("/")
                info = {"name": f"{camera} of rig {rig}", "type": "depthrig", "id": camera, "rig": rig, "streams": []}
                found.setdefault((rig, camera), info)["streams"].append(stream)
        return list(found.values())

    @check_if_already_connected
    def connect(self, warmup: bool = True) -> None:
        """Subscribe, and compare the images with the configuration. A running rig needs no `warmup`.

        Raises ConnectionError when the rig, the stream or its images are not there within `timeout_s`, and ValueError
        when the images are others than `width`, `height` and `fps` say.
        """
        names = [name for name, used in ((self._color, self.use_rgb), (self._depth, self.use_depth)) if used]
        deadline = time.monotonic() + self.config.timeout_s
        try:
            where = (self.config.rig, self.config.runtime_dir, self.config.timeout_s)
            reader = SetReader(names, *where) if len(names) > 1 else _SingleReader(Stream(names[0], *where))
        except depthrig.DepthrigError as e:
            raise ConnectionError(f"{self}: {e}") from e
        try:
            first = reader.next(max(0.0, deadline - time.monotonic()))
            self._check(first)
            rate = self._rate(reader, first, deadline)
            self.fps = round(rate) if self.fps is None else self.fps
            if rate * _FASTER < self.fps:
                raise ValueError(
                    f"{self}: fps = {self.fps}, but the camera delivers {rate:.1f} images a second; write a lower fps, or set "
                    "the camera's rate in the rig file"
                )
        except BaseException as e:
            self._group = None
            reader.close()
            if isinstance(e, depthrig.DepthrigError):
                raise ConnectionError(f"{self}: {e}") from e
            raise
        self._reader = reader

    def _check(self, group: Mapping[str, Frame]) -> None:
        for name, frame in group.items():
            header = frame.header
            if name == self._color and header.pixel_format not in (PixelFormat.RGB8, PixelFormat.BGR8):
                raise ValueError(
                    f"{self}: {name} carries {header.format_name}; LeRobot needs rgb8 or bgr8, which the rig file may ask for"
                )
            if name == self._depth and header.pixel_format not in (PixelFormat.Z16, PixelFormat.DEPTH_F32):
                raise ValueError(f"{self}: {name} carries {header.format_name}, which is not depth")
            width, height = self.width or header.width, self.height or header.height
            if (width, height) != (header.width, header.height):
                raise ValueError(
                    f"{self}: width = {width}, height = {height}, but images of {name} are {header.width}x{header.height}; "
                    "write that, or set the camera's mode in the rig file"
                )
            self.width, self.height = width, height

    def _rate(self, reader: SetReader | _SingleReader, group: Mapping[str, Frame], deadline: float) -> float:
        """Return the measured rate of the slowest stream, images a second, those included that were lost.

        A busy computer may be late with some; only what is never reached before the deadline is too slow.
        """
        since = {name: frame.header for name, frame in group.items()}
        rates: dict[str, float] = {}
        while len(rates) < len(since) or (min(rates.values()) * _FASTER < (self.fps or 0) and time.monotonic() < deadline):
            # Kept, so that there is an image to return from now on.
            group = reader.next(max(0.2, deadline - time.monotonic()))
            self._take(group)
            for name, frame in group.items():
                number = frame.header.captured - since[name].captured
                if number >= _RATE_FRAMES:
                    rate = number * 1e9 / (frame.capture_time_ns - since[name].capture_time_ns)
                    rates[name] = max(rate, rates.get(name, 0.0))
                    since[name] = frame.header
        return min(rates.values())

    @check_if_not_connected
    def disconnect(self) -> None:
        """Stop reading. Images stay valid."""
        with self._lock:
            reader, self._reader, self._group = self._reader, None, None
            if reader is not None:
                reader.close()

    @check_if_not_connected
    def read(self) -> NDArray[np.uint8]:
        """Wait for the next colour image, up to 10 s, and return it: (height, width, 3)."""
        return self._next(self._color, _READ_TIMEOUT_S, only_new=True)

    @check_if_not_connected
    def async_read(self, timeout_ms: float = 200) -> NDArray[np.uint8]:
        """Return the newest colour image that was not read yet, waiting for one; TimeoutError when none came."""
        return self._next(self._color, timeout_ms / 1e3)

    @check_if_not_connected
    def read_latest(self, max_age_ms: int = 500) -> NDArray[np.uint8]:
        """Return the newest colour image, read or not; TimeoutError when it was exposed more than `max_age_ms` ago."""
        return self._newest(self._color, max_age_ms / 1e3)

    @check_if_not_connected
    def read_depth(self, timeout_ms: int = 0) -> NDArray[np.uint16]:
        """Wait for the next depth image: (height, width, 1), millimetres, 0 for no depth."""
        return self._next(self._depth, timeout_ms / 1e3 if timeout_ms else _READ_TIMEOUT_S, only_new=True)

    @check_if_not_connected
    def async_read_depth(self, timeout_ms: float = 200) -> NDArray[np.uint16]:
        """Return the newest depth image that was not read yet: that of the colour image that was read last."""
        return self._next(self._depth, timeout_ms / 1e3)

    @check_if_not_connected
    def read_latest_depth(self, max_age_ms: int = 500) -> NDArray[np.uint16]:
        """Return the newest depth image, or that of the colour image that was read last."""
        return self._newest(self._depth, max_age_ms / 1e3)

    def _next(self, name: str, timeout_s: float, only_new: bool = False) -> NDArray[Any]:
        with self._lock:
            reader = self._opened(name)
            if only_new:
                reader.latest()
            if only_new or self._group is None or name in self._read:
                try:
                    self._take(reader.next(timeout_s))
                except (depthrig.Timeout, depthrig.StreamGone) as e:
                    raise TimeoutError(f"{self}: {e}") from e
            return self._image(name)

    def _newest(self, name: str, max_age_s: float) -> NDArray[Any]:
        with self._lock:
            reader = self._opened(name)
            if self._group is None or name in self._read:
                group = reader.latest()
                if group is not None:
                    self._take(group)
            if self._group is None:
                raise RuntimeError(f"{self} has not captured any image yet; is the camera streaming (`depthrig status`)?")
            frame = self._group[name]
            # Images of a replay carry the times of the recording.
            age = time.monotonic() - self._came if frame.replayed else frame.age_s
            if age > max_age_s:
                raise TimeoutError(
                    f"{self}: the newest image of {name} is {age * 1e3:.0f} ms old, at most {max_age_s * 1e3:.0f} ms are allowed; "
                    "`depthrig status` shows what the camera is doing"
                )
            return self._image(name)

    def _opened(self, name: str) -> SetReader | _SingleReader:
        is_used = self.use_rgb if name == self._color else self.use_depth
        if not is_used:
            raise RuntimeError(f"{self}: {'use_rgb' if name == self._color else 'use_depth'} is false; {name} is not read")
        assert self._reader is not None
        return self._reader

    def _take(self, group: Mapping[str, Frame]) -> None:
        self._group = group
        self._came = time.monotonic()
        self._read.clear()

    def _image(self, name: str) -> NDArray[Any]:
        assert self._group is not None
        self._read.add(name)
        frame = self._group[name]
        image = self._color_image(frame) if name == self._color else millimetres(frame)
        if image.shape[:2] != (self.height, self.width):
            raise RuntimeError(
                f"{self}: images of {name} are {image.shape[1]}x{image.shape[0]} now, and were {self.width}x{self.height}: the rig "
                "runs with another mode; connect again"
            )
        return image

    def _color_image(self, frame: Frame) -> NDArray[np.uint8]:
        is_rgb = frame.header.format == _RGB8
        if is_rgb == (self.color_mode == ColorMode.RGB):
            return frame.copy()
        return np.ascontiguousarray(frame.array[..., ::-1])


def millimetres(frame: Frame) -> NDArray[np.uint16]:
    """Return depth as LeRobot has it: (height, width, 1), rounded to millimetres, 0 for no depth and beyond 65.535 m."""
    if frame.header.format == _Z16 and frame.header.depth_unit_m == 0.001:
        return frame.copy()[..., np.newaxis]
    metres = frame.depth_m().astype(np.float64)
    with np.errstate(invalid="ignore"):
        rounded = np.rint(metres * 1000)
        rounded[~(rounded <= _MOST)] = 0
    return rounded.astype(np.uint16)[..., np.newaxis]
