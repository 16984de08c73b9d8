"""Depth images from a dataset that was recorded with ``depth = "rank"``: NumPy and a Zstandard package, no Rust.

The format is in ``docs/dataset-format.md``, "Depth codec". With Python's ``mcap`` a dataset reads like this:

>>> from mcap.reader import make_reader
>>> from depthrig.codec import decode_depth
>>> with open("seg_0000.mcap", "rb") as f:
...     for _, channel, message in make_reader(f).iter_messages(topics=["/mount/d435/depth/depth_compressed"]):
...         metres = decode_depth(message.data) * float(channel.metadata["depth_unit_m"])  # 0 is "no depth"
"""

from __future__ import annotations

import struct
from typing import Any, Union

import numpy as np
import numpy.typing as npt

__all__ = ["decode_depth", "unpack_depth"]

Buffer = Union[bytes, bytearray, memoryview]

_CODEC = "rank/1"
_IMAGE_MAX = 1 << 28
"""Larger images are refused, as depthrig itself does."""


def decode_depth(message: Buffer) -> npt.NDArray[np.uint16]:
    """Return the image in a ``depthrig_msgs/msg/CompressedDepth`` message (CDR), without row padding.

    :returns: ``(height, width)``, ``uint16``, in units of ``depth_unit_m``; 0 is "no depth".
    :raises ValueError: when the message is damaged, or of a later version of the codec.
    """
    data = memoryview(message).cast("B")
    if bytes(data[:2]) != b"\x00\x01":
        raise ValueError("the message is not little-endian CDR")
    at = 4 + 8  # encapsulation, stamp

    def u32() -> int:
        nonlocal at
        at = (at + 3) // 4 * 4  # the encapsulation's 4 bytes do not disturb an alignment of 4
        if at + 4 > len(data):
            raise ValueError(f"the message of {len(data)} bytes is cut short")
        (value,) = struct.unpack_from("<I", data, at)
        at += 4
        return int(value)

    def raw() -> memoryview:
        nonlocal at
        n = u32()
        if n > len(data) - at:
            raise ValueError(f"the message of {len(data)} bytes is cut short")
        at += n
        return data[at - n : at]

    raw()  # frame_id
    height, width, step = u32(), u32(), u32()
    codec = bytes(raw()).rstrip(b"\0").decode("utf-8", "replace")
    if codec != _CODEC:
        raise ValueError(f'the depth is packed with "{codec}", this reads "{_CODEC}"; install a later depthrig')
    return unpack_depth(raw(), height, width, step)


def unpack_depth(data: Any, height: int, width: int, step: int | None = None) -> npt.NDArray[np.uint16]:
    """Return the image in the field ``data`` of such a message, as other decoders of ROS 2 messages give it.

    :param data: bytes or anything that gives them, a list of numbers as well.
    :param step: bytes from row to row in the live image; ``2 * width`` when not given.
    :returns: ``(height, width)``, ``uint16``, without row padding.
    :raises ValueError: when the data is damaged or does not fit this size.
    """
    packed = bytes(data)
    step = 2 * width if step is None else step
    if height < 1 or width < 1 or step < 2 * width or step * height > _IMAGE_MAX:
        raise ValueError(f"invalid 16-bit image of {width}x{height} with {step} bytes per row")
    if len(packed) < 4:
        raise ValueError("the data is cut short")
    (count,) = struct.unpack_from("<I", packed)
    pixels = width * height
    if not 1 <= count <= min(65536, pixels):
        raise ValueError(f"a palette of {count} values does not fit {pixels} pixels")
    body = np.frombuffer(_unzstd(packed[4:], 2 * count + step * height), np.uint8).astype(np.uint16)

    def plane(at: int, n: int) -> npt.NDArray[np.uint16]:
        return body[at : at + n] | (body[at + n : at + 2 * n] << np.uint16(8))

    steps = plane(0, count).astype(np.int64)
    palette = np.cumsum(steps)
    if (steps[1:] == 0).any() or palette[-1] > 65535:
        raise ValueError("the palette is not rising or leaves 16 bits")
    folded = plane(2 * count, pixels)
    residuals = (folded >> np.uint16(1)) ^ (0 - (folded & np.uint16(1))).astype(np.uint16)
    ranks = _unpredict(residuals.reshape(height, width))
    if ranks.max() >= count:
        raise ValueError(f"rank {ranks.max()} is not in the palette of {count} values")
    return palette.astype(np.uint16)[ranks]


def _unpredict(residuals: npt.NDArray[np.uint16]) -> npt.NDArray[np.int32]:
    """Add to each residual the median of west, north and west + north - northwest.

    A pixel needs its west neighbour, so rows cannot be done at once; the pixels of an anti-diagonal can. In a
    image sheared by one pixel per row, anti-diagonals are columns; here they are rows, for speed.
    """
    height, width = residuals.shape
    diagonals = width + height - 1
    # sheared[d + 2, y + 1] is the pixel (y, d - y); what surrounds it stays 0.
    sheared = np.zeros((diagonals + 2, height + 1), np.int32)
    view = np.lib.stride_tricks.as_strided(
        sheared[2:, 1:], (height, width), (sheared.strides[0] + sheared.strides[1], sheared.strides[0])
    )
    view[:] = residuals
    for d in range(diagonals):
        first, last = max(0, d - width + 1), min(height, d + 1)
        west = sheared[d + 1, first + 1 : last + 1]
        north = sheared[d + 1, first:last]
        northwest = sheared[d, first:last]
        here = sheared[d + 2, first + 1 : last + 1]
        least, most = np.minimum(west, north), np.maximum(west, north)
        here += np.clip(west + north - northwest, least, most)
        here &= 0xFFFF
    return view


def _unzstd(packed: bytes, size: int) -> bytes:
    """Unpack exactly ``size`` bytes, with whichever Zstandard package is there."""
    try:
        from compression import zstd  # Python 3.14
    except ImportError:
        try:
            from backports import zstd
        except ImportError:
            return _unzstandard(packed, size)
    try:
        body = bytes(zstd.ZstdDecompressor().decompress(packed, size + 1))
    except zstd.ZstdError as e:
        raise ValueError(f"the data cannot be unpacked: {e}") from e
    return _exactly(body, size)


def _unzstandard(packed: bytes, size: int) -> bytes:
    try:
        import zstandard
    except ImportError as e:
        raise ImportError("depth of this codec needs a Zstandard package: pip install backports.zstd") from e
    try:
        with zstandard.ZstdDecompressor().stream_reader(packed) as reader:
            body = reader.read(size + 1)
    except zstandard.ZstdError as e:
        raise ValueError(f"the data cannot be unpacked: {e}") from e
    return _exactly(body, size)


def _exactly(body: bytes, size: int) -> bytes:
    if len(body) != size:
        raise ValueError(f"the data unpacks to {len(body)} bytes or more, {size} are wanted")
    return body
