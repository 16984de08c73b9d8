"""A frame in shared memory, and NumPy views on it that keep it there.

The array that iceoryx2 itself offers is writable memory whose slot is reused as soon as the sample object is gone:
the pixels change under the reader, and writing to them kills the process. Here every array has, at the end of its
chain of bases, an `_Owner` that holds the sample, and it is read-only for NumPy as it is for the hardware.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ._header import Header
from ._layout import PixelFormat
from .errors import BadFrame, VersionMismatch

# Per format: NumPy's element type, its bytes, and how many of them a pixel has.
_ELEMENTS = {
    PixelFormat.RGB8: ("|u1", 1, 3),
    PixelFormat.BGR8: ("|u1", 1, 3),
    PixelFormat.MONO8: ("|u1", 1, 1),
    PixelFormat.MONO16: ("<u2", 2, 1),
    PixelFormat.Z16: ("<u2", 2, 1),
    PixelFormat.DEPTH_F32: ("<f4", 4, 1),
    PixelFormat.YUYV: ("|u1", 1, 2),
    PixelFormat.UYVY: ("|u1", 1, 2),
    PixelFormat.NV12: ("|u1", 1, 1),
    PixelFormat.CONFIDENCE8: ("|u1", 1, 1),
}


class _Owner:
    """Keeps a sample, and with it the slot, for as long as an array refers to it."""

    __slots__ = ("__array_interface__", "sample")

    def __init__(self, sample: Any, interface: dict[str, Any]) -> None:
        self.sample = sample
        self.__array_interface__ = interface


def array_interface(header: Header, address: int, available: int) -> dict[str, Any]:
    """Describe the pixels at `address`, of which `available` bytes may be read, to NumPy.

    Raises BadFrame when the header speaks of more bytes than there are.
    """
    where = f"{header.stream_id} frame {header.sequence}"
    length = header.payload_len
    if length > available:
        raise BadFrame(f"{where}: its header speaks of {length} bytes, its slot has {available}")
    interface: dict[str, Any] = {"version": 3, "data": (address, True), "strides": None}
    pixel_format = header.pixel_format
    if pixel_format is None:
        raise VersionMismatch(
            f"{where}: pixel format {header.format} is unknown to this version; install the `depthrig` package of "
            "the daemon's version"
        )
    if pixel_format is PixelFormat.MJPEG:
        interface.update(typestr="|u1", shape=(length,))
        return interface
    typestr, size, channels = _ELEMENTS[pixel_format]
    width, stride = header.width, header.stride
    rows = header.height * 3 // 2 if pixel_format is PixelFormat.NV12 else header.height
    row_bytes = width * size * channels
    needed = (rows - 1) * stride + row_bytes if rows else 0
    if stride < row_bytes or needed > length:
        raise BadFrame(
            f"{where}: {width}x{header.height} {header.format_name} with {stride} bytes a row does not fit into "
            f"its {length} bytes"
        )
    shape: tuple[int, ...] = (rows, width) if channels == 1 else (rows, width, channels)
    interface.update(typestr=typestr, shape=shape)
    if stride != row_bytes:
        interface["strides"] = (stride, size) if channels == 1 else (stride, size * channels, size)
    return interface


class Frame:
    """A frame: its header, and its pixels where the driver wrote them.

    The frame's slot in shared memory is given back when the frame and every array made from it are gone. A subscriber
    may hold 16 frames; work on :meth:`copy` when more are needed.
    """

    __slots__ = ("_interface", "_sample", "header")

    header: Header
    """What the frame says of itself; valid also without the frame."""

    def __init__(self, sample: Any, header: Header, address: int, available: int) -> None:
        self.header = header
        self._interface = array_interface(header, address, available)
        self._sample: Any | None = sample

    @property
    def array(self) -> npt.NDArray[Any]:
        """The pixels as a read-only array without a copy.

        Shapes: `(H, W, 3)` u8 for rgb8 and bgr8; `(H, W)` u16 for z16 and mono16; `(H, W)` f32 for depth_f32;
        `(H, W)` u8 for mono8 and confidence8; `(H, W, 2)` u8 for yuyv and uyvy; `(H * 3 // 2, W)` u8 for nv12;
        `(bytes,)` u8 for mjpeg.
        """
        if self._sample is None:
            raise ValueError(f"frame {self.header.sequence} of {self.header.stream_id} was released")
        return np.asarray(_Owner(self._sample, self._interface))

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> npt.NDArray[Any]:
        array = self.array
        if dtype is not None and np.dtype(dtype) != array.dtype:
            if copy is False:
                raise ValueError(f"{array.dtype} pixels cannot be seen as {np.dtype(dtype)} without a copy")
            return array.astype(dtype)
        return array.copy() if copy else array

    def copy(self) -> npt.NDArray[Any]:
        """Return the pixels as an array of one's own, writable and without rows' padding."""
        return self.array.copy()

    def depth_m(self) -> npt.NDArray[np.float32]:
        """Return depth in metres as a new float32 array, NaN where there is no depth."""
        array = self.array
        if self.header.pixel_format is PixelFormat.DEPTH_F32:
            metres = array.astype(np.float32)
            with np.errstate(invalid="ignore"):
                metres[~(metres > 0)] = np.nan
            return metres
        if self.header.pixel_format is not PixelFormat.Z16:
            raise TypeError(f"{self.header.stream_id} carries {self.header.format_name}, which is no depth")
        unit = self.header.depth_unit_m
        if not unit > 0:
            raise BadFrame(f"{self.header.stream_id}: its header states no depth unit")
        metres = np.empty(array.shape, dtype=np.float32)
        # Multiplied in double precision, rounded once.
        np.multiply(array, np.float64(unit), out=metres, casting="same_kind")
        metres[array == 0] = np.nan
        return metres

    @property
    def age_s(self) -> float:
        """Seconds since the middle of the exposure. Of a replayed frame it is the age of the recording."""
        return self.header.age_s

    def release(self) -> None:
        """Let go of the pixels now. Arrays made before stay valid, and keep the slot until they are gone."""
        self._sample = None

    def __enter__(self) -> Frame:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()

    def __repr__(self) -> str:
        h = self.header
        released = ", released" if self._sample is None else ""
        age = "replayed" if h.replayed else f"{self.age_s * 1e3:.1f} ms old"
        return f"<Frame {h.stream_id} #{h.sequence} {h.width}x{h.height} {h.format_name}, {age}{released}>"
