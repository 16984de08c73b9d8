#!/usr/bin/env python3
"""Computes `opencv.json`: what OpenCV makes of a few stereo cameras, for `tests.rs`.

    pip install "opencv-python-headless==4.14.*"; python3 opencv.py > opencv.json

OpenCV 5.0 gives the same maps to the last digit, and a few pixels that differ by 1.
"""

import json
import sys

import cv2
import numpy as np

# Left and right as fx fy cx cy, coefficients; then (RX, RY, RZ) and T from left to right, metres; width, height.
CAMERAS = {
    # A ZED's HD720 as in drivers/zed/src/conf/sample.conf.
    "zed": (
        ([532.41, 532.53, 636.02, 362.41], [-0.0634518, 0.0401532, -0.000375119, 0.00074809, -0.0161231]),
        ([532.63, 532.67, 641.12, 375.51], [-0.0587747, 0.0322036, 5.85653e-05, -0.000297978, -0.0123602]),
        ([0.00364425, -0.0041, -0.00102985], [-0.12014, -0.0000942712, 0.000234404], (1280, 720)),
    ),
    # A wide lens that bends much, and cameras that look apart.
    "wide": (
        ([349.7, 350.1, 330.2, 190.3], [-0.1731, 0.0273, 0.0011, -0.0007, 0.0009]),
        ([351.2, 350.8, 341.9, 183.6], [-0.1742, 0.0281, -0.0004, 0.0012, 0.0003]),
        ([0.021, -0.045, 0.013], [-0.11991, 0.0021, -0.0034], (672, 376)),
    ),
    # Eight coefficients, and a long focal length.
    "rational": (
        ([601.3, 602.2, 322.8, 236.4], [0.51, -2.7, 0.0006, -0.0003, 1.6, 0.39, -2.5, 1.55]),
        ([598.9, 600.1, 317.2, 243.9], [0.48, -2.6, -0.0002, 0.0005, 1.5, 0.36, -2.4, 1.45]),
        ([-0.008, 0.011, -0.004], [-0.0551, 0.0004, 0.0009], (640, 480)),
    ),
}


def image(width, height):
    """An image that `tests.rs` makes by the same rule: smooth, with another slope in each channel."""
    y, x = np.mgrid[0:height, 0:width]
    channels = [128 + 100 * np.sin(x / (11.0 + c) + y / (17.0 - c)) for c in range(3)]
    return np.stack([np.floor(c) for c in channels], -1).astype(np.uint8)


def yuyv(width, height):
    """YUYV made of the image's channels: Y the first, U and V the others of the left pixel, a quarter as strong.

    Stronger colours would be cut off at 0 and 255, and then it matters whether they are mixed before or after."""
    p = image(width, height)
    p[..., 1:] = p[..., 1:] // 4 + 96
    out = np.empty((height, width, 2), np.uint8)
    out[..., 0] = p[..., 0]
    out[:, 0::2, 1] = p[:, 0::2, 1]
    out[:, 1::2, 1] = p[:, 0::2, 2]
    return out


def made(name):
    (lk, ld), (rk, rd), (r, t, size) = CAMERAS[name]
    k = [np.array([[f[0], 0, f[2]], [0, f[1], f[3]], [0, 0, 1]], float) for f in (lk, rk)]
    d = [np.array(v, float) for v in (ld, rd)]
    rotation, t = cv2.Rodrigues(np.array(r, float))[0], np.array(t, float).reshape(3, 1)
    r1, r2, p1, p2, *_ = cv2.stereoRectify(k[0], d[0], k[1], d[1], size, rotation, t, flags=cv2.CALIB_ZERO_DISPARITY, alpha=0)
    per_camera = []
    for i, (ri, pi) in enumerate([(r1, p1), (r2, p2)]):
        mx, my = cv2.initUndistortRectifyMap(k[i], d[i], ri, pi, size, cv2.CV_32FC1)
        w, h = size
        at = [(int(x), int(y)) for y in np.linspace(0, h - 1, 9) for x in np.linspace(0, w - 1, 13)]
        rgb = image(w, h)
        views = {
            "grey": cv2.remap(np.ascontiguousarray(rgb[..., 0]), mx, my, cv2.INTER_LINEAR),
            "rgb": cv2.remap(rgb, mx, my, cv2.INTER_LINEAR),
            "yuyv": cv2.remap(cv2.cvtColor(yuyv(w, h), cv2.COLOR_YUV2RGB_YUY2), mx, my, cv2.INTER_LINEAR),
            "luma": cv2.remap(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), mx, my, cv2.INTER_LINEAR),
        }
        per_camera.append(
            {
                "intrinsics": k[i][[0, 1, 0, 1], [0, 1, 2, 2]].tolist(),
                "coeffs": [*d[i].tolist(), 0.0, 0.0, 0.0][:8],
                "rational": len(d[i]) == 8,
                "rotation": ri.ravel().tolist(),
                "map": [[x, y, float(mx[y, x]), float(my[y, x])] for x, y in at],
                "pixels": {n: [np.atleast_1d(v[y, x]).tolist() for x, y in at] for n, v in views.items()},
            }
        )
    return {
        "name": name,
        "size": size,
        "rotation_vector": r,
        "translation": t.ravel().tolist(),
        "focal": p1[0, 0],
        "center": [p1[0, 2], p1[1, 2]],
        "baseline": -p2[0, 3] / p2[0, 0],
        "eyes": per_camera,
    }


print(json.dumps({"opencv": cv2.__version__, "cameras": [made(n) for n in CAMERAS]}), file=sys.stdout)
