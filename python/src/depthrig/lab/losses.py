"""Losses in PyTorch; all are means over pixels that count."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from .config import LossConfig

__all__ = ["beside_fill_loss", "hole_loss", "refine_loss", "unsteady_loss", "value_loss"]

WRONG = 0.05
"""Raw depth that is off by more than this share of the truth counts as missing."""

WORSE_OFF_M = 0.01
"""Added to the L1 of filled depth over an image of which it is a denominator."""


STEADY = 0.8
"""Depth in holes may change by this part of what filled depth does."""
STEADY_M = 0.002
"""Added to the change of filled depth of which that of refined depth is a part."""


def inverse(depth: Tensor) -> Tensor:
    """Return 1/m of metres; 0 stays 0."""
    return torch.where(depth > 0, 1 / depth.clamp_min(1e-6), 0.0)


def beside_fill_loss(predicted: Tensor, truth: Tensor, filled: Tensor, config: LossConfig) -> Tensor:
    """Return the mean over images of what the L1 of depth changes in that of filled depth, as a part of it.

    `config.off_m` is added to that part's denominator, so that images with much to win count most. An image that became
    worse counts again, `config.worse` times, as a part of its own error.

    :param predicted: `(batch, height, width)`, 1/m, as `filled`.
    :param truth: metres, 0 where unknown.
    """
    valid = (truth >= config.near_m) & (truth <= config.far_m) & (filled > 0)
    count = valid.sum((1, 2)).clamp_min(1)

    def error(of: Tensor) -> Tensor:
        return (torch.where(valid, 1 / of.clamp_min(1e-3) - truth, 0.0).abs().sum((1, 2))) / count

    before = error(filled)
    change = error(predicted) - before
    worse = change.clamp_min(0) / (before + WORSE_OFF_M)
    return (change / (before + config.off_m) + config.worse * worse).mean()


def unsteady_loss(predicted: Tensor, raw: Tensor, filled: Tensor, config: LossConfig) -> Tensor:
    """Return the mean over crops of how much depth in holes changes when the sensor measures again, as a part of filled
    depth's change and beyond `STEADY` of it.

    :param predicted: `(2 * batch, height, width)`, 1/m, as `filled`; the second half is of the same crops, measured again.
    :param raw: metres, 0 for a hole.
    """
    once, again = filled.chunk(2)
    hole = (raw.chunk(2)[0] <= 0) & (once * config.far_m >= 1) & (again * config.far_m >= 1)
    count = hole.sum((1, 2)).clamp_min(1)

    def change(of: Tensor) -> Tensor:
        one, two = (1 / half.clamp_min(1e-3) for half in of.chunk(2))
        return torch.where(hole, one - two, 0.0).abs().sum((1, 2)) / count

    return (change(predicted) / (change(filled) + STEADY_M) - STEADY).clamp_min(0).mean()


def refine_loss(predicted: Tensor, truth: Tensor, raw: Tensor, config: LossConfig) -> Tensor:
    """Return the L1 and gradient loss of inverse depth, or of its logarithm (`config.space`).

    The gradient loss is the mean difference between neighbours' differences, to the right and downwards, where both
    have a truth within the range; it has one scale.

    :param predicted: `(batch, height, width)`, 1/m.
    :param truth: metres, 0 where unknown.
    :param raw: metres, 0 for a hole.
    """
    valid = (truth >= config.near_m) & (truth <= config.far_m)
    if config.space == "log":
        # A prediction of 0 is depth that cannot be known: it has no logarithm and no say.
        valid = valid & (predicted > 0)
        error = torch.where(valid, predicted * truth, 1.0).log()
    else:
        error = torch.where(valid, predicted - inverse(truth), 0.0)
    wrong = (raw - truth).abs() > WRONG * truth
    weight = valid * torch.where(wrong, config.missing, 1.0)
    loss = (weight * error.abs()).sum() / weight.sum().clamp_min(1e-6)
    if config.gradient > 0:
        right, down = valid[..., 1:] & valid[..., :-1], valid[:, 1:] & valid[:, :-1]
        of_x = (error[..., 1:] - error[..., :-1]).abs() * right
        of_y = (error[:, 1:] - error[:, :-1]).abs() * down
        count = (right.sum() + down.sum()).clamp_min(1)
        loss = loss + config.gradient * (of_x.sum() + of_y.sum()) / count
    return loss


def hole_loss(logits: Tensor, raw: Tensor, seen: Tensor) -> Tensor:
    """Return the binary cross-entropy of "is a hole", over the pixels that the sensor can see.

    :param seen: False at borders that registration to colour leaves empty, and outside the sensor's field.
    """
    each = F.binary_cross_entropy_with_logits(logits, (raw <= 0).to(logits.dtype), reduction="none")
    return torch.where(seen, each, 0.0).sum() / seen.sum().clamp_min(1)


def value_loss(predicted: Tensor, raw: Tensor, stereo: bool) -> Tensor:
    """Return the L1 loss of relative depth, each brought to a median of 0 and a mean deviation of 1, where measured.

    :param stereo: relative inverse depth; else depth.
    """
    losses = []
    for one, measured in zip(predicted, raw, strict=True):
        valid = measured > 0
        if int(valid.sum()) < 2:
            continue
        target = (1 / measured[valid]) if stereo else measured[valid]
        losses.append((_normalised(one[valid].float()) - _normalised(target)).abs().mean())
    # An image without depth has no say, but a gradient.
    return torch.stack(losses).mean() if losses else 0.0 * predicted.sum()


def _normalised(values: Tensor) -> Tensor:
    centred = values - values.median()
    return centred / centred.abs().mean().clamp_min(1e-6)
