"""Affine alignment of relative depth to metres, and its inverse.

The alignment is the robust one of MoGe (arXiv 2410.19115, section 3.2): scale s and shift t minimise the sum of
min(1, w |s p + t - g|) with w = 1/g. The sum is concave between the lines s p + t = g of the points, so a minimum lies
where two of them cross: for each point as anchor, the best line through it is a one-dimensional problem that sorting
solves.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from .errors import LabError

__all__ = ["Affine", "align", "masked_nearest", "normalise", "objective", "unscale"]

Array = npt.NDArray[np.float64]
CHUNK = 1 << 21
"""Numbers in one array of candidates."""
POLISHED = 16
"""Candidates that are evaluated again, without running sums."""


@dataclass(frozen=True)
class Affine:
    """`scale * p + shift`."""

    scale: float
    shift: float
    cost: float
    """The sum that was minimised; at most the number of points."""


def objective(p: Array, g: Array, weight: Array, scale: float, shift: float) -> float:
    """Return the sum of min(1, w |scale p + shift - g|)."""
    return float(np.minimum(1.0, weight * np.abs(scale * p + shift - g)).sum())


def _scales(x: Array, y: Array, weight: Array) -> tuple[Array, Array]:
    """For each row: every ratio y/x as a candidate, and the truncated sum there, by one walk over the sorted kinks.

    A term min(1, w |a x - y|) falls with slope -w|x| from the kink at which it leaves 1, rises from y/x on, and is
    constant again from the kink beyond.
    """
    flat = np.abs(x) < 1e-9 * np.abs(x).max(1, keepdims=True).clip(1e-300)
    safe = np.where(flat, 1.0, x)
    slope = np.where(flat, 0.0, weight * np.abs(x))
    middle = np.where(flat, 0.0, y / safe)
    reach = np.where(flat, 0.0, 1 / (weight * np.abs(safe)))
    kinks = np.concatenate([middle - reach, middle, middle + reach], 1)
    change = np.concatenate([-slope, 2 * slope, -slope], 1)
    order = np.argsort(kinks, 1, kind="stable")
    kinks = np.take_along_axis(kinks, order, 1)
    slopes = np.cumsum(np.take_along_axis(change, order, 1), 1)
    steps = slopes[:, :-1] * np.diff(kinks, axis=1)
    far = (~flat).sum(1, keepdims=True) + np.where(flat, np.minimum(1, weight * np.abs(y)), 0).sum(1, keepdims=True)
    sums = np.concatenate([far, far + np.cumsum(steps, 1)], 1)
    n = x.shape[1]
    is_middle = (order >= n) & (order < 2 * n) & ~np.take_along_axis(np.tile(flat, 3), order, 1)
    return kinks, np.where(is_middle & (kinks > 0), sums, np.inf)


def align(p: npt.NDArray[Any], g: npt.NDArray[Any], weight: npt.NDArray[Any] | None = None) -> Affine:
    """Return the scale (above 0) and shift that bring `p` to `g`: exact, in n sorts of n numbers.

    :param p: relative depth of n points; a few thousand at most (`masked_nearest`).
    :param g: metric depth of the same points, above 0.
    :param weight: of each point; 1/g when not given.
    :raises LabError: when there are fewer than two points, or none that a rising line could join.
    """
    p, g = np.asarray(p, np.float64).ravel(), np.asarray(g, np.float64).ravel()
    w = 1 / g if weight is None else np.asarray(weight, np.float64).ravel()
    if p.shape != g.shape or p.shape != w.shape:
        raise LabError(f"alignment of {p.size} points with {g.size} and {w.size} weights")
    good = np.isfinite(p) & np.isfinite(g) & np.isfinite(w) & (w > 0)
    p, g, w = p[good], g[good], w[good]
    if p.size < 2:
        raise LabError(f"alignment needs two points, {p.size} are valid")
    if np.ptp(p) == 0:
        raise LabError("alignment of one relative depth: its scale is unobservable")
    # Large means and small differences would cancel in the products below.
    origin, span = float(np.median(p)), float(np.ptp(p))
    q = (p - origin) / span
    best: list[tuple[float, float, float]] = []
    rows = max(1, CHUNK // (3 * p.size))
    for first in range(0, p.size, rows):
        anchors = np.arange(first, min(first + rows, p.size))
        x, y = q - q[anchors, None], g - g[anchors, None]
        kinks, sums = _scales(x, y, np.broadcast_to(w, x.shape))
        at = np.argpartition(sums, min(POLISHED, sums.size - 1), None)[:POLISHED]
        for row, column in zip(*np.unravel_index(at, sums.shape), strict=True):
            if np.isfinite(sums[row, column]):
                anchor, a = anchors[row], float(kinks[row, column])
                best.append((float(sums[row, column]), a, float(g[anchor] - a * q[anchor])))
        best = sorted(best)[:POLISHED]
    if not best:
        raise LabError("alignment finds no rising line: relative and metric depth run against each other")
    _, a, b = min((objective(q, g, w, a, b), a, b) for _, a, b in best)
    scale, shift = a / span, b - a * origin / span
    return Affine(scale, shift, objective(p, g, w, scale, shift))


def masked_nearest(depth: npt.NDArray[Any], side: int = 32) -> npt.NDArray[np.int64]:
    """Return flat indices of at most side² valid pixels: in each cell of a grid the one nearest to its centre."""
    height, width = depth.shape
    rows, columns = min(side, height), min(side, width)
    y, x = np.mgrid[:height, :width]
    cell_y, cell_x = y * rows // height, x * columns // width
    centre_y = ((cell_y + 0.5) * height / rows) - 0.5
    centre_x = ((cell_x + 0.5) * width / columns) - 0.5
    distance = (y - centre_y) ** 2 + (x - centre_x) ** 2
    valid = np.flatnonzero(np.isfinite(depth).ravel() & (depth.ravel() > 0))
    cell = (cell_y * columns + cell_x).ravel()[valid]
    order = np.lexsort((valid, distance.ravel()[valid], cell))
    _, first = np.unique(cell[order], return_index=True)
    return valid[order[first]].astype(np.int64)


def normalise(g: npt.NDArray[Any], valid: npt.NDArray[np.bool_]) -> Array:
    """Return (g - median) / mean|g - median| over the valid pixels; 0 elsewhere.

    :raises LabError: when nothing is valid or all is equal.
    """
    values = np.asarray(g, np.float64)[valid]
    if not values.size:
        raise LabError("normalisation of an empty image")
    median = float(np.median(values))
    spread = float(np.abs(values - median).mean())
    if not spread > 0:
        raise LabError("normalisation of an image of one depth")
    return np.where(valid, (np.asarray(g, np.float64) - median) / spread, 0.0)


def unscale(
    relative: npt.NDArray[Any], truth: npt.NDArray[Any], inverse: bool, side: int = 32
) -> npt.NDArray[np.float32]:
    """Return relative depth in metres, as the truth has them.

    :param relative: dense `(height, width)`; of inverse depth when `inverse` (stereo), else of depth (ToF).
    :param truth: metres, 0 where unknown.
    :returns: metres; 0 where the aligned value is not a distance.
    """
    at = masked_nearest(truth, side)
    if not at.size:
        raise LabError("the true depth is empty")
    g = truth.ravel()[at].astype(np.float64)
    found = align(relative.ravel()[at], 1 / g if inverse else g)
    metric = found.scale * np.asarray(relative, np.float64) + found.shift
    # Twice as far as anything true is no reading of a sensor.
    limit = 2 * float(truth.max())
    if inverse:
        metric = np.where(metric > 1 / limit, 1 / np.maximum(metric, 1 / limit), 0)
    return np.where((metric > 0) & (metric <= limit), metric, 0).astype(np.float32)
