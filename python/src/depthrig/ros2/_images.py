"""Frames as `sensor_msgs` images and camera information, which say the same as those of a recording."""

from __future__ import annotations

import io
import struct
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image

from .._frame import Frame
from .._header import Header
from .._layout import Distortion, PixelFormat
from . import _types

JPEG_QUALITY = 90
_PNG_LEVEL = 1
"""Depth of 1280x720 takes a third of the time of Pillow's default level, and a tenth more bytes."""
_MILLIMETRE_M = 0.001
_PLAIN = {
    PixelFormat.RGB8: "rgb8",
    PixelFormat.BGR8: "bgr8",
    PixelFormat.MONO8: "mono8",
    PixelFormat.MONO16: "mono16",
    PixelFormat.CONFIDENCE8: "mono8",
    PixelFormat.DISPARITY_F32: "32FC1",
}
_TO_RGB = (PixelFormat.YUYV, PixelFormat.UYVY, PixelFormat.NV12, PixelFormat.MJPEG)
_MODELS = {
    Distortion.UNKNOWN: ("", 0),
    Distortion.KANNALA_BRANDT4: ("equidistant", 4),
    Distortion.RATIONAL: ("rational_polynomial", 8),
}
# Of compressed_depth_image_transport: the method and two numbers that only inverse depth uses, then the PNG file.
_DEPTH_HEAD = struct.pack("<iff", 0, 0.0, 0.0)


def is_color(header: Header) -> bool:
    """Whether the stream has a JPEG topic: colour, and images of 8 bit."""
    plain = (PixelFormat.RGB8, PixelFormat.BGR8, PixelFormat.MONO8)
    return header.pixel_format in _TO_RGB or header.pixel_format in plain


def is_depth16(header: Header) -> bool:
    """Whether depth is whole millimetres, which ROS calls 16UC1; other units become metres."""
    return header.pixel_format is PixelFormat.Z16 and abs(header.depth_unit_m - _MILLIMETRE_M) < 1e-9


def is_image(header: Header) -> bool:
    """Whether the stream can be a ROS image at all."""
    return header.is_depth or header.pixel_format in _PLAIN or header.pixel_format in _TO_RGB


def raw(frame: Frame, stamp: Any) -> bytearray:
    """Return `sensor_msgs/Image`: the pixels as they are, or colour that ROS's tools do not know as rgb8."""
    header = frame.header
    kind = header.pixel_format
    if header.is_depth:
        encoding = "16UC1" if is_depth16(header) else "32FC1"
        pixels: npt.NDArray[Any] = frame.array if encoding == "16UC1" else frame.depth_m()
    elif kind in _TO_RGB:
        encoding, pixels = "rgb8", np.asarray(_rgb_image(frame))
    else:
        assert kind is not None
        encoding, pixels = _PLAIN[kind], frame.array
    rows, columns = pixels.shape[:2]
    step = pixels.nbytes // rows
    message = _types.make(_types.IMAGE, stamp, rows, columns, encoding, 0, step, _types.no_bytes())
    return _types.encode_with(_types.IMAGE, message, pixels)


def jpeg(frame: Frame, stamp: Any) -> bytearray:
    """Return `sensor_msgs/CompressedImage` with JPEG; that of a camera that sends JPEG is passed on unchanged."""
    if frame.header.pixel_format is PixelFormat.MJPEG:
        return _compressed(stamp, "rgb8; jpeg compressed bgr8", frame.array)
    image = _rgb_image(frame)
    file = io.BytesIO()
    image.save(file, "JPEG", quality=JPEG_QUALITY, subsampling=0)
    form = "mono8; jpeg compressed " if image.mode == "L" else "rgb8; jpeg compressed bgr8"
    return _compressed(stamp, form, np.frombuffer(file.getbuffer(), np.uint8))


def compressed_depth(frame: Frame, stamp: Any) -> bytearray:
    """Return depth in whole millimetres as `compressed_depth_image_transport` sends it: a head and a PNG of 16 bit."""
    file = io.BytesIO()
    file.write(_DEPTH_HEAD)
    Image.fromarray(np.ascontiguousarray(frame.array)).save(file, "PNG", compress_level=_PNG_LEVEL)
    return _compressed(stamp, "16UC1; compressedDepth png", np.frombuffer(file.getbuffer(), np.uint8))


def camera_info(header: Header, stamp: Any) -> bytes:
    """Return `sensor_msgs/CameraInfo` of a frame, as a recording has it."""
    k = header.intrinsics
    model, count = _MODELS.get(k.distortion, ("plumb_bob", 5))
    if k.distortion is Distortion.INVERSE_BROWN_CONRADY and any(k.coeffs):
        # ROS has no name for it; where it distorts nothing it is the plain one.
        model = "inverse_brown_conrady"
    one = 1.0 if k.is_known else 0.0
    matrix = np.array([k.fx, 0, k.cx, 0, k.fy, k.cy, 0, 0, one], np.float64)
    rotation = np.eye(3).ravel()
    projection = np.array([k.fx, 0, k.cx, 0, 0, k.fy, k.cy, 0, 0, 0, one, 0], np.float64)
    coefficients = np.array(k.coeffs[:count], np.float64)
    roi = _types.make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
    size = (header.height, header.width)
    message = _types.make(
        _types.CAMERA_INFO, stamp, *size, model, coefficients, matrix, rotation, projection, 0, 0, roi
    )
    return _types.encode(_types.CAMERA_INFO, message)


def _compressed(stamp: Any, form: str, file: npt.NDArray[Any]) -> bytearray:
    message = _types.make(_types.COMPRESSED, stamp, form, _types.no_bytes())
    return _types.encode_with(_types.COMPRESSED, message, file)


def _rgb_image(frame: Frame) -> Image.Image:
    """Return colour or grey as Pillow's image, RGB or L."""
    kind, array = frame.header.pixel_format, frame.array
    if kind is PixelFormat.MJPEG:
        return Image.open(io.BytesIO(array.tobytes())).convert("RGB")
    if kind in (PixelFormat.RGB8, PixelFormat.MONO8):
        return Image.fromarray(np.ascontiguousarray(array))
    if kind is PixelFormat.BGR8:
        return Image.fromarray(np.ascontiguousarray(array[:, :, ::-1]))
    if kind is PixelFormat.NV12:
        rows = frame.header.height
        luma, chroma = array[:rows], array[rows:].reshape(rows // 2, -1, 2).repeat(2, axis=0)
    else:
        place = 0 if kind is PixelFormat.YUYV else 1
        luma, chroma = array[:, :, place], array[:, :, 1 - place].reshape(len(array), -1, 2)
    return Image.fromarray(_rgb(luma, chroma.repeat(2, axis=1)))


def _rgb(luma: npt.NDArray[Any], chroma: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:
    """Convert BT.601 of limited range, as cameras send it, with chroma of each pixel."""
    y = 1.164 * (luma.astype(np.float32) - 16)
    u, v = (chroma[:, :, i].astype(np.float32) - 128 for i in (0, 1))
    rgb = np.stack((y + 1.596 * v, y - 0.392 * u - 0.813 * v, y + 2.017 * u), axis=2)
    pixels: npt.NDArray[np.uint8] = np.rint(np.clip(rgb, 0, 255)).astype(np.uint8)
    return pixels
