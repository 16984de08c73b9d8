"""Writes opencv_corners.json: corners of OpenCV's sample chessboards, with what OpenCV calibrates from them.

    python opencv_corners.py FOLDER > opencv_corners.json

FOLDER has left01.jpg to right14.jpg of Debian's package opencv-doc. The corners are those of findChessboardCorners, refined by cornerSubPix
in a window of 11x11 pixels (half-size 5): a larger one crosses the neighbouring corners of distant boards.
"""

import json
import sys
from pathlib import Path

import cv2
import numpy as np

COLUMNS, ROWS = 9, 6
CRITERIA = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 200, 1e-12)


def corners(path):
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    found, points = cv2.findChessboardCorners(image, (COLUMNS, ROWS), None)
    assert found, path
    points = cv2.cornerSubPix(image, points, (5, 5), (-1, -1), (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-4))
    # As they are written.
    return np.round(points.astype(float), 4).astype(np.float32)


def main():
    folder = Path(sys.argv[1])
    board = np.zeros((COLUMNS * ROWS, 3), np.float32)
    board[:, :2] = np.mgrid[:COLUMNS, :ROWS].T.reshape(-1, 2)
    numbers = [n for n in range(1, 15) if n != 10]
    seen = {side: [corners(folder / f"{side}{n:02}.jpg") for n in numbers] for side in ("left", "right")}
    boards = [board] * len(numbers)
    out = {"columns": COLUMNS, "rows": ROWS, "opencv": cv2.__version__, "cameras": {}}
    single = {}
    for side in ("left", "right"):
        rms, k, d, _, _, sigmas, _, _ = cv2.calibrateCameraExtended(boards, seen[side], (640, 480), None, None, criteria=CRITERIA)
        single[side] = (k, d)
        _, kb, db, *_ = cv2.calibrateCamera(boards, seen[side], (640, 480), None, None, flags=cv2.CALIB_FIX_K3, criteria=CRITERIA)
        out["cameras"][side] = {
            "corners": [[[round(float(c), 4) for c in p[0]] for p in view] for view in seen[side]],
            "rms": rms,
            "intrinsics": [k[0, 0], k[1, 1], k[0, 2], k[1, 2], *d[0]],
            "sigmas": [float(s) for s in sigmas[:9, 0]],
            "without_k3": [kb[0, 0], kb[1, 1], kb[0, 2], kb[1, 2], *db[0]],
        }
    for name, flags in (("fixed", cv2.CALIB_FIX_INTRINSIC), ("joint", cv2.CALIB_USE_INTRINSIC_GUESS)):
        (kl, dl), (kr, dr) = single["left"], single["right"]
        rms, kl, dl, kr, dr, r, t, _, _ = cv2.stereoCalibrate(
            boards, seen["left"], seen["right"], kl.copy(), dl.copy(), kr.copy(), dr.copy(), (640, 480), flags=flags, criteria=CRITERIA
        )
        out[name] = {"rms": rms, "rotation": cv2.Rodrigues(r)[0][:, 0].tolist(), "translation": t[:, 0].tolist()}
        out[name]["left"] = [kl[0, 0], kl[1, 1], kl[0, 2], kl[1, 2], *dl[0]]
        out[name]["right"] = [kr[0, 0], kr[1, 1], kr[0, 2], kr[1, 2], *dr[0]]
    json.dump(out, sys.stdout)


main()
