"""Measures the noise of a depth sensor in single images, to hold a simulated sensor against a real one.

    python -m depthrig.lab.noise SHARDS... --image depth.png 0.001 23.0

Prints, for each sensor and kind of scene of the shards and for each image, the share of holes, how long they are, and
the noise of smooth surfaces. `--image` takes a 16-bit PNG, its unit in metres, and focal length times baseline (pixels
times metres).
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from .batches import seen_of
from .errors import LabError
from .images import grey
from .shards import Shard, list_shards

__all__ = ["BASELINES", "SIDE", "Noise", "hole_runs", "main", "measure", "plane_residuals"]

SIDE = 9
"""Side of the windows to which planes are fitted, pixels."""
BASELINES = {"d405": 0.018, "d415": 0.055, "d435": 0.05, "d455": 0.095, "zed2i": 0.12}
"""Baselines of stereo cameras, metres."""
LONG, SHORT = 32, 4
"""A run of holes in a row is long from so many pixels on, and short below so many."""


@dataclass(frozen=True)
class Noise:
    """What several images of one sensor have in common."""

    images: int
    holes: float
    """Share of missing pixels within what the sensor can see."""
    long: float
    """Share of the missing pixels that lie in long runs (32 pixels of a row or more)."""
    short: float
    """Share of those in short runs (less than 4)."""
    residual_px: tuple[float, float, float]
    """Quartiles over windows of 9x9 measured pixels: standard deviation of disparity about its plane, pixels."""
    correlation: float
    """Of the residuals of neighbours in a row, in the smoother half of the windows; 0 is white noise."""


def hole_runs(missing: npt.NDArray[np.bool_]) -> npt.NDArray[np.int64]:
    """Return the lengths of the runs of missing pixels in each row."""
    edges = np.diff(np.pad(missing, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    # Both come in the order of rows, so that the nth begin is of the nth end.
    return np.nonzero(edges < 0)[1] - np.nonzero(edges > 0)[1]


def plane_residuals(disparity: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return `(windows, SIDE, SIDE)`: disparity less its least-squares plane, where a whole window was measured.

    :param disparity: `(height, width)`, NaN for a hole. A plane in space is one in disparity.
    """
    offsets = np.arange(SIDE) - SIDE // 2
    x, y = np.meshgrid(offsets, offsets)
    basis = np.stack([x.ravel(), y.ravel(), np.ones(SIDE * SIDE)], 1)
    rows, columns = disparity.shape[0] // SIDE, disparity.shape[1] // SIDE
    cut = disparity[: rows * SIDE, : columns * SIDE].reshape(rows, SIDE, columns, SIDE)
    tiles: npt.NDArray[np.float64] = cut.swapaxes(1, 2).reshape(-1, SIDE * SIDE)
    tiles = tiles[np.isfinite(tiles).all(1)]
    of_plane: npt.NDArray[np.float64] = np.linalg.pinv(basis).astype(np.float64).T
    residuals: npt.NDArray[np.float64] = tiles - tiles @ of_plane @ basis.T
    return residuals.reshape(-1, SIDE, SIDE)


