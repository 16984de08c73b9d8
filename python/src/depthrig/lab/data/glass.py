"""ClearGrasp and TransCG: real images of transparent objects."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from .. import images
from ..config import DataConfig
from ..errors import LabError
from ..sample import Licence, Sample
from .source import Source, natural

__all__ = ["ClearGrasp", "TransCg"]

GLASS = 4
TRANSCG_CAMERAS = {"d435": (1, 1e-3), "l515": (2, 2.5e-4)}
"""Number in file names, and metres per unit."""


class ClearGrasp(Source):
    """`real-{test,val}/{d415,d435}/N-transparent-rgb-img.jpg`; depth of the same objects painted is the truth."""

    licence = Licence("Apache-2.0", ships=True)

    def __init__(self, data: DataConfig):
        super().__init__(data)
        self.splits("test", "val")
        if data.sensor not in ("d415", "d435"):
            raise LabError(f'{self.root}: sensor = "{data.sensor}" is unknown; use d415, d435')
        self.sensor = data.sensor
        folder = self.root / f"real-{data.split}" / data.sensor
        self.frames = sorted(folder.glob("*-transparent-rgb-img.jpg"), key=natural)
        self.found(len(self.frames), f"real-{data.split}/{data.sensor}/*-transparent-rgb-img.jpg")

    def __len__(self) -> int:
        return len(self.frames)

    def _path(self, index: int, name: str) -> Path:
        path = self.frames[index]
        return path.with_name(path.name.removesuffix("transparent-rgb-img.jpg") + name)

    def __getitem__(self, index: int) -> Sample:
        path = self.frames[index]
        raw = images.metres(images.exr_channel(self._path(index, "transparent-depth-img.exr"), "R", "Y"))
        truth = images.metres(images.exr_channel(self._path(index, "opaque-depth-img.exr"), "R", "Y"))
        mask = images.grey(self._path(index, "mask.png")) > 0
        material = np.where(mask, GLASS, 0).astype(np.uint8)
        name = f"real-{self.data.split}/{self.data.sensor}/{path.name.split('-')[0]}"
        return Sample(name, images.color(path), self.licence, raw, truth, material=material)

    def files(self) -> Sequence[Path]:
        """Return every file."""
        names = ("transparent-rgb-img.jpg", "transparent-depth-img.exr", "opaque-depth-img.exr", "mask.png")
        return [self._path(i, n) for i in range(len(self)) for n in names if self._path(i, n).is_file()]


class TransCg(Source):
    """`sceneN/VIEW/rgb1.png`; 1 is a D435 in millimetres, 2 an L515 in quarters of one."""

    licence = Licence("CC BY-NC-SA 4.0", ships=False)

    def __init__(self, data: DataConfig):
        super().__init__(data)
        self.splits("all")
        if data.sensor not in TRANSCG_CAMERAS:
            raise LabError(f'{self.root}: sensor = "{data.sensor}" is unknown; use {", ".join(TRANSCG_CAMERAS)}')
        self.sensor = data.sensor
        self.number, self.unit_m = TRANSCG_CAMERAS[data.sensor]
        scenes = sorted(self.root.glob("scene*"), key=natural)
        self.frames = [
            view / f"rgb{self.number}.png"
            for scene in scenes
            for view in sorted(scene.iterdir(), key=natural)
            if (view / f"rgb{self.number}.png").is_file()
        ]
        self.found(len(self.frames), f"sceneN/VIEW/rgb{self.number}.png")

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> Sample:
        path = self.frames[index]
        n = self.number
        raw = images.metres(images.grey(path.with_name(f"depth{n}.png")) * self.unit_m)
        truth = images.metres(images.grey(path.with_name(f"depth{n}-gt.png")) * self.unit_m)
        mask = images.grey(path.with_name(f"depth{n}-gt-mask.png")) > 0
        material = np.where(mask, GLASS, 0).astype(np.uint8)
        name = f"{path.parent.parent.name}/{path.parent.name}/{n}"
        return Sample(name, images.color(path), self.licence, raw, truth, material=material)

    def files(self) -> Sequence[Path]:
        """Return every file."""
        n = self.number
        names = (f"rgb{n}.png", f"depth{n}.png", f"depth{n}-gt.png", f"depth{n}-gt-mask.png")
        return [p.with_name(name) for p in self.frames for name in names if p.with_name(name).is_file()]
