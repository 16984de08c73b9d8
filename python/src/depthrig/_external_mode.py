"""What a stream of an external camera can deliver: one mode, checked where it is made."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from . import _layout as layout
from ._frame import shape_of
from ._header import Intrinsics, Pose, blank_fields, pack_fields
from ._layout import Distortion, ExternalClock, ExternalModeFlags, PixelFormat
from ._runtime import check_name

_BYTES = {PixelFormat.RGB8: 3, PixelFormat.BGR8: 3, PixelFormat.MONO16: 2, PixelFormat.Z16: 2, PixelFormat.DEPTH_F32: 4}
_BYTES |= {PixelFormat.YUYV: 2, PixelFormat.UYVY: 2}
_UNKNOWN = Intrinsics(0.0, 0.0, 0.0, 0.0, (0.0,) * 8, int(Distortion.UNKNOWN), 0)
_HERE = Pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
_MAX_SIDE = 16384


@dataclass(frozen=True)
class ExternalMode:
    """A mode of a stream: `ExternalMode("depth", PixelFormat.Z16, 640, 480, 30.0)`.

    Raises ValueError for what the daemon would refuse.
    """

    stream: str
    """`color`, `depth`, …: 1 to 31 of a-z, 0-9 and _, a letter first."""
    format: PixelFormat
    """How the pixels are stored."""
    width: int
    """Pixels per row."""
    height: int
    """Rows."""
    rate_hz: float
    """Nominal frame rate."""
    depth_unit_m: float | None = None
    """Metres per unit of z16; a millimetre by default."""
    intrinsics: Intrinsics | None = None
    """Of this picture at this size; None when no calibration is known."""
    pose: Pose | None = None
    """Pose of this stream's optical frame in the camera's frame; None when it is the camera's own."""
    clock: ExternalClock = ExternalClock.ARRIVAL
    """Which clock the `device_time` of a frame is of."""
    tick_ps: int = 1000
    """Picoseconds per tick of the device's clock."""
    counter_bits: int = 64
    """Bits of that clock before it starts again at 0."""
    sequence_bits: int = 0
    """Bits of the device's frame counter; 0 when it has none."""
    simulated: bool = False
    """The frames are made by a program and not by a sensor."""

    def __post_init__(self) -> None:
        """Check what can be checked here."""
        check_name(self.stream, "stream")
        if PixelFormat(self.format) is PixelFormat.MOTION:
            raise ValueError(f"stream {self.stream!r}: motion samples of another process's camera are not taken yet")
        if not (0 < self.width <= _MAX_SIDE and 0 < self.height <= _MAX_SIDE):
            raise ValueError(
                f"stream {self.stream!r}: {self.width}x{self.height} is no size, at most {_MAX_SIDE} a side"
            )
        if self.format in (PixelFormat.YUYV, PixelFormat.UYVY, PixelFormat.NV12) and self.width % 2:
            raise ValueError(f"stream {self.stream!r}: {self.format.name.lower()} has an even number of columns")
        if self.format is PixelFormat.NV12 and self.height % 2:
            raise ValueError(f"stream {self.stream!r}: nv12 has an even number of rows")
        if not 0 < self.rate_hz <= 1000:
            raise ValueError(f"stream {self.stream!r}: {self.rate_hz!r} is no rate, 0 to 1000 Hz")
        if self.frame_bytes > layout.EXTERNAL_MAX_FRAME_BYTES:
            raise ValueError(f"stream {self.stream!r}: a frame of {self.frame_bytes} bytes is too large")
        unit = self.unit_m
        if not (math.isfinite(unit) and 0 <= unit <= 1):
            raise ValueError(f"stream {self.stream!r}: {unit!r} m is no unit of depth")
        if self.clock is ExternalClock.HOST and (self.tick_ps, self.counter_bits) != (1000, 64):
            raise ValueError(f"stream {self.stream!r}: the host's clock has ticks of 1000 ps and 64 bits")

    @property
    def unit_m(self) -> float:
        """Metres per unit of depth as it is announced; 0 when the pixels are no depth."""
        if self.format is PixelFormat.Z16:
            return 0.001 if self.depth_unit_m is None else self.depth_unit_m
        return 1.0 if self.format is PixelFormat.DEPTH_F32 else 0.0

    @property
    def frame_bytes(self) -> int:
        """Bytes of a frame; for MJPEG the most that one may have."""
        pixels = self.width * self.height
        if self.format is PixelFormat.NV12:
            return pixels * 3 // 2
        if self.format is PixelFormat.MJPEG:
            return pixels * 2
        return pixels * _BYTES.get(self.format, 1)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of a frame as an array; for MJPEG that of the longest one."""
        return self._seen[0]

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of its elements."""
        return self._seen[1]

    @property
    def _seen(self) -> tuple[tuple[int, ...], np.dtype[Any]]:
        rows = self.height * 3 // 2 if self.format is PixelFormat.NV12 else self.height
        stride = self.frame_bytes // rows
        seen = shape_of(int(self.format), self.width, self.height, stride, self.frame_bytes)
        return seen.shape, np.dtype(seen.typestr)

    def pack(self) -> bytes:
        """Return the record of an offer."""
        values = {
            **blank_fields(layout.EXTERNAL_MODE_FIELDS),
            "stream": self.stream,
            "rate_hz": float(self.rate_hz),
            "depth_unit_m": self.unit_m,
            "tick_ps": self.tick_ps,
            "format": int(self.format),
            "width": self.width,
            "height": self.height,
            "clock": int(self.clock),
            "counter_bits": self.counter_bits,
            "sequence_bits": self.sequence_bits,
            "flags": int(ExternalModeFlags.SIMULATED) if self.simulated else 0,
        }
        for prefix, fields in (("intrinsics", self.intrinsics or _UNKNOWN), ("pose", self.pose or _HERE)):
            values.update({f"{prefix}.{name}": value for name, value in fields._asdict().items()})
        return pack_fields(layout.EXTERNAL_MODE_FIELDS, layout.EXTERNAL_MODE_SIZE, values)

    def __str__(self) -> str:
        return f"{self.stream} {self.width}x{self.height} {self.format.name.lower()} {self.rate_hz:g} Hz"
