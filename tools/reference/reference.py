#!/usr/bin/env python3
"""Renders worlds of `depthrig scenes --worlds` with a path tracer that is not ours, and says what ours lacks.

    depthrig scenes --seed 11 --count 8 --size 320x240 --worlds WORLDS
    .venv-reference/bin/python tools/reference/reference.py WORLDS OUT [--spp 8]

True depth is checked with one ray of Mitsuba through the centre of each pixel, against meshes. Colour is path traced with
refraction, interreflection and soft shadows, and light comes from the lamps alone: the light from all around, which our
caster has instead of interreflection, is left out, and one gain for each image makes their brightness the same. OUT gets
an image of each world, `reference.json` and `sheet.jpg`. A world that is there is left alone.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from PIL import Image

mi.set_variant("scalar_rgb")

MATERIALS = ("nothing", "diffuse", "glossy", "metal", "glass", "dark")
DEPTH = 12
"""Longest path, in segments: through a cup of glass and back."""
MARGIN = 1.1
"""The path tracer's image is so much larger than the camera's, and has twice its pixels."""
# Microfacets about as wide as the highlights of our caster (exponents 70 and 180).
GLOSSY_ALPHA, METAL_ALPHA = 0.16, 0.1
GLASS_IOR = 1.5
WINDOW = 5
"""Colour is compared in means over so many pixels, squared."""


def bsdf(part: dict[str, Any], color: Any) -> dict[str, Any]:
    """Return Mitsuba's description of a part's material."""
    body = {"type": "mesh_attribute", "name": "vertex_color"}
    surface = part["surface"]
    if surface == "glass":
        # Light passes two surfaces.
        tint = {"type": "rgb", "value": [float(math.sqrt(c)) for c in color]}
        return {"type": "dielectric", "int_ior": GLASS_IOR, "specular_transmittance": tint}
    if surface == "mirror":
        return {"type": "conductor", "material": "none", "specular_reflectance": {"type": "rgb", "value": 0.87}}
    if surface == "metal":
        metal = {"type": "roughconductor", "material": "none", "alpha": METAL_ALPHA, "specular_reflectance": body}
        return {"type": "twosided", "bsdf": metal}
    if surface == "glossy":
        varnished = {"type": "principled", "base_color": body, "roughness": math.sqrt(GLOSSY_ALPHA), "specular": 0.5}
        return {"type": "twosided", "bsdf": varnished}
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": body}}


def first_color(path: Path) -> Any:
    """Return the colour of the first corner of a PLY file."""
    data = path.read_bytes()
    start = data.index(b"end_header\n") + len(b"end_header\n")
    return np.frombuffer(data, "<f4", 9, start)[6:]


def scene_of(folder: Path, world: dict[str, Any], lamps: bool) -> Any:
    """Return the scene, with or without its lamps."""
    scene: dict[str, Any] = {"type": "scene"}
    for i, part in enumerate(world["parts"]):
        path = folder / part["file"]
        scene[f"part{i:04d}"] = {
            "type": "ply",
            "filename": str(path),
            "bsdf": bsdf(part, first_color(path)),
            "id": f"part{i:04d}",
        }
    for i, lamp in enumerate(world["lamps"] if lamps else []):
        # Our lamps give a white surface that faces them the brightness power / distance².
        radiance = [lamp["power"] * c / lamp["radius"] ** 2 for c in lamp["color"]]
        scene[f"lamp{i}"] = {
            "type": "sphere",
            "center": lamp["center"],
            "radius": lamp["radius"],
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": radiance}},
        }
    return mi.load_dict(scene)


class Camera:
    """The colour camera: x to the right, y down, z ahead."""

    def __init__(self, world: dict[str, Any]):
        k = world["intrinsics"]
        if any(k["coeffs"]):
            raise SystemExit("a lens with distortion cannot be rendered; use --camera d435")
        self.fx, self.fy, self.cx, self.cy = (float(k[n]) for n in ("fx", "fy", "cx", "cy"))
        self.width, self.height = world["width"], world["height"]
        columns = np.array(world["camera"], np.float64)
        self.axes, self.place = columns[:3].T, columns[3]

    def rays(self, dx: float = 0.0, dy: float = 0.0) -> Any:
        """Return directions with z = 1 in the camera's frame, `(height, width, 3)`, off by part of a pixel."""
        y, x = np.mgrid[: self.height, : self.width].astype(np.float64)
        return np.stack([(x + dx - self.cx) / self.fx, (y + dy - self.cy) / self.fy, np.ones_like(x)], -1)


