"""HyperSim: rendered rooms. No sensor; the files have distances, not depth.

Beside the scenes lie two tables of the dataset's repository: `metadata_images_split_scene_v1.csv` (the split) and
`metadata_camera_parameters.csv` (the camera of each scene; some are tilted and shifted).
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from .. import images
from ..config import DataConfig
from ..errors import LabError
from ..sample import Intrinsics, Licence, Sample
from .source import Source

__all__ = ["HyperSim", "axial_share", "depth_of", "pinhole_of"]

SPLITS = "metadata_images_split_scene_v1.csv"
CAMERAS = "metadata_camera_parameters.csv"


def _rows(path: Path) -> list[dict[str, str]]:
    try:
        with path.open(newline="") as f:
            return list(csv.DictReader(f))
    except OSError:
        raise LabError(f"{path}: no such file; it is in the repository apple/ml-hypersim") from None


def axial_share(camera: npt.NDArray[np.float64], height: int, width: int) -> npt.NDArray[np.float64]:
    """Return depth along the optical axis per distance along the ray, at each pixel centre.

    :param camera: `M_cam_from_uv` of the scene: from (u, v, 1), u from -1 to 1 to the right, v upwards, to a ray of a
        camera that looks along -z.
    """
    u = (np.arange(width) + 0.5) / width * 2 - 1
    v = 1 - (np.arange(height) + 0.5) / height * 2
    plane = np.stack([*np.meshgrid(u, v), np.ones((height, width))])
    ray = np.tensordot(camera, plane, 1)
    share: npt.NDArray[np.float64] = -ray[2] / np.linalg.norm(ray, axis=0)
    return share


def depth_of(distance: npt.NDArray[Any], camera: npt.NDArray[np.float64]) -> npt.NDArray[np.float32]:
    """Return depth of an image of distances; NaN becomes 0."""
    return images.metres(np.nan_to_num(distance.astype(np.float64)) * axial_share(camera, *distance.shape))


def pinhole_of(camera: npt.NDArray[np.float64], height: int, width: int) -> Intrinsics | None:
    """Return the intrinsics of a camera whose image is square to its axis; None for one that is tilted."""
    rays = camera / -camera[2, 2]
    if abs(rays[2, :2]).max() > 1e-6 or abs(rays[0, 1]) > 1e-6 or abs(rays[1, 0]) > 1e-6:
        return None
    fx, fy = width / 2 / rays[0, 0], height / 2 / rays[1, 1]
    cx = (width - 1) / 2 - fx * rays[0, 2]
    cy = (height - 1) / 2 + fy * rays[1, 2]
    return Intrinsics(float(fx), float(fy), float(cx), float(cy))


class HyperSim(Source):
    """The frames of the official split that its authors released; colour is the tone-mapped preview."""

    licence = Licence("CC BY-SA 3.0", ships=True)

    def __init__(self, data: DataConfig):
        super().__init__(data)
        self.splits("train", "val", "test")
        names = [f"M_cam_from_uv_{r}{c}" for r in range(3) for c in range(3)]
        self.cameras = {}
        for row in _rows(self.root / CAMERAS):
            try:
                matrix = np.array([float(row[n]) for n in names]).reshape(3, 3)
            except (KeyError, ValueError, TypeError) as e:
                raise LabError(f"{self.root / CAMERAS}: scene {row.get('scene_name')}: {e}") from None
            self.cameras[row["scene_name"]] = matrix
        self.frames: list[tuple[str, str, int]] = []
        for row in _rows(self.root / SPLITS):
            try:
                wanted = row["included_in_public_release"] == "True" and row["split_partition_name"] == data.split
                scene, camera, frame = row["scene_name"], row["camera_name"], int(row["frame_id"])
            except (KeyError, ValueError, TypeError) as e:
                raise LabError(f"{self.root / SPLITS}: {type(e).__name__} {e}") from None
            # A scene that was not downloaded is left out; one that is damaged is not.
            if wanted and (self.root / scene).is_dir():
                if scene not in self.cameras:
                    raise LabError(f"{self.root / CAMERAS}: no camera of scene {scene}; its depth would be wrong")
                self.frames.append((scene, camera, frame))
        self.found(len(self.frames), f"scene ai_VVV_NNN of split {data.split}")

    def __len__(self) -> int:
        return len(self.frames)

    def _paths(self, index: int) -> tuple[Path, Path]:
        scene, camera, frame = self.frames[index]
        folder = self.root / scene / "images"
        color = folder / f"scene_{camera}_final_preview" / f"frame.{frame:04d}.tonemap.jpg"
        return color, folder / f"scene_{camera}_geometry_hdf5" / f"frame.{frame:04d}.depth_meters.hdf5"

    def __getitem__(self, index: int) -> Sample:
        import h5py

        scene, camera, frame = self.frames[index]
        color_path, depth_path = self._paths(index)
        try:
            with h5py.File(depth_path, "r") as f:
                distance = np.array(f["dataset"])
        except (OSError, KeyError) as e:
            raise LabError(f"{depth_path}: {e}") from None
        if distance.ndim != 2:
            raise LabError(f"{depth_path}: distances of shape {distance.shape}")
        matrix = self.cameras[scene]
        intrinsics = pinhole_of(matrix, *distance.shape)
        truth = depth_of(distance, matrix)
        name = f"{scene}/{camera}/{frame:04d}"
        return Sample(name, images.color(color_path), self.licence, truth=truth, intrinsics=intrinsics)

    def files(self) -> Sequence[Path]:
        """Return every file."""
        return [p for i in range(len(self)) for p in self._paths(i) if p.is_file()]
