"""Regions of a measured image, drawn at random, that are hidden to see how well they are filled."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

__all__ = ["KINDS", "region"]

KINDS = ("rectangles", "border", "blob")
LEAST_SIDE = 12
"""Smallest side of a rectangle, pixels."""


def region(kind: str, size: tuple[int, int], rng: np.random.Generator) -> npt.NDArray[np.bool_]:
    """Return where an image of `size` (height, width) is hidden.

    `rectangles` are one to six, with sides from 12 pixels to 0.6 of the height, every second time turned; a `border`
    covers 3 to 40 % from one side; a `blob` is where smooth noise is above a level.

    :param kind: one of `KINDS`.
    """
    height, width = size
    y, x = np.mgrid[:height, :width].astype(np.float64)
    hidden = np.zeros(size, bool)
    if kind == "rectangles":
        for _ in range(int(rng.integers(1, 7))):
            side = float(np.exp(rng.uniform(np.log(LEAST_SIDE), np.log(0.6 * height))))
            stretch = float(np.exp(rng.uniform(-0.5, 0.5)))
            turn = float(rng.uniform(0, np.pi)) if rng.random() < 0.5 else 0.0
            u, v = x - rng.uniform(0, width), y - rng.uniform(0, height)
            across, along = u * np.cos(turn) + v * np.sin(turn), v * np.cos(turn) - u * np.sin(turn)
            hidden |= (abs(across) <= side * stretch / 2) & (abs(along) <= side / stretch / 2)
    elif kind == "border":
        part, side = float(np.exp(rng.uniform(np.log(0.03), np.log(0.4)))), int(rng.integers(4))
        distance: Any = (x, width - 1 - x, y, height - 1 - y)[side]
        hidden = distance < part * (width if side < 2 else height)
    else:
        cell = float(np.exp(rng.uniform(np.log(0.05), np.log(0.4)))) * height
        rows, columns = int(height / cell) + 2, int(width / cell) + 2
        coarse = rng.uniform(0, 1, (rows, columns))
        i, j = np.floor(y / cell).astype(int), np.floor(x / cell).astype(int)
        v, u = y / cell - i, x / cell - j
        u, v = u * u * (3 - 2 * u), v * v * (3 - 2 * v)
        noise = (coarse[i, j] * (1 - u) + coarse[i, j + 1] * u) * (1 - v)
        noise += (coarse[i + 1, j] * (1 - u) + coarse[i + 1, j + 1] * u) * v
        hidden = noise > rng.uniform(0.5, 0.75)
    return hidden
