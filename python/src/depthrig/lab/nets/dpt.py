"""The head: DPT (Ranftl et al.: Vision Transformers for Dense Prediction, 2021), with the official names of tensors."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor, nn

from .vit import PATCH, Size

__all__ = ["Head"]

OUTPUT_CHANNELS = 32


class _Residual(nn.Module):
    def __init__(self, features: int):
        super().__init__()
        self.conv1 = nn.Conv2d(features, features, 3, padding=1)
        self.conv2 = nn.Conv2d(features, features, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        return self.conv2(F.relu(self.conv1(F.relu(x)))) + x


class _Refine(nn.Module):
    def __init__(self, features: int):
        super().__init__()
        self.out_conv = nn.Conv2d(features, features, 1)
        self.resConfUnit1 = _Residual(features)
        self.resConfUnit2 = _Residual(features)

    def forward(self, x: Tensor, skip: Tensor | None, size: tuple[int, int]) -> Tensor:
        if skip is not None:
            x = x + self.resConfUnit1(skip)
        x = F.interpolate(self.resConfUnit2(x), size=size, mode="bilinear", align_corners=True)
        return self.out_conv(x)


class _Scratch(nn.Module):
    def __init__(self, size: Size):
        super().__init__()
        f = size.features
        for i, level in enumerate(size.levels, 1):
            setattr(self, f"layer{i}_rn", nn.Conv2d(level, f, 3, padding=1, bias=False))
        for i in range(1, 5):
            setattr(self, f"refinenet{i}", _Refine(f))
        # The coarsest has nothing to add; its unit is in every checkpoint.
        for p in self.refinenet4.resConfUnit1.parameters():
            p.requires_grad_(False)
        self.output_conv1 = nn.Conv2d(f, f // 2, 3, padding=1)
        self.output_conv2 = nn.Sequential(
            nn.Conv2d(f // 2, OUTPUT_CHANNELS, 3, padding=1), nn.ReLU(), nn.Conv2d(OUTPUT_CHANNELS, 1, 1)
        )


class Head(nn.Module):
    """One plane from the tokens of four depths.

    :param width: of the tokens that come in.
    """

    def __init__(self, size: Size, width: int):
        super().__init__()
        a, b, _, d = size.levels
        self.projects = nn.ModuleList(nn.Conv2d(width, level, 1) for level in size.levels)
        self.resize_layers = nn.ModuleList(
            [
                nn.ConvTranspose2d(a, a, 4, 4),
                nn.ConvTranspose2d(b, b, 2, 2),
                nn.Identity(),
                nn.Conv2d(d, d, 3, 2, 1),
            ]
        )
        self.scratch = _Scratch(size)

    def forward(self, tokens: list[Tensor], rows: int, columns: int) -> Tensor:
        """Return `(batch, 1, 14 rows, 14 columns)` before any last activation."""
        levels = []
        for i, t in enumerate(tokens):
            x = t.transpose(1, 2).reshape(len(t), -1, rows, columns)
            x = self.resize_layers[i](self.projects[i](x))
            levels.append(getattr(self.scratch, f"layer{i + 1}_rn")(x))
        l1, l2, l3, l4 = levels
        s = self.scratch
        x = s.refinenet4(l4, None, l3.shape[2:])
        x = s.refinenet3(x, l3, l2.shape[2:])
        x = s.refinenet2(x, l2, l1.shape[2:])
        x = s.refinenet1(x, l1, (2 * l1.shape[2], 2 * l1.shape[3]))
        size = (PATCH * rows, PATCH * columns)
        x = F.interpolate(s.output_conv1(x), size=size, mode="bilinear", align_corners=True)
        return s.output_conv2(x)
