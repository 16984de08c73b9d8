"""Our own shards (`depthrig.lab.shards`), read in any order."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from itertools import accumulate
from pathlib import Path

from ..config import DataConfig
from ..errors import LabError
from ..sample import Sample
from ..shards import Shard, list_shards
from .source import Source

__all__ = ["ShardFolder"]


class ShardFolder(Source):
    """Every shard of a folder. `split` is not used: each split is a folder of its own."""

    def __init__(self, data: DataConfig):
        super().__init__(data)
        self.shards = [Shard(p) for p in list_shards(self.root)]
        self.ends = list(accumulate(len(s) for s in self.shards))
        self.licence = self[0].licence

    def __len__(self) -> int:
        return self.ends[-1]

    def __getitem__(self, index: int) -> Sample:
        if not 0 <= index < len(self):
            raise IndexError(index)
        at = bisect_right(self.ends, index)
        sample = self.shards[at][index - (self.ends[at - 1] if at else 0)]
        # The licence is checked before training, by that of the first sample.
        if index and sample.licence != self.licence:
            raise LabError(f"{sample.name}: licence {sample.licence.name}, the first sample has {self.licence.name}")
        return sample

    def files(self) -> Sequence[Path]:
        """Return every file."""
        return [s.path for s in self.shards]
