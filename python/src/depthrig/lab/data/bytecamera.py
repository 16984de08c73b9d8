"""ByteCameraDepth: folders of real images per session and camera, as published or as `depthrig export` writes them.

There is no truth: these serve the hole and value models. `sensor` chooses a camera; without it all are taken.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from .. import images
from ..config import DataConfig
from ..errors import LabError
from ..sample import Intrinsics, Licence, Sample
from .source import RANGES_M, Source, natural

__all__ = ["ByteCameraDepth", "model_of"]

UNITS_M = {"d405": 1e-4, "l515": 2.5e-4}
"""Metres per unit of 16-bit depth; 1 mm for all others."""


def model_of(folder: str) -> str:
    """Return the camera of a folder: `camera_realsense_405`, `camera_d405_2`, `camera_zed2i_quality`."""
    name = folder.removeprefix("camera_").lower().replace("realsense_", "d").replace("azure_", "")
    if match := re.match(r"d?(l515|405|415|435i?|455)", name):
        return "l515" if match[1] == "l515" or match[1] == "515" else "d" + match[1].removesuffix("i")
    if name.startswith("d515"):
        return "l515"
    return next((m for m in ("d405", "d415", "d435", "d455", "l515", "kinect", "zed2i") if m in name), "")


@dataclass(frozen=True)
class _Camera:
    folder: Path
    model: str
    unit_m: float
    intrinsics: Intrinsics | None
    """Of depth."""


class ByteCameraDepth(Source):
    """Every number for which a camera has both colour and depth."""

    licence = Licence("CC BY 4.0", ships=True)

    def __init__(self, data: DataConfig):
        super().__init__(data)
        self.splits("train", "all")
        self.frames: list[tuple[_Camera, int, Path]] = []
        sessions = [self.root, *sorted(p for p in self.root.iterdir() if p.is_dir())]
        folders = [f for s in sessions for f in sorted(s.glob("camera_*")) if f.is_dir()]
        models = set()
        for folder in folders:
            model = model_of(folder.name)
            if data.sensor and data.sensor not in (model, folder.name, folder.name.removeprefix("camera_")):
                continue
            camera = self._camera(folder, model)
            models.add(model)
            self.frames += [(camera, n, path) for n, path in self._depths(folder)]
        self.found(len(self.frames), f"camera_{data.sensor or 'MODEL'}/depth_N.png with color_N.png")
        # Of one camera its range is known; of several their mean would say nothing.
        self.sensor = models.pop() if len(models) == 1 else ""

    def _camera(self, folder: Path, model: str) -> _Camera:
        unit = UNITS_M.get(model, 1e-3)
        intrinsics = None
        path = folder.parent / "calibration.json"
        if path.is_file():
            try:
                streams = json.loads(path.read_text())["streams"]
                mine = next((s for s in streams if self._is_depth(s, folder.name)), None)
                if mine is not None:
                    unit = float(mine.get("depth_unit_m") or unit)
                    intrinsics = self._intrinsics(mine.get("intrinsics"))
            except (ValueError, KeyError, TypeError, AttributeError) as e:
                raise LabError(f"{path}: {type(e).__name__} {e}") from None
        if self.data.unit_m is not None:
            unit = self.data.unit_m
        return _Camera(folder, model, unit, intrinsics)

    @staticmethod
    def _is_depth(stream: dict[str, Any], folder: str) -> bool:
        return stream["folder"] == folder and stream["prefix"] in ("depth", "raw_depth")

    @staticmethod
    def _intrinsics(found: Any) -> Intrinsics | None:
        if not isinstance(found, dict) or not found.get("fx"):
            return None
        fx, fy, cx, cy = (float(found[k]) for k in ("fx", "fy", "cx", "cy"))
        coeffs = tuple(float(c) for c in found.get("coeffs") or ())
        return Intrinsics(fx, fy, cx, cy, str(found.get("model", "none")), coeffs)

    @staticmethod
    def _depths(folder: Path) -> list[tuple[int, Path]]:
        found = [*folder.glob("depth_*.png"), *folder.glob("raw_depth_*.npy")]
        numbered = []
        for path in sorted(found, key=natural):
            match = re.fullmatch(r"(?:raw_)?depth_(\d+)\.(?:png|npy)", path.name)
            if match and (folder / f"color_{match[1]}.png").is_file():
                numbered.append((int(match[1]), path))
        return numbered

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> Sample:
        camera, number, path = self.frames[index]
        raw: npt.NDArray[np.float32]
        if path.suffix == ".npy":
            try:
                metres = np.load(path, allow_pickle=False)
            except (OSError, ValueError, EOFError) as e:
                raise LabError(f"{path}: damaged: {e}") from None
            if metres.ndim != 2 or metres.dtype.kind != "f":
                raise LabError(f"{path}: {metres.dtype} {metres.shape}; float (height, width) in metres is wanted")
            raw = images.metres(metres)
        else:
            units = images.grey(path)
            if units.dtype != np.uint16:
                raise LabError(f"{path}: {units.dtype} pixels, 16 bits are wanted")
            raw = images.metres(np.where(units == 65535, 0, units) * camera.unit_m)
        color = images.color(path.with_name(f"color_{number}.png"))
        name = f"{camera.folder.relative_to(self.root)}/{number}"
        if color.shape[:2] != raw.shape:
            sizes = f"colour is {color.shape[1]}x{color.shape[0]}, depth {raw.shape[1]}x{raw.shape[0]}"
            raise LabError(f"{path}: {sizes}: not aligned to colour; record or import it aligned")
        return Sample(name, color, self.licence, raw, intrinsics=camera.intrinsics)

    def files(self) -> Sequence[Path]:
        """Return every file."""
        return [p for _, n, depth in self.frames for p in (depth, depth.with_name(f"color_{n}.png"))]


assert UNITS_M.keys() <= RANGES_M.keys()
