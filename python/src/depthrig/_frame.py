"""A frame in shared memory, and NumPy views on it that keep it there.

The array that iceoryx2 itself offers is writable memory whose slot is reused as soon as the sample object is gone:
the pixels change under the reader, and writing to them kills the process. Here every array has, at the end of its
chain of bases, an `_Owner` that holds the sample, and it is read-only for NumPy as it is for the hardware. (A read-only
`memoryview` at that place would not do: NumPy looks through it and can be made writable again.)
"""

from __future__ import annotations

import functools
import time
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from . import _layout, _torch
from ._header import Header
from ._layout import FrameFlags, PixelFormat
from .errors import BadFrame, VersionMismatch

if TYPE_CHECKING:
    import torch

_FORMATS = frozenset(int(f) for f in PixelFormat)
_KINDS = {"u8": "u1", "u16": "<u2", "u32": "<u4", "i32": "<i4", "u64": "<u8", "i64": "<i8", "f32": "<f4", "f64": "<f8"}

MOTION_DTYPE = np.dtype(
    {
        "names": [name for name, _, _, _ in _layout.MOTION_FIELDS],
        "formats": [
            _KINDS[kind] if count == 1 else (_KINDS[kind], (count,)) for _, _, kind, count in _layout.MOTION_FIELDS
        ],
        "offsets": [offset for _, offset, _, _ in _layout.MOTION_FIELDS],
        "itemsize": _layout.MOTION_SAMPLE_SIZE,
    }
)
"""A sample of an IMU as NumPy sees it; `MotionSample` in bus/src/motion.rs documents its fields."""


class _Owner:
    """Keeps a sample, and with it the slot, for as long as an array refers to it."""

    __slots__ = ("__array_interface__", "sample")

    def __init__(self, sample: Any, interface: dict[str, Any]) -> None:
        self.sample = sample
        self.__array_interface__ = interface


class Shape(NamedTuple):
    """NumPy's view of pixels of one format and size."""

    typestr: str
    shape: tuple[int, ...]
    strides: tuple[int, ...] | None
    length: int
    """Bytes that a slot must have."""


@functools.lru_cache(maxsize=64)
def shape_of(code: int, width: int, height: int, stride: int, length: int) -> Shape:
    """Return NumPy's view of such pixels, computed once: a stream's frames are alike.

    Raises BadFrame when the image does not fit into `length` bytes, VersionMismatch for an unknown format; neither
    message names the frame.
    """
    if code not in _FORMATS:
        raise VersionMismatch(
            f"pixel format {code} is unknown to this version; install the `depthrig` package of the daemon's version"
        )
    pixel_format = PixelFormat(code)
    if pixel_format is PixelFormat.MJPEG:
        return Shape("|u1", (length,), None, length)
    if pixel_format is PixelFormat.MOTION:
        needed = width * _layout.MOTION_SAMPLE_SIZE
        if (height, stride, length) != (1, needed, needed):
            raise BadFrame(f"{width} IMU samples in {height} rows of {stride} bytes are not its {length} bytes")
        return Shape(f"|V{_layout.MOTION_SAMPLE_SIZE}", (width,), None, length)
    typestr, size, channels = _layout.ELEMENTS[pixel_format]
    rows = height * 3 // 2 if pixel_format is PixelFormat.NV12 else height
    row_bytes = width * size * channels
    needed = (rows - 1) * stride + row_bytes if rows else 0
    if stride < row_bytes or needed > length:
        raise BadFrame(
            f"{width}x{height} {pixel_format.name.lower()} with {stride} bytes a row does not fit into its "
            f"{length} bytes"
        )
    shape: tuple[int, ...] = (rows, width) if channels == 1 else (rows, width, channels)
    strides: tuple[int, ...] | None = None
    if stride != row_bytes:
        strides = (stride, size) if channels == 1 else (stride, size * channels, size)
    return Shape(typestr, shape, strides, length)


