"""One sample of any dataset: colour, what a sensor measured, the truth, and what may be done with them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from .errors import LabError

__all__ = ["MATERIALS", "UNKNOWN_LICENCE", "Intrinsics", "Licence", "Sample", "check_licences"]

Depth = npt.NDArray[np.float32]

MATERIALS = ("nothing", "diffuse", "glossy", "metal", "glass", "dark")
"""Names of the numbers in a material image."""


@dataclass(frozen=True)
class Licence:
    """Terms of a dataset."""

    name: str
    ships: bool
    """Whether weights trained on it may be passed on, also commercially."""


UNKNOWN_LICENCE = Licence("none stated", ships=False)


@dataclass(frozen=True)
class Intrinsics:
    """Pinhole camera of an image, in pixels; the centre of the first pixel is (0, 0)."""

    fx: float
    fy: float
    cx: float
    cy: float
    model: str = "none"
    """Distortion model; `none` for a pinhole."""
    coeffs: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        numbers = (self.fx, self.fy, self.cx, self.cy, *self.coeffs)
        if not all(np.isfinite(numbers)) or self.fx <= 0 or self.fy <= 0:
            raise LabError(f"invalid intrinsics fx {self.fx}, fy {self.fy}, cx {self.cx}, cy {self.cy}")


@dataclass(frozen=True)
class Sample:
    """One image of a dataset. All arrays have one height and width."""

    name: str
    """Unique within its dataset."""
    color: npt.NDArray[np.uint8]
    """``(height, width, 3)``, red first."""
    licence: Licence
    raw: Depth | None = None
    """``(height, width)``, metres along the optical axis as measured, registered to colour; 0 is a hole."""
    truth: Depth | None = None
    """``(height, width)``, metres along the optical axis at pixel centres; 0 is unknown."""
    intrinsics: Intrinsics | None = None
    material: npt.NDArray[np.uint8] | None = None
    """``(height, width)``, numbers of `MATERIALS`."""
    filled: Depth | None = None
    """``(height, width)``, metres: raw depth without holes, as `fill` of the daemon gives it; 0 is unknown."""

    def __post_init__(self) -> None:
        if self.color.dtype != np.uint8 or self.color.ndim != 3 or self.color.shape[2] != 3 or not self.color.size:
            raise LabError(
                f"{self.name}: colour is {self.color.dtype} {self.color.shape}, not uint8 (height, width, 3)"
            )
        planes: tuple[tuple[str, npt.NDArray[Any] | None, type], ...] = (
            ("raw depth", self.raw, np.float32),
            ("truth", self.truth, np.float32),
            ("filled depth", self.filled, np.float32),
            ("material", self.material, np.uint8),
        )
        for what, plane, dtype in planes:
            if plane is None:
                continue
            if plane.dtype != dtype or plane.shape != self.color.shape[:2]:
                height, width = self.color.shape[:2]
                found = f"{plane.dtype} {plane.shape}"
                raise LabError(f"{self.name}: {what} is {found}, its colour is {width}x{height}: register it to colour")
            if dtype == np.float32 and not (np.isfinite(plane).all() and plane.min() >= 0):
                raise LabError(f"{self.name}: {what} has negative or infinite distances; the loader must make them 0")

    def need_intrinsics(self, what_for: str) -> Intrinsics:
        """Return the intrinsics.

        :raises LabError: when the dataset has none.
        """
        if self.intrinsics is None:
            raise LabError(f"{self.name}: no intrinsics, which {what_for} needs; use a dataset that has them")
        return self.intrinsics

    def need_truth(self) -> Depth:
        """Return the truth.

        :raises LabError: when there is none, or it is empty.
        """
        if self.truth is None:
            raise LabError(f"{self.name}: no true depth; this dataset serves the hole and value models only")
        if not self.truth.any():
            raise LabError(f"{self.name}: the true depth is empty")
        return self.truth


def check_licences(licences: dict[str, Licence], ships: bool, say: Any = print) -> None:
    """Print the licence of each dataset, and refuse what a model that ships must not have seen.

    :raises LabError: when `ships` and one of them forbids it.
    """
    for name, licence in licences.items():
        say(f"{name}: licence {licence.name}{'' if licence.ships else ', NOT for models that ship'}")
    refused = [f"{name} ({licence.name})" for name, licence in licences.items() if not licence.ships]
    if ships and refused:
        raise LabError(
            f"a model that ships must not be trained on {', '.join(refused)}; remove it or set ships = false"
        )
