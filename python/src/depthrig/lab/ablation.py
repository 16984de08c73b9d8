"""Trains small refiners on several kinds of raw depth and compares them: `python -m depthrig.lab.ablation CONFIG.toml`.

CONFIG is that of one training (`depthrig.lab.train`) of kind `tiny`. Its first `[[data]]` are worlds measured by physics,
the second ones the same worlds measured by statistics, and `[synthesis]` names a hole and a value model, which make raw
depth from the true depth of the first ones. Each of `VARIANTS` is trained with `--seeds` seeds, and measured on
`[[check]]`. Nothing but raw depth differs: the worlds, the order of the batches and the steps are the same, and holes are
filled by the pyramid of this package everywhere.

The folder gets the data and runs, `ablation.json` and `ablation.md`. A run that is complete is left alone, so the same
command goes on after an interruption, and processes with `--only` can share the work.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from .config import Config, DataConfig, ModelConfig, SynthesisConfig, read
from .data import open_source
from .errors import LabError
from .make_shards import make
from .metrics import measure, pooled
from .record import write_atomically
from .shards import ShardWriter
from .train import run

__all__ = ["VARIANTS", "main", "summary", "table"]

VARIANTS: dict[str, dict[str, Any] | int] = {
    "physics": 0,
    "statistical": 1,
    "synthetic": {},
    "no guided filter": {"filter": False},
    "no hole noise": {"hole": None},
    "no value noise": {"value": None},
}
"""Raw depth to train on: as a dataset has it (its number), or synthesised with these changes."""
BASE = "synthetic"
"""The variant that the others are compared with."""
NOISE_WIDTH = 16
"""Width of the noise models, of kind `conv`."""


def _plain(data: DataConfig, out: Path) -> DataConfig:
    """Copy a dataset without filled depth, so that all are filled alike."""
    path = out / "samples-000000.tar"
    if not path.exists():
        out.mkdir(parents=True, exist_ok=True)
        source = open_source(data)
        # Under a name of its own: another process may write the same bytes.
        own = out / f"{os.getpid()}.tar"
        with ShardWriter(own) as writer:
            for number in range(len(source)):
                sample = source[number]
                facts = {"sensor": "any", "sensor_model": "any", "seed": 0, "families": [], "scene": "any"}
                writer.write(number, dataclasses.replace(sample, filled=None), facts)
        own.replace(path)
    return DataConfig("shards", str(out))


def _synthesised(config: Config, changes: Mapping[str, Any], out: Path) -> DataConfig:
    synthesis = dataclasses.replace(config.synthesis, **changes)
    noise = ModelConfig(kind="hole", encoder="conv", width=NOISE_WIDTH)
    make(dataclasses.replace(config, name="samples", data=config.data[:1], model=noise, synthesis=synthesis), out)
    return DataConfig("shards", str(out))


def _check(config: Config) -> None:
    if config.model.kind != "tiny" or len(config.data) != 2 or len(config.check) != 1:
        raise LabError('an ablation needs kind = "tiny", two [[data]] (physics, statistical) and one [[check]]')
    if config.synthesis.hole is None or config.synthesis.value is None or config.synthesis.sensor == "none":
        raise LabError("an ablation needs sensor, hole and value under [synthesis]")


def run_all(config: Config, seeds: int, only: Sequence[str] = ()) -> dict[str, Any]:
    """Make the data, train what is not there yet; returns the L1 of each run and of raw and filled depth.

    :param only: variants to train; none is all.
    """
    if unknown := set(only) - set(VARIANTS):
        raise LabError(f"--only: {min(unknown)} is unknown; use {', '.join(VARIANTS)}")
    _check(config)
    folder = Path(config.folder)
    held_out = _plain(config.check[0], folder / "data" / "held-out")
    found: dict[str, Any] = {"variants": {}}
    for name, of in VARIANTS.items():
        if only and name not in only:
            continue
        slug = name.replace(" ", "-")
        out = folder / "data" / slug
        data = _plain(config.data[of], out) if isinstance(of, int) else _synthesised(config, of, out)
        for seed in range(config.seed, config.seed + seeds):
            where = folder / "runs" / f"{slug}-{seed}"
            if not (where / "metrics.json").exists():
                one = dataclasses.replace(config, name=slug, folder=str(where), data=(data,), check=(held_out,))
                run(dataclasses.replace(one, seed=seed, synthesis=SynthesisConfig()))
            metrics = json.loads((where / "metrics.json").read_text())
            l1 = {k: metrics[f"{k}: pixels"]["strict"]["l1_m"] for k in ("raw", "filled", "net")}
            found["variants"].setdefault(name, []).append(l1.pop("net"))
            found |= l1
    found["fill"] = _daemon_fill(config)
    return found


def _daemon_fill(config: Config) -> float | None:
    """Strict L1 of the held-out data as `fill` of the daemon left them."""
    source = open_source(config.check[0])
    limits = (config.train.loss.near_m, config.train.loss.far_m)
    images = []
    # Those that a training is measured on.
    for i in np.linspace(0, len(source) - 1, min(len(source), config.train.check_samples)).astype(int):
        sample = source[int(i)]
        if sample.filled is None:
            return None
        images.append(measure(sample.filled, sample.need_truth(), *limits))
    return pooled(images)["pixels"].strict.l1_m


def summary(found: Mapping[str, Any]) -> dict[str, dict[str, float]]:
    """Return of each variant the mean of its seeds, their standard deviation, and its difference to `BASE`.

    `difference` is the mean over seeds of the difference between runs of one seed, and `difference_error` its standard
    error.
    """
    out = {}
    base = np.array(found["variants"][BASE])
    for name, values in found["variants"].items():
        v = np.array(values)
        apart = v - base
        error = float(apart.std(ddof=1) / np.sqrt(len(v))) if len(v) > 1 else float("nan")
        spread = float(v.std(ddof=1)) if len(v) > 1 else float("nan")
        out[name] = {
            "mean": float(v.mean()),
            "spread": spread,
            "difference": float(apart.mean()),
            "difference_error": error,
        }
    return out


def table(found: Mapping[str, Any]) -> str:
    """Return the comparison as a table in Markdown."""
    lines = ["| raw depth to train on | L1, m | spread | to `synthetic` | standard error |", "|---|---|---|---|---|"]
    for name, s in summary(found).items():
        apart = ("", "") if name == BASE else (f"{s['difference']:+.4f}", f"{s['difference_error']:.4f}")
        lines.append(f"| {name} | {s['mean']:.4f} | {s['spread']:.4f} | {apart[0]} | {apart[1]} |")
    names = {"raw": "raw", "filled": "the pyramid of the lab", "fill": "`fill`"}
    for key, name in names.items():
        if found.get(key) is not None:
            lines.append(f"| not trained: {name} | {found[key]:.4f} | | | |")
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns 0, or 1 with a message."""
    parser = argparse.ArgumentParser(prog="python -m depthrig.lab.ablation", description="Compare kinds of raw depth")
    parser.add_argument("config", metavar="CONFIG.toml", help="configuration of one training")
    parser.add_argument("--seeds", metavar="N", type=int, default=3, help="trainings of each [default: 3]")
    text = "variants to train, in this process; without it all, and the table"
    parser.add_argument("--only", metavar="NAME", nargs="+", default=[], help=text)
    parsed = parser.parse_args(arguments)
    torch.set_num_threads(1)
    try:
        if parsed.seeds < 1:
            raise LabError(f"--seeds {parsed.seeds} is out of range 1..")
        config = read(parsed.config)
        found = run_all(config, parsed.seeds, parsed.only)
        if parsed.only:
            return 0
        folder = Path(config.folder)
        text = json.dumps(found | {"summary": summary(found)}, indent=1)
        # A single seed has no spread, and JSON no NaN.
        write_atomically(folder / "ablation.json", (text.replace("NaN", "null") + "\n").encode())
        write_atomically(folder / "ablation.md", (table(found) + "\n").encode())
    except LabError as e:
        print(f"error: {e}", file=sys.stderr)
        return 1
    print(table(found))
    return 0


if __name__ == "__main__":
    sys.exit(main())