def cast(scene: Any, camera: Camera) -> tuple[Any, Any]:
    """Return depth along the optical axis and the number of the part of each pixel; -1 where there is none."""
    rays = camera.rays()
    directions = rays @ camera.axes.T
    lengths = np.linalg.norm(directions, axis=-1)
    depth = np.zeros(rays.shape[:2])
    part = np.full(rays.shape[:2], -1)
    origin = mi.Point3f(*camera.place.tolist())
    for y, x in np.ndindex(*depth.shape):
        direction = directions[y, x] / lengths[y, x]
        hit = scene.ray_intersect_preliminary(mi.Ray3f(origin, mi.Vector3f(*direction.tolist())))
        if hit.is_valid():
            depth[y, x] = hit.t / lengths[y, x]
            part[y, x] = int(hit.shape.id()[4:])
    return depth, part


def render(scene: Any, camera: Camera, spp: int, seed: int) -> Any:
    """Return linear RGB of the camera, from an image with twice its pixels."""
    width, height = (2 * math.ceil(MARGIN * side) for side in (camera.width, camera.height))
    focal = 2 * camera.fx
    to_world = np.eye(4)
    # Mitsuba's x points to the left and its y up.
    to_world[:3, :3] = camera.axes @ np.diag([-1.0, -1.0, 1.0])
    to_world[:3, 3] = camera.place
    sensor = mi.load_dict(
        {
            "type": "perspective",
            "fov_axis": "x",
            "fov": math.degrees(2 * math.atan(width / 2 / focal)),
            "near_clip": 0.01,
            "to_world": mi.ScalarTransform4f(to_world.tolist()),
            "film": {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}},
            "sampler": {"type": "independent", "sample_count": spp, "seed": seed},
        }
    )
    integrator = mi.load_dict({"type": "path", "max_depth": DEPTH, "hide_emitters": True})
    large = np.array(mi.render(scene, sensor=sensor, integrator=integrator, spp=spp, seed=seed))[..., :3]
    # Single paths that a lamp was met by chance outshine whole neighbourhoods.
    large = np.minimum(large, 8.0 * np.median(large[large > 0]))
    out = np.zeros((camera.height, camera.width, 3))
    for dx, dy in ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)):
        rays = camera.rays(dx, dy)
        x = width / 2 + focal * rays[..., 0] - 0.5
        y = height / 2 + focal * rays[..., 1] - 0.5
        x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
        u, v = (x - x0)[..., None], (y - y0)[..., None]
        out += (large[y0, x0] * (1 - u) + large[y0, x0 + 1] * u) * (1 - v)
        out += (large[y0 + 1, x0] * (1 - u) + large[y0 + 1, x0 + 1] * u) * v
    return out / 4


def calm(image: Any) -> Any:
    """Return the means over `WINDOW` squared pixels, in which the noise of few paths is small."""
    half = WINDOW // 2
    padded = np.pad(image, ((half, half), (half, half), (0, 0)), mode="edge")
    height, width = image.shape[:2]
    return sum(padded[y : y + height, x : x + width] for y in range(WINDOW) for x in range(WINDOW)) / WINDOW**2


def light_of(developed: Any, world: dict[str, Any]) -> Any:
    """Return the light that `develop` made an image of, with gain 1; 0 to 4."""
    levels = np.linspace(0, 1, 4096) ** 2 * 4
    factors = np.array(world["white"]) * world["exposure"]
    return np.interp(developed, _curve(levels), levels) / factors


def develop(light: Any, world: dict[str, Any], gain: float = 1.0) -> Any:
    """Return 0 to 1 of linear light: the tone curve of our caster (`color.rs`)."""
    return _curve(np.clip(light * np.array(world["white"]) * world["exposure"] * gain, 0, 4))


def _curve(x: Any) -> Any:
    film = (x * (2.51 * x + 0.03)) / (x * (2.43 * x + 0.59) + 0.14)
    return np.clip(np.where(film <= 0.0031308, 12.92 * film, 1.055 * np.maximum(film, 1e-9) ** (1 / 2.4) - 0.055), 0, 1)


def matched(light: Any, ours: Any, world: dict[str, Any]) -> float:
    """Return the gain with which developed light has the mean of `ours`."""
    low, high = 1e-3, 1e3
    for _ in range(40):
        gain = math.sqrt(low * high)
        if develop(light, world, gain).mean() < ours.mean():
            low = gain
        else:
            high = gain
    return gain


def edges(part: Any) -> Any:
    """Return the pixels that have another part within one pixel."""
    padded = np.pad(part, 1, mode="edge")
    height, width = part.shape
    around = [padded[y : y + height, x : x + width] for y in range(3) for x in range(3)]
    return np.any([a != part for a in around], 0)


