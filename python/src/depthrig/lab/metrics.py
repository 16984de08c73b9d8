"""Depth metrics: L1, RMSE, AbsRel and thresholds, with two denominators.

Plain ones are over pixels with a truth in range and a prediction. Strict ones are over all pixels with a truth in
range: a missing prediction counts as one of 0 m and fails every threshold. Definitions are those of `depthrig eval`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from .errors import LabError
from .sample import MATERIALS

__all__ = ["THRESHOLDS", "Metrics", "Scores", "Sums", "measure", "pooled", "table"]

THRESHOLDS = {"δ0.5": 1.25**0.5, "δ1": 1.25, "δ1.05": 1.05, "δ1.10": 1.10}
"""A pixel is within when max(d/d*, d*/d) is below."""


@dataclass(frozen=True)
class Sums:
    """What every metric is made of; those of several images add up."""

    counted: int = 0
    valid: int = 0
    abs_m: float = 0.0
    square_m2: float = 0.0
    relative: float = 0.0
    missing_m: float = 0.0
    missing_square_m2: float = 0.0
    within: tuple[int, ...] = (0,) * len(THRESHOLDS)

    def __add__(self, other: Sums) -> Sums:
        return Sums(
            self.counted + other.counted,
            self.valid + other.valid,
            self.abs_m + other.abs_m,
            self.square_m2 + other.square_m2,
            self.relative + other.relative,
            self.missing_m + other.missing_m,
            self.missing_square_m2 + other.missing_square_m2,
            tuple(a + b for a, b in zip(self.within, other.within, strict=True)),
        )

    def scores(self) -> Metrics:
        """Return the metrics; NaN where nothing counts."""

        def over(value: float, count: int) -> float:
            return value / count if count else math.nan

        missing = self.counted - self.valid
        plain = Scores(
            over(self.abs_m, self.valid),
            math.sqrt(over(self.square_m2, self.valid)),
            over(self.relative, self.valid),
            {n: over(w, self.valid) for n, w in zip(THRESHOLDS, self.within, strict=True)},
        )
        strict = Scores(
            over(self.abs_m + self.missing_m, self.counted),
            math.sqrt(over(self.square_m2 + self.missing_square_m2, self.counted)),
            over(self.relative + missing, self.counted),
            {n: over(w, self.counted) for n, w in zip(THRESHOLDS, self.within, strict=True)},
        )
        return Metrics(plain, strict, self.counted, 100 * over(missing, self.counted))


@dataclass(frozen=True)
class Scores:
    """Metrics with one denominator; metres and shares."""

    l1_m: float
    rmse_m: float
    abs_rel: float
    within: dict[str, float]


@dataclass(frozen=True)
class Metrics:
    """Metrics of one image or of several."""

    plain: Scores
    strict: Scores
    counted: int
    """Pixels with a truth in range."""
    missing_percent: float


@dataclass(frozen=True)
class Measured:
    """The sums of one image."""

    whole: Sums
    by_material: dict[str, Sums] = field(default_factory=dict)


def _sums(predicted: npt.NDArray[Any], truth: npt.NDArray[Any]) -> Sums:
    p, t = predicted.astype(np.float64), truth.astype(np.float64)
    has = np.isfinite(p) & (p > 0)
    missing = t[~has]
    counted = t.size
    p, t = p[has], t[has]
    error = np.abs(p - t)
    factor = np.maximum(p / t, t / p)
    within = tuple(int((factor < limit).sum()) for limit in THRESHOLDS.values())
    errors = (float(error.sum()), float((error**2).sum()), float((error / t).sum()))
    return Sums(counted, t.size, *errors, float(missing.sum()), float((missing**2).sum()), within)


def measure(
    predicted: npt.NDArray[Any],
    truth: npt.NDArray[Any],
    near_m: float = 0.1,
    far_m: float = 6.0,
    material: npt.NDArray[np.uint8] | None = None,
) -> Measured:
    """Return the sums of one image: all of it, and by material where there is an image of materials.

    :param predicted: metres; 0, negative, NaN and infinite are missing.
    :raises LabError: when sizes differ or the range is empty.
    """
    if predicted.shape != truth.shape or (material is not None and material.shape != truth.shape):
        raise LabError(f"a prediction of {predicted.shape} for a truth of {truth.shape}; compare images of one size")
    if not 0 < near_m <= far_m:
        raise LabError(f"invalid depth range {near_m}..={far_m} m")
    with np.errstate(invalid="ignore"):
        counts = np.isfinite(truth) & (truth >= near_m) & (truth <= far_m)
    of: dict[str, Sums] = {}
    if material is not None:
        for number, name in enumerate(MATERIALS):
            chosen = counts & (material == number)
            if chosen.any():
                of[name] = _sums(predicted[chosen], truth[chosen])
    return Measured(_sums(predicted[counts], truth[counts]), of)


def pooled(images: list[Measured]) -> Mapping[str, Metrics]:
    """Return the metrics of several images.

    `pixels` are those of all pixels together, `images` the mean over images that have a truth, and `pixels, MATERIAL`
    those of one material.
    """
    total = Sums()
    by: dict[str, Sums] = {}
    for one in images:
        total = total + one.whole
        for name, sums in one.by_material.items():
            by[name] = by.get(name, Sums()) + sums
    out = {"pixels": total.scores(), "images": _mean([i.whole.scores() for i in images if i.whole.counted])}
    return out | {f"pixels, {name}": by[name].scores() for name in MATERIALS if name in by}


def _mean(of: list[Metrics]) -> Metrics:
    def mean(values: list[float]) -> float:
        # An image without any prediction has no plain metrics.
        known = [v for v in values if not math.isnan(v)]
        return math.fsum(known) / len(known) if known else math.nan

    def scores(each: list[Scores]) -> Scores:
        within = {n: mean([s.within[n] for s in each]) for n in THRESHOLDS}
        return Scores(
            mean([s.l1_m for s in each]), mean([s.rmse_m for s in each]), mean([s.abs_rel for s in each]), within
        )

    counted = sum(m.counted for m in of)
    missing = mean([m.missing_percent for m in of])
    return Metrics(scores([m.plain for m in of]), scores([m.strict for m in of]), counted, missing)


def table(rows: Mapping[str, Metrics]) -> str:
    """Return the metrics as lines of text, strict ones first."""
    names = ["L1", "RMSE", "AbsRel", *THRESHOLDS]
    lines = [f"{'':36}" + "".join(f"{n:>9}" for n in names) + f"{'missing %':>11}"]
    for name, metrics in rows.items():
        for kind, s in (("strict", metrics.strict), ("plain", metrics.plain)):
            numbers = "".join(f"{v:9.4f}" for v in (s.l1_m, s.rmse_m, s.abs_rel, *s.within.values()))
            lines.append(f"{name + ', ' + kind:36}{numbers}{metrics.missing_percent:11.2f}")
    return "\n".join(lines)
