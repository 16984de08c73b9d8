"""Batches as a pure function of the seed and the step, so that a run that was killed goes on with the same ones."""

from __future__ import annotations

import multiprocessing
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch.utils.data import DataLoader, Dataset

from .config import Config
from .data import Source
from .errors import LabError
from .fill import fill, filled_of, inverse_of
from .sample import Sample
from .synthesis import synthesise

__all__ = ["Batches", "Example", "again", "batch_of", "check_use", "example", "is_blank", "loader", "raw_of", "seen_of"]

ATTEMPTS = 100
"""After so many samples in a row without true depth the dataset is refused."""

AGAIN_PER_M = 0.1 / (0.05 * 385)
"""Measured again, inverse depth is off by so much, 1/m: a tenth of a pixel of disparity of a D435. These four numbers are those of the
still scene of `depthrig cdm bench --flicker`."""
AGAIN_CELL = 4
"""It is off alike over so many pixels: a stereo camera compares windows."""
AGAIN_GONE = 0.01
"""Share of these cells that become holes."""
AGAIN_COLOR = 2 / 255
"""Colour is off by so much at most."""

Planes = dict[str, npt.NDArray[Any]]


@dataclass(frozen=True)
class Example:
    """One crop: its name and its planes (`color`, `raw`, `truth`, `filled`, `seen`)."""

    name: str
    planes: Planes


def seen_of(raw: npt.NDArray[np.float32]) -> npt.NDArray[np.bool_]:
    """Return what the sensor can see: the rectangle around everything it measured.

    Registration to colour leaves borders empty, and the field of some sensors is narrower than colour's.
    """
    seen = np.zeros(raw.shape, bool)
    rows, columns = np.flatnonzero(raw.any(1)), np.flatnonzero(raw.any(0))
    if rows.size:
        seen[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] = True
    return seen


def raw_of(sample: Sample, config: Config, rng: np.random.Generator) -> npt.NDArray[np.float32]:
    """Return raw depth: the sample's, else made from its truth.

    :raises LabError: when there is none and the configuration does not say how to make it.
    """
    if sample.raw is not None:
        return sample.raw
    if config.synthesis.sensor == "none":
        raise LabError(f'{sample.name}: no raw depth; set sensor = "stereo" or "tof" under [synthesis]')
    return synthesise(sample.need_truth(), config.synthesis, rng)


def needs_truth(config: Config) -> bool:
    """Whether the model learns from true depth."""
    return config.model.kind in ("tiny", "cdm") or config.model.refined_input


def is_blank(sample: Sample) -> bool:
    """Whether the true depth of a sample that has it is empty, as behind a covered lens."""
    return sample.truth is not None and not sample.truth.any()


def check_use(sample: Sample, config: Config, where: str) -> None:
    """Refuse a dataset by its first sample.

    :raises LabError: when the model needs true depth that it has not, or recorded depth would be mirrored.
    """
    if needs_truth(config) and sample.truth is None:
        raise LabError(f"{where}: no true depth; it serves the hole and value models only")
    if config.train.flip and sample.raw is not None:
        raise LabError(f"{where}: it has raw depth of its own, whose holes have a side; leave flip out")


def example(sample: Sample, config: Config, rng: np.random.Generator) -> Example:
    """Return one random crop of a sample, its colours changed a little.

    :raises LabError: when the image is smaller than the crop, or has no truth and the model needs it.
    """
    height, width = config.train.crop
    if sample.color.shape[0] < height or sample.color.shape[1] < width:
        found = f"{sample.color.shape[1]}x{sample.color.shape[0]}"
        raise LabError(f"{sample.name}: {found} is smaller than the crop of {width}x{height}; choose a smaller crop")
    truth = sample.need_truth() if needs_truth(config) else sample.truth
    raw = raw_of(sample, config, rng)
    y = int(rng.integers(sample.color.shape[0] - height + 1))
    x = int(rng.integers(sample.color.shape[1] - width + 1))
    cut = (slice(y, y + height), slice(x, x + width))
    jitter = config.train.color_jitter
    gamma, gain = np.exp(jitter * rng.uniform(-1, 1)), np.exp(jitter * rng.uniform(-1, 1, 3) / 2)
    # A table of the 256 values: powers of every pixel took a quarter of the time.
    levels = (np.arange(256, dtype=np.float32) / 255) ** gamma
    tables = np.clip(levels * gain[:, None], 0, 1).astype(np.float32)
    color = np.stack([table[sample.color[(*cut, c)]] for c, table in enumerate(tables)])
    # Of the whole image: a crop has no borders of its own.
    planes: Planes = {"color": color, "raw": raw[cut], "seen": seen_of(raw)[cut]}
    planes["truth"] = np.zeros((height, width), np.float32) if truth is None else truth[cut]
    if config.model.kind == "tiny":
        planes["filled"] = filled_of(sample, planes["raw"], cut)
    if config.train.flip and rng.random() < 0.5:
        planes = {name: plane[..., ::-1] for name, plane in planes.items()}
    return Example(sample.name, {name: np.ascontiguousarray(plane) for name, plane in planes.items()})