def compare(folder: Path, out: Path, spp: int) -> dict[str, Any]:
    """Render a world, write its image, and return the numbers."""
    world = json.loads((folder / "world.json").read_text())
    camera = Camera(world)

    def image(name: str) -> Any:
        return np.array(Image.open(folder / name))

    truth, part = image("truth.png") * world["truth_unit_m"], image("part.png").astype(int)
    material, ours = image("material.png"), image("color.png") / 255
    depth, found = cast(scene_of(folder, world, lamps=False), camera)
    known = truth > 0
    same = known & (found == part)
    off = np.abs(depth - truth)[same]
    inner = known & ~edges(part)
    light = render(scene_of(folder, world, lamps=True), camera, spp, world["number"])
    ours = develop(calm(light_of(ours, world)), world)
    gain = matched(calm(light), ours, world)
    theirs = develop(calm(light), world, gain)
    apart = np.abs(theirs - ours).mean(-1)
    Image.fromarray((255 * develop(light, world, gain) + 0.5).astype(np.uint8)).save(out / f"{folder.name}.png")
    of = {}
    for number, name in enumerate(MATERIALS):
        chosen = material == number
        if chosen.any():
            signed = (theirs - ours)[chosen].mean()
            of[name] = {"pixels": int(chosen.sum()), "apart": float(apart[chosen].sum()), "signed": float(signed)}
    return {
        "pixels": int(known.sum()),
        "other_part": int((known & (found != part)).sum()),
        "other_part_off_edges": int((inner & (found != part)).sum()),
        "depth_m": {
            "median": float(np.median(off)),
            "p99": float(np.quantile(off, 0.99)),
            "max": float(off.max()),
            "within_unit": float((off <= world["truth_unit_m"]).mean()),
        },
        "off_m": np.histogram(off, [0, 5e-5, 1e-4, 2e-4, 5e-4, 1e-3, 1e-2, 10])[0].tolist(),
        "gain": gain,
        "materials": of,
    }


def sheet(folders: list[Path], out: Path) -> None:
    """Write `sheet.jpg`: ours, theirs, and their difference, two worlds in a row."""
    rows = []
    for folder in folders:
        pair = [np.array(Image.open(p).convert("RGB")) for p in (folder / "color.png", out / f"{folder.name}.png")]
        apart = np.clip(128 + (pair[1].astype(int) - pair[0]), 0, 255).astype(np.uint8)
        cell = Image.fromarray(np.concatenate([*pair, apart], 1))
        rows.append(np.array(cell.resize((cell.width * 2 // 3, cell.height * 2 // 3), Image.Resampling.LANCZOS)))
    if len(rows) % 2:
        rows.append(np.zeros_like(rows[0]))
    whole = np.concatenate([np.concatenate(rows[i : i + 2], 1) for i in range(0, len(rows), 2)], 0)
    Image.fromarray(whole).save(out / "sheet.jpg", quality=80)


def summary(found: dict[str, Any]) -> str:
    """Return the numbers of all worlds as tables in Markdown."""
    all_of = found.values()
    pixels = sum(f["pixels"] for f in all_of)
    histogram = np.sum([f["off_m"] for f in all_of], 0)
    shares = np.cumsum(histogram) / histogram.sum()
    lines = ["| depth differs by at most | pixels |", "|---|---|"]
    for limit, share in zip(("0.05 mm", "0.1 mm", "0.2 mm", "0.5 mm", "1 mm", "10 mm"), shares, strict=False):
        lines.append(f"| {limit} | {100 * share:.3f} % |")
    for key, name in (("other_part", "another part"), ("other_part_off_edges", "another part, not beside an edge")):
        lines.append(f"| {name} | {100 * sum(f[key] for f in all_of) / pixels:.3f} % |")
    lines += ["", "| material | pixels | mean difference of colour | theirs brighter by |", "|---|---|---|---|"]
    for name in MATERIALS:
        of = [f["materials"][name] for f in all_of if name in f["materials"]]
        if of:
            count = sum(m["pixels"] for m in of)
            apart = sum(m["apart"] for m in of) / count
            signed = sum(m["signed"] * m["pixels"] for m in of) / count
            lines.append(f"| {name} | {100 * count / pixels:.1f} % | {255 * apart:.1f} | {255 * signed:+.1f} |")
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description="Compare worlds with a path tracer")
    parser.add_argument("worlds", metavar="WORLDS", type=Path, help="folder of depthrig scenes --worlds")
    parser.add_argument("out", metavar="OUT", type=Path, help="folder for images and numbers")
    parser.add_argument("--spp", type=int, default=8, help="paths of each of four parts of a pixel [default: 8]")
    args = parser.parse_args()
    folders = sorted(p.parent for p in args.worlds.glob("*/world.json"))
    if not folders:
        print(f"error: {args.worlds}: no worlds; write them with depthrig scenes --worlds", file=sys.stderr)
        return 1
    args.out.mkdir(parents=True, exist_ok=True)
    path = args.out / "reference.json"
    found: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}
    for folder in folders:
        if folder.name not in found:
            found[folder.name] = compare(folder, args.out, args.spp)
            path.write_text(json.dumps(found, indent=1) + "\n")
            print(folder.name, json.dumps(found[folder.name]["depth_m"]), flush=True)
    sheet(folders, args.out)
    print(summary(found))
    return 0


if __name__ == "__main__":
    sys.exit(main())
