"""Guesses at the depth in holes: planes through what was measured around, as fixed operations of a network.

Inverse depth of a plane is linear in the pixel, so a line of best fit over measured cells continues a wall, a floor or
a table into a hole. Each guess weights the cells in its own way: all alike, far ones more, near ones more.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

__all__ = ["CELL", "FEATURES", "GUESSES", "planes"]

CELL = 8
"""Pixels along a side of a cell."""
GUESSES = (0, -3, 3)
"""Of each guess the power of a cell's inverse depth that weights it."""
FEATURES = 3
"""Numbers that come with each guess: how much was measured around, how well the plane fits, its inverse depth."""
SIGMAS = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
"""Of the Gaussians, cells. Each weighs `sigma ** -FALL`, so that their sum falls with this power of the distance."""
FALL = 6
UNIT = 64.0
"""Cells in a unit of the coordinates."""
RIDGE = 1.5e-5
"""Added to the variance of the coordinates: without cells that span a plane it becomes a mean."""
LEAST = 0.02
"""The least guess, as a part of the mean."""


def _around(moments: Tensor) -> Tensor:
    """Return the weighted sums around each cell of `(batch, n, height, width)`."""
    y = torch.arange(moments.shape[2], dtype=moments.dtype, device=moments.device)
    x = torch.arange(moments.shape[3], dtype=moments.dtype, device=moments.device)
    of_y, of_x = (y[:, None] - y).square(), (x[:, None] - x).square()
    total = torch.zeros_like(moments)
    for sigma in SIGMAS:
        rows, columns = (torch.exp(-d / (2 * sigma * sigma)) for d in (of_y, of_x))
        total = total + sigma**-FALL * (rows @ (moments @ columns))
    return total


def planes(inverse: Tensor, known: Tensor) -> tuple[Tensor, Tensor]:
    """Return the guesses at cells of `CELL` pixels, `(batch, 3, …)`, and their features, `(batch, 9, …)`.

    :param inverse: `(batch, 1, height, width)`, inverse depth over its mean, 0 where not known.
    :param known: the same size, 1 where known, else 0.
    """
    weight = F.avg_pool2d(known, CELL)
    q = (F.avg_pool2d(inverse, CELL) / weight.clamp_min(1e-6)).clamp(0.1, 10.0)
    y = torch.arange(q.shape[2], dtype=q.dtype, device=q.device)[:, None] / UNIT
    x = torch.arange(q.shape[3], dtype=q.dtype, device=q.device)[None] / UNIT
    y, x = (y - y.mean()).expand_as(q), (x - x.mean()).expand_as(q)
    found, features = [], []
    for power in GUESSES:
        w = weight * q**power
        wx, wy, wq = w * x, w * y, w * q
        around = _around(torch.cat([w, wx, wy, wq, wx * x, wx * y, wy * y, wq * x, wq * y, wq * q], 1))
        total = around[:, :1].clamp_min(1e-20)
        mx, my, mq, xx, xy, yy, xq, yq, qq = (around[:, 1:] / total).split(1, 1)
        xx, yy = (xx - mx * mx).clamp_min(0) + RIDGE, (yy - my * my).clamp_min(0) + RIDGE
        xy, xq, yq, qq = xy - mx * my, xq - mx * mq, yq - my * mq, qq - mq * mq
        whole = xx * yy - xy * xy
        by_x, by_y = (xq * yy - yq * xy) / whole, (yq * xx - xq * xy) / whole
        guess = (mq + by_x * (x - mx) + by_y * (y - my)).clamp(LEAST, 1 / LEAST)
        left = (qq - by_x * xq - by_y * yq).clamp_min(0)
        found.append(guess)
        features += [total.log() / 10, (left / (guess * guess) + 1e-5).log() / 8, guess.log()]
    return torch.cat(found, 1), torch.cat(features, 1)
