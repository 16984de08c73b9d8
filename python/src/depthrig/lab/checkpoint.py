"""Checkpoints: complete or absent, also when the process is killed or the disk is full."""

from __future__ import annotations

import os
import pickle
from pathlib import Path
from typing import Any

import torch

from .errors import LabError, first_line
from .record import fsync_folder

__all__ = ["load", "save"]


def save(path: Path, state: Any) -> None:
    """Write a file of `torch.save`; one that was there stays until the new one is complete and synced.

    :raises LabError: when it cannot be written; what was there is unchanged.
    """
    part = path.with_name(f".{path.name}.tmp")
    try:
        with part.open("wb") as f:
            torch.save(state, f)
            f.flush()
            os.fsync(f.fileno())
        part.replace(path)
    except (OSError, RuntimeError) as e:
        part.unlink(missing_ok=True)
        raise LabError(f"{path}: not written: {first_line(e)}; the last one is kept; is the disk full?") from None
    except BaseException:
        part.unlink(missing_ok=True)
        raise
    fsync_folder(path.parent)


def load(path: Path) -> dict[str, Any]:
    """Return the state in a checkpoint.

    :raises LabError: when it is damaged.
    """
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, EOFError, ValueError, pickle.UnpicklingError) as e:
        raise LabError(f"{path}: damaged checkpoint: {first_line(e)}; remove it to begin again") from None
    if not isinstance(state, dict) or not {"step", "model", "optimizer", "ema"} <= state.keys():
        raise LabError(f"{path}: not a checkpoint of this program; remove it to begin again")
    return state
