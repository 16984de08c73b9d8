"""Raw depth of a camera made from true depth: value noise, holes, and high-frequency noise by hand.

The noise models of a camera (`nets.noise`) draw smooth patterns: relative depth V and the probability of a hole H.
`synthesise` brings V to metres, filters the truth along it with a random radius, adds what a network cannot draw, and
punches the holes. With neither model it is all by hand. Every number comes from the generator that is passed in.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from .align import unscale
from .config import SynthesisConfig
from .errors import LabError
from .guided import box_sum, guided_filter

__all__ = ["Noise", "draw_noise", "hole_mask", "smooth_field", "synthesise", "value_noise", "with_noise"]

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
UNFILTERED = 0.1
"""Share of images whose value noise is not filtered."""
TRUE = 0.1
"""Share of images without value noise."""
ANCHORS_SIDE = 32
"""Relative depth is aligned at this many points, squared."""
AT_WIDTH = 640
"""Sizes in pixels are meant at this width."""


def smooth_field(rng: np.random.Generator, shape: tuple[int, int], radius: int, uniform: bool = False) -> Array:
    """Return noise that is correlated over about `radius` pixels.

    :param uniform: distributed evenly over 0 to 1; else with a mean of 0 and a deviation of 1.
    """
    field = rng.standard_normal(shape)
    for _ in range(2):
        field = box_sum(field, radius) / box_sum(np.ones(shape), radius)
    if uniform:
        ranks = np.empty(field.size)
        ranks[np.argsort(field.ravel(), kind="stable")] = (np.arange(field.size) + 0.5) / field.size
        return np.asarray(ranks.reshape(shape), np.float64)
    return (field - field.mean()) / max(float(field.std()), 1e-12)


def value_noise(
    truth: npt.NDArray[np.float32],
    relative: npt.NDArray[Any] | None,
    stereo: bool,
    rng: np.random.Generator,
    filtered: bool = True,
) -> npt.NDArray[np.float32]:
    """Return the truth with the noise of a value model's relative depth: metres, 0 where there are none.

    The filter's radius is drawn from 2 to 64 pixels (at a width of 640) and its epsilon from 1e-5 to 1e-2 of the
    variance, both log-uniform.

    :param filtered: False leaves the filter out.
    """
    kind = rng.random()
    radius = np.exp(rng.uniform(np.log(2), np.log(64))) * truth.shape[1] / AT_WIDTH
    share = np.exp(rng.uniform(np.log(1e-5), np.log(1e-2)))
    if relative is None or kind < TRUE:
        return truth
    if relative.shape != truth.shape:
        raise LabError(f"value noise of {relative.shape} for a truth of {truth.shape}")
    noisy = unscale(relative, truth, inverse=stereo, side=ANCHORS_SIDE)
    if kind < TRUE + UNFILTERED or not filtered:
        return noisy
    valid = (truth > 0) & (noisy > 0)
    if not valid.any():
        return noisy
    guide, image = noisy.astype(np.float64), truth.astype(np.float64)
    if stereo:
        guide, image = 1 / np.maximum(guide, 1e-3), 1 / np.maximum(image, 1e-3)
    # Where the aligned guide has no distance it would pull whole windows.
    steady = np.where(noisy > 0, guide, np.median(guide[valid]))
    epsilon = float(share * guide[valid].var())
    out, reached = guided_filter(steady, image, valid, max(1, round(radius)), epsilon)
    good = reached & (noisy > 0) & (out > (1e-3 if stereo else 0))
    metric = 1 / np.where(good, out, 1) if stereo else out
    return np.where(good, metric, 0).astype(np.float32)


def hole_mask(probability: npt.NDArray[Any], rng: np.random.Generator) -> Mask:
    """Return where holes are: above 0.5 half of the time, else above smooth noise that is uniform over 0 to 1."""
    if not (np.isfinite(probability).all() and probability.min() >= 0 and probability.max() <= 1):
        raise LabError("the probability of holes is not within 0..=1")
    sampled = rng.random() < 0.5
    radius = max(1, round(np.exp(rng.uniform(np.log(1), np.log(16))) * probability.shape[1] / AT_WIDTH))
    if not sampled:
        mask: Mask = probability > 0.5
        return mask
    return np.asarray(probability > smooth_field(rng, probability.shape, radius, uniform=True))


@dataclass(frozen=True)
class Noise:
    """High-frequency noise of one image. Pixels are those of a width of 640."""

    white_px: float
    """Deviation of disparity from pixel to pixel, pixels. ToF: hundredths of a metre instead."""
    blocky_px: float
    """The same, correlated over 5 pixels as by a matching window."""
    step_px: float
    """Step of disparity; 0 is none."""
    shift_px: float
    """Deviation of where a pixel looks, pixels."""
    blotches: float
    """Share of the image in blotches of missing depth."""
    speckle: float
    """Share of pixels with an arbitrary depth."""
    widen_px: float
    """Near things grow by so much at their edges."""
    thin_px: float
    """Things thinner than this are dropped."""
    flying: float
    """Share of edge pixels that lie between near and far."""


def draw_noise(rng: np.random.Generator, strength: float) -> Noise:
    """Return the noise of one image; `strength` 0 is none."""
    on = rng.random(6) < 0.7
    white, blocky = rng.uniform(0.03, 0.15, 2)
    return Noise(
        white_px=strength * float(white),
        blocky_px=strength * float(blocky),
        step_px=1 / 32 if strength > 0 and on[0] else 0.0,
        shift_px=0.5 * strength if on[1] else 0.0,
        blotches=strength * float(rng.uniform(0, 0.03)) if on[2] else 0.0,
        speckle=strength * float(rng.uniform(0, 0.003)) if on[3] else 0.0,
        widen_px=strength * float(rng.uniform(0, 4)),
        thin_px=strength * float(rng.uniform(0, 3)) if on[4] else 0.0,
        flying=min(1.0, strength * float(rng.uniform(0, 0.5))) if on[5] else 0.0,
    )


def _least(image: Array, radius: int) -> Array:
    """The least value within `radius`, by rows and columns."""
    for axis in (0, 1):
        pad = [(0, 0), (0, 0)]
        pad[axis] = (radius, radius)
        windows = np.lib.stride_tricks.sliding_window_view(np.pad(image, pad, mode="edge"), 2 * radius + 1, axis)
        image = windows.min(-1)
    return image


def with_noise(
    depth: npt.NDArray[np.float32], noise: Noise, config: SynthesisConfig, rng: np.random.Generator
) -> npt.NDArray[np.float32]:
    """Return depth with high-frequency noise; holes stay holes."""
    shape = depth.shape
    scale = shape[1] / AT_WIDTH
    stereo = config.sensor == "stereo"
    far = np.where(depth > 0, depth.astype(np.float64), np.inf)
    radius = round(noise.widen_px * scale)
    if radius > 0:
        # Half of what grows, by patches: a matching window does not fatten every edge.
        near = _least(far, radius)
        jump = near < 0.93 * far
        far = np.where(jump & (smooth_field(rng, shape, max(1, 4 * radius)) > 0), near, far)
    radius = round(noise.thin_px * scale / 2 + 0.25)
    if radius > 0 and noise.thin_px > 0:
        # Closing: what is nearer than all around it and thin takes the depth behind it.
        behind = _closed(far, radius)
        far = np.where(behind > 1.07 * far, behind, far)
    if noise.shift_px > 0:
        y, x = np.indices(shape)
        dy, dx = noise.shift_px * max(scale, 0.5) * rng.standard_normal((2, *shape))
        at_y = np.clip(np.rint(y + dy), 0, shape[0] - 1).astype(int)
        far = far[at_y, np.clip(np.rint(x + dx), 0, shape[1] - 1).astype(int)]
    if noise.flying > 0:
        beside = np.roll(far, 1, 1)
        beside[:, 0] = far[:, 0]
        edge = np.isfinite(far) & np.isfinite(beside) & (np.maximum(far, beside) > 1.07 * np.minimum(far, beside))
        mixed = edge & (rng.random(shape) < noise.flying)
        share = rng.random(shape)
        with np.errstate(invalid="ignore"):
            far = np.where(mixed, share * far + (1 - share) * beside, far)
    white, blocky = rng.standard_normal(shape), smooth_field(rng, shape, 2)
    error = noise.white_px * white + noise.blocky_px * blocky
    if stereo:
        fb = config.focal_baseline
        disparity = fb / far + error
        if noise.step_px > 0:
            disparity = np.rint(disparity / noise.step_px) * noise.step_px
        out = fb / np.where(disparity > 1e-6, disparity, np.inf)
    else:
        out = far + 0.01 * error
    if noise.speckle > 0:
        valid = out[np.isfinite(out) & (out > 0)]
        if valid.size:
            wild = rng.random(shape) < noise.speckle
            out = np.where(wild & np.isfinite(far), rng.uniform(0.5, 1.5, shape) * float(np.median(valid)), out)
    if noise.blotches > 0:
        blotch = smooth_field(rng, shape, max(1, round(6 * scale)), uniform=True) < noise.blotches
        out = np.where(blotch, np.inf, out)
    return np.where((depth > 0) & np.isfinite(far) & np.isfinite(out) & (out > 0), out, 0).astype(np.float32)


def _closed(image: Array, radius: int) -> Array:
    """Morphological closing: the least of the greatest within `radius`."""
    return _least(-_least(-image, radius), radius)


def synthesise(
    truth: npt.NDArray[np.float32],
    config: SynthesisConfig,
    rng: np.random.Generator,
    relative: npt.NDArray[Any] | None = None,
    hole_probability: npt.NDArray[Any] | None = None,
) -> npt.NDArray[np.float32]:
    """Return raw depth of the configured sensor, metres, 0 for holes.

    :param relative: what the value model predicts; without it there is no value noise.
    :param hole_probability: what the hole model predicts; without it there are the holes of the truth and of the noise.
    """
    if config.sensor == "none":
        raise LabError('synthesis needs sensor = "stereo" or "tof"')
    raw = value_noise(truth, relative, config.sensor == "stereo", rng, config.filter)
    raw = with_noise(raw, draw_noise(rng, config.strength), config, rng)
    if hole_probability is not None:
        raw = np.where(hole_mask(hole_probability, rng), np.float32(0), raw)
    return raw
