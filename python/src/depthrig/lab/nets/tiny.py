"""A small refiner for CPUs: multiplies filled inverse depth by exp(r), |r| <= 2.

It works at half resolution and below, because stages of full size are bound by memory. Every layer is a convolution,
a group norm or an activation; a convolution of 2x2 with stride 2 takes pixels apart and a transposed one puts them
together, which is what unshuffle and shuffle are.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

__all__ = ["CHANNELS", "MULTIPLE", "REACH", "Tiny", "tiny_inputs"]

CHANNELS = 6
"""Colour, filled and raw inverse depth divided by the mean of the filled one, 1 where raw depth was measured."""
MULTIPLE = 16
"""Sides of an input are multiples of this."""
DILATIONS = ((1,), (1, 1), (1, 2, 1), (1, 2, 4, 1))
"""Of the blocks of each stage on the way down: holes are often larger than what plain blocks see."""
REACH = 2.0
"""The largest |r|."""


def tiny_inputs(color: Tensor, filled: Tensor, raw: Tensor) -> Tensor:
    """Return the input of the network.

    :param color: `(batch, 3, height, width)`, 0 to 1, red first.
    :param filled: `(batch, height, width)`, 1/m, above 0 wherever an image has any depth.
    :param raw: `(batch, height, width)`, 1/m, 0 for a hole.
    """
    mean = filled.mean((1, 2), keepdim=True).clamp_min(1e-6)
    planes = torch.stack([filled / mean, raw / mean, (raw > 0).to(filled.dtype)], 1)
    return torch.cat([color - 0.5, planes], 1)


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

    :param width: channels at half resolution; a multiple of 8.
    """

    def __init__(self, width: int = 32):
        super().__init__()
        widths = (width, width * 3 // 2 // 8 * 8, 2 * width, 3 * width)
        self.apart = nn.Conv2d(CHANNELS, widths[0], 2, 2)
        self.encode = nn.ModuleList(_stage(w, n) for w, n in zip(widths, DILATIONS, strict=True))
        self.down = nn.ModuleList(nn.Conv2d(a, b, 2, 2) for a, b in zip(widths, widths[1:], strict=False))
        self.up = nn.ModuleList(nn.ConvTranspose2d(b, a, 2, 2) for a, b in zip(widths, widths[1:], strict=False))
        self.decode = nn.ModuleList(_stage(w, n) for w, n in zip(widths, ((1,), (1,), (1, 1)), strict=False))
        self.together = nn.ConvTranspose2d(widths[0], 1, 2, 2)
        # It begins as the identity.
        nn.init.zeros_(self.together.weight)
        assert self.together.bias is not None
        nn.init.zeros_(self.together.bias)
        for module in self.modules():
            if isinstance(module, _Inverted):
                nn.init.zeros_(module.norm3.weight)

    def forward(self, x: Tensor, filled: Tensor) -> Tensor:
        """Return `(batch, height, width)`, 1/m.

        :param x: `(batch, 6, height, width)`.
        :param filled: `(batch, height, width)`, 1/m.
        """
        x = self.apart(x)
        skips = []
        for stage, down in zip(self.encode, self.down, strict=False):
            x = stage(x)
            skips.append(x)
            x = down(x)
        x = self.encode[-1](x)
        for up, stage in zip(reversed(self.up), reversed(self.decode), strict=True):
            x = stage(up(x) + skips.pop())
        r = REACH * torch.tanh(self.together(x) / REACH)
        return filled * torch.exp(r.squeeze(1))
