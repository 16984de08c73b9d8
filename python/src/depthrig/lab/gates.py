"""Whether `tiny` may be the default: measured against `fill` of the daemon on scenes and on real images.

`python -m depthrig.lab.gates MODEL.pt --held-out SHARDS --real DATA --depthrig PROGRAM --out gates.json`

Each gate has a name, a limit that stands here, and the number that was found. Errors are strict L1 of depth: a pixel
without a prediction counts as one of 0 m. Both refiners fill every hole (reach 1).
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from . import images
from .config import DataConfig
from .data import open_source
from .errors import LabError
from .fill import filled_of, inverse_of
from .holes import KINDS, region
from .nets import load_weights
from .nets.tiny import MULTIPLE, Tiny, tiny_inputs
from .record import write_atomically
from .sample import MATERIALS, Sample

__all__ = ["GATES", "Hidden", "Row", "held_out", "judge", "load_tiny", "main", "measure_all", "real", "refine"]

GATES = {
    "held-out families: less L1 than fill": 0.25,
    "real hidden regions: less L1 than fill": 0.05,
    "held-out images worse than fill": 0.20,
    "real images worse than fill": 0.20,
}
"""Limits: the first two are reached from there on, the last two below."""
NEAR_M, FAR_M = 0.1, 6.0
DRAWS = 8
"""Regions of each kind that are hidden in each real image."""
EDGE = 0.05
"""Neighbours that differ by this share of the depth are an edge."""
AROUND = 3
"""Pixels so far from an edge belong to it."""


@dataclass(frozen=True)
class Row:
    """Errors of `fill` and `tiny` over the pixels of one kind in one image: sums in metres."""

    pixels: int
    fill_m: float
    tiny_m: float

    def __add__(self, other: Row) -> Row:
        return Row(self.pixels + other.pixels, self.fill_m + other.fill_m, self.tiny_m + other.tiny_m)

    def line(self) -> dict[str, float]:
        """Return L1 of both, and how much less that of `tiny` is."""
        count = max(self.pixels, 1)
        less = 1 - self.tiny_m / self.fill_m if self.fill_m > 0 else 0.0
        return {"pixels": self.pixels, "fill": self.fill_m / count, "tiny": self.tiny_m / count, "less": less}


@dataclass(frozen=True)
class Hidden:
    """The result of one hidden region: the real image, the kind of region, its errors."""

    image: str
    kind: str
    row: Row


def load_tiny(path: Path, width: int) -> Tiny:
    """Return the network of a `model.pt`.

    :raises LabError: when it is of another network.
    """
    net = Tiny(width)
    if missing := load_weights(net, path):
        raise LabError(f"{path}: no tensor {missing[0]}; it is of another network")
    return net.eval()


def refine(
    net: Tiny, color: npt.NDArray[np.uint8], raw: npt.NDArray[np.float32], filled: npt.NDArray[np.float32]
) -> npt.NDArray[np.float32]:
    """Return refined depth of an image of any size, metres; 0 where `filled` is.

    As in the daemon, borders are repeated up to multiples of 16 and cut off again.

    :param color: `(height, width, 3)`, red first.
    :param raw: metres.
    :param filled: 1/m.
    """
    height, width = raw.shape
    pad = ((0, -height % MULTIPLE), (0, -width % MULTIPLE))
    planes = [np.pad(p, pad, mode="edge") for p in (inverse_of(raw), filled)]
    wide = np.pad(color, (*pad, (0, 0)), mode="edge").transpose(2, 0, 1).astype(np.float32) / 255
    q, f = (torch.from_numpy(np.ascontiguousarray(p, np.float32))[None] for p in planes)
    with torch.inference_mode():
        out = net(tiny_inputs(torch.from_numpy(wide)[None], f, q), f)[0, :height, :width].numpy()
    return inverse_of(np.where(filled > 0, out, 0)).astype(np.float32)


def compare(
    chosen: npt.NDArray[np.bool_], truth: npt.NDArray[Any], filled_m: npt.NDArray[Any], refined_m: npt.NDArray[Any]
) -> Row:
    """Return the errors over the chosen pixels that have a truth in range."""
    chosen = chosen & (truth >= NEAR_M) & (truth <= FAR_M)
    t = truth[chosen].astype(np.float64)
    errors = [float(np.abs(p[chosen] - t).sum()) for p in (filled_m, refined_m)]
    return Row(int(chosen.sum()), *errors)


def edges(truth: npt.NDArray[Any]) -> npt.NDArray[np.bool_]:
    """Return the pixels within `AROUND` of a step in depth."""
    near = np.zeros(truth.shape, bool)
    for axis in (0, 1):
        ahead, behind = (truth[1:], truth[:-1]) if axis == 0 else (truth[:, 1:], truth[:, :-1])
        step = (ahead > 0) & (behind > 0) & (abs(ahead - behind) > EDGE * np.minimum(ahead, behind))
        cut = (slice(1, None), slice(None))[:: 1 if axis == 0 else -1]
        near[cut] |= step
    for axis in (0, 1):
        grown = near.copy()
        for shift in range(1, AROUND + 1):
            grown |= np.roll(near, shift, axis) | np.roll(near, -shift, axis)
        near = grown
    return near


def _kinds(sample: Sample) -> Iterable[tuple[str, npt.NDArray[np.bool_]]]:
    truth, raw = sample.need_truth(), sample.raw
    assert raw is not None
    yield "all", np.ones(truth.shape, bool)
    yield "holes", raw <= 0
    yield "measured", raw > 0
    yield "edges", edges(truth)
    if sample.material is not None:
        for number, name in enumerate(MATERIALS):
            yield name, sample.material == number


def held_out(net: Tiny, folder: Path, most: int | None = None) -> list[dict[str, Row]]:
    """Return the errors of each image of shards by kind of pixel: `all`, `holes`, `measured`, `edges`, materials."""
    source = open_source(DataConfig("shards", str(folder)))
    count = min(len(source), most or len(source))
    found = []
    for i in np.linspace(0, len(source) - 1, count).astype(int):
        sample = source[int(i)]
        if sample.raw is None or sample.filled is None:
            raise LabError(f"{sample.name}: no filled depth; make these shards with this version of depthrig")
        filled = filled_of(sample, sample.raw)
        refined = refine(net, sample.color, sample.raw, filled)
        truth = sample.need_truth()
        found.append({kind: compare(at, truth, sample.filled, refined) for kind, at in _kinds(sample)})
    return found


@dataclass(frozen=True)
class Pair:
    """A real image."""

    name: str
    color: npt.NDArray[np.uint8]
    depth: npt.NDArray[np.uint16]
    unit_m: float


def pairs(folder: Path) -> list[Pair]:
    """Return the real images of the folder of test data (its README names them).

    :raises LabError: when none is there.
    """
    found = []
    of = [(p.parent, 1e-3) for p in sorted(folder.glob("lingbot_depth/*/raw_depth.png"))]
    for where, unit_m in of:
        color = images.color(next(p for p in (where / "rgb.png", where / "rgb.jpg") if p.exists()))
        found.append(Pair(f"lingbot_depth/{where.name}", color, images.grey(where / "raw_depth.png"), unit_m))
    close = folder / "cdm_d405"
    if close.is_dir():
        depth = images.grey(close / "depth_26.png")
        found.append(Pair("cdm_d405", images.color(close / "color_26.png"), depth, 1e-4))
    if not found:
        raise LabError(f"{folder}: no real images (lingbot_depth, cdm_d405)")
    return [dataclasses.replace(p, depth=np.where(p.depth == 65535, 0, p.depth).astype(np.uint16)) for p in found]


def fill_by_daemon(program: Path, pair: Pair, depth: npt.NDArray[np.uint16]) -> npt.NDArray[np.float32]:
    """Return inverse depth as `fill` of the daemon gives it, with reach 1.

    :raises LabError: when the program fails.
    """
    with tempfile.TemporaryDirectory() as folder:
        here = Path(folder)
        (here / "color.png").write_bytes(images.encode_png(pair.color))
        (here / "depth.png").write_bytes(images.encode_png(depth))
        command = [str(program), "cdm", "run", "--engine", "fill", "--fill-reach", "1", "--inverse", "--threads", "1"]
        command += ["--rgb", str(here / "color.png"), "--depth", str(here / "depth.png")]
        command += ["--depth-unit", str(pair.unit_m), "--out", str(here / "filled.npy")]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise LabError(f"{pair.name}: {program.name} cdm run failed: {done.stderr.strip()}")
        return np.load(here / "filled.npy").astype(np.float32)


def real(net: Tiny, of: Sequence[Pair], program: Path, draws: int) -> list[Hidden]:
    """Return the errors over measured pixels that were hidden, `draws` times for each image and kind of region.

    The regions of an image follow from its name's place in the list of draws alone.
    """
    found = []
    for pair in of:
        for at, kind in enumerate(KINDS):
            done = 0
            for draw in range(4 * draws):
                rng = np.random.default_rng([*pair.name.encode(), at, draw])
                hidden = region(kind, pair.depth.shape, rng) & (pair.depth > 0)
                # Nothing to compare with, or nothing to go by.
                if not 100 <= hidden.sum() <= 0.9 * (pair.depth > 0).sum():
                    continue
                left = np.where(hidden, 0, pair.depth).astype(np.uint16)
                filled = fill_by_daemon(program, pair, left)
                refined = refine(net, pair.color, (left * pair.unit_m).astype(np.float32), filled)
                truth = pair.depth * pair.unit_m
                found.append(Hidden(pair.name, kind, compare(hidden, truth, inverse_of(filled), refined)))
                done += 1
                if done == draws:
                    break
    return found


def _mean_line(rows: Sequence[Row]) -> dict[str, float]:
    """Return the mean of the images' L1, and the share of images in which `tiny` is worse."""
    lines = [r.line() for r in rows if r.pixels]
    fill, tiny = (float(np.mean([line[n] for line in lines])) for n in ("fill", "tiny"))
    worse = float(np.mean([line["tiny"] > line["fill"] for line in lines]))
    return {"images": len(lines), "fill": fill, "tiny": tiny, "less": 1 - tiny / fill, "worse": worse}


