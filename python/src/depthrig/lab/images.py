"""Images on disk as arrays, with the file in every error."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from .errors import LabError

__all__ = [
    "color",
    "decode_color",
    "decode_png",
    "encode_png",
    "exr_channel",
    "grey",
    "metres",
    "resize_labels",
    "shrink",
]

PIXELS_MAX = 1 << 26


def _open(source: Any, where: str) -> Any:
    from PIL import Image

    try:
        image = Image.open(source)
        if image.width * image.height > PIXELS_MAX:
            raise LabError(f"{where}: {image.width}x{image.height} is too large")
        image.load()
    except FileNotFoundError:
        raise LabError(f"{where}: no such file") from None
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as e:
        if isinstance(e, LabError):
            raise
        raise LabError(f"{where}: damaged image: {e}") from None
    return image


def _array(image: Any, where: str) -> npt.NDArray[Any]:
    if image.mode in ("I;16", "I;16B", "I;16L", "I"):
        # Pillow before 12 opens 16-bit PNG as 32 bits.
        array = np.asarray(image)
        if array.min() < 0 or array.max() > 65535:
            raise LabError(f"{where}: pixels beyond 16 bits")
        return array.astype(np.uint16)
    if image.mode in ("L", "RGB"):
        return np.array(image)
    raise LabError(f"{where}: pixels of mode {image.mode}")


def decode_png(data: bytes, where: str) -> npt.NDArray[Any]:
    """Return an image of 8-bit RGB, 8-bit or 16-bit grey."""
    return _array(_open(io.BytesIO(data), where), where)


def encode_png(image: npt.NDArray[Any]) -> bytes:
    """Return an array as PNG: 8-bit RGB, 8-bit or 16-bit grey."""
    from PIL import Image

    out = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(image)).save(out, "PNG", compress_level=1)
    return out.getvalue()


def color(path: Path) -> npt.NDArray[np.uint8]:
    """Return a colour image, red first; an alpha channel is dropped."""
    return np.array(_open(path, str(path)).convert("RGB"))


def decode_color(data: bytes, where: str) -> npt.NDArray[np.uint8]:
    """Return a JPEG or PNG as colour, red first."""
    return np.array(_open(io.BytesIO(data), where).convert("RGB"))


def grey(path: Path) -> npt.NDArray[Any]:
    """Return an image of one channel, 8 or 16 bits."""
    array = _array(_open(path, str(path)), str(path))
    if array.ndim != 2:
        raise LabError(f"{path}: {array.shape[2]} channels, one is wanted")
    return array


def exr_channel(path: Path, *names: str) -> npt.NDArray[np.float32]:
    """Return a channel of an OpenEXR file as float32: the first of `names` that it has."""
    try:
        import OpenEXR
    except ImportError as e:
        raise LabError("OpenEXR files need the package: pip install OpenEXR") from e
    if not path.is_file():
        raise LabError(f"{path}: no such file")
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {name: np.array(c.pixels, np.float32) for name, c in file.channels().items()}
    except Exception as e:  # the package raises several, RuntimeError among them
        raise LabError(f"{path}: damaged OpenEXR file: {e}") from None
    for name in names:
        if name in channels:
            return channels[name]
    raise LabError(f"{path}: no channel {' or '.join(names)}, only {', '.join(sorted(channels))}")


def metres(depth: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
    """Return depth with everything that is not a distance (NaN, infinite, 0, negative) as 0."""
    depth = depth.astype(np.float32)
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))


def shrink(image: npt.NDArray[np.uint8], size: tuple[int, int], where: str) -> npt.NDArray[np.uint8]:
    """Return colour at `size` (height, width), of which its own is a whole multiple, by the mean of each block.

    :raises LabError: when it is not a multiple.
    """
    if image.shape[:2] == size:
        return image
    height, width = size
    factor = image.shape[0] // max(height, 1)
    if factor < 1 or (factor * height, factor * width) != image.shape[:2]:
        found = f"{image.shape[1]}x{image.shape[0]}"
        raise LabError(f"{where}: colour of {found} is not a whole multiple of its depth of {width}x{height}")
    blocks = image.reshape(height, factor, width, factor, 3).mean((1, 3))
    return np.rint(blocks).astype(np.uint8)


def resize_labels(labels: npt.NDArray[Any], size: tuple[int, int], where: str) -> npt.NDArray[Any]:
    """Return labels at `size`, of which their own is a whole multiple, by the pixel at the middle of each block."""
    if labels.shape == size:
        return labels
    factor = labels.shape[0] // max(size[0], 1)
    if factor < 1 or (factor * size[0], factor * size[1]) != labels.shape:
        raise LabError(f"{where}: {labels.shape[1]}x{labels.shape[0]} is not a whole multiple of its depth")
    return labels[factor // 2 :: factor, factor // 2 :: factor]
