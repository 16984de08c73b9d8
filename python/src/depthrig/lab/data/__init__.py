"""Datasets: one loader per layout on disk, each yielding the same `Sample`.

A loader checks the folder when it is opened, and its first images for a wrong depth unit.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from ..config import DataConfig
from ..errors import LabError
from . import bytecamera, dreds, glass, hammer, hypersim, irs, recorded, shard_folder
from .source import Source, check_units

__all__ = ["KINDS", "Source", "open_source"]

KINDS: dict[str, Callable[[DataConfig], Source]] = {
    "shards": shard_folder.ShardFolder,
    "depthrig": recorded.Recorded,
    "bytecameradepth": bytecamera.ByteCameraDepth,
    "hypersim": hypersim.HyperSim,
    "dreds": dreds.Dreds,
    "std": dreds.Std,
    "hiss": dreds.Hiss,
    "irs": irs.Irs,
    "hammer": hammer.Hammer,
    "cleargrasp": glass.ClearGrasp,
    "transcg": glass.TransCg,
}
"""The loader of each layout."""


def open_source(data: DataConfig) -> Source:
    """Return the dataset that a configuration names, its first samples checked.

    :raises LabError: when the layout is unknown, does not fit, or its depth is in another unit.
    """
    kind = KINDS.get(data.kind)
    if kind is None:
        raise LabError(f'kind = "{data.kind}" is unknown; use {", ".join(KINDS)}')
    if not Path(data.path).is_dir():
        raise LabError(f"{data.path}: no such folder")
    source = kind(data)
    if not len(source):
        raise LabError(f"{data.path}: no samples of {data.kind} with split {data.split}")
    check_units(source)
    return source
