"""Measures a hole model: `python -m depthrig.lab.hole_iou CONFIG.toml [--again FOLDER...]`.

CONFIG is that of its training (`depthrig.lab.train`). The measure is the intersection over union of predicted and
measured holes, of all pixels together that the sensor can see. Every predictor gives a score for each pixel, and its
threshold is the best one on training data; the held-out data of `[[check]]` have no part in it.

Beside the model are predictors that need no training. With further measurements of the held-out worlds (`depthrig
scenes --again 1`, and so on) the table says how well holes can be known at all: `other measurements` takes the share of
the other ones that have a hole, and its threshold is the best one on the held-out data themselves.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from .batches import seen_of
from .config import Config, DataConfig, read
from .data import Source, open_source
from .errors import LabError
from .nets import load_weights, noise_net
from .nets.cdm import normalise_color
from .nets.vit import PATCH
from .record import write_atomically
from .sample import Sample

__all__ = ["Counts", "main", "measure", "shadow"]

BINS = 256
TRAINED_ON = 200
"""Samples of the training data by which thresholds are chosen and which the mean map is of."""

Scores = npt.NDArray[np.float32]


@dataclass
class Counts:
    """Pixels by score, of each image: with a hole and without."""

    images: list[npt.NDArray[np.int64]] = field(default_factory=list)

    def add(self, score: npt.NDArray[Any], hole: npt.NDArray[np.bool_], seen: npt.NDArray[np.bool_]) -> None:
        """Count one image; scores are 0 to 1."""
        level = np.clip((score * BINS).astype(np.int64), 0, BINS - 1)
        counts = [np.bincount(level[seen & (hole == is_hole)], minlength=BINS) for is_hole in (False, True)]
        self.images.append(np.stack(counts))

    def iou(self) -> npt.NDArray[np.float64]:
        """Return the intersection over union of all images for each threshold, `n / BINS` and above."""
        return _iou(np.sum(self.images, 0))

    def best(self) -> int:
        """Return the threshold with the best of them."""
        return int(np.nanargmax(self.iou()))

    def at(self, threshold: int) -> dict[str, float]:
        """Return the measures at a threshold: of all pixels, and the mean over images that have a hole."""
        total = np.sum(self.images, 0)
        with_hole = [_iou(i)[threshold] for i in self.images if i[1].any()]
        hit, said = total[1, threshold:].sum(), total[:, threshold:].sum()
        return {
            "iou": float(_iou(total)[threshold]),
            "image_iou": float(np.mean(with_hole)) if with_hole else float("nan"),
            "precision": float(hit / said) if said else 0.0,
            "recall": float(hit / max(total[1].sum(), 1)),
            "threshold": threshold / BINS,
        }


def _iou(counts: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
    above = np.cumsum(counts[:, ::-1], 1)[:, ::-1]
    return above[1] / np.maximum(above[0] + counts[1].sum(), 1)


def shadow(truth: npt.NDArray[np.float32], focal_baseline: float) -> npt.NDArray[np.bool_]:
    """Return what the right camera does not see, because something nearer hides it.

    :param truth: metres in the view of the left camera, 0 where unknown.
    :param focal_baseline: focal length times baseline, pixels times metres.
    """
    x = np.arange(truth.shape[1], dtype=np.float64)
    at = np.where(truth > 0, x - focal_baseline / np.where(truth > 0, truth, 1), np.inf)
    # Seen are those that lie left of all that begin right of them.
    least = np.minimum.accumulate(at[:, ::-1], 1)[:, ::-1]
    hidden = np.zeros(truth.shape, bool)
    hidden[:, :-1] = np.isfinite(at[:, :-1]) & (least[:, 1:] <= at[:, :-1])
    return hidden


def model_score(config: Config) -> Callable[[Sample], Scores]:
    """Return the trained model as a predictor.

    :raises LabError: when it is not there.
    """
    path = Path(config.folder) / "model.pt"
    if not path.exists():
        raise LabError(f"{path}: no such file; train first: python -m depthrig.lab.train CONFIG.toml")
    net = noise_net(config.model)
    load_weights(net, path)
    net.eval()

    def score(sample: Sample) -> Scores:
        height, width = sample.color.shape[:2]
        out = np.zeros((height, width), np.float32)
        if config.model.encoder != "conv":
            height, width = height // PATCH * PATCH, width // PATCH * PATCH
        color = np.ascontiguousarray(sample.color[:height, :width].transpose(2, 0, 1), np.float32) / 255
        with torch.inference_mode():
            out[:height, :width] = net(normalise_color(torch.from_numpy(color)[None]))[0].sigmoid().numpy()
        return out

    return score


def mean_map(samples: Sequence[Sample]) -> Scores:
    """Return the share of the images that have a hole at a pixel, of those whose sensor can see it."""
    holes: Any = 0
    seen_sum: Any = 0
    for sample in samples:
        hole, seen = _holes(sample)
        holes, seen_sum = holes + (hole & seen), seen_sum + seen.astype(np.int64)
    return np.asarray(holes / np.maximum(seen_sum, 1), np.float32)


def _holes(sample: Sample) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
    if sample.raw is None:
        raise LabError(f"{sample.name}: no raw depth")
    return sample.raw <= 0, seen_of(sample.raw)


def _some(source: Source, most: int) -> list[Sample]:
    return [source[int(i)] for i in np.linspace(0, len(source) - 1, min(most, len(source))).astype(int)]


def measure(config: Config, again: Sequence[Source] = ()) -> dict[str, Any]:
    """Return the measures of each predictor.

    :param again: further measurements of the worlds of the first held-out dataset.
    """
    if config.model.kind != "hole":
        raise LabError(f'model.kind = "{config.model.kind}"; this measures hole models')
    if not config.check:
        raise LabError("no [[check]]: held-out data are needed")
    trained, held_out = open_source(config.data[0]), open_source(config.check[0])
    known = _some(trained, TRAINED_ON)
    seen_map = mean_map(known)
    learned = model_score(config)
    fb = config.synthesis.focal_baseline

    def left(sample: Sample) -> Scores:
        height, width = sample.color.shape[:2]
        return np.tile(1 - np.arange(width, dtype=np.float32) / width, (height, 1))

    predictors: dict[str, Callable[[Sample], npt.NDArray[Any]]] = {
        "the model": learned,
        "everything": lambda s: np.ones(s.color.shape[:2], np.float32),
        "columns at the left": left,
        "mean map of the training data": lambda s: seen_map,
        "occlusion of the true depth": lambda s: shadow(s.need_truth(), fb * s.color.shape[1] / 640),
    }
    train_counts, counts = ({name: Counts() for name in predictors} for _ in range(2))
    for sample in known:
        hole, seen = _holes(sample)
        for name, predictor in predictors.items():
            train_counts[name].add(predictor(sample), hole, seen)
    share: list[float] = []
    for sample in _some(held_out, len(held_out)):
        hole, seen = _holes(sample)
        share.append(float(hole[seen].mean()) if seen.any() else 0.0)
        for name, predictor in predictors.items():
            counts[name].add(predictor(sample), hole, seen)
    found = {}
    for name in predictors:
        threshold = train_counts[name].best()
        found[name] = counts[name].at(threshold) | {"train_iou": float(train_counts[name].iou()[threshold])}
    if again:
        found |= _known(held_out, again)
    return {"images": len(held_out), "holes": float(np.mean(share)), "found": found}


def _known(held_out: Source, again: Sequence[Source]) -> dict[str, dict[str, float]]:
    """How well other measurements of the same world foretell one."""
    one, rest = Counts(), Counts()
    for source in again:
        if len(source) != len(held_out):
            raise LabError(f"{source.root}: {len(source)} samples, the held-out data have {len(held_out)}")
    for i in range(len(held_out)):
        sample = held_out[i]
        hole, seen = _holes(sample)
        others = [s[i] for s in again]
        if not all(np.array_equal(o.color, sample.color) for o in others):
            raise LabError(f"{sample.name}: another measurement has another colour image; use the same seed and sizes")
        masks = np.stack([_holes(o)[0] for o in others])
        one.add(masks[0].astype(np.float32), hole, seen)
        rest.add(masks.mean(0), hole, seen)
    return {
        "one other measurement": one.at(BINS // 2),
        f"{len(again)} other measurements": rest.at(1 + int(np.nanargmax(rest.iou()[1:]))),
    }


def table(found: dict[str, Any]) -> str:
    """Return the measures as a table in Markdown."""
    lines = ["| predictor | IoU | mean of images | precision | recall |", "|---|---|---|---|---|"]
    for name, m in found["found"].items():
        numbers = " | ".join(f"{m[k]:.3f}" for k in ("iou", "image_iou", "precision", "recall"))
        lines.append(f"| {name} | {numbers} |")
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns 0, or 1 with a message."""
    parser = argparse.ArgumentParser(prog="python -m depthrig.lab.hole_iou", description="Measure a hole model")
    parser.add_argument("config", metavar="CONFIG.toml", help="configuration of its training")
    text = "further measurements of the held-out worlds, as shards"
    parser.add_argument("--again", metavar="FOLDER", type=Path, nargs="+", default=[], help=text)
    parsed = parser.parse_args(arguments)
    torch.set_num_threads(1)
    try:
        config = read(parsed.config)
        again = [open_source(DataConfig("shards", str(folder))) for folder in parsed.again]
        found = measure(config, again)
        text = json.dumps(found, indent=1)
        write_atomically(Path(config.folder) / "iou.json", (text + "\n").encode())
    except LabError as e:
        print(f"error: {e}", file=sys.stderr)
        return 1
    print(f"{found['images']} images, {100 * found['holes']:.1f} % holes\n\n{table(found)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