def measure_all(net: Tiny, shards: Path, folder: Path, program: Path, most: int | None = None) -> dict[str, Any]:
    """Return every number: by kind of pixel of the held-out scenes, by image and kind of region of the real ones."""
    scenes = held_out(net, shards, most)
    kinds = dict.fromkeys(kind for image in scenes for kind in image)
    regions = real(net, pairs(folder), program, DRAWS)
    images_of = dict.fromkeys(h.image for h in regions)
    by = {name: [h.row for h in regions if h.image == name] for name in images_of}
    by |= {kind: [h.row for h in regions if h.kind == kind] for kind in KINDS}
    return {
        "held-out": {k: sum((i[k] for i in scenes if k in i), Row(0, 0.0, 0.0)).line() for k in kinds},
        "held-out, mean of images": _mean_line([i["all"] for i in scenes]),
        "real, mean of regions": _mean_line([h.row for h in regions]),
        "real": {name: _mean_line(rows) for name, rows in by.items()},
    }


def judge(found: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Return each gate with its limit, the number found, and whether it is reached."""
    scenes, regions = found["held-out, mean of images"], found["real, mean of regions"]
    values = [scenes["less"], regions["less"], scenes["worse"], regions["worse"]]
    out = {}
    for (name, limit), value in zip(GATES.items(), values, strict=True):
        reached = value < limit if "worse" in name else value >= limit
        out[name] = {"limit": limit, "found": round(value, 4), "reached": bool(reached)}
    return out


def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns 0, 1 with a message, or 3 when a gate is not reached."""
    parser = argparse.ArgumentParser(prog="python -m depthrig.lab.gates", description="Measure tiny against fill")
    parser.add_argument("model", type=Path, metavar="MODEL.pt")
    parser.add_argument("--width", type=int, default=48, metavar="N", help="of the network [default: 48]")
    parser.add_argument("--held-out", type=Path, required=True, metavar="DIR", help="shards that training never saw")
    parser.add_argument("--real", type=Path, required=True, metavar="DIR", help="folder of real images")
    parser.add_argument("--depthrig", type=Path, required=True, metavar="FILE", help="the program, for fill")
    parser.add_argument("--most", type=int, metavar="N", help="held-out images to measure [default: all]")
    parser.add_argument("--out", type=Path, metavar="FILE")
    parsed = parser.parse_args(arguments)
    torch.set_num_threads(1)
    try:
        net = load_tiny(parsed.model, parsed.width)
        found = measure_all(net, parsed.held_out, parsed.real, parsed.depthrig, parsed.most)
    except LabError as e:
        print(f"error: {e}", file=sys.stderr)
        return 1
    gates = judge(found)
    text = json.dumps({"gates": gates, **found}, indent=1, ensure_ascii=False)
    print(text)
    if parsed.out:
        write_atomically(parsed.out, (text + "\n").encode())
    return 0 if all(g["reached"] for g in gates.values()) else 3


if __name__ == "__main__":
    sys.exit(main())