def measure(raws: Iterable[tuple[npt.NDArray[np.float32], float]]) -> Noise:
    """Return the noise of images of one sensor.

    :param raws: measured depth in metres (0 for a hole), and focal length times baseline in pixels times metres.
    :raises LabError: when nothing was measured in any of them.
    """
    shares, runs, residuals = [], [], []
    for raw, focal_baseline in raws:
        seen = seen_of(raw)
        missing = seen & (raw <= 0)
        if not seen.any():
            shares.append(1.0)
            continue
        shares.append(float(missing.sum() / seen.sum()))
        runs.append(hole_runs(missing))
        disparity = np.full(raw.shape, np.nan)
        np.divide(focal_baseline, raw, out=disparity, where=raw > 0)
        residuals.append(plane_residuals(disparity))
    if not residuals:
        raise LabError("no image has any depth")
    all_runs, tiles = np.concatenate(runs), np.concatenate(residuals)
    missing_total = max(int(all_runs.sum()), 1)
    deviations = tiles.std((1, 2))
    smooth = tiles[deviations <= np.median(deviations)] if len(tiles) else tiles
    power = float((smooth[:, :, 1:] ** 2 + smooth[:, :, :-1] ** 2).sum()) / 2
    quartiles = np.percentile(deviations, [25, 50, 75]) if len(tiles) else np.full(3, math.nan)
    return Noise(
        images=len(shares),
        holes=float(np.mean(shares)),
        long=float(all_runs[all_runs >= LONG].sum() / missing_total),
        short=float(all_runs[all_runs < SHORT].sum() / missing_total),
        residual_px=(float(quartiles[0]), float(quartiles[1]), float(quartiles[2])),
        correlation=float((smooth[:, :, 1:] * smooth[:, :, :-1]).sum()) / power if power > 0 else math.nan,
    )


def of_shards(folder: Path) -> dict[str, Noise]:
    """Return the noise of each stereo sensor and kind of scene in a folder of shards."""
    groups: dict[str, list[tuple[npt.NDArray[np.float32], float]]] = {}
    for path in list_shards(folder):
        shard = Shard(path)
        for index in range(len(shard)):
            facts = shard.facts(index)
            baseline = BASELINES.get(str(facts.get("sensor")))
            if baseline is None:
                continue
            sample = shard[index]
            if sample.raw is None or sample.intrinsics is None:
                continue
            name = " ".join(str(facts.get(key)) for key in ("sensor", "sensor_model", "scene"))
            groups.setdefault(name, []).append((sample.raw, sample.intrinsics.fx * baseline))
    if not groups:
        raise LabError(f"{folder}: no sample of a stereo camera ({', '.join(BASELINES)})")
    return {name: measure(raws) for name, raws in sorted(groups.items())}


def of_image(path: str, unit: str, focal_baseline: str) -> Noise:
    """Return the noise of one image; 65535 is a hole as 0 is."""
    try:
        unit_m, product = float(unit), float(focal_baseline)
    except ValueError:
        raise LabError(f"--image {path} {unit} {focal_baseline}: write the unit and the product as numbers") from None
    if not (0 < unit_m < 1 and 0 < product < 1e6):
        raise LabError(f"--image {path} {unit} {focal_baseline}: the unit is 0 to 1 m, the product above 0 px m")
    pixels = grey(Path(path))
    return measure([(np.where(pixels == 65535, 0, pixels * unit_m).astype(np.float32), product)])


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the noise of shards and images."""
    parser = argparse.ArgumentParser(prog="python -m depthrig.lab.noise", description="Noise of depth sensors.")
    parser.add_argument("shards", nargs="*", type=Path, help="folders of shards")
    parser.add_argument("--image", nargs=3, action="append", default=[], metavar=("PNG", "UNIT_M", "FOCAL_BASELINE"))
    parser.add_argument("--json", action="store_true", help="print JSON")
    args = parser.parse_args(arguments)
    if not args.shards and not args.image:
        parser.error("name a folder of shards, or an image")
    found: dict[str, Noise] = {}
    try:
        for folder in args.shards:
            found |= {f"{folder.name} {name}": noise for name, noise in of_shards(folder).items()}
        for image in args.image:
            found[image[0]] = of_image(*image)
    except LabError as e:
        print(f"error: {e}", file=sys.stderr)
        return 1
    if args.json:
        print(json.dumps({name: asdict(noise) for name, noise in found.items()}, indent=1))
        return 0
    wide = max(len(name) for name in found)
    print(f"{'':{wide}}  images  holes  of them long, short  residual px (quartiles)  correlation")
    for name, n in found.items():
        quartiles = " ".join(f"{v:.3f}" for v in n.residual_px)
        shares = f"{n.images:6d} {n.holes:6.1%} {n.long:10.0%} {n.short:8.0%}"
        print(f"{name:{wide}}  {shares}      {quartiles} {n.correlation:16.2f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
