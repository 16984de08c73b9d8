"""HAMMER: real scenes with depth of a D435, an L515 and a ToF camera, and truth from a scan."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from .. import images
from ..config import DataConfig
from ..errors import LabError
from ..sample import UNKNOWN_LICENCE, Intrinsics, Sample
from .source import Source, natural

__all__ = ["Hammer"]

UNIT_M = 1e-3
TEST_SCENES = (12, 13, 14)
SENSORS = {"d435": "d435", "l515": "l515", "tof": "kinect"}


class Hammer(Source):
    """`sceneS_trajT…/polarization`: scenes 2 to 11 are `train`, 12 to 14 `test`; `sensor` is the raw depth."""

    licence = UNKNOWN_LICENCE

    def __init__(self, data: DataConfig):
        super().__init__(data)
        self.splits("train", "test", "all")
        if data.sensor not in SENSORS:
            raise LabError(f'{self.root}: sensor = "{data.sensor}" is unknown; use {", ".join(SENSORS)}')
        self.sensor = SENSORS[data.sensor]
        self.frames: list[Path] = []
        for folder in sorted(self.root.glob("scene*_traj*"), key=natural):
            match = re.match(r"scene(\d+)_traj", folder.name)
            if match is None or not folder.is_dir():
                continue
            test = int(match[1]) in TEST_SCENES
            if data.split in ("all", "test" if test else "train"):
                self.frames += self._sequence(folder / "polarization")
        self.found(len(self.frames), f"sceneS_trajT_K/polarization/rgb/000000.png in split {data.split}")

    @staticmethod
    def _sequence(folder: Path) -> list[Path]:
        found = sorted((folder / "rgb").glob("*.png"))
        for number, path in enumerate(found):
            if path.name != f"{number:06d}.png":
                raise LabError(f"{path}: {number:06d}.png is missing before it; unpack this sequence again")
        return found

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> Sample:
        path = self.frames[index]
        folder = path.parents[1]
        truth = images.metres(images.grey(folder / "_gt" / path.name) * UNIT_M)
        raw = images.metres(images.grey(folder / f"depth_{self.data.sensor}" / path.name) * UNIT_M)
        at = folder / "intrinsics.txt"
        try:
            k = np.loadtxt(at)
        except (OSError, ValueError) as e:
            raise LabError(f"{at}: {e}") from None
        if k.shape != (3, 3):
            raise LabError(f"{at}: {k.shape} numbers, a 3x3 matrix is wanted")
        intrinsics = Intrinsics(float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2]))
        name = f"{folder.parent.name}/{path.stem}"
        return Sample(name, images.color(path), self.licence, raw, truth, intrinsics)

    def files(self) -> Sequence[Path]:
        """Return every file."""
        names = ("rgb", "_gt", f"depth_{self.data.sensor}")
        every = [p.parents[1] / n / p.name for p in self.frames for n in names]
        return [p for p in every if p.is_file()]
