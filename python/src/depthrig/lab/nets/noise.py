"""The noise models of a camera: one encoder of colour and a DPT head (the form of Depth Anything V2)."""

from __future__ import annotations

from torch import Tensor, nn

from .dpt import Head
from .vit import PATCH, Encoder, Size

__all__ = ["NoiseNet"]


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