class Frame:
    """A frame: its header, and its pixels where the driver wrote them.

    The frame's slot in shared memory is given back when the frame and every array made from it are gone. A subscriber
    may hold 16 frames; work on :meth:`copy` when more are needed.
    """

    __slots__ = ("_address", "_flags", "_header", "_raw", "_sample", "_shape", "capture_time_ns", "sequence")

    sequence: int
    """Number of this frame on its channel; as in the header."""
    capture_time_ns: int
    """Middle of the exposure, nanoseconds on the clock of :func:`time.monotonic_ns`; as in the header."""

    def __init__(self, sample: Any, raw: Any, fields: tuple[Any, ...], address: int, available: int) -> None:
        """Make a frame of a sample: the bytes of its header, what `essentials` read in them, and where its pixels are.

        `raw` may be the header in shared memory: it is copied when somebody asks for it. Raises BadFrame when the
        header speaks of more than the `available` bytes of pixels.
        """
        self._sample: Any | None = sample
        self._raw = raw
        self._header: Header | None = None
        self._address = address
        _, self.sequence, self.capture_time_ns, _, self._flags, *image = fields
        try:
            shape = self._shape = shape_of(*image)
        except (BadFrame, VersionMismatch) as e:
            raise type(e)(f"{self._where}: {e}") from None
        if shape.length > available:
            raise BadFrame(f"{self._where}: its header speaks of {shape.length} bytes, its slot has {available}")

    @property
    def header(self) -> Header:
        """The frame's header; stays valid without the frame."""
        if self._header is None:
            self._header = Header(bytes(self._raw))
            self._raw = None
        return self._header

    @property
    def _where(self) -> str:
        return f"{self.header.stream_id} frame {self.sequence}"

    def _array(self, read_only: bool) -> npt.NDArray[Any]:
        """Return the pixels as an array that keeps the slot. A writable one must not leave this package."""
        if self._sample is None:
            raise ValueError(f"frame {self.sequence} of {self.header.stream_id} was released")
        typestr, shape, strides, _ = self._shape
        data = (self._address, read_only)
        interface = {"version": 3, "data": data, "typestr": typestr, "shape": shape, "strides": strides}
        array = np.asarray(_Owner(self._sample, interface))
        return array.view(MOTION_DTYPE) if typestr[1] == "V" else array

    @property
    def array(self) -> npt.NDArray[Any]:
        """The pixels as a read-only array without a copy.

        Shapes: `(H, W, 3)` u8 for rgb8 and bgr8; `(H, W)` u16 for z16 and mono16; `(H, W)` f32 for depth_f32 and
        disparity_f32; `(H, W)` u8 for mono8 and confidence8; `(H, W, 2)` u8 for yuyv and uyvy; `(H * 3 // 2, W)` u8
        for nv12; `(bytes,)` u8 for mjpeg; `(samples,)` of :data:`MOTION_DTYPE` for motion.
        """
        return self._array(read_only=True)

    @property
    def is_motion(self) -> bool:
        """Whether it is a batch of an IMU instead of an image."""
        return self._shape.typestr[1] == "V"

    @property
    def motion(self) -> npt.NDArray[Any]:
        """The samples of an IMU's batch as a read-only structured array without a copy, oldest first.

        `frame.motion["gyro_rad_s"]` is `(n, 3)` f32; the other fields are `time_ns`, `device_time`, `sequence` (a gap
        is samples that the device never gave, or that were lost with a batch), `uncertainty_ns`, `accel_offset_ns`,
        `accel_m_s2`, `temperature_c` and `flags` (:class:`depthrig.MotionFlags`); NaN is "not measured". Raises TypeError for an image.
        """
        if not self.is_motion:
            raise TypeError(f"{self.header.stream_id} carries {self.header.format_name} images, not IMU samples")
        return self.array

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> npt.NDArray[Any]:
        array = self.array
        if dtype is not None and np.dtype(dtype) != array.dtype:
            if copy is False:
                raise ValueError(f"{array.dtype} pixels cannot be seen as {np.dtype(dtype)} without a copy")
            return array.astype(dtype)
        return array.copy() if copy else array

    def copy(self) -> npt.NDArray[Any]:
        """Return the pixels as a new array, writable and without row padding."""
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
            raise TypeError(f"{self.header.stream_id} carries {self.header.format_name}, which is not depth")
        unit = self.header.depth_unit_m
        if not unit > 0:
            raise BadFrame(f"{self.header.stream_id}: its header states no depth unit")
        metres = np.empty(array.shape, dtype=np.float32)
        # Multiplied in double precision, rounded once.
        np.multiply(array, np.float64(unit), out=metres, casting="same_kind")
        metres[array == 0] = np.nan
        return metres

    def torch(
        self,
        device: str | torch.device = "cpu",
        *,
        metres: bool = False,
        out: torch.Tensor | None = None,
        copy: bool = True,
    ) -> torch.Tensor:
        """Return the pixels as a PyTorch tensor on `device`, of the shape of :attr:`array`: one copy to the device.

        * On the CPU the pixels are copied once, out of shared memory into the tensor.
        * With CUDA they are copied into pinned memory and from there to the GPU in one asynchronous transfer, ordered
          on the current stream like every operation of PyTorch; the frame may be let go at once.
        * `out` is a tensor to write into in place of a new one: its shape, type and device must fit.
        * `metres` gives float32 metres of a depth image, 0 where there is no depth (:meth:`depth_m` has NaN there).
          On the CPU that is the same single pass; elsewhere the pixels travel as they are and are converted there.
        * `copy=False` (CPU only) shares the memory: it holds the frame's slot as an array does, and PyTorch knows no
          read-only tensors, so **writing to such a tensor ends the process** with a segmentation fault.

        16-bit pixels are `torch.uint16`, which PyTorch has since 2.3. Raises ImportError without PyTorch, and TypeError
        for a batch of IMU samples, which has no pixels: take a field of :attr:`motion`.
        """
        if self.is_motion:
            raise TypeError(f"{self.header.stream_id} carries IMU samples: use torch.tensor(frame.motion[FIELD])")
        return _torch.tensor(self, device, metres, out, copy)

    @property
    def age_s(self) -> float:
        """Seconds since the middle of the exposure. Of a replayed frame it is the age of the recording."""
        return (time.monotonic_ns() - self.capture_time_ns) / 1e9

    @property
    def replayed(self) -> bool:
        """Whether a replay published it: its times are those of the recording."""
        return bool(self._flags & FrameFlags.REPLAYED)

    def release(self) -> None:
        """Release the pixels now. Arrays made before stay valid, and keep the slot until they are gone."""
        _ = self.header  # its bytes go with the slot
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
