"""What every loader is, and the check of depth units."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ..config import DataConfig
from ..errors import LabError
from ..sample import Licence, Sample

__all__ = ["RANGES_M", "Source", "check_units", "natural"]

RANGES_M = {
    "d405": (0.05, 1.5),
    "d415": (0.16, 10.0),
    "d435": (0.11, 10.0),
    "d455": (0.2, 12.0),
    "l515": (0.2, 9.0),
    "kinect": (0.2, 6.0),
    "zed2i": (0.15, 20.0),
}
"""Distances within which the median of a camera's image lies."""
ANY_M = (0.03, 60.0)
LOOKED_AT = 5
"""Samples whose depth is looked at."""


def natural(path: Path) -> tuple[tuple[int, int, str], ...]:
    """Sort key that puts `a_2` before `a_10`."""
    import re

    parts = re.split(r"(\d+)", path.name)
    return tuple((1, int(p), "") if p.isdigit() else (0, 0, p) for p in parts)


class Source:
    """A dataset: samples by number."""

    licence: Licence
    sensor = ""
    """Model of the camera of raw depth, a key of `RANGES_M`, where it is known."""

    def __init__(self, data: DataConfig):
        self.data = data
        self.root = Path(data.path)

    def __len__(self) -> int:
        raise NotImplementedError

    def __getitem__(self, index: int) -> Sample:
        raise NotImplementedError

    def files(self) -> Sequence[Path]:
        """Every file that the dataset consists of, for its hash."""
        raise NotImplementedError

    def splits(self, *known: str) -> None:
        """Check the split.

        :raises LabError: when it is not one of `known`.
        """
        if self.data.split not in known:
            raise LabError(f'{self.root}: split = "{self.data.split}" is unknown; use {", ".join(known)}')

    def found(self, count: int, wanted: str) -> None:
        """Check that there is data.

        :raises LabError: when `count` is 0; names the files that are wanted.
        """
        if count == 0:
            raise LabError(f"{self.root}: not this layout: no {wanted}")


def _median(depth: npt.NDArray[np.float32]) -> float:
    valid = depth[depth > 0]
    return float(np.median(valid)) if valid.size else float("nan")


def check_units(source: Source) -> None:
    """Look at the depth of some samples for a wrong unit.

    Against the truth raw depth must agree within a factor of 2 in the median; alone its median must lie within what the
    camera measures.

    :raises LabError: when it does not; names the unit that would fit.
    """
    rows = np.linspace(0, len(source) - 1, min(LOOKED_AT, len(source))).astype(int)
    low, high = RANGES_M.get(source.sensor, ANY_M)
    medians: dict[str, list[float]] = {"raw": [], "truth": []}
    ratios = []
    for i in rows:
        sample = source[int(i)]
        if sample.raw is not None:
            medians["raw"].append(_median(sample.raw))
        if sample.truth is not None:
            medians["truth"].append(_median(sample.truth))
        if sample.raw is not None and sample.truth is not None:
            both = (sample.raw > 0) & (sample.truth > 0)
            if both.any():
                ratios.append(float(np.median(sample.raw[both] / sample.truth[both])))
    if ratios and not 0.5 <= np.median(ratios) <= 2:
        ratio = float(np.median(ratios))
        raise LabError(f"{source.root}: raw depth is {ratio:.3g} times the truth in the median: one has a wrong unit")
    for what, values in medians.items():
        values = [v for v in values if not np.isnan(v)]
        if not values and medians[what]:
            raise LabError(f"{source.root}: {what} depth is empty in all of {len(medians[what])} samples looked at")
        if not values:
            continue
        middle = float(np.median(values))
        least, most = (low, high) if what == "raw" else ANY_M
        if not least <= middle <= most:
            fits = [u for u in (0.1, 0.25, 4.0, 10.0, 1e-3, 1e3) if least <= middle * u <= most]
            times = " or ".join(f"{u:g}" for u in fits)
            advice = f"; {times} times its unit would fit" if fits else ""
            camera = f"a {source.sensor.upper()}" if source.sensor and what == "raw" else "any camera"
            raise LabError(
                f"{source.root}: {what} depth has a median of {middle:.4g} m, beyond {least}..={most} m of {camera}: "
                f"wrong unit{advice}"
            )
