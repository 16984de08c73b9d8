"""The frame header as an object. The layout itself is generated: see _layout.py."""

from __future__ import annotations

import ctypes
import struct
import time
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from . import _layout
from ._layout import ClockDomain, Distortion, DropReason, FrameFlags, HeaderFields, PixelFormat, StageStep
from .errors import VersionMismatch

essentials = struct.Struct("<8sQ32xq16xq264xI5I").unpack_from
"""Fields that receiving a frame needs, unpacked at once: VERSION_BYTES, sequence, capture and publish time, flags; then
format, width, height, stride and payload_len. The others are read on demand, which saves time on the way to a policy.
"""
VERSION_BYTES = struct.pack("<4sHH", _layout.HEADER_MAGIC, _layout.HEADER_VERSION, _layout.HEADER_SIZE)
HeaderBytes = ctypes.c_char * _layout.HEADER_SIZE

_TEXT_SIZE = 32
_CODES = {"u8": "B", "u16": "H", "u32": "I", "u64": "Q", "i64": "q", "f32": "f", "f64": "d"}


Fields = Sequence[tuple[str, int, str, int]]
"""A layout as the generated tables have it: name, offset, element type, elements."""


def pack_fields(fields: Fields, size: int, values: Mapping[str, Any]) -> bytes:
    """Return `size` bytes with these values at the places of `fields`; texts are padded with zeros."""
    raw = bytearray(size)
    for name, offset, kind, count in fields:
        value = values[name]
        if isinstance(value, (str, bytes)):
            value = value.encode() if isinstance(value, str) else value
            struct.pack_into(f"<{count}s", raw, offset, value)
        else:
            parts = value if isinstance(value, (tuple, list)) else (value,)
            struct.pack_into(f"<{count}{_CODES[kind]}", raw, offset, *parts)
    return bytes(raw)


def blank_fields(fields: Fields) -> dict[str, Any]:
    """Return zero for each field."""
    return {name: b"" if kind == "u8" else 0 if count == 1 else (0,) * count for name, _, kind, count in fields}


def unpack_fields(fields: Fields, raw: bytes) -> dict[str, Any]:
    """Return the values at the places of `fields`: text of 32 bytes and more, bytes of fewer, tuples of several."""
    values: dict[str, Any] = {}
    for name, offset, kind, count in fields:
        if kind == "u8":
            field = raw[offset : offset + count]
            values[name] = _layout._text(field) if count >= _TEXT_SIZE else field
        else:
            parts = struct.unpack_from(f"<{count}{_CODES[kind]}", raw, offset)
            values[name] = parts[0] if count == 1 else parts
    return values


class Intrinsics(_layout.IntrinsicsFields):
    """Camera intrinsics for the size of the frame: pixels, the centre of the top-left pixel at (0, 0)."""

    __slots__ = ()

    @property
    def distortion(self) -> Distortion:
        """The distortion model; models of later versions read as UNKNOWN."""
        return Distortion(self.model) if self.model in list(Distortion) else Distortion.UNKNOWN

    @property
    def is_known(self) -> bool:
        """Whether a calibration is known at all."""
        return self.fx > 0

    def matrix(self) -> npt.NDArray[np.float64]:
        """Return the 3x3 camera matrix K."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], dtype=np.float64)


class Pose(_layout.PoseFields):
    """Pose of the stream's optical frame on the mount: `p_mount = R p_camera + t`."""

    __slots__ = ()

    def matrix(self) -> npt.NDArray[np.float64]:
        """Return the 4x4 matrix that takes points of the camera to points of the mount, metres."""
        x, y, z, w = self.rotation_xyzw
        pose = np.eye(4)
        pose[:3, :3] = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
        pose[:3, 3] = self.translation_m
        return pose


class Refinement(NamedTuple):
    """How a refined frame was computed, and from which frames."""

    engine: str
    """The engine, such as `fill` (which has no weights) or `onnxruntime 1.31.1 cpu fp32`."""
    model: str | None
    """The model, such as `cdm-d435@1f2e3d4c`; None for an engine without weights."""
    steps_s: dict[str, float]
    """Seconds spent in each step: wait, register, prepare, infer, finish, and in total."""
    depth_sequence: int
    """`sequence` of the depth frame."""
    depth_capture_time_ns: int
    """Middle of the depth frame's exposure, which is also the capture time of the refined one."""
    color_sequence: int
    """`sequence` of the colour frame."""
    color_capture_time_ns: int
    """Middle of the colour frame's exposure."""


