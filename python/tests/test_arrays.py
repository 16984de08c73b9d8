"""Shapes, strides and units of the views, on memory of our own; the live tests do the same in shared memory."""

from __future__ import annotations

import ctypes
import warnings

import numpy as np
import pytest

import depthrig
from depthrig import Frame, Header, PixelFormat, _layout
from depthrig._header import essentials

BLANK = {n: ("" if (k, c) == ("u8", 32) else b"\0" * c if k == "u8" else [0] * c) for n, _, k, c in _layout.FIELDS}


def header(pixel_format: int, width: int, height: int, stride: int, length: int, **more: object) -> Header:
    names = {"camera": "cam", "stream": "test", "sequence": [7]}
    size = {"format": [pixel_format], "width": [width], "height": [height], "stride": [stride]}
    return Header(Header.pack({**BLANK, **names, **size, "payload_len": [length], **more}))


def frame(h: Header, data: np.ndarray) -> Frame:
    """A frame over `data`, which stands for the sample: the frame must keep it alive."""
    raw = np.ascontiguousarray(data).view(np.uint8).reshape(-1)
    return Frame(raw, h.raw, essentials(h.raw), raw.ctypes.data, raw.size)


@pytest.mark.parametrize(
    ("pixel_format", "row_bytes", "shape", "dtype"),
    [
        (PixelFormat.RGB8, 15, (4, 5, 3), np.uint8),
        (PixelFormat.BGR8, 15, (4, 5, 3), np.uint8),
        (PixelFormat.MONO8, 5, (4, 5), np.uint8),
        (PixelFormat.MONO16, 10, (4, 5), np.uint16),
        (PixelFormat.Z16, 10, (4, 5), np.uint16),
        (PixelFormat.DEPTH_F32, 20, (4, 5), np.float32),
        (PixelFormat.YUYV, 10, (4, 5, 2), np.uint8),
        (PixelFormat.UYVY, 10, (4, 5, 2), np.uint8),
        (PixelFormat.NV12, 5, (6, 5), np.uint8),
        (PixelFormat.CONFIDENCE8, 5, (4, 5), np.uint8),
        (PixelFormat.DISPARITY_F32, 20, (4, 5), np.float32),
    ],
)
@pytest.mark.parametrize("pad", [0, 3, 8])
def test_shape_and_stride(pixel_format: int, row_bytes: int, shape: tuple, dtype: type, pad: int) -> None:
    rows, stride = shape[0], row_bytes + pad
    data = np.random.default_rng(1).integers(0, 256, rows * stride, dtype=np.uint8)
    array = frame(header(pixel_format, 5, 4, stride, data.size), data).array
    assert (array.shape, array.dtype) == (shape, dtype)
    expected = np.ascontiguousarray(data.reshape(rows, stride)[:, :row_bytes])
    np.testing.assert_array_equal(np.ascontiguousarray(array).view(np.uint8).reshape(rows, -1), expected)


def test_mjpeg_is_its_bytes() -> None:
    data = np.arange(200, dtype=np.uint8)
    array = frame(header(PixelFormat.MJPEG, 640, 480, 0, 123), data).array
    np.testing.assert_array_equal(array, data[:123])


def test_every_format_has_a_shape() -> None:
    for pixel_format in PixelFormat:
        size = (1, 1, 64) if pixel_format is PixelFormat.MOTION else (2, 2, 8)
        assert frame(header(pixel_format, *size, 64), np.zeros(64, np.uint8)).array.size > 0


@pytest.mark.parametrize(
    ("width", "height", "stride", "length", "why"),
    [
        (5, 4, 9, 40, "9 bytes a row does not fit"),  # rows overlap
        (5, 4, 10, 39, "does not fit into its 39 bytes"),  # the last pixel is cut
        (5, 4, 10, 41, "speaks of 41 bytes, its slot has 40"),
        (2**32 - 1, 2**32 - 1, 2**32 - 1, 40, "does not fit"),
    ],
)
def test_a_header_cannot_make_us_read_beyond_the_slot(
    width: int, height: int, stride: int, length: int, why: str
) -> None:
    with pytest.raises(depthrig.BadFrame, match=why):
        frame(header(PixelFormat.Z16, width, height, stride, length), np.zeros(40, np.uint8))


def test_an_unknown_format_is_another_version() -> None:
    with pytest.raises(depthrig.VersionMismatch, match="cam/test frame 7: pixel format 999 is unknown"):
        frame(header(999, 1, 1, 1, 1), np.zeros(1, np.uint8))


def test_depth_in_metres() -> None:
    data = np.array([[0, 1, 65535], [1000, 7, 12345]], np.uint16)
    metres = frame(header(PixelFormat.Z16, 3, 2, 6, 12, depth_unit_m=[0.0001]), data).depth_m()
    assert metres.dtype == np.float32
    expected = np.array([[np.nan, 0.0001, 6.5535], [0.1, 0.0007, 1.2345]]).astype(np.float32)
    np.testing.assert_array_equal(metres, expected)

    floats = np.array([[np.nan, 0, -1], [0.5, 2.25, 3]], np.float32)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        metres = frame(header(PixelFormat.DEPTH_F32, 3, 2, 12, 24), floats).depth_m()
    np.testing.assert_array_equal(metres, np.array([[np.nan] * 3, [0.5, 2.25, 3]], np.float32))
    metres[0, 0] = 1  # one's own copy


def test_depth_of_what_is_none() -> None:
    with pytest.raises(TypeError, match="cam/test carries rgb8, which is not depth"):
        frame(header(PixelFormat.RGB8, 2, 2, 6, 12), np.zeros(12, np.uint8)).depth_m()
    with pytest.raises(depthrig.BadFrame, match="states no depth unit"):
        frame(header(PixelFormat.Z16, 2, 2, 4, 8), np.zeros(8, np.uint8)).depth_m()


def test_asarray_and_copies() -> None:
    f = frame(header(PixelFormat.Z16, 2, 2, 4, 8), np.array([1, 2, 3, 4], np.uint16))
    address = f.array.ctypes.data
    assert np.asarray(f).ctypes.data == address
    assert np.asarray(f, dtype=np.float32).tolist() == [[1, 2], [3, 4]]
    assert np.array(f).ctypes.data != address
    copy = f.copy()
    copy[0, 0] = 9
    assert f.array[0, 0] == 1
    if np.lib.NumpyVersion(np.__version__) >= "2.0.0":
        with pytest.raises(ValueError, match="without a copy"):
            np.asarray(f, dtype=np.float32, copy=False)


def test_no_way_to_write() -> None:
    array = frame(header(PixelFormat.Z16, 2, 2, 4, 8), np.zeros(4, np.uint16)).array
    with pytest.raises(ValueError, match="read-only"):
        array[0, 0] = 1
    with pytest.raises(ValueError, match="read-only"):
        array += 1
    with pytest.raises(ValueError, match="WRITEABLE"):
        array.flags.writeable = True
    with pytest.raises(ValueError, match="WRITEABLE"):
        array[::2].flags.writeable = True
    assert memoryview(array).readonly
    with pytest.raises((TypeError, ValueError)):
        ctypes.c_char.from_buffer(array)


def test_a_released_frame_says_so() -> None:
    f = frame(header(PixelFormat.MONO8, 2, 2, 2, 4), np.arange(4, dtype=np.uint8))
    with f as entered:
        array = entered.array
    assert array.tolist() == [[0, 1], [2, 3]]
    with pytest.raises(ValueError, match="frame 7 of cam/test was released"):
        f.array  # noqa: B018
    assert "released" in repr(f)
