"""Depth as `sensor_msgs/PointCloud2` in the optical frame: x right, y down, z forward, metres."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import numpy.typing as npt

from .._frame import Frame
from .._header import Intrinsics
from .._layout import Distortion
from . import _types

_ITERATIONS = 40
_CONVERGED = 1e-6
"""Of the unit image plane: a thousandth of a pixel at a focal length of 1000."""
_FLOAT32 = 7


def points(frame: Frame, stamp: Any) -> bytearray:
    """Return the organised cloud: a point for each pixel, NaN where there is no depth."""
    depth = frame.depth_m()
    rows, columns = depth.shape
    rays = _rays(frame.header.intrinsics, columns, rows)
    cloud = np.empty((rows, columns, 3), np.float32)
    np.multiply(rays[0], depth, out=cloud[:, :, 0])
    np.multiply(rays[1], depth, out=cloud[:, :, 1])
    # Also where no ray is known.
    np.multiply(rays[2], depth, out=cloud[:, :, 2])
    fields = [_types.make("sensor_msgs/msg/PointField", name, 4 * i, _FLOAT32, 1) for i, name in enumerate("xyz")]
    message = _types.make(
        _types.POINTS, stamp, rows, columns, fields, False, 12, 12 * columns, _types.no_bytes(), False
    )
    return _types.encode_with(_types.POINTS, message, cloud, tail=1)


@functools.lru_cache(maxsize=32)
def _rays(lens: Intrinsics, columns: int, rows: int) -> npt.NDArray[np.float32]:
    """Return x, y and z of each pixel's ray at z = 1; NaN where the lens shows nothing."""
    x = (np.arange(columns, dtype=np.float64) - lens.cx) / lens.fx
    y = (np.arange(rows, dtype=np.float64) - lens.cy) / lens.fy
    seen = np.stack(np.broadcast_arrays(x[None, :], y[:, None]))
    with np.errstate(all="ignore"):
        plane = _undistorted(lens, seen)
    one = np.where(np.isfinite(plane[:1]), 1.0, np.nan)
    return np.concatenate((plane, one)).astype(np.float32)


def _undistorted(lens: Intrinsics, seen: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the points that the lens shows at `seen`, on the plane at z = 1."""
    model = lens.distortion
    if model is Distortion.KANNALA_BRANDT4:
        return _from_fisheye(lens, seen)
    if model in (Distortion.UNKNOWN, Distortion.NONE) or not any(lens.coeffs):
        return seen
    points = seen.copy()
    for _ in range(_ITERATIONS):
        points += seen - _distorted(lens, points)
    off = np.abs(seen - _distorted(lens, points)).max(axis=0)
    points[:, ~(off < _CONVERGED)] = np.nan
    return points


def _distorted(lens: Intrinsics, points: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return where the lens shows these points: OpenCV's models, and RealSense's inverse one."""
    k1, k2, p1, p2, k3, k4, k5, k6 = lens.coeffs
    if lens.distortion is not Distortion.RATIONAL:
        k4 = k5 = k6 = 0.0
    r2 = (points**2).sum(axis=0)
    scale = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    x, y = points * scale
    # The inverse model has its tangential part of the scaled point.
    a, b = (x, y) if lens.distortion is Distortion.INVERSE_BROWN_CONRADY else points
    return np.stack((x + 2 * p1 * a * b + p2 * (r2 + 2 * a * a), y + 2 * p2 * a * b + p1 * (r2 + 2 * b * b)))


def _from_fisheye(lens: Intrinsics, seen: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Invert `r = theta (1 + k1 theta^2 + k2 theta^4 + ...)` with Newton's method."""
    k1, k2, k3, k4 = lens.coeffs[:4]
    r = np.hypot(*seen)
    theta = r.copy()
    for _ in range(_ITERATIONS):
        t = theta * theta
        value = theta * (1 + t * (k1 + t * (k2 + t * (k3 + t * k4)))) - r
        theta -= value / (1 + t * (3 * k1 + t * (5 * k2 + t * (7 * k3 + t * 9 * k4))))
    t = theta * theta
    off = np.abs(theta * (1 + t * (k1 + t * (k2 + t * (k3 + t * k4)))) - r)
    bad = ~((off < _CONVERGED) & (theta >= 0) & (theta < np.pi / 2))
    ratio = np.where(r > 0, np.tan(theta) / np.where(r > 0, r, 1), 1.0)
    ratio[bad] = np.nan
    return seen * ratio
