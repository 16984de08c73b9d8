"""Intrinsics as depthrig states them, from the SDK's metadata of a frame or from the camera's calibration."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from .._header import Intrinsics
from .._layout import Distortion
from ._errors import OakError

if TYPE_CHECKING:
    import depthai as dai

_KEPT = 8
"""Coefficients that a frame's header has room for."""


def intrinsics(
    matrix: Sequence[Sequence[float]], model: Distortion = Distortion.NONE, coefficients: Sequence[float] = ()
) -> Intrinsics:
    """Return the intrinsics of a camera matrix, pixels, with up to eight coefficients of `model`."""
    coeffs = tuple(float(c) for c in coefficients) + (0.0,) * (_KEPT - len(coefficients))
    (fx, _, cx), (_, fy, cy) = matrix[0], matrix[1]
    return Intrinsics(float(fx), float(fy), float(cx), float(cy), coeffs, int(model), 0)


def unknown() -> Intrinsics:
    """Return the intrinsics that stand for no calibration."""
    return Intrinsics(0.0, 0.0, 0.0, 0.0, (0.0,) * _KEPT, int(Distortion.UNKNOWN), 0)


def distortion(model: str, coefficients: Sequence[float]) -> tuple[Distortion, tuple[float, ...]]:
    """Return depthrig's model and coefficients for those of the SDK.

    `model` is the name of a `CameraModel`. The SDK has OpenCV's order: k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 tx ty for
    `Perspective` (depthai-core `include/depthai/device/CalibrationHandler.hpp`, MIT), k1 k2 k3 k4 for `Fisheye`.

    Raises OakError for a lens that a frame's header cannot describe.
    """
    values = [float(c) for c in coefficients]
    while values and values[-1] == 0.0:
        values.pop()
    if not values:
        return Distortion.NONE, ()
    if model == "Perspective" and len(values) <= 5:
        return Distortion.BROWN_CONRADY, tuple(values)
    if model == "Perspective" and len(values) <= _KEPT:
        return Distortion.RATIONAL, tuple(values)
    if model == "Fisheye" and len(values) <= 4:
        return Distortion.KANNALA_BRANDT4, tuple(values)
    raise OakError(
        f"its lens is described by a {model} model with {len(values)} coefficients, for which a frame's header has no "
        "room; leave --keep-distortion out, then the camera itself undistorts its images"
    )


def of_frame(frame: dai.ImgFrame) -> Intrinsics | None:
    """Return the intrinsics that a frame carries for its own size; None when it carries none."""
    transformation = frame.getTransformation()
    if transformation is None:
        return None
    matrix = transformation.getIntrinsicMatrix()
    if not (matrix[0][0] > 1 and matrix[1][1] > 1):  # the SDK has the identity where it knows nothing
        return None
    model, coefficients = distortion(
        transformation.getDistortionModel().name, transformation.getDistortionCoefficients()
    )
    return intrinsics(matrix, model, coefficients)


def of_calibration(
    calibration: dai.CalibrationHandler, socket: dai.CameraBoardSocket, width: int, height: int, undistorted: bool
) -> Intrinsics | None:
    """Return the calibration's intrinsics of a sensor at a size; None when it has none for that sensor."""
    try:
        matrix: Any = calibration.getCameraIntrinsics(socket, width, height)
        model = calibration.getDistortionModel(socket).name
        coefficients = calibration.getDistortionCoefficients(socket)
    except RuntimeError:  # the SDK reports it this way
        return None
    if undistorted:
        return intrinsics(matrix)
    return intrinsics(matrix, *distortion(model, coefficients))
