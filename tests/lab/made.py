"""Small made images, and the folders of dataset layouts with them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from depthrig.lab.images import encode_png
from depthrig.lab.sample import Intrinsics, Licence, Sample

OURS = Licence("MIT OR Apache-2.0", ships=True)


def sample(seed: int = 0, height: int = 32, width: int = 48, holes: bool = True, name: str = "made") -> Sample:
    """A plane with a nearer box, in steps of 0.1 mm; raw depth with noise and a hole."""
    rng = np.random.default_rng(seed)
    truth = np.tile(np.linspace(1.5, 0.8, height)[:, None], (1, width))
    y, x = int(rng.integers(2, height // 2)), int(rng.integers(2, width // 2))
    box = (slice(y, y + height // 3), slice(x, x + width // 3))
    truth[box] = 0.5 + 0.1 * rng.random()
    truth = np.rint(truth * 1e4) / 1e4
    raw = np.rint((truth + 0.002 * rng.standard_normal(truth.shape)) * 1e3) / 1e3
    material = np.ones((height, width), np.uint8)
    material[box] = 4
    if holes:
        raw[y : y + height // 4, x : x + width // 4] = 0
        truth[0, :4] = 0
    color = np.clip(255 * truth[..., None] / 2 + rng.integers(0, 20, (height, width, 3)), 0, 255).astype(np.uint8)
    camera = Intrinsics(50.0, 50.0, width / 2 - 0.5, height / 2 - 0.5)
    return Sample(name, color, OURS, raw.astype(np.float32), truth.astype(np.float32), camera, material)


def write(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(encode_png(image))


def exr(path: Path, **channels: np.ndarray) -> None:
    import OpenEXR

    path.parent.mkdir(parents=True, exist_ok=True)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {k: np.ascontiguousarray(v, np.float32) for k, v in channels.items()}).write(str(path))
