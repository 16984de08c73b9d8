"""DREDS, STD and HISS: stereo, simulated or (STD) of a real D415, with transparent and specular objects."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from .. import images
from ..config import DataConfig
from ..errors import LabError
from ..sample import Intrinsics, Licence, Sample
from .source import Source, natural

__all__ = ["Dreds", "Hiss", "Std"]

FOCAL_640 = 446.31
"""Focal length at a width of 640 (`SwinDRNet/datasets/datasets.py`)."""
MATERIALS = {0: 1, 1: 1, 2: 4, 3: 3}
"""From the material of `meta.txt` (0 and 1 diffuse, 2 transparent, 3 specular) to ours."""


def _material(mask: npt.NDArray[np.int64], meta: Path) -> npt.NDArray[np.uint8]:
    """Material of each pixel: `mask` has the number of the instance, `meta` a line for each instance."""
    out = np.zeros(mask.shape, np.uint8)
    try:
        lines = meta.read_text().splitlines()
    except (OSError, UnicodeDecodeError) as e:
        raise LabError(f"{meta}: {e}") from None
    for number, line in enumerate(lines, 1):
        words = line.split()
        if not words:
            continue
        try:
            out[mask == int(words[0])] = MATERIALS[int(words[5])]
        except (IndexError, ValueError, KeyError):
            raise LabError(f"{meta}: line {number} is not INSTANCE LABEL FOLDER NAME SCALE MATERIAL …") from None
    return out


class _Simulated(Source):
    """`NNNN_color.png` with the images of the same number beside it."""

    licence = Licence("CC BY-NC 4.0", ships=False)
    truth_name: str
    raw_name: str
    mask_name: str | None = None

    def __init__(self, data: DataConfig):
        super().__init__(data)
        self.frames = self.find()
        self.found(len(self.frames), f"*_color.png with *_{self.truth_name} in split {data.split}")

    def find(self) -> list[Path]:
        """Return the colour images, in order."""
        raise NotImplementedError

    def __len__(self) -> int:
        return len(self.frames)

    def _path(self, index: int, name: str) -> Path:
        color = self.frames[index]
        return color.with_name(color.name.removesuffix("color.png") + name)

    def __getitem__(self, index: int) -> Sample:
        color_path = self.frames[index]
        # Three equal channels; no depth is -0.001.
        truth = images.metres(images.exr_channel(self._path(index, self.truth_name), "R", "Y"))
        raw = images.metres(images.exr_channel(self._path(index, self.raw_name), "R", "Y"))
        name = str(color_path.relative_to(self.root)).removesuffix("_color.png")
        if raw.shape != truth.shape:
            raise LabError(f"{color_path}: raw depth is {raw.shape}, true depth {truth.shape}: sizes are mixed")
        height, width = truth.shape
        color = images.shrink(images.color(color_path), (height, width), str(color_path))
        focal = FOCAL_640 * width / 640
        intrinsics = Intrinsics(focal, focal, (width - 1) / 2, (height - 1) / 2)
        material = None
        if self.mask_name is not None and (mask_path := self._path(index, self.mask_name)).is_file():
            if mask_path.suffix == ".exr":
                mask = np.rint(images.exr_channel(mask_path, "R", "Y") * 255).astype(np.int64)
            else:
                mask = images.grey(mask_path).astype(np.int64)
            mask = images.resize_labels(mask, truth.shape, str(mask_path))
            material = _material(mask, self._path(index, "meta.txt"))
        return Sample(name, color, self.licence, raw, truth, intrinsics, material)

    def files(self) -> Sequence[Path]:
        """Return every file."""
        names = ["color.png", self.truth_name, self.raw_name]
        return [self._path(i, n) for i in range(len(self)) for n in names if self._path(i, n).is_file()]


class Dreds(_Simulated):
    """`{train,val,test}/SCENE/NNNN_color.png`: colour of 1280x720, depth of 640x360."""

    truth_name = "depth_120.exr"
    raw_name = "simDepthImage.exr"
    mask_name = "mask.exr"

    def find(self) -> list[Path]:
        """Return the colour images, in order."""
        self.splits("train", "val", "test")
        return sorted((self.root / self.data.split).glob("*/*_color.png"))


class Std(_Simulated):
    """`test_N/NNNN_color.png`: raw depth of a real D415."""

    truth_name = "gt_depth.exr"
    raw_name = "depth_415.exr"
    mask_name = "mask.png"
    sensor = "d415"

    def find(self) -> list[Path]:
        """Return the colour images, in order."""
        self.splits("test")
        folders = sorted(self.root.glob("test_*"), key=natural)
        return [p for folder in folders for p in sorted(folder.glob("*_color.png"))]


class Hiss(_Simulated):
    """`{train,val}/SCENE/SURFACE/NNNN_color.png`. What the authors leave out is left out: a list, and some surfaces."""

    truth_name = "depth.exr"
    raw_name = "simDepthImage.exr"
    left_out = ("glass", "mirror", "bed")

    def find(self) -> list[Path]:
        """Return the colour images, in order."""
        self.splits("train", "val")
        bad: set[str] = set()
        if (listed := self.root / "bad_his.txt").is_file():
            bad = {line.strip() for line in listed.read_text().splitlines() if line.strip()}
        frames = sorted((self.root / self.data.split).glob("*/*/*_color.png"))

        def kept(path: Path) -> bool:
            name = str(path.relative_to(self.root))
            stem = name.removesuffix("_color.png")
            return not any(w in name.lower() for w in self.left_out) and not any(
                stem.endswith(b) or b in name for b in bad
            )

        return [p for p in frames if kept(p)]
