"""A scene of which everything is known: a plane with a red square, as two cameras see it, computed with NumPy alone."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from PIL import Image

WIDTH = 320
HEIGHT = 240
PLANE_M = 1.0
"""The plane z = 1 m of the mount."""
SQUARE = (0.02, -0.03)
"""Middle of the red square on the plane."""
HALF_M = 0.1
RED = (200, 40, 40)
BLUE = (50, 70, 210)

MANIFEST = 'model = "pattern"\nrate_hz = 10.0\n'
STREAM = """
[[stream]]
name = "{name}"
files = "{name}_*.png"
{more}intrinsics = {{ fx = {k[0]}, fy = {k[1]}, cx = {k[2]}, cy = {k[3]}, model = "{model}", coeffs = {coeffs} }}
pose_in_device = {{ translation_m = {shift}, rotation_xyzw = [0.0, 0.0, 0.0, 1.0] }}
"""
CAMERA = """
[[camera]]
name = "{name}"
backend = "files"
manifest = {manifest}
pose = {{ translation_m = {translation}, rotation_xyzw = {rotation} }}
"""


@dataclass(frozen=True)
class Lens:
    """`fx fy cx cy`, Brown-Conrady coefficients `k1 k2 p1 p2 k3`, and where the lens is in the camera."""

    k: tuple[float, float, float, float]
    coeffs: tuple[float, ...] = ()
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def rays(self) -> np.ndarray:
        """The ray of each pixel at z = 1, by fixed-point iteration as OpenCV does it."""
        u, v = np.meshgrid(np.arange(WIDTH, dtype=float), np.arange(HEIGHT, dtype=float))
        shown_x = (u - self.k[2]) / self.k[0]
        shown_y = (v - self.k[3]) / self.k[1]
        x, y = shown_x.copy(), shown_y.copy()
        k1, k2, p1, p2, k3 = self.coeffs or (0.0,) * 5
        for _ in range(60):
            r2 = x * x + y * y
            radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
            x = (shown_x - 2 * p1 * x * y - p2 * (r2 + 2 * x * x)) / radial
            y = (shown_y - p1 * (r2 + 2 * y * y) - 2 * p2 * x * y) / radial
        return np.stack([x, y, np.ones_like(x)], axis=-1)


@dataclass(frozen=True)
class SceneCamera:
    """A camera that sees the plane, turned about y."""

    name: str
    depth: Lens
    color: Lens
    translation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn_deg: float = 0.0
    rotation: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        c, s = np.cos(np.radians(self.turn_deg)), np.sin(np.radians(self.turn_deg))
        object.__setattr__(self, "rotation", np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]))

    def seen(self, lens: Lens) -> tuple[np.ndarray, np.ndarray]:
        """Depth along the optical axis, metres, and the point on the plane, for each pixel."""
        origin = self.rotation @ np.array(lens.shift) + np.array(self.translation)
        directions = lens.rays() @ self.rotation.T
        z = (PLANE_M - origin[2]) / directions[..., 2]
        return z, origin + directions * z[..., None]

    def write(self, folder: Path) -> str:
        """Writes its images; returns its part of the rig file."""
        folder.mkdir()
        z, _ = self.seen(self.depth)
        Image.fromarray(np.round(z * 1000).astype(np.uint16)).save(folder / "depth_1.png")
        _, points = self.seen(self.color)
        is_red = (np.abs(points[..., :2] - SQUARE) <= HALF_M).all(axis=-1)
        color = np.where(is_red[..., None], np.array(RED, np.uint8), np.array(BLUE, np.uint8))
        Image.fromarray(color.astype(np.uint8)).save(folder / "color_1.png")
        streams = ""
        for name, lens, more in (("color", self.color, ""), ("depth", self.depth, "depth_unit_m = 0.001\n")):
            model = "brown_conrady" if lens.coeffs else "none"
            streams += STREAM.format(
                name=name, more=more, k=lens.k, model=model, coeffs=list(lens.coeffs), shift=list(lens.shift)
            )
        (folder / "camera.toml").write_text(MANIFEST + streams)
        half = np.radians(self.turn_deg) / 2
        return CAMERA.format(
            name=self.name,
            manifest=json.dumps(str(folder / "camera.toml")),
            translation=list(self.translation),
            rotation=[0.0, float(np.sin(half)), 0.0, float(np.cos(half))],
        )


# Lenses that bend so much that a corner of the square would be 20 pixels off without them.
# Colour has its own lens, 5 cm beside that of depth: without its pose the square would be 15 pixels off.
FRONT = SceneCamera(
    "front",
    depth=Lens((300.0, 300.0, 159.5, 119.5)),
    color=Lens((280.0, 285.0, 150.0, 125.0), shift=(0.05, 0.0, 0.0)),
)
SIDE = SceneCamera(
    "side",
    depth=Lens((290.0, 292.0, 155.0, 122.0), (0.8, -0.07, 0.002, -0.001, 0.01)),
    color=Lens((310.0, 305.0, 163.0, 117.0), (0.75, 0.03, -0.001, 0.001, 0.0), shift=(0.0, 0.03, 0.0)),
    translation=(0.6, 0.05, 0.1),
    turn_deg=-15.0,
)
CAMERAS = (FRONT, SIDE)
