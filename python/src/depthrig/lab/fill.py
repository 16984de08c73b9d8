"""Holes of an image filled without a model: pull and push over halved images, in inverse depth.

A stand-in for `fill` of the daemon where a sample lacks its result: the same pyramid, without cleaning and colour.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from .sample import Sample

__all__ = ["fill", "filled_of", "inverse_of"]

WHOLE = (slice(None), slice(None))


def inverse_of(depth: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return 1/m of metres; 0 stays 0."""
    known = depth > 0
    return np.where(known, 1 / np.where(known, depth, 1), 0).astype(depth.dtype)


def filled_of(
    sample: Sample, raw: npt.NDArray[np.float32], cut: tuple[slice, slice] = WHOLE
) -> npt.NDArray[np.float32]:
    """Return inverse depth without holes of a part of a sample: as the sample has it, else of the part alone.

    :param raw: depth of the part.
    """
    if sample.filled is not None:
        return inverse_of(sample.filled[cut])
    return fill(inverse_of(raw))


def _halve(sums: npt.NDArray[Any]) -> npt.NDArray[Any]:
    height, width = sums.shape
    padded = np.pad(sums, ((0, height % 2), (0, width % 2)))
    return padded[::2, ::2] + padded[1::2, ::2] + padded[::2, 1::2] + padded[1::2, 1::2]


def fill(inverse: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
    """Return inverse depth without holes; what was measured stays, and an image without any depth stays 0.

    :param inverse: `(height, width)`, 1/m, 0 for a hole.
    """
    values, weights = inverse.astype(np.float64), (inverse > 0).astype(np.float64)
    if not weights.any():
        return np.zeros(inverse.shape, np.float32)
    levels = []
    while True:
        levels.append((values, weights))
        if min(weights.shape) == 1 or weights.all():
            break
        total = _halve(weights)
        values = _halve(values * weights) / np.maximum(total, 1e-12)
        weights = np.minimum(total, 1.0)
    known = weights > 0
    coarse = np.where(known, values, values[known].mean())
    for values, weights in reversed(levels[:-1]):
        height, width = values.shape
        up = np.repeat(np.repeat(coarse, 2, 0), 2, 1)[:height, :width]
        # One smoothing takes the blocks out.
        padded = np.pad(up, 1, mode="edge")
        around = [padded[y : y + height, x : x + width] for y in range(3) for x in range(3)]
        coarse = np.where(weights > 0, values, np.mean(around, 0))
    return coarse.astype(np.float32)
