"""Colour and depth images that every recorder is given: 1280x720, real and synthetic.

A set of images is one file: a line of JSON (`width`, `height`, `pairs`, `source`), then for each pair the RGB8
pixels and the little-endian 16-bit depth. Real images of 640x480 are put together four to an image, each another
one: scaling would smooth them, and tiling one would let a compressor find its repetition.
"""

import json
from pathlib import Path

import cv2
import numpy as np

WIDTH, HEIGHT = 1280, 720


def _load(color: Path, depth: Path) -> tuple[np.ndarray, np.ndarray]:
    rgb = cv2.imread(str(color), cv2.IMREAD_COLOR)
    z = cv2.imread(str(depth), cv2.IMREAD_UNCHANGED)
    if rgb is None or z is None or z.dtype != np.uint16:
        raise SystemExit(f"{color} and {depth} cannot be read as a colour and a 16-bit depth image")
    return np.ascontiguousarray(rgb[..., ::-1]), z


def real(data: Path) -> tuple[list, str]:
    """A D405's pair as it is, and two mosaics of the four 640x480 pairs: their upper and their lower parts."""
    pairs = [_load(data / "cdm_d405/color_26.png", data / "cdm_d405/depth_26.png")]
    small = []
    for i in range(4):
        folder = data / "lingbot_depth" / str(i)
        color = next(p for p in sorted(folder.iterdir()) if p.stem == "rgb")
        small.append(_load(color, folder / "raw_depth.png"))
    half_w, half_h = WIDTH // 2, HEIGHT // 2
    for top, order in ((0, (0, 1, 2, 3)), (480 - half_h, (2, 0, 3, 1))):
        mosaic = []
        for kind in range(2):
            q = [small[i][kind][top : top + half_h, :half_w] for i in order]
            mosaic.append(np.concatenate([np.concatenate(q[:2], 1), np.concatenate(q[2:], 1)], 0))
        pairs.append(tuple(mosaic))
    return pairs, "cdm_d405 as it is, two mosaics of lingbot_depth 0 to 3"


def synthetic() -> tuple[list, str]:
    """Rooms of planes and balls with texture, sensor noise, holes, and depth from whole steps of disparity."""
    rng = np.random.default_rng(1)
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float32)
    pairs = []
    for _ in range(3):
        depth = 2.5 + 0.8 * x / WIDTH - 0.9 * y / HEIGHT
        color = np.stack([130 + 60 * x / WIDTH, 120 + 50 * y / HEIGHT, 110 + 0 * x], -1)
        texture = sum(
            a * cv2.resize(rng.standard_normal((HEIGHT // s + 1, WIDTH // s + 1)).astype(np.float32), (WIDTH, HEIGHT))
            for s, a in ((64, 14), (16, 8), (4, 4))
        )
        for _ in range(12):
            cx, cy, r = rng.uniform(0, WIDTH), rng.uniform(0, HEIGHT), rng.uniform(40, 180)
            inside = (x - cx) ** 2 + (y - cy) ** 2 < r**2
            bulge = np.sqrt(np.maximum(r**2 - (x - cx) ** 2 - (y - cy) ** 2, 0)) / 1000
            z = rng.uniform(0.6, 2.0)
            depth = np.where(inside & (z < depth), z - bulge, depth)
            color = np.where(inside[..., None], rng.uniform(30, 220, 3) + 400 * bulge[..., None], color)
        noisy = color + texture[..., None] + rng.normal(0, 1.5, (HEIGHT, WIDTH, 1)) + rng.normal(0, 0.7, color.shape)
        # A stereo camera of 650 px focal length and 50 mm: whole steps of 1/32 px, and 4 % holes at edges.
        disparity = np.round((650 * 0.05 / depth + rng.normal(0, 0.03, depth.shape)) * 32) / 32
        z16 = np.clip(np.round(650 * 0.05 / disparity * 1000), 0, 65535)
        edges = cv2.dilate((np.abs(np.diff(depth, axis=1, prepend=depth[:, :1])) > 0.05).astype(np.uint8), np.ones((9, 9)))
        z16[(edges > 0) | (rng.random(depth.shape) < 0.01)] = 0
        pairs.append((np.clip(noisy, 0, 255).astype(np.uint8), z16.astype(np.uint16)))
    return pairs, "three synthetic rooms"


def save(path: Path, pairs: list, source: str) -> None:
    """Writes a set of images."""
    head = {"width": WIDTH, "height": HEIGHT, "pairs": len(pairs), "source": source}
    with path.open("wb") as f:
        f.write(json.dumps(head).encode() + b"\n")
        for color, depth in pairs:
            assert color.shape == (HEIGHT, WIDTH, 3) and depth.shape == (HEIGHT, WIDTH)
            f.write(color.tobytes() + depth.astype("<u2").tobytes())


def load(path: Path) -> tuple[dict, list[tuple[bytes, bytes]]]:
    """The head and the pairs of a set of images."""
    with path.open("rb") as f:
        head = json.loads(f.readline())
        pixels = head["width"] * head["height"]
        return head, [(f.read(3 * pixels), f.read(2 * pixels)) for _ in range(head["pairs"])]
