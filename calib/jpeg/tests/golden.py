#!/usr/bin/env python3
"""JPEG images in all the forms that matter, with the pixels that Pillow (libjpeg-turbo) decodes them to.

    python3 golden.py make FOLDER         small images and golden.csv: the committed witnesses
    python3 golden.py random FOLDER SEED  images of random form and size, each with its pixels in a .raw beside it

`make` also demands that OpenCV decodes the same pixels, when it is installed.
"""

import io
import random
import sys
import zlib
from pathlib import Path

import numpy as np
from PIL import Image

SUBSAMPLING = {"444": 0, "422": 1, "420": 2}


def scene(width: int, height: int, rng: np.random.Generator) -> np.ndarray:
    """Slopes, saturated edges and grain."""
    y, x = np.mgrid[0:height, 0:width]
    slopes = np.stack([127 + 120 * np.sin(x / 7 + y / 19), 127 + 120 * np.cos(y / 5), (x * 9 + y * 5) % 256], -1)
    slopes[:: max(height // 3, 1)] = [255, 0, 0]
    slopes[:, width // 2 :: 5] = [0, 255, 0]
    return np.clip(slopes + rng.integers(-40, 41, slopes.shape), 0, 255).astype(np.uint8)


def encode(image: np.ndarray, form: str, progressive: bool, restarts: int, quality: int) -> bytes:
    out = io.BytesIO()
    options = {"quality": quality, "progressive": progressive}
    if restarts:
        options["restart_marker_blocks"] = restarts
    image = Image.fromarray(image)
    if form == "grey":
        image = image.convert("L")
    elif form == "rgb":
        options["keep_rgb"] = True
    else:
        options["subsampling"] = SUBSAMPLING[form]
    image.save(out, "JPEG", **options)
    return out.getvalue()


def decode(jpeg: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(jpeg)))


def also_opencv(jpeg: bytes, pixels: np.ndarray) -> None:
    try:
        import cv2
    except ImportError:
        return
    flag = cv2.IMREAD_GRAYSCALE if pixels.ndim == 2 else cv2.IMREAD_COLOR_RGB
    assert (cv2.imdecode(np.frombuffer(jpeg, np.uint8), flag) == pixels).all()


def make(folder: Path) -> None:
    folder.mkdir(exist_ok=True)
    rng = np.random.default_rng(1)
    lines = ["file,width,height,channels,crc32"]
    for width, height in [(1, 1), (17, 15), (35, 24)]:
        for form in ["444", "422", "420", "grey"]:
            for progressive in (False, True):
                for restarts in (0, 1):
                    jpeg = encode(scene(width, height, rng), form, progressive, restarts, 80)
                    pixels = decode(jpeg)
                    also_opencv(jpeg, pixels)
                    kind = "progressive" if progressive else "baseline"
                    name = f"{width}x{height}_{form}_{kind}{'_restarts' if restarts else ''}.jpg"
                    (folder / name).write_bytes(jpeg)
                    channels = 1 if pixels.ndim == 2 else 3
                    lines.append(f"{name},{width},{height},{channels},{zlib.crc32(pixels.tobytes()):08x}")
    (folder / "golden.csv").write_text("\n".join(lines) + "\n")


def make_random(folder: Path, seed: int) -> None:
    rng, dice = np.random.default_rng(seed), random.Random(seed)
    for n in range(300):
        width, height = dice.randint(1, 150), dice.randint(1, 150)
        form = dice.choice(["444", "422", "420", "grey", "rgb"])
        restarts = dice.choice([0, 0, 1, 5])
        jpeg = encode(scene(width, height, rng), form, dice.random() < 0.4, restarts, dice.randint(1, 100))
        (folder / f"{n:03}_{width}x{height}_{form}.jpg").write_bytes(jpeg)
        (folder / f"{n:03}_{width}x{height}_{form}.raw").write_bytes(decode(jpeg).tobytes())


if __name__ == "__main__":
    if sys.argv[1] == "make":
        make(Path(sys.argv[2]))
    else:
        make_random(Path(sys.argv[2]), int(sys.argv[3]))
