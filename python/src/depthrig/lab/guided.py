"""Guided filter (He, Sun, Tang: Guided Image Filtering, 2013) over images with holes.

In each window the output is a line of the guide, fitted to the input's valid pixels; a pixel takes the mean of the
lines of all windows around it that have a valid pixel. Box sums are differences of running sums, so the cost does not
depend on the radius.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from .errors import LabError

__all__ = ["box_sum", "guided_filter"]

Array = npt.NDArray[np.float64]


def box_sum(image: Array, radius: int) -> Array:
    """Return for each pixel the sum over the square of 2 radius + 1 pixels around it, cut off at the borders."""
    for axis in (0, 1):
        size = image.shape[axis]
        sums = np.insert(np.cumsum(image, axis), 0, 0, axis)
        at = np.arange(size)
        high, low = np.minimum(at + radius + 1, size), np.maximum(at - radius, 0)
        image = np.take(sums, high, axis) - np.take(sums, low, axis)
    return image


def guided_filter(
    guide: npt.NDArray[Any], image: npt.NDArray[Any], valid: npt.NDArray[np.bool_], radius: int, epsilon: float
) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Return `image` filtered along `guide`, and where it has a value.

    :param guide: dense `(height, width)`.
    :param valid: pixels of `image` that are taken; the others may hold anything.
    :param radius: of the window, pixels.
    :param epsilon: added to the variance of the guide, in its units squared.
    """
    if guide.shape != image.shape or guide.shape != valid.shape or guide.ndim != 2:
        raise LabError(f"guide {guide.shape}, image {image.shape} and mask {valid.shape} differ in size")
    if radius < 1 or not epsilon >= 0:
        raise LabError(f"radius = {radius} below 1 or epsilon = {epsilon} below 0")
    w = valid.astype(np.float64)
    count = box_sum(w, radius)
    empty = count < 0.5
    if empty.all():
        return np.zeros(guide.shape), ~empty
    # Around 0, so that variances do not cancel.
    centre_i = float(np.asarray(guide, np.float64)[valid].mean())
    centre_p = float(np.asarray(image, np.float64)[valid].mean())
    i = np.asarray(guide, np.float64) - centre_i
    p = np.where(valid, np.asarray(image, np.float64) - centre_p, 0.0)
    n = np.where(empty, 1.0, np.rint(count))
    mean_i, mean_p = box_sum(w * i, radius) / n, box_sum(w * p, radius) / n
    variance = np.maximum(box_sum(w * i * i, radius) / n - mean_i**2, 0)
    covariance = box_sum(w * i * p, radius) / n - mean_i * mean_p
    # A flat guide with epsilon 0 leaves the mean.
    bottom = variance + epsilon
    a = np.where(bottom > 1e-300, covariance / np.where(bottom > 1e-300, bottom, 1), 0)
    b = mean_p - a * mean_i
    a, b = np.where(empty, 0, a), np.where(empty, 0, b)
    lines = box_sum((~empty).astype(np.float64), radius)
    reached = lines > 0.5
    lines = np.where(reached, np.rint(lines), 1)
    out = (box_sum(a, radius) * i + box_sum(b, radius)) / lines + centre_p
    return np.where(reached, out, 0.0), reached
