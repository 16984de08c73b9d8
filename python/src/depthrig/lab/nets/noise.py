"""The noise models of a camera: the paper's form, and a small one that learns from nothing on a CPU.

`NoiseNet` is one encoder of colour and a DPT head (the form of Depth Anything V2); it needs pretrained weights.
`NoiseConv` is a U-Net of convolutions.
"""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor, nn

from .dpt import Head
from .vit import PATCH, Encoder, Size

__all__ = ["NoiseConv", "NoiseNet"]


class NoiseNet(nn.Module):
    """One plane from colour: the logit of a hole, or relative depth, which is free in scale and shift.

    :param channels: 3, or 4 with refined inverse depth as a further input.
    """

    def __init__(self, size: Size, channels: int = 3):
        super().__init__()
        self.pretrained = Encoder(size, channels)
        self.depth_head = Head(size, size.width)

    def forward(self, x: Tensor) -> Tensor:
        """Return `(batch, height, width)` of normalised colour `(batch, channels, height, width)`."""
        rows, columns = x.shape[2] // PATCH, x.shape[3] // PATCH
        return self.depth_head(self.pretrained(x), rows, columns).squeeze(1)

    def encoder_parameters(self) -> set[nn.Parameter]:
        """Return the parameters that were pretrained, which learn more slowly than the rest."""
        return set(self.pretrained.parameters())


class _Residual(nn.Module):
    def __init__(self, channels: int):
        super().__init__()
        self.conv1 = nn.Conv2d(channels, channels, 3, padding=1, bias=False)
        self.norm1 = nn.GroupNorm(channels // 8, channels)
        self.conv2 = nn.Conv2d(channels, channels, 3, padding=1, bias=False)
        self.norm2 = nn.GroupNorm(channels // 8, channels)
        nn.init.zeros_(self.norm2.weight)

    def forward(self, x: Tensor) -> Tensor:
        y = F.relu(self.norm1(self.conv1(x)))
        return F.relu(x + self.norm2(self.conv2(y)))


class NoiseConv(nn.Module):
    """The same plane from a U-Net, for images of any size.

    :param channels: 3, or 4 with refined inverse depth as a further input.
    :param width: channels at half resolution, where it begins and ends; a multiple of 8.
    """

    DEEPEST = 32
    """A pixel of the last stage is so many pixels wide."""

    def __init__(self, channels: int = 3, width: int = 16):
        super().__init__()
        widths = (width, 2 * width, 4 * width, 6 * width, 8 * width)
        self.apart = nn.Conv2d(channels, widths[0], 4, 2, 1)
        self.encode = nn.ModuleList(
            nn.Sequential(*(_Residual(w) for _ in range(n))) for w, n in zip(widths, (1, 2, 2, 2, 3), strict=True)
        )
        self.down = nn.ModuleList(nn.Conv2d(a, b, 2, 2) for a, b in zip(widths, widths[1:], strict=False))
        self.up = nn.ModuleList(nn.ConvTranspose2d(b, a, 2, 2) for a, b in zip(widths, widths[1:], strict=False))
        self.decode = nn.ModuleList(_Residual(w) for w in widths[:-1])
        self.together = nn.ConvTranspose2d(widths[0], 1, 2, 2)

    def forward(self, x: Tensor) -> Tensor:
        """Return `(batch, height, width)` of normalised colour `(batch, channels, height, width)`."""
        height, width = x.shape[2:]
        x = F.pad(x, (0, -width % self.DEEPEST, 0, -height % self.DEEPEST), mode="replicate")
        x = self.apart(x)
        skips = []
        for stage, down in zip(self.encode, self.down, strict=False):
            x = stage(x)
            skips.append(x)
            x = down(x)
        x = self.encode[-1](x)
        for up, stage in zip(reversed(self.up), reversed(self.decode), strict=True):
            x = stage(up(x) + skips.pop())
        return self.together(x)[:, 0, :height, :width]
