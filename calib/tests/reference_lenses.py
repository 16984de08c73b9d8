"""Writes lenses.csv: what OpenCV and librealsense say of the same lenses and points. Needs opencv-python and pyrealsense2.

Each row: the library, the model, fx fy cx cy, eight coefficients in depthrig's order, the point x y z, the pixel u v.
OpenCV computes in 64 bits, librealsense in 32: its pixels are good to about 1e-4.
"""

import csv
import sys

import cv2
import numpy as np
import pyrealsense2 as rs

PINHOLE = (611.5, 609.25, 319.75, 241.5)
LENSES = {
    ("opencv", "brown_conrady"): [-0.28, 0.075, 0.0012, -0.00014, 0.016],
    ("opencv", "rational"): [0.52, -2.71, 0.00065, -0.00032, 1.54, 0.40, -2.53, 1.46],
    ("opencv", "kannala_brandt4"): [0.031, -0.011, 0.0043, -0.0007],
    ("librealsense", "brown_conrady"): [-0.055, 0.064, 0.0007, 0.0002, -0.02],
    ("librealsense", "inverse_brown_conrady"): [-0.055, 0.064, 0.0007, 0.0002, -0.02],
    ("librealsense", "kannala_brandt4"): [0.031, -0.011, 0.0043, -0.0007],
}


def pixel(library: str, model: str, coeffs: list[float], p: np.ndarray) -> tuple[float, float]:
    fx, fy, cx, cy = PINHOLE
    if library == "opencv":
        k = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
        zero = np.zeros(3)
        if model == "kannala_brandt4":
            return cv2.fisheye.projectPoints(p.reshape(1, 1, 3), zero, zero, k, np.array(coeffs))[0].ravel()
        return cv2.projectPoints(p.reshape(1, 1, 3), zero, zero, k, np.array(coeffs))[0].ravel()
    i = rs.intrinsics()
    i.width, i.height, i.fx, i.fy, i.ppx, i.ppy = 640, 480, fx, fy, cx, cy
    i.model = getattr(rs.distortion, model)
    i.coeffs = [*coeffs, 0.0][:5]
    return rs.rs2_project_point_to_pixel(i, list(p))


def main() -> None:
    out = csv.writer(sys.stdout, lineterminator="\n")
    rng = np.random.default_rng(7)
    for (library, model), coeffs in LENSES.items():
        for _ in range(12):
            z = rng.uniform(0.3, 3.0)
            p = np.array([rng.uniform(-0.45, 0.45) * z, rng.uniform(-0.35, 0.35) * z, z])
            row = [*PINHOLE, *coeffs, *([0.0] * (8 - len(coeffs))), *p, *map(float, pixel(library, model, coeffs, p))]
            out.writerow([library, model, *(repr(float(v)) for v in row)])


if __name__ == "__main__":
    main()
