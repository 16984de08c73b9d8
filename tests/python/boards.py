"""Images of printed boards: the sheet that depthrig draws (its SVG), seen by a pinhole camera, with noise. Written in NumPy alone."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

Array = NDArray[np.float64]
TEXELS_PER_MM = 4.0
PAPER = 225.0
INK = 25.0
WALL = 120.0


@dataclass
class Sheet:
    """A printed sheet: grey values, and its size in millimetres."""

    texels: Array

    @classmethod
    def of(cls, svg: Path) -> Sheet:
        text = svg.read_text()
        size = re.search(r'viewBox="0 0 ([\d.]+) ([\d.]+)"', text)
        assert size
        width, height = (float(v) for v in size.groups())
        texels = np.full((round(height * TEXELS_PER_MM), round(width * TEXELS_PER_MM)), PAPER)
        for x, y, w, h in re.findall(r"M([\d.]+) ([\d.]+)h([\d.]+)v([\d.]+)h", text):
            left, top = float(x), float(y)
            rows = slice(round(top * TEXELS_PER_MM), round((top + float(h)) * TEXELS_PER_MM))
            columns = slice(round(left * TEXELS_PER_MM), round((left + float(w)) * TEXELS_PER_MM))
            texels[rows, columns] = INK
        return cls(texels)

    @property
    def size_m(self) -> Array:
        rows, columns = self.texels.shape
        return np.array([columns, rows]) / TEXELS_PER_MM * 1e-3


@dataclass
class Pose:
    """Where a sheet's middle is in the camera's optical frame, and how it is turned about x, y and z."""

    place_m: tuple[float, float, float]
    turn_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def matrix(self) -> Array:
        a, b, c = np.radians(self.turn_deg)
        about_x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
        about_y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
        about_z = np.array([[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]])
        pose = np.eye(4)
        pose[:3, :3] = about_z @ about_y @ about_x
        pose[:3, 3] = self.place_m
        return pose


@dataclass
class Camera:
    """A pinhole camera; `world` is the pose of the world that sheets are in."""

    width: int = 640
    height: int = 480
    focal: float = 600.0
    world: Array = field(default_factory=lambda: np.eye(4))

    def see(self, sheets: list[tuple[Sheet, Pose]], seed: int = 0, samples: int = 3) -> NDArray[np.uint8]:
        """The image of sheets in front of a grey wall, later ones in front."""
        total = np.zeros((self.height, self.width))
        steps = (np.arange(samples) + 0.5) / samples - 0.5
        for dy in steps:
            for dx in steps:
                x = (np.arange(self.width) + dx - (self.width - 1) / 2) / self.focal
                y = (np.arange(self.height) + dy - (self.height - 1) / 2) / self.focal
                rays = np.stack([*np.meshgrid(x, y), np.ones((self.height, self.width))], axis=-1)
                total += self._rays(rays, sheets)
        noise = np.random.default_rng(seed).normal(0.0, 1.5, total.shape)
        return np.clip(total / samples**2 + noise, 0, 255).astype(np.uint8)

    def _rays(self, rays: Array, sheets: list[tuple[Sheet, Pose]]) -> Array:
        seen = np.full(rays.shape[:2], WALL)
        for sheet, pose in sheets:
            matrix = self.world @ pose.matrix()
            normal = matrix[:3, 2]
            depth = (normal @ matrix[:3, 3]) / (rays @ normal)
            on = (rays * depth[..., None] - matrix[:3, 3]) @ matrix[:3, :2] + sheet.size_m / 2
            texel = np.floor(on * 1e3 * TEXELS_PER_MM).astype(int)
            rows, columns = sheet.texels.shape
            column, row = texel[..., 0], texel[..., 1]
            hit = (depth > 0) & (column >= 0) & (row >= 0) & (column < columns) & (row < rows)
            seen[hit] = sheet.texels[row[hit], column[hit]]
        return seen


def places(count: int, seed: int = 1) -> list[Pose]:
    """Places of an A4 board at 0.5 m: all over the image of the default camera, tilted."""
    random = np.random.default_rng(seed)
    found = []
    for n in range(count):
        x, y = random.uniform(-0.10, 0.10), random.uniform(-0.07, 0.07)
        tilt = 30.0 if n % 2 else -30.0
        turn = (tilt + random.uniform(-8, 8), random.uniform(-30, 30), random.uniform(-20, 20))
        found.append(Pose((x, y, random.uniform(0.42, 0.6)), turn))
    return found


def save(image: NDArray[np.uint8], path: Path) -> None:
    path.parent.mkdir(exist_ok=True)
    Image.fromarray(image).save(path)
