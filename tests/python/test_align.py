"""Cameras beside robots, found from masks that were not drawn by depthrig."""

from __future__ import annotations

import json
import math
import subprocess
import tomllib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from test_calibrate_mount import of_quaternion
from test_daemon import binary, command, environment, runtime

__all__ = ["binary", "runtime"]

WIDTH, HEIGHT, FOCAL = 320, 240, 300.0
# Half the sides of each link's box and its middle, metres, in the link's frame.
BOXES = [((0.10, 0.12, 0.08), (0, 0, 0.08)), ((0.05, 0.06, 0.18), (0, 0, 0.18)), ((0.04, 0.05, 0.15), (0.01, 0, 0.15)), ((0.03, 0.07, 0.05), (0, 0.01, 0.05))]
HEIGHTS = [0.16, 0.36, 0.30]
AXES = [(0.0, 0.6, 0.8), (0.0, 1.0, 0.0), (0.8, 0.6, 0.0)]
LENS = f"{FOCAL},{FOCAL},{(WIDTH - 1) / 2},{(HEIGHT - 1) / 2},{WIDTH},{HEIGHT}"


def rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    """Rodrigues' formula."""
    x, y, z = axis / np.linalg.norm(axis)
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(angle) * k + (1 - math.cos(angle)) * k @ k


def rpy(r: np.ndarray) -> list[float]:
    """Roll, pitch and yaw of a rotation about fixed axes, radians."""
    return [math.atan2(r[2, 1], r[2, 2]), math.asin(-np.clip(r[2, 0], -1, 1)), math.atan2(r[1, 0], r[0, 0])]


def direction(rng: np.random.Generator) -> np.ndarray:
    """A direction, all equally likely."""
    v = rng.normal(size=3)
    return v / np.linalg.norm(v)


def camera(rng: np.random.Generator) -> np.ndarray:
    """A camera that looks at an arm from 1.1 to 1.5 m, optical axes."""
    azimuth, elevation, away = rng.uniform(-math.pi, math.pi), rng.uniform(0.1, 0.7), rng.uniform(1.1, 1.5)
    target = np.array([0.0, 0.0, 0.35]) + rng.uniform(-0.08, 0.08, 3)
    forward = -np.array([math.cos(azimuth) * math.cos(elevation), math.sin(azimuth) * math.cos(elevation), math.sin(elevation)])
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([right, np.cross(forward, right), forward]) @ rotation(np.array([0, 0, 1.0]), rng.uniform(-0.2, 0.2))
    pose[:3, 3] = target - forward * away
    return pose


