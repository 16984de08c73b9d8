"""Writes opencv_charuco.png and .json: a ChArUco board drawn by OpenCV, seen at an angle, the corners that OpenCV finds in it, and where
they are.

    python opencv_charuco.py
"""

import json
from pathlib import Path

import cv2
import numpy as np

folder = Path(__file__).parent
board = cv2.aruco.CharucoBoard((11, 8), 30, 22, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50))
flat = board.generateImage((1100, 800), marginSize=0)
corners = np.float32([[0, 0], [1100, 0], [1100, 800], [0, 800]])
seen = np.float32([[120, 90], [560, 60], [590, 430], [80, 380]])
warp = cv2.getPerspectiveTransform(corners, seen)
# From four times the size, so that edges are as a lens shows them.
large = np.float64([[4, 0, 1.5], [0, 4, 1.5], [0, 0, 1]])
image = cv2.warpPerspective(flat, large @ warp, (2560, 1920), flags=cv2.INTER_LINEAR, borderValue=255)
image = cv2.resize(image, (640, 480), interpolation=cv2.INTER_AREA)
image = cv2.GaussianBlur(image, (5, 5), 0.9)
image[300:470, 250:420] = 128  # Something covers a part of it.
found, ids, _, markers = cv2.aruco.CharucoDetector(board).detectBoard(image)
cv2.imwrite(str(folder / "opencv_charuco.png"), image)
# A square ends between two pixels of the flat image.
flat_corners = np.float32([[100 * (i % 10 + 1) - 0.5, 100 * (i // 10 + 1) - 0.5] for i in range(70)])
truth = cv2.perspectiveTransform(flat_corners[None], warp)[0]
places = {int(i): [round(float(c), 2) for c in p] for i, p in zip(ids.ravel(), found.reshape(-1, 2))}
(folder / "opencv_charuco.json").write_text(json.dumps({"markers": len(markers), "corners": places, "truth": truth.round(3).tolist()}) + "\n")
