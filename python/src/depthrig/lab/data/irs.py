"""IRS: rendered stereo of rooms. No sensor; depth follows from disparity."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from .. import images
from ..config import DataConfig
from ..errors import LabError
from ..sample import Intrinsics, Licence, Sample
from .source import Source

__all__ = ["Irs"]

FOCAL = 480.0
BASELINE_M = 0.1


class Irs(Source):
    """The lines of `lists/irs_SPLIT.list`: left image, right image, disparity, normals, relative to the folder.

    The other lists there are parts of that one, or of another layout.
    """

    licence = Licence("Apache-2.0", ships=True)

    def __init__(self, data: DataConfig):
        super().__init__(data)
        self.splits("train", "test")
        path = self.root / f"lists/irs_{data.split}.list"
        self.pairs: list[tuple[str, str]] = []
        for number, line in enumerate(path.read_text().splitlines() if path.is_file() else [], 1):
            words = line.split()
            if len(words) >= 3:
                self.pairs.append((words[0], words[2]))
            elif words:
                raise LabError(f"{path}: line {number} is not LEFT RIGHT DISPARITY NORMAL")
        self.found(len(self.pairs), f"lists/{path.name} with lines")

    def __len__(self) -> int:
        return len(self.pairs)

    def __getitem__(self, index: int) -> Sample:
        left, disparity_name = self.pairs[index]
        disparity = images.exr_channel(self.root / disparity_name, "G", "Y", "R").astype(np.float64)
        valid = np.isfinite(disparity) & (disparity > 0)
        depth = FOCAL * BASELINE_M / np.where(valid, disparity, np.inf)
        height, width = disparity.shape
        intrinsics = Intrinsics(FOCAL, FOCAL, (width - 1) / 2, (height - 1) / 2)
        name = left.rsplit(".", 1)[0]
        color = images.color(self.root / left)
        return Sample(name, color, self.licence, truth=images.metres(depth), intrinsics=intrinsics)

    def files(self) -> Sequence[Path]:
        """Return every file."""
        every = [self.root / name for pair in self.pairs for name in pair]
        return [p for p in every if p.is_file()]
