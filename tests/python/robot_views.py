"""Views of a robot's arm as a fixed camera sees it: masks, depth, joint positions, and where the camera really is.

Robots are those of the package `example-robot-data` (UR5, Panda). COLLADA is read by pycollada, meshes are placed by trimesh and
pixels are hit by rays of Embree, so that nothing of depthrig draws what depthrig is tested with. Runs in an environment of its own,
.venv-robots (requirements-robots.txt):

    .venv-robots/bin/python tests/python/robot_views.py FOLDER --robot ur5 --seed 1 [--views 8] [--masks clean ragged]
"""

from __future__ import annotations

import argparse
import json
import math
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import trimesh
from PIL import Image
from trimesh.ray.ray_pyembree import RayMeshIntersector

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Matrix = NDArray[np.float64]

WIDTH = 640
HEIGHT = 480
FOCAL = 600.0
MODELS = {"ur5": "ur_description/urdf/ur5_robot.urdf", "panda": "panda_description/urdf/panda.urdf"}
DRAWN = {
    "ur5": {
        "shoulder_pan_joint": (-1.2, 1.2),
        "shoulder_lift_joint": (-2.2, -0.6),
        "elbow_joint": (-1.6, 1.6),
        "wrist_1_joint": (-2.0, 0.5),
        "wrist_2_joint": (-1.5, 1.5),
        "wrist_3_joint": (-1.5, 1.5),
    },
    "panda": {
        "panda_joint1": (-1.2, 1.2),
        "panda_joint2": (-0.8, 0.9),
        "panda_joint3": (-0.8, 0.8),
        "panda_joint4": (-2.6, -0.8),
        "panda_joint5": (-1.0, 1.0),
        "panda_joint6": (0.8, 2.8),
        "panda_joint7": (-1.5, 1.5),
        "panda_finger_joint1": (0.0, 0.04),
    },
}
"""Ranges of the joint positions that are drawn, radians and metres."""


def robots() -> Path:
    """The folder of the robots' descriptions, which the wheel keeps outside of Python's modules."""
    found = sorted(Path(trimesh.__file__).parents[1].glob("cmeel.prefix/share/example-robot-data/robots"))
    assert found, "example-robot-data is not installed"
    return found[0]


def rotation(axis: Matrix, angle: float) -> Matrix:
    return np.asarray(trimesh.transformations.rotation_matrix(angle, axis))


def origin(element: ET.Element | None) -> Matrix:
    """A pose as URDF writes it."""
    if element is None:
        return np.eye(4)
    xyz = [float(v) for v in element.get("xyz", "0 0 0").split()]
    rpy = [float(v) for v in element.get("rpy", "0 0 0").split()]
    pose = np.asarray(trimesh.transformations.euler_matrix(*rpy, axes="sxyz"))
    pose[:3, 3] = xyz
    return pose


@dataclass
class Joint:
    name: str
    kind: str
    parent: str
    child: str
    origin: Matrix
    axis: Matrix
    mimic: tuple[str, float, float] | None


