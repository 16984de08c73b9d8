"""The encoder: a vision transformer of DINOv2's form, with its names of tensors."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

__all__ = ["PATCH", "SIZES", "Encoder", "Size"]

PATCH = 14
GRID = 37
"""Edge of the grid that position embeddings were trained on."""
NORM_EPS = 1e-6


@dataclass(frozen=True)
class Size:
    """Sizes of a network."""

    width: int
    blocks: int
    heads: int
    taps: tuple[int, int, int, int]
    """Blocks, counted from 0, whose tokens go to the head."""
    features: int
    """Channels within the head."""
    levels: tuple[int, int, int, int]
    """Channels of the four levels when they enter the head."""


SIZES = {
    "vits": Size(384, 12, 6, (2, 5, 8, 11), 64, (48, 96, 192, 384)),
    "vitb": Size(768, 12, 12, (2, 5, 8, 11), 128, (96, 192, 384, 768)),
    "vitl": Size(1024, 24, 16, (4, 11, 17, 23), 256, (256, 512, 1024, 1024)),
}
"""The official sizes (`cdm_plugin/src/arch.rs`)."""


class _Attention(nn.Module):
    def __init__(self, width: int, heads: int):
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(width, 3 * width)
        self.proj = nn.Linear(width, width)

    def forward(self, x: Tensor) -> Tensor:
        b, n, d = x.shape
        q, k, v = self.qkv(x).reshape(b, n, 3, self.heads, d // self.heads).permute(2, 0, 3, 1, 4)
        return self.proj(F.scaled_dot_product_attention(q, k, v).transpose(1, 2).reshape(b, n, d))


class _Scale(nn.Module):
    def __init__(self, width: int):
        super().__init__()
        self.gamma = nn.Parameter(torch.ones(width))

    def forward(self, x: Tensor) -> Tensor:
        return x * self.gamma


class _Mlp(nn.Module):
    def __init__(self, width: int):
        super().__init__()
        self.fc1 = nn.Linear(width, 4 * width)
        self.fc2 = nn.Linear(4 * width, width)

    def forward(self, x: Tensor) -> Tensor:
        return self.fc2(F.gelu(self.fc1(x)))


class _Block(nn.Module):
    def __init__(self, width: int, heads: int):
        super().__init__()
        self.norm1 = nn.LayerNorm(width, NORM_EPS)
        self.attn = _Attention(width, heads)
        self.ls1 = _Scale(width)
        self.norm2 = nn.LayerNorm(width, NORM_EPS)
        self.mlp = _Mlp(width)
        self.ls2 = _Scale(width)

    def forward(self, x: Tensor) -> Tensor:
        x = x + self.ls1(self.attn(self.norm1(x)))
        return x + self.ls2(self.mlp(self.norm2(x)))


class _PatchEmbed(nn.Module):
    def __init__(self, width: int, channels: int):
        super().__init__()
        self.proj = nn.Conv2d(channels, width, PATCH, PATCH)


class Encoder(nn.Module):
    """Tokens of an image at four depths of the network."""

    def __init__(self, size: Size, channels: int = 3):
        super().__init__()
        self.size = size
        self.cls_token = nn.Parameter(torch.zeros(1, 1, size.width))
        self.pos_embed = nn.Parameter(torch.zeros(1, 1 + GRID * GRID, size.width))
        # In every checkpoint; without effect.
        self.mask_token = nn.Parameter(torch.zeros(1, size.width), requires_grad=False)
        self.patch_embed = _PatchEmbed(size.width, channels)
        self.blocks = nn.ModuleList(_Block(size.width, size.heads) for _ in range(size.blocks))
        self.norm = nn.LayerNorm(size.width, NORM_EPS)
        nn.init.trunc_normal_(self.pos_embed, std=0.02)
        nn.init.normal_(self.cls_token, std=1e-6)

    def position(self, rows: int, columns: int) -> Tensor:
        """Return the position embeddings of a grid of patches; bicubic, with the scales that DINOv2 passes on."""
        if rows * columns == GRID * GRID and rows == columns:
            return self.pos_embed
        grid = self.pos_embed[:, 1:].reshape(1, GRID, GRID, -1).permute(0, 3, 1, 2)
        scale = ((rows + 0.1) / GRID, (columns + 0.1) / GRID)
        grid = F.interpolate(grid.float(), scale_factor=scale, mode="bicubic", antialias=False).to(grid.dtype)
        assert grid.shape[2:] == (rows, columns), (grid.shape, rows, columns)
        return torch.cat([self.pos_embed[:, :1], grid.flatten(2).transpose(1, 2)], 1)

    def forward(self, x: Tensor) -> list[Tensor]:
        """Return patch tokens `(batch, rows * columns, width)` of the tapped blocks, each through the final norm."""
        rows, columns = x.shape[2] // PATCH, x.shape[3] // PATCH
        tokens = self.patch_embed.proj(x).flatten(2).transpose(1, 2)
        tokens = torch.cat([self.cls_token.expand(len(x), -1, -1), tokens], 1) + self.position(rows, columns)
        taps = []
        for i, block in enumerate(self.blocks):
            tokens = block(tokens)
            if i in self.size.taps:
                taps.append(self.norm(tokens)[:, 1:])
        return taps