def moved(pose: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A pose off by as much as a start may be."""
    start = pose.copy()
    start[:3, :3] = rotation(direction(rng), math.radians(15)) @ pose[:3, :3]
    start[:3, 3] += direction(rng) * 0.1
    return start


def start_argument(start: np.ndarray) -> str:
    """`--start`."""
    return " ".join(f"{v:.9f}" for v in [*start[:3, 3], *rpy(start[:3, :3])])


def distance(found: dict, pose: np.ndarray) -> tuple[float, float]:
    """Millimetres and degrees between a result and the truth."""
    r = of_quaternion(found["camera"]["rotation_xyzw"])
    mm = 1e3 * float(np.linalg.norm(np.array(found["camera"]["translation_m"]) - pose[:3, 3]))
    cosine = (np.trace(r.T @ pose[:3, :3]) - 1) / 2
    return mm, math.degrees(math.acos(min(1.0, max(-1.0, cosine))))


def stl(half: tuple[float, ...], middle: tuple[float, ...]) -> bytes:
    """A box as a binary STL."""
    triangles = []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        for side in (-1, 1):
            corners = np.zeros((4, 3))
            corners[:, axis] = side
            corners[:, u] = [-1, 1, 1, -1]
            corners[:, v] = [-1, -1, 1, 1]
            corners = corners * half + middle
            triangles += [corners[[0, 1, 2]], corners[[0, 2, 3]]]
    data = np.zeros(len(triangles), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    data["corners"] = triangles
    return bytes(80) + np.uint32(len(triangles)).tobytes() + data.tobytes()


def write_robot(folder: Path) -> Path:
    """A URDF of two boxes as such and two as meshes."""
    links, joints = [], []
    (folder / "meshes").mkdir()
    for i, (half, middle) in enumerate(BOXES):
        if i % 2:
            (folder / "meshes" / f"link{i}.stl").write_bytes(stl(half, middle))
            visual = f'<visual><geometry><mesh filename="package://boxes/meshes/link{i}.stl"/></geometry></visual>'
        else:
            size = " ".join(str(2 * h) for h in half)
            visual = f'<visual><origin xyz="{" ".join(map(str, middle))}"/><geometry><box size="{size}"/></geometry></visual>'
        links.append(f'<link name="link{i}">{visual}</link>')
    for i, (z, axis) in enumerate(zip(HEIGHTS, AXES, strict=True)):
        joints.append(
            f'<joint name="joint{i}" type="revolute"><parent link="link{i}"/><child link="link{i + 1}"/><origin xyz="0 0 {z}"/>'
            f'<axis xyz="{" ".join(map(str, axis))}"/><limit lower="-2" upper="2" effort="1" velocity="1"/></joint>'
        )
    urdf = folder / "boxes.urdf"
    urdf.write_text(f'<robot name="boxes">{"".join(links)}{"".join(joints)}</robot>')
    return urdf


def look(positions: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Depth by rays against boxes, 0 where there is none."""
    x, y = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    rays = np.stack([(x - (WIDTH - 1) / 2) / FOCAL, (y - (HEIGHT - 1) / 2) / FOCAL, np.ones_like(x, float)], -1).reshape(-1, 3)
    depth = np.full(len(rays), np.inf)
    link = np.eye(4)
    for i, (half, middle) in enumerate(BOXES):
        if i:
            step = np.eye(4)
            step[:3, :3] = rotation(np.array(AXES[i - 1]), positions[i - 1])
            step[2, 3] = HEIGHTS[i - 1]
            link = link @ step
        from_base = np.linalg.inv(link) @ pose
        directions = rays @ from_base[:3, :3].T
        with np.errstate(divide="ignore"):
            a = (np.array(middle) - half - from_base[:3, 3]) / directions
            b = (np.array(middle) + half - from_base[:3, 3]) / directions
        enter, leave = np.minimum(a, b).max(1), np.maximum(a, b).min(1)
        depth = np.where((enter < leave) & (enter > 0), np.minimum(depth, enter), depth)
    return np.where(np.isfinite(depth), depth, 0).reshape(HEIGHT, WIDTH)


class Case:
    """Views of the boxes on disk."""

    def __init__(self, folder: Path) -> None:
        rng = np.random.default_rng(4)
        self.folder = folder
        self.urdf = write_robot(folder)
        self.pose = camera(rng)
        self.start = moved(self.pose, rng)
        for name in ("masks", "depth"):
            (folder / name).mkdir()
        rows = ["view,joint2,joint0,joint1"]
        for view in range(1, 7):
            positions = rng.uniform(-1.3, 1.3, 3)
            depth = look(positions, self.pose)
            Image.fromarray(((depth > 0) * 255).astype(np.uint8)).save(folder / "masks" / f"mask_{view:02}.png")
            Image.fromarray(np.round(depth * 1e3).astype(np.uint16)).save(folder / "depth" / f"depth_{view:02}.png")
            rows.append(f"{view},{positions[2]},{positions[0]},{positions[1]}")
        self.joints = folder / "joints.csv"
        self.joints.write_text("\n".join(rows) + "\n")

    def arguments(self, *more: str) -> list[str]:
        fixed = ["calibrate", "align", "--urdf", str(self.urdf), "--joints", str(self.joints), "--masks", str(self.folder / "masks")]
        packages = ["--meshes", f"boxes={self.folder}", "--start", start_argument(self.start)]
        return [*fixed, *packages, *([] if "--intrinsics" in more else ["--intrinsics", LENS]), *more]


@pytest.fixture
def case(tmp_path: Path) -> Case:
    return Case(tmp_path)


def test_a_camera_beside_boxes_is_found(binary: str, runtime: Path, case: Case) -> None:
    out = case.folder / "front.toml"
    overlay = case.folder / "overlay"
    arguments = case.arguments("-o", str(out), "--overlay", str(overlay), "--json")
    found = json.loads(command(binary, runtime, *arguments))
    mm, deg = distance(found, case.pose)
    assert mm < 3.0 and deg < 0.3, (mm, deg)
    assert mm < 3 * found["sigma_mm"] and deg < 3 * found["sigma_deg"]
    assert found["camera_in"] == "base" and len(found["views"]) == 6
    assert found["moved_mm"] == pytest.approx(100, abs=4) and found["moved_deg"] == pytest.approx(15, abs=0.5)
    assert tomllib.loads(out.read_text())["camera"] == found["camera"]
    images = sorted(overlay.iterdir())
    assert [p.name for p in images] == [f"{i}.png" for i in range(1, 7)]
    # Nearly all of it is mask and arm, or neither.
    pixels = np.asarray(Image.open(images[0]).convert("RGB")).astype(int)
    assert (np.ptp(pixels, axis=2) > 0).mean() < 0.01 < (pixels.min(2) > 0).mean()
    # Nothing is written twice, and a run that is refused changes nothing.
    before = out.read_bytes()
    assert command(binary, runtime, *arguments, codes=(2,)) == ""
    assert out.read_bytes() == before
    assert "overlap" in command(binary, runtime, *case.arguments())


def test_depth_helps(binary: str, runtime: Path, case: Case) -> None:
    without = json.loads(command(binary, runtime, *case.arguments("--json")))
    found = json.loads(command(binary, runtime, *case.arguments("--json", "--depth", str(case.folder / "depth"))))
    mm, deg = distance(found, case.pose)
    assert mm < 2.0 and deg < 0.2, (mm, deg)
    assert found["depth_mm"] < 1.0 and "depth_mm" not in without
    # A view without depth is used by its mask, and named.
    (case.folder / "depth" / "depth_03.png").unlink()
    partly = json.loads(command(binary, runtime, *case.arguments("--json", "--depth", str(case.folder / "depth")), codes=(3,)))
    assert partly["left_out"] == ["view 3: has no depth, its mask is used"] and len(partly["views"]) == 6


def change_degrees(case: Case) -> list[str]:
    lines = case.joints.read_text().splitlines()
    rows = [[line.split(",")[0], *(str(math.degrees(float(v))) for v in line.split(",")[1:])] for line in lines[1:]]
    case.joints.write_text("\n".join([lines[0], *(",".join(r) for r in rows)]))
    return []


def change_name(case: Case) -> list[str]:
    case.joints.write_text(case.joints.read_text().replace("joint2", "elbow"))
    return []


def change_column(case: Case) -> list[str]:
    rows = [line.rsplit(",", 1)[0] for line in case.joints.read_text().splitlines()]
    case.joints.write_text("\n".join(rows))
    return []


def change_size(case: Case) -> list[str]:
    return ["--intrinsics", "600,600,319.5,239.5,640,480"]


def change_empty(case: Case) -> list[str]:
    Image.fromarray(np.zeros((HEIGHT, WIDTH), np.uint8)).save(case.folder / "masks" / "mask_03.png")
    return []


def change_mesh(case: Case) -> list[str]:
    (case.folder / "meshes" / "link3.stl").unlink()
    return []


def change_few(case: Case) -> list[str]:
    for view in range(3, 7):
        (case.folder / "masks" / f"mask_{view:02}.png").unlink()
    return []


def change_still(case: Case) -> list[str]:
    lines = case.joints.read_text().splitlines()
    same = lines[1].split(",", 1)[1]
    case.joints.write_text("\n".join([lines[0], *(f"{i},{same}" for i in range(1, 7))]))
    return []


def change_order(case: Case) -> list[str]:
    for view in range(1, 7):
        (case.folder / "masks" / f"mask_{view:02}.png").rename(case.folder / "masks" / f"new_{(view + 2) % 6 + 1:02}.png")
    return []


def change_start(case: Case) -> list[str]:
    turned = case.start.copy()
    turned[:3, :3] = turned[:3, :3] @ rotation(np.array([0, 1.0, 0]), math.pi)
    case.start = turned
    return []


def change_depth(case: Case) -> list[str]:
    return ["--depth", str(case.folder / "masks")]


def change_damaged(case: Case) -> list[str]:
    (case.folder / "meshes" / "link1.stl").write_bytes(b"solid nothing")
    return []


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (change_degrees, "positions are radians, these look like degrees"),
        (change_name, "the robot has no moving joint elbow; its joints are joint0, joint1, joint2"),
        (change_column, "the header has no column joint1; add it, or"),
        (change_size, "the mask is 320x240, the intrinsics are for 640x480"),
        (change_empty, "view 3: the mask has 0 pixels of the arm"),
        (change_mesh, "the mesh package://boxes/meshes/link3.stl was not found"),
        (change_few, "2 views of the arm; alignment needs 3"),
        (change_still, "the arm moves by 0 mm between the views"),
        (change_order, "each mask belongs to its joint positions"),
        (change_start, "the arm is behind the camera"),
        (change_depth, "is no depth image; depth is a grey PNG of 16 bits"),
        (change_damaged, "link1.stl: "),
    ],
)
def test_bad_input_is_refused(binary: str, runtime: Path, case: Case, change, message: str) -> None:
    out = case.folder / "front.toml"
    more = change(case)
    arguments = case.arguments("-o", str(out), *more)
    done = subprocess.run([binary, *arguments], env=environment(runtime), capture_output=True, text=True, check=False)
    assert done.returncode in (1, 2) and message in done.stderr, done.stderr
    assert not out.exists()