class Robot:
    """Meshes of links and the joints between them."""

    def __init__(self, name: str) -> None:
        self.urdf = robots() / MODELS[name]
        root = ET.parse(self.urdf).getroot()
        self.meshes: dict[str, trimesh.Trimesh] = {}
        for link in root.iter("link"):
            parts = [part for visual in link.iter("visual") if (part := self._part(visual)) is not None]
            if parts:
                self.meshes[link.get("name", "")] = trimesh.util.concatenate(parts)
        self.joints = [self._joint(j) for j in root.findall("joint")]
        self.ranges = DRAWN[name]

    def _part(self, visual: ET.Element) -> trimesh.Trimesh | None:
        mesh = visual.find("geometry/mesh")
        if mesh is None:
            return None
        file = robots().parent / mesh.get("filename", "").removeprefix("package://example-robot-data/")
        part = trimesh.load(file, force="mesh", process=False)
        part = trimesh.Trimesh(part.vertices, part.faces, process=False)
        return part.apply_transform(origin(visual.find("origin")))

    @staticmethod
    def _joint(joint: ET.Element) -> Joint:
        def of(tag: str, attribute: str, default: str = "") -> str:
            element = joint.find(tag)
            return default if element is None else element.get(attribute, default)

        mimic = joint.find("mimic")
        return Joint(
            joint.get("name", ""),
            joint.get("type", ""),
            of("parent", "link"),
            of("child", "link"),
            origin(joint.find("origin")),
            np.array([float(v) for v in of("axis", "xyz", "1 0 0").split()]),
            None
            if mimic is None
            else (mimic.get("joint", ""), float(mimic.get("multiplier", "1")), float(mimic.get("offset", "0"))),
        )

    def posed(self, positions: dict[str, float]) -> trimesh.Trimesh:
        """The whole arm in the base's frame."""
        children = {j.child for j in self.joints}
        base = next(j.parent for j in self.joints if j.parent not in children)
        poses = {base: np.eye(4)}
        waiting = list(self.joints)
        while waiting:
            joint = next(j for j in waiting if j.parent in poses)
            waiting.remove(joint)
            position = positions.get(joint.name, 0.0)
            if joint.mimic is not None:
                source, factor, offset = joint.mimic
                position = factor * positions.get(source, 0.0) + offset
            motion = np.eye(4)
            if joint.kind in ("revolute", "continuous"):
                motion = rotation(joint.axis, position)
            elif joint.kind == "prismatic":
                motion[:3, 3] = joint.axis * position
            poses[joint.child] = poses[joint.parent] @ joint.origin @ motion
        return trimesh.util.concatenate([m.copy().apply_transform(poses[link]) for link, m in self.meshes.items()])


def looking_at(place: Matrix, target: Matrix) -> Matrix:
    """A camera's pose, optical axes: x right, y down, z forward."""
    forward = (target - place) / np.linalg.norm(target - place)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = place
    return pose


@dataclass
class Drawing:
    """What the camera sees at the middle of each pixel."""

    seen: NDArray[np.bool_]
    depth: Matrix
    """Along the optical axis, metres; 0 where there is nothing."""


def render(mesh: trimesh.Trimesh, camera: Matrix) -> Drawing:
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    rays = np.stack([(u - (WIDTH - 1) / 2) / FOCAL, (v - (HEIGHT - 1) / 2) / FOCAL, np.ones(u.shape)], -1)
    directions = rays.reshape(-1, 3) @ camera[:3, :3].T
    origins = np.broadcast_to(camera[:3, 3], directions.shape)
    hit = RayMeshIntersector(mesh).intersects_first(origins, directions)
    seen = hit >= 0
    triangles = mesh.triangles[hit[seen]]
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    far = np.einsum("ij,ij->i", triangles[:, 0] - camera[:3, 3], normals)
    along = np.einsum("ij,ij->i", directions[seen], normals)
    depth = np.zeros(hit.shape)
    # Rays are scaled to z = 1.
    depth[seen] = far / np.where(np.abs(along) < 1e-15, 1e-15, along)
    return Drawing(seen.reshape(u.shape), np.clip(depth, 0.0, 60.0).reshape(u.shape))


