"""Makes shards with raw depth from datasets without a sensor: `python -m depthrig.lab.make_shards CONFIG.toml OUT`.

`[synthesis]` says which sensor, and which noise models of a camera, trained with this package. Shards are independent
of each other: `--shard K/N` makes every N-th, a complete one is left as it is, and the result does not depend on N.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F

from .config import Config, read
from .data import Source, open_source
from .errors import LabError
from .losses import inverse
from .nets import NoiseConv, NoiseNet, load_weights, noise_net
from .nets.cdm import normalise_color
from .nets.vit import PATCH
from .progress import Bar, bar
from .record import fingerprint, keep
from .sample import Sample, check_licences
from .shards import ShardWriter, part_of, write_description
from .synthesis import synthesise

__all__ = ["main", "make"]

SIDE = 392
"""Shorter side of an image for the noise models with a ViT, pixels. `conv` gets images as they are."""


class NoiseModels:
    """The hole and the value model of a camera, each optional."""

    def __init__(self, config: Config):
        self.refined_input = config.model.refined_input
        self.value = self._open(config, config.synthesis.value)
        _check_measure(config)
        self.hole = self._open(config, config.synthesis.hole)

    @staticmethod
    def _open(config: Config, path: str | None) -> NoiseConv | NoiseNet | None:
        if path is None:
            return None
        net = noise_net(config.model)
        if missing := load_weights(net, Path(path)):
            raise LabError(f"{path}: no tensor {missing[0]}; it is of another network")
        return net.eval()

    def draw(self, sample: Sample) -> tuple[npt.NDArray[Any] | None, npt.NDArray[Any] | None]:
        """Return relative depth and the probability of a hole at the size of the image; None without the model."""
        color = sample.color
        if self.value is None and self.hole is None:
            return None, None
        height, width = color.shape[:2]
        size = [height, width]
        if not isinstance(self.value or self.hole, NoiseConv):
            scale = SIDE / min(height, width)
            size = [max(1, round(scale * side / PATCH)) * PATCH for side in size]
        x = torch.from_numpy(color.transpose(2, 0, 1).astype(np.float32))[None] / 255
        x = normalise_color(F.interpolate(x, size=size, mode="bilinear", align_corners=False, antialias=True))

        if self.refined_input:
            truth = inverse(torch.from_numpy(sample.need_truth()))[None, None]
            x = torch.cat([x, F.interpolate(truth, size=size, mode="nearest")], 1)

        def full(net: NoiseConv | NoiseNet) -> torch.Tensor:
            with torch.inference_mode():
                small = net(x)[:, None]
            return F.interpolate(small, size=(height, width), mode="bilinear", align_corners=False)[0, 0]

        value = full(self.value).numpy() if self.value is not None else None
        hole = full(self.hole).sigmoid().numpy() if self.hole is not None else None
        return value, hole


def _check_measure(config: Config) -> None:
    """Refuse a value model of the other kind of sensor: it says depth (ToF) or inverse depth (stereo).

    Known where the model lies in the folder of its run.
    """
    run = Path(config.synthesis.value).with_name("run.json") if config.synthesis.value else None
    if run is None or not run.is_file():
        return
    try:
        sensor = str(json.loads(run.read_text())["config"]["synthesis"]["sensor"])
    except (OSError, ValueError, KeyError, TypeError) as e:
        raise LabError(f"{run}: not the record of a run ({e})") from None
    if (sensor == "tof") != (config.synthesis.sensor == "tof"):
        raise LabError(
            f'{run}: the value model learned from sensor = "{sensor}", and these shards are of '
            f'sensor = "{config.synthesis.sensor}"; train one of that kind'
        )


def _usable(sample: Sample) -> bool:
    """Whether a shard can hold it: a pinhole camera and some truth."""
    return sample.intrinsics is not None and sample.truth is not None and bool(sample.truth.any())


def make(config: Config, out: Path, part: tuple[int, int] = (0, 1), per_shard: int = 1000) -> int:
    """Write the shards of one part; returns how many samples were left out (no pinhole camera, or no truth).

    :raises LabError: when data or models cannot be used.
    """
    if config.synthesis.sensor == "none":
        raise LabError('no sensor to make raw depth of; set sensor = "stereo" or "tof" under [synthesis]')
    sources = [open_source(d) for d in config.data]
    check_licences({f"{s.data.kind} {s.root}": s.licence for s in sources}, config.ships)
    if len(licences := sorted({s.licence.name for s in sources})) > 1:
        raise LabError(f"shards have one licence, and these data have {', '.join(licences)}; make a folder of each")
    models = NoiseModels(config)
    out.mkdir(parents=True, exist_ok=True)
    _agree(config, out, sources, per_shard)
    total = sum(len(s) for s in sources)
    shards = {
        out / f"{config.name}-{shard:06d}.tar": range(shard * per_shard, min(total, (shard + 1) * per_shard))
        for shard in range(part[0], -(-total // per_shard), part[1])
    }
    left_out = 0
    with closing(bar(sum(map(len, shards.values())), "sample")) as progress:
        for path, numbers in shards.items():
            if path.exists():
                progress.update(len(numbers))
                continue
            with ShardWriter(path) as writer:
                left_out += _fill(writer, sources, numbers, config, models, progress)
    arguments = {"data": [d.path for d in config.data], "seed": config.seed, "sensor": config.synthesis.sensor}
    write_description(out, config.name, "lab", arguments, total)
    return left_out


def _agree(config: Config, out: Path, sources: Sequence[Source], per_shard: int) -> None:
    """Write into the folder what its shards are made of, or refuse one that holds others. Paths do not count."""
    synthesis = dataclasses.replace(config.synthesis, value=None, hole=None)
    model = dataclasses.replace(config.model, weights=None)
    made_by = {"synthesis": dataclasses.asdict(synthesis), "model": dataclasses.asdict(model)}
    data = {f"{i} {s.data.kind}": fingerprint(s.files(), s.root) for i, s in enumerate(sources)}
    for what, path in (("value", config.synthesis.value), ("hole", config.synthesis.hole)):
        if path is not None:
            data[what] = fingerprint([Path(path)], Path(path).parent)
    keep(out, {"name": config.name, "seed": config.seed, "per shard": per_shard, **made_by}, data)


def _fill(
    writer: ShardWriter, sources: Sequence[Source], numbers: range, config: Config, models: NoiseModels, progress: Bar
) -> int:
    facts = {"sensor": config.synthesis.sensor, "sensor_model": config.synthesis.sensor, "seed": config.seed}
    left_out = 0
    for number in numbers:
        at = number
        source = sources[0]
        for source in sources:
            if at < len(source):
                break
            at -= len(source)
        sample = source[at]
        progress.update()
        if not _usable(sample):
            left_out += 1
            continue
        rng = np.random.default_rng([config.seed, 4, number])
        value, hole = models.draw(sample)
        raw = synthesise(sample.need_truth(), config.synthesis, rng, value, hole)
        made = Sample(sample.name, sample.color, sample.licence, raw, sample.truth, sample.intrinsics, sample.material)
        writer.write(number, made, {**facts, "families": [], "scene": "room"})
    return left_out


def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns 0, or 1 with a message."""
    description = "Make shards with raw depth"
    parser = argparse.ArgumentParser(prog="python -m depthrig.lab.make_shards", description=description)
    parser.add_argument("config", metavar="CONFIG.toml", help="datasets and sensor")
    parser.add_argument("out", metavar="OUT", type=Path, help="folder for the shards")
    of_shards = "every N-th shard from the K-th on [default: 0/1]"
    parser.add_argument("--shard", metavar="K/N", default="0/1", help=of_shards)
    parser.add_argument("--per-shard", metavar="COUNT", type=int, default=1000, help="samples in each [default: 1000]")
    parsed = parser.parse_args(arguments)
    torch.set_num_threads(1)
    try:
        if parsed.per_shard < 1:
            raise LabError(f"--per-shard {parsed.per_shard} is out of range 1..")
        left_out = make(read(parsed.config), parsed.out, part_of(parsed.shard), parsed.per_shard)
    except LabError as e:
        print(f"error: {e}", file=sys.stderr)
        return 1
    print(f"complete: {parsed.out}; {left_out} samples left out, which have no pinhole camera or no truth")
    return 0


if __name__ == "__main__":
    sys.exit(main())