def again(first: Example, rng: np.random.Generator) -> Example:
    """Return a crop of a still scene measured again: other noise of colour and raw depth, and what that changes in filled depth.

    The change is that of the stand-in for `fill`: it follows from what was measured around, as with any pyramid.
    """
    planes = dict(first.planes)
    height, width = planes["raw"].shape
    cells = (-(-height // AGAIN_CELL), -(-width // AGAIN_CELL))

    def each(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        return values.repeat(AGAIN_CELL, 0).repeat(AGAIN_CELL, 1)[:height, :width]

    off = each(AGAIN_PER_M * rng.standard_normal(cells, np.float32))
    gone = each(rng.random(cells, np.float32) < AGAIN_GONE)
    once = inverse_of(planes["raw"])
    # Far depth that noise would put at infinity stays near it.
    twice = np.where((once > 0) & ~gone, np.maximum(once + off, 0.5 * once), 0)
    planes["raw"] = inverse_of(twice)
    of_once, of_twice = fill(once), fill(twice)
    change = np.where((of_once > 0) & (of_twice > 0), of_twice / np.maximum(of_once, 1e-6), 1)
    planes["filled"] = (planes["filled"] * change).astype(np.float32)
    color = planes["color"] + AGAIN_COLOR * (2 * rng.random(planes["color"].shape, np.float32) - 1)
    planes["color"] = color.clip(0, 1)
    return Example(first.name, planes)


def batch_of(examples: Sequence[Example]) -> dict[str, Any]:
    """Return tensors of several examples, with their names."""
    planes = {name: torch.from_numpy(np.stack([e.planes[name] for e in examples])) for name in examples[0].planes}
    return {"names": [e.name for e in examples], **planes}


class Batches(Dataset):  # type: ignore[type-arg,unused-ignore]
    """The batch of each step. In each epoch every sample comes once (or `weight` times), in an order that is drawn."""

    def __init__(self, sources: Sequence[Source], config: Config, rank: int = 0, world: int = 1):
        self.sources = sources
        self.config = config
        self.rank = rank
        self.world = world
        self.counts = [max(1, round(len(s) * s.data.weight)) for s in sources]
        self.ends = np.cumsum(self.counts)
        self._blank: set[str] = set()
        self._order: tuple[int, npt.NDArray[np.int64]] = (-1, np.zeros(0, np.int64))

    def _sample(self, position: int) -> Sample:
        total = int(self.ends[-1])
        epoch = position // total
        if self._order[0] != epoch:
            self._order = (epoch, np.random.default_rng([self.config.seed, 1, epoch]).permutation(total))
        drawn = int(self._order[1][position % total])
        at = int(np.searchsorted(self.ends, drawn, side="right"))
        within = drawn - (int(self.ends[at]) - self.counts[at])
        # With a weight that is not whole, other samples come in the next epoch.
        return self.sources[at][(within + epoch * self.counts[at]) % len(self.sources[at])]

    def __len__(self) -> int:
        return self.config.train.steps

    def __getitem__(self, step: int) -> dict[str, Any]:
        size = self.config.train.batch
        first = (step * self.world + self.rank) * size
        examples = []
        for position in range(first, first + size):
            rng = np.random.default_rng([self.config.seed, 2, position])
            examples.append(example(self._with_truth(position), self.config, rng))
        if self.config.train.loss.steady > 0:
            draws = (np.random.default_rng([self.config.seed, 6, p]) for p in range(first, first + size))
            examples += [again(each, rng) for each, rng in zip(examples, draws, strict=True)]
        return batch_of(examples)

    def _with_truth(self, position: int) -> Sample:
        """The sample of a position, or where its true depth is empty and the model needs it, another that is drawn."""
        sample = self._sample(position)
        rng = np.random.default_rng([self.config.seed, 5, position])
        for _ in range(ATTEMPTS):
            if not (needs_truth(self.config) and is_blank(sample)):
                return sample
            if sample.name not in self._blank:
                self._blank.add(sample.name)
                said = f"warning: {sample.name}: the true depth is empty; others are drawn in its place"
                print(said, file=sys.stderr, flush=True)
            sample = self._sample(position - position % int(self.ends[-1]) + int(rng.integers(int(self.ends[-1]))))
        raise LabError(f"{sample.name}: the true depth is empty, and so is that of {ATTEMPTS} others that were drawn")


def loader(batches: Batches, first_step: int) -> Any:
    """Return an iterable over the batches from a step on, read ahead by `workers` processes."""
    workers = batches.config.train.workers
    steps = range(first_step, batches.config.train.steps)
    # A generator of its own, so that reading does not touch the one of the network.
    own = torch.Generator().manual_seed(batches.config.seed)
    options: dict[str, Any] = {}
    if workers:
        # Not by fork: this process has threads. What all import is imported once: they start one after the other.
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload([__name__])
        options = {"prefetch_factor": 2, "multiprocessing_context": context}
    return DataLoader(batches, batch_size=None, sampler=steps, num_workers=workers, generator=own, **options)
