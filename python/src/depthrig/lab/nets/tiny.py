"""A small refiner for CPUs: multiplies filled inverse depth in holes by exp(r), |r| <= 2.

Planes through what was measured (`planes`) are guesses at what lies in a hole; the network says how far to go from the
filled depth to each of them, and what to add. What was measured stays as it was, and so do narrow holes and a hole of
which the network knows little: a small r becomes 0.

It works at an eighth of the resolution and below. Every learned layer is a convolution, a group norm or an activation;
a convolution of 8x8 with stride 8 takes pixels apart and a transposed one puts them together, which is what unshuffle
and shuffle are.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .planes import CELL, FEATURES, GUESSES, planes

__all__ = ["CHANNELS", "MULTIPLE", "REACH", "Tiny", "tiny_inputs"]

CHANNELS = 6
"""Colour, filled and raw inverse depth divided by the mean of the filled one, 1 where raw depth was measured."""
MULTIPLE = 16
"""Sides of an input are multiples of this."""
DILATIONS = ((1, 2, 1), (1, 2, 4, 8, 1))
"""Of the blocks of each stage on the way down: holes are often larger than what plain blocks see."""
REACH = 2.0
"""The largest |r|."""
STAY = 0.02
"""|r| becomes smaller by this, down to 0."""
LEAST_HOLE = 5
"""Side of a square, pixels: where none fits into a hole, it stays as `fill` has it, but for training. What is measured in one image
and missing in the next would flicker."""
KEPT = 1e-3
"""Measured depth that filling changed by more than this part was wrong, and counts as a hole."""


def tiny_inputs(color: Tensor, filled: Tensor, raw: Tensor) -> Tensor:
    """Return the input of the network.

    :param color: `(batch, 3, height, width)`, 0 to 1, red first.
    :param filled: `(batch, height, width)`, 1/m, above 0 wherever an image has any depth.
    :param raw: `(batch, height, width)`, 1/m, 0 for a hole.
    """
    mean = filled.mean((1, 2), keepdim=True).clamp_min(1e-6)
    depths = torch.stack([filled / mean, raw / mean, (raw > 0).to(filled.dtype)], 1)
    return torch.cat([color - 0.5, depths], 1)


def _wide(known: Tensor) -> Tensor:
    """Return 1 in holes as far as squares of `LEAST_HOLE` that fit into them reach, else 0."""
    around = (LEAST_HOLE, 1, LEAST_HOLE // 2)
    return F.max_pool2d(1 - F.max_pool2d(known, *around), *around)


def _norm(channels: int) -> nn.GroupNorm:
    return nn.GroupNorm(channels // 8, channels)


class _Inverted(nn.Module):
    """Inverted residual (MobileNetV2): wider, by depth, narrower again."""

    def __init__(self, channels: int, dilation: int = 1, expand: int = 3):
        super().__init__()
        wide = expand * channels
        self.widen = nn.Conv2d(channels, wide, 1, bias=False)
        self.norm1 = _norm(wide)
        self.each = nn.Conv2d(wide, wide, 3, padding=dilation, dilation=dilation, groups=wide, bias=False)
        self.norm2 = _norm(wide)
        self.narrow = nn.Conv2d(wide, channels, 1, bias=False)
        self.norm3 = _norm(channels)

    def forward(self, x: Tensor) -> Tensor:
        y = F.relu(self.norm1(self.widen(x)))
        y = F.relu(self.norm2(self.each(y)))
        return x + self.norm3(self.narrow(y))


def _stage(channels: int, dilations: tuple[int, ...]) -> nn.Sequential:
    return nn.Sequential(*(_Inverted(channels, d) for d in dilations))


class Tiny(nn.Module):
    """Refined inverse depth, from `tiny_inputs` and the filled inverse depth.

    :param width: channels at an eighth of the resolution; a multiple of 8.
    """

    def __init__(self, width: int = 80):
        super().__init__()
        # In eights, which a group of the norms has.
        widths = (width, max(width, 3 * width // 16 * 8))
        guesses = len(GUESSES)
        self.apart = nn.Conv2d(CHANNELS + 1, widths[0], CELL, CELL)
        self.hint = nn.Conv2d(guesses * (1 + FEATURES), widths[0], 1)
        self.encode = nn.ModuleList(_stage(w, n) for w, n in zip(widths, DILATIONS, strict=True))
        self.down = nn.Conv2d(*widths, 2, 2)
        self.up = nn.ConvTranspose2d(*widths[::-1], 2, 2)
        self.decode = _stage(widths[0], (1, 1))
        self.together = nn.ConvTranspose2d(widths[0], guesses + 1, CELL, CELL)
        # It begins with a part of each guess, and nothing to add.
        nn.init.zeros_(self.together.weight)
        assert self.together.bias is not None
        nn.init.constant_(self.together.bias, -2.0)
        nn.init.zeros_(self.together.bias[guesses:])
        for module in self.modules():
            if isinstance(module, _Inverted):
                nn.init.zeros_(module.norm3.weight)

    def forward(self, x: Tensor, filled: Tensor) -> Tensor:
        """Return `(batch, height, width)`, 1/m.

        :param x: `(batch, 6, height, width)`.
        :param filled: `(batch, height, width)`, 1/m.
        """
        # In 16 bits sums of squares would be noise.
        with torch.autocast(x.device.type, enabled=False):
            here, raw, measured = x[:, 3:4].clamp_min(1e-6), x[:, 4:5], x[:, 5:6]
            known = measured * ((raw - here).abs() <= KEPT * here).to(x.dtype)
            hole = 1 - known
            guesses, features = planes(raw * known, known)
            ways = (guesses / F.avg_pool2d(here, CELL)).log().clamp(-REACH, REACH)
        y = self.apart(torch.cat([x, hole], 1)) + self.hint(torch.cat([ways, features], 1))
        y = self.encode[0](y)
        y = self.decode(y + self.up(self.encode[1](self.down(y))))
        parts = self.together(y).float()
        with torch.autocast(x.device.type, enabled=False):
            guesses = F.interpolate(guesses, scale_factor=float(CELL), mode="bilinear", align_corners=False)
            ways = (guesses / here).log().clamp(-REACH, REACH)
            r = (torch.sigmoid(parts[:, :-1]) * ways).sum(1, keepdim=True) + parts[:, -1:]
            r = r.clamp(-REACH, REACH)
            # Narrow holes teach, too.
            r = (hole if self.training else _wide(known)) * (r - r.clamp(-STAY, STAY))
            return filled * torch.exp(r.squeeze(1))
