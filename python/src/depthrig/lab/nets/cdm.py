"""The paper's network: two encoders, of colour and of inverse depth, fused token by token, and a DPT head."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .dpt import Head
from .vit import PATCH, Encoder, Size

__all__ = ["MEAN", "STD", "Cdm", "normalise_color"]

FUSION_HEADS = 4
START = 0.5
"""Inverse depth that an untrained network gives about everywhere, 1/m."""
MEAN = (0.485, 0.456, 0.406)
STD = (0.229, 0.224, 0.225)


def normalise_color(color: Tensor) -> Tensor:
    """Return colour of 0 to 1, `(batch, 3, height, width)`, as DINOv2 was trained on it."""
    mean = torch.tensor(MEAN, device=color.device, dtype=color.dtype)[:, None, None]
    return (color - mean) / torch.tensor(STD, device=color.device, dtype=color.dtype)[:, None, None]


class Cdm(nn.Module):
    """Inverse depth (1/m, not negative) from normalised colour and raw inverse depth.

    The names and shapes of its state are those of the official class, so `depthrig cdm import` takes
    `torch.save(net.state_dict(), …)`.
    """

    def __init__(self, size: Size):
        super().__init__()
        self.pretrained = Encoder(size)
        self.depth_pretrained = Encoder(size)
        self.depth_head_rgbd = Head(size, 2 * size.width)
        self.crossAtts = nn.ModuleList(
            nn.MultiheadAttention(size.width, FUSION_HEADS, batch_first=True) for _ in range(4)
        )
        # Without weights to begin with: what is negative everywhere is 0 after the last activation, and never learns.
        last = self.depth_head_rgbd.scratch.output_conv2[-1]
        assert isinstance(last, nn.Conv2d) and last.bias is not None
        nn.init.constant_(last.bias, START)

    def forward(self, x: Tensor) -> Tensor:
        """Return `(batch, height, width)`.

        :param x: `(batch, 4, height, width)`: normalised colour, 1/m (0 for a hole); sides are multiples of 14.
        """
        rows, columns = x.shape[2] // PATCH, x.shape[3] // PATCH
        of_color = self.pretrained(x[:, :3])
        of_depth = self.depth_pretrained(x[:, 3:].expand(-1, 3, -1, -1))
        fused = []
        for attention, rgb, depth in zip(self.crossAtts, of_color, of_depth, strict=True):
            b, n, d = rgb.shape
            # At each place a sequence of two tokens; the sum of what both become.
            pair = torch.stack([rgb, depth], 2).reshape(b * n, 2, d)
            both = attention(pair, pair, pair, need_weights=False)[0].sum(1).reshape(b, n, d)
            fused.append(torch.cat([rgb, both], 2))
        return F.relu(self.depth_head_rgbd(fused, rows, columns)).squeeze(1)

    def encoder_parameters(self) -> set[nn.Parameter]:
        """Return the parameters that were pretrained, which learn more slowly than the rest."""
        return {*self.pretrained.parameters(), *self.depth_pretrained.parameters()}