def smooth(random: np.random.Generator, spacing: int) -> Matrix:
    """A smooth field of standard deviation 1."""
    coarse = random.normal(size=(HEIGHT // spacing + 3, WIDTH // spacing + 3)).astype(np.float32)
    size = (coarse.shape[1] * spacing, coarse.shape[0] * spacing)
    field = np.asarray(Image.fromarray(coarse).resize(size, Image.Resampling.BICUBIC))[:HEIGHT, :WIDTH]
    return field / field.std()


def ragged(mask: NDArray[np.bool_], random: np.random.Generator) -> NDArray[np.bool_]:
    """A mask as a network draws it: its outline is off by 3 px (one standard deviation), 10 % of it is missing."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    from_u = np.clip(np.rint(u + 3.0 * smooth(random, 8)), 0, WIDTH - 1).astype(int)
    from_v = np.clip(np.rint(v + 3.0 * smooth(random, 8)), 0, HEIGHT - 1).astype(int)
    result = mask[from_v, from_u].copy()
    inside = np.argwhere(result)
    left = int(0.9 * len(inside))
    while result.sum() > left:
        row, column = inside[random.integers(len(inside))]
        result &= (v - row) ** 2 + (u - column) ** 2 > random.uniform(8, 30) ** 2
    return result


def direction(random: np.random.Generator) -> Matrix:
    d = random.normal(size=3)
    return d / np.linalg.norm(d)


@dataclass
class View:
    positions: dict[str, float]
    drawing: Drawing


def view(robot: Robot, camera: Matrix, random: np.random.Generator) -> View:
    """Positions in which nothing reaches under the table and most of the arm is in the image."""
    while True:
        positions = {name: float(random.uniform(*limits)) for name, limits in robot.ranges.items()}
        mesh = robot.posed(positions)
        if mesh.bounds[0][2] < -0.02:
            continue
        drawing = render(mesh, camera)
        seen = drawing.seen
        border = seen[:, 0].sum() + seen[:, -1].sum() + seen[0].sum() + seen[-1].sum()
        if seen.sum() > 8000 and border < 60:
            return View(positions, drawing)


def write(folder: Path, robot: Robot, seed: int, views: int, masks: list[str]) -> None:
    random = np.random.default_rng(seed)
    azimuth = random.uniform(-1.0, 1.0)
    place = random.uniform(1.3, 1.6) * np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
    place[2] = random.uniform(0.2, 1.0)
    camera = looking_at(place, np.array([0.05, 0.0, 0.35]) + random.normal(size=3) * 0.03)
    camera = camera @ rotation(np.array([0.0, 0.0, 1.0]), random.normal() * 0.1)
    start = camera @ rotation(direction(random), math.radians(15.0))
    start[:3, 3] = camera[:3, 3] + 0.1 * direction(random)
    for kind in [*masks, "depth"]:
        (folder / kind).mkdir(parents=True, exist_ok=True)
    rows = [["view", *robot.ranges]]
    for n in range(views):
        drawn = view(robot, camera, random)
        rows.append([str(n), *(repr(drawn.positions[name]) for name in robot.ranges)])
        depth = drawn.drawing.depth
        seen = drawn.drawing.seen
        noisy = depth + random.normal(size=depth.shape) * 0.002 * depth**2
        values = np.where(seen, np.clip(np.rint(noisy * 1000), 0, 65535), 0).astype(np.uint16)
        Image.fromarray(values).save(folder / "depth" / f"{n:02}.png")
        for kind in masks:
            mask = ragged(seen, np.random.default_rng([seed, n])) if kind == "ragged" else seen
            Image.fromarray(mask.astype(np.uint8) * 255).save(folder / kind / f"{n:02}.png")
    (folder / "joints.csv").write_text("".join(",".join(row) + "\n" for row in rows))
    roll, pitch, yaw = trimesh.transformations.euler_from_matrix(start, axes="sxyz")
    truth = {
        "camera": camera.tolist(),
        "start": " ".join(repr(float(v)) for v in (*start[:3, 3], roll, pitch, yaw)),
        "urdf": str(robot.urdf),
        "intrinsics": f"{FOCAL},{FOCAL},{(WIDTH - 1) / 2},{(HEIGHT - 1) / 2},{WIDTH},{HEIGHT}",
    }
    (folder / "truth.json").write_text(json.dumps(truth))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--robot", choices=MODELS, required=True)
    parser.add_argument("--seed", type=int, nargs="+", required=True, help="several: a folder each")
    parser.add_argument("--views", type=int, default=8)
    parser.add_argument("--masks", nargs="+", choices=("clean", "ragged"), default=["clean", "ragged"])
    args = parser.parse_args()
    robot = Robot(args.robot)
    for seed in args.seed:
        write(args.folder / str(seed), robot, seed, args.views, args.masks)


if __name__ == "__main__":
    main()
