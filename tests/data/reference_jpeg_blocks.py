#!/usr/bin/env python3
"""Computes `reference_jpeg_blocks.csv`: mean red, green and blue of 80x80 blocks, decoded by Pillow (libjpeg-turbo).

JPEG decoders differ by a level or two, so that a checksum would tell nothing; a picture that is shifted, cut, flipped
or has its colours swapped shows in the blocks.

    python3 reference_jpeg_blocks.py FOLDER_OF_THE_TEST_DATA > reference_jpeg_blocks.csv
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image

BLOCK = 80


def main() -> None:
    print("file,x,y,red,green,blue")
    for name in ("lingbot_depth/1/rgb.jpg", "lingbot_depth/3/rgb.jpg"):
        picture = np.asarray(Image.open(Path(sys.argv[1]) / name), dtype=np.float64)
        for y in range(0, picture.shape[0], BLOCK):
            for x in range(0, picture.shape[1], BLOCK):
                mean = picture[y : y + BLOCK, x : x + BLOCK].mean(axis=(0, 1))
                print(f"{name},{x},{y}," + ",".join(f"{m:.2f}" for m in mean))


if __name__ == "__main__":
    main()