class Header(HeaderFields):
    """The header of a frame: every field as an attribute, and values derived from them.

    It is a copy of the 768 bytes in shared memory and stays valid without the frame. Times are nanoseconds on
    CLOCK_MONOTONIC, the clock of :func:`time.monotonic_ns`.
    """

    __slots__ = ()

    def __init__(self, raw: bytes) -> None:
        if len(raw) != _layout.HEADER_SIZE:
            raise ValueError(f"a header has {_layout.HEADER_SIZE} bytes, not {len(raw)}")
        super().__init__(raw)

    def check_version(self, what: str) -> None:
        """Raise VersionMismatch unless this is a header of the version that this package reads."""
        if self._raw[: len(VERSION_BYTES)] != VERSION_BYTES:
            raise VersionMismatch(
                f"{what}: a frame has header version {self.version} ({self.magic!r}, {self.size} bytes), this "
                f"package reads version {_layout.HEADER_VERSION}; install the `depthrig` package of the "
                "daemon's version"
            )

    @property
    def pixel_format(self) -> PixelFormat | None:
        """How the pixels are stored; None for a format of a later version."""
        code = self.format
        return PixelFormat(code) if code in list(PixelFormat) else None

    @property
    def format_name(self) -> str:
        """Name of the pixel format, as configuration and reports write it."""
        pixel_format = self.pixel_format
        return f"unknown format {self.format}" if pixel_format is None else pixel_format.name.lower()

    @property
    def is_depth(self) -> bool:
        """Whether the pixels are depth."""
        return self.format in (PixelFormat.Z16, PixelFormat.DEPTH_F32)

    @property
    def stream_id(self) -> str:
        """CAMERA/STREAM, as :class:`depthrig.Stream` takes it."""
        return f"{self.camera}/{self.stream}"

    @property
    def intrinsics(self) -> Intrinsics:
        """Intrinsics of this image at this size."""
        return Intrinsics(*self._intrinsics())

    @property
    def pose(self) -> Pose:
        """Pose of this stream's optical frame on the mount."""
        return Pose(*self._pose())

    @property
    def drops(self) -> dict[str, int]:
        """Frames lost so far, by reason; `captured = sequence + sum(drops.values())`."""
        return {reason.name.lower(): n for reason, n in zip(DropReason, self.dropped)}

    @property
    def clock(self) -> ClockDomain | None:
        """Where the capture time comes from; None for a domain of a later version."""
        code = self.clock_domain
        return ClockDomain(code) if code in list(ClockDomain) else None

    @property
    def flags(self) -> FrameFlags:
        """Facts about the frame, as bits."""
        return FrameFlags(super().flags)

    @property
    def flag_names(self) -> frozenset[str]:
        """Facts about the frame, as names: `"replayed" in header.flag_names`."""
        flags = self.flags
        return frozenset(f.name.lower() for f in FrameFlags if f in flags and f.name is not None)

    @property
    def replayed(self) -> bool:
        """Published by a replay: the times are those of the recording."""
        return FrameFlags.REPLAYED in self.flags

    @property
    def derived(self) -> bool:
        """Computed from other frames, not captured."""
        return FrameFlags.DERIVED in self.flags

    @property
    def synthetic(self) -> bool:
        """Generated by a simulated camera."""
        return FrameFlags.SYNTHETIC in self.flags

    @property
    def refinement(self) -> Refinement | None:
        """Engine, model, times and source frames of this frame; None when it was not refined."""
        if not self.refiner:
            return None
        return Refinement(
            engine=self.refiner,
            model=self.refiner_model or None,
            steps_s={step.name.lower(): ns / 1e9 for step, ns in zip(StageStep, self.stage_ns)},
            depth_sequence=self.source_sequence,
            depth_capture_time_ns=self.capture_time_ns,
            color_sequence=self.source_color_sequence,
            color_capture_time_ns=self.source_color_capture_time_ns,
        )

    @property
    def metadata_level(self) -> str:
        """Source of the times, best first: full, header, kernel or arrival; simulated for a simulated camera."""
        if FrameFlags.SYNTHETIC in self.flags:
            return "simulated"
        if FrameFlags.METADATA_LOST in self.flags:
            return "arrival"
        if self.clock is ClockDomain.DEVICE:
            return "header" if FrameFlags.HEADER_TIME in self.flags else "full"
        return "kernel" if self.clock is ClockDomain.KERNEL else "arrival"

    @property
    def age_s(self) -> float:
        """Seconds since the middle of the exposure. Of a replayed frame it is the age of the recording."""
        return (time.monotonic_ns() - self.capture_time_ns) / 1e9

    def to_dict(self) -> dict[str, Any]:
        """Return every field of the layout by its name; nested ones are written `intrinsics.fx`."""
        values: dict[str, Any] = {}
        for name, _, _, _ in _layout.FIELDS:
            part: Any = self
            for attribute in name.split("."):
                part = getattr(part, attribute)
            values[name] = int(part) if name == "flags" else part
        return values

    @classmethod
    def pack(cls, values: Mapping[str, Any]) -> bytes:
        """Return the bytes of a header with these values, named as :meth:`to_dict` names them."""
        return pack_fields(_layout.FIELDS, _layout.HEADER_SIZE, values)

    @property
    def raw(self) -> bytes:
        """The bytes as they lay in shared memory."""
        return self._raw

    def __eq__(self, other: object) -> bool:
        return self._raw == other._raw if isinstance(other, Header) else NotImplemented

    def __hash__(self) -> int:
        return hash(self._raw)

    def __repr__(self) -> str:
        flags = f" [{', '.join(sorted(self.flag_names))}]" if self.flags else ""
        lost = {reason: n for reason, n in self.drops.items() if n}
        return (
            f"<Header {self.stream_id} #{self.sequence} {self.width}x{self.height} {self.format_name}, "
            f"captured at {self.capture_time_ns} ns ±{self.capture_uncertainty_ns / 1e6:.3g} ms"
            f"{f', dropped {lost}' if lost else ''}{flags}>"
        )
