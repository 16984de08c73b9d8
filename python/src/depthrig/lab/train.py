"""Trains a model: `python -m depthrig.lab.train CONFIG.toml`.

The run's folder gets `run.json` (configuration, revision, hashes of the data), `log.jsonl` (a line per step),
`checkpoint.pt`, and at the end `model.pt`, `metrics.json` and, of `tiny`, `tiny.onnx`. The same command goes on where
a run ended; on the CPU, with one thread, to the same bits as one without interruption. With `torchrun` (or
`WORLD_SIZE`, `RANK`, `MASTER_ADDR` and `MASTER_PORT`) several processes share each step.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.distributed as dist
from torch import Tensor

from . import checkpoint, losses, metrics
from .batches import Batches, check_use, is_blank, loader, raw_of
from .config import Config, DataConfig, read
from .data import Source, open_source
from .errors import LabError, first_line
from .fill import filled_of
from .nets import build
from .nets.cdm import normalise_color
from .nets.export import export_tiny
from .nets.tiny import tiny_inputs
from .progress import bar
from .record import fingerprint, keep, write_atomically
from .sample import check_licences

__all__ = ["loss_of", "main", "rate_at", "run"]


def rate_at(config: Config, step: int) -> float:
    """Return the factor of the learning rate at a step."""
    t = config.train
    if t.schedule == "onecycle":
        rise = 0.3 * t.steps
        if step < rise:
            return 0.04 + 0.96 * (1 - math.cos(math.pi * step / rise)) / 2
        return max(1e-4, (1 + math.cos(math.pi * (step - rise) / max(t.steps - rise, 1))) / 2)
    if step < t.warmup:
        return (step + 1) / t.warmup
    if t.schedule == "constant":
        return 1.0
    return max(1e-4, (1 + math.cos(math.pi * (step - t.warmup) / max(t.steps - t.warmup, 1))) / 2)


def predict(net: Any, batch: dict[str, Any], config: Config) -> Tensor:
    """Return what the network says of a batch: inverse depth, logits of holes, or relative depth."""
    if config.model.kind == "tiny":
        return net(tiny_inputs(batch["color"], batch["filled"], losses.inverse(batch["raw"])), batch["filled"])
    x = normalise_color(batch["color"])
    if config.model.kind == "cdm":
        return net(torch.cat([x, losses.inverse(batch["raw"])[:, None]], 1))
    if config.model.refined_input:
        x = torch.cat([x, losses.inverse(batch["truth"])[:, None]], 1)
    return net(x)


def loss_of(predicted: Tensor, batch: dict[str, Any], config: Config) -> Tensor:
    """Return the loss of the configured model."""
    predicted = predicted.float()
    if config.model.kind == "hole":
        return losses.hole_loss(predicted, batch["raw"], batch["seen"])
    if config.model.kind == "value":
        return losses.value_loss(predicted, batch["raw"], stereo=config.synthesis.sensor != "tof")
    if config.train.loss.space == "fill":
        loss = losses.beside_fill_loss(predicted, batch["truth"], batch["filled"], config.train.loss)
        if config.train.loss.steady > 0:
            unsteady = losses.unsteady_loss(predicted, batch["raw"], batch["filled"], config.train.loss)
            loss = loss + config.train.loss.steady * unsteady
        return loss
    return losses.refine_loss(predicted, batch["truth"], batch["raw"], config.train.loss)


class _Trainer:
    """What a run consists of, and the loop."""

    def __init__(self, config: Config, folder: Path, sources: list[Source], held_out: list[Source]):
        self.config, self.folder, self.held_out = config, folder, held_out
        self.world, self.rank = int(os.environ.get("WORLD_SIZE", "1")), int(os.environ.get("RANK", "0"))
        self.device = self._device()
        torch.manual_seed(config.seed)
        self.net = build(config.model).to(self.device)
        self.batches = Batches(sources, config, self.rank, self.world)
        t = config.train
        slow = self.net.encoder_parameters() if hasattr(self.net, "encoder_parameters") else set()
        learning = [p for p in self.net.parameters() if p.requires_grad]
        groups = [
            {"params": [p for p in learning if p in slow], "lr": t.rate, "factor": 1.0},
            {"params": [p for p in learning if p not in slow], "lr": t.rate * t.head_rate, "factor": t.head_rate},
        ]
        groups = [g for g in groups if g["params"]]
        self.optimizer = torch.optim.AdamW(groups, lr=t.rate, weight_decay=t.weight_decay)
        self.ema = {n: v.detach().clone() for n, v in self.net.state_dict().items()} if t.ema > 0 else {}
        self.step = 0
        self._resume()
        self.parallel = self.net
        if self.world > 1:
            self.parallel = torch.nn.parallel.DistributedDataParallel(self.net, find_unused_parameters=False)

    def _device(self) -> torch.device:
        if self.config.train.device == "cuda":
            if not torch.cuda.is_available():
                raise LabError('device = "cuda", but PyTorch finds no GPU; use device = "cpu"')
            device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")))
            torch.cuda.set_device(device)
            return device
        return torch.device("cpu")

    @property
    def checkpoint(self) -> Path:
        return self.folder / "checkpoint.pt"

    def _resume(self) -> None:
        if not self.checkpoint.exists():
            return
        state = checkpoint.load(self.checkpoint)
        try:
            self.net.load_state_dict(state["model"])
            self.optimizer.load_state_dict(state["optimizer"])
        except (RuntimeError, ValueError, KeyError) as e:
            raise LabError(f"{self.checkpoint}: of another network: {first_line(e)}") from None
        self.ema = {n: v.to(self.device) for n, v in state["ema"].items()}
        self.step = int(state["step"])

    def save(self) -> None:
        """Write the checkpoint; on a full disk the last one stays and the run goes on."""
        state = {"step": self.step, "model": self.net.state_dict(), "optimizer": self.optimizer.state_dict()}
        try:
            checkpoint.save(self.checkpoint, {**state, "ema": self.ema})
        except LabError as e:
            print(f"warning: step {self.step}: {e}", file=sys.stderr, flush=True)

    def _finite(self, ok: bool, what: str, names: list[str]) -> None:
        """Stop every process when one has a number that is none."""
        flag = torch.tensor([0.0 if ok else 1.0], device=self.device)
        if self.world > 1:
            dist.all_reduce(flag)
        if flag.item() > 0:
            where = ", ".join(names) if not ok else "another process"
            raise LabError(
                f"step {self.step}: {what} is not finite; the batch is {where}; lower the rate or look at it"
            )

    def one(self, batch: dict[str, Any]) -> dict[str, float]:
        """Take one step; returns what is logged."""
        t = self.config.train
        names = batch.pop("names")
        batch = {n: v.to(self.device, non_blocking=True) for n, v in batch.items()}
        factor = rate_at(self.config, self.step)
        for group in self.optimizer.param_groups:
            group["lr"] = t.rate * group["factor"] * factor
        self.optimizer.zero_grad(set_to_none=True)
        with torch.autocast(self.device.type, torch.bfloat16, enabled=t.bf16):
            predicted = predict(self.parallel, batch, self.config)
        loss = loss_of(predicted, batch, self.config)
        self._finite(bool(torch.isfinite(loss)), "the loss", names)
        loss.backward()  # type: ignore[no-untyped-call,unused-ignore]
        norm = torch.nn.utils.clip_grad_norm_(self.net.parameters(), t.clip)
        self._finite(bool(torch.isfinite(norm)), "the gradient", names)
        self.optimizer.step()
        if self.ema:
            with torch.no_grad():
                for name, value in self.net.state_dict().items():
                    self.ema[name].lerp_(value, 1 - t.ema)
        shared = loss.detach().clone()
        if self.world > 1:
            dist.all_reduce(shared)
            shared /= self.world
        self.step += 1
        return {"step": self.step, "loss": shared.item(), "rate": t.rate * factor, "gradient": norm.item()}

    def train(self) -> None:
        """Run the remaining steps."""
        t = self.config.train
        log = _Log(self.folder, self.step, t.steps) if self.rank == 0 else None
        self.net.train()
        try:
            for batch in loader(self.batches, self.step):
                numbers = self.one(batch)
                done = self.step == t.steps
                if self.rank != 0:
                    continue
                assert log is not None
                log.write(numbers)
                if done or self.step % t.checkpoint_every == 0:
                    self.save()
                if t.check_every and self.step % t.check_every == 0 and not done:
                    print(metrics.table(self.check()), flush=True)
        finally:
            if log is not None:
                log.close()

    def weights(self) -> dict[str, Tensor]:
        """Return the weights that the model ships: averaged, where that is configured."""
        return {n: v.detach().cpu() for n, v in (self.ema or self.net.state_dict()).items()}

    def check(self) -> dict[str, metrics.Metrics]:
        """Return the metrics of held-out samples: raw, filled and, as `net`, refined."""
        if not self.held_out or self.config.model.kind in ("hole", "value"):
            return {}
        own = {n: v.clone() for n, v in self.net.state_dict().items()}
        self.net.load_state_dict(self.ema or own)
        self.net.eval()
        of: dict[str, list[metrics.Measured]] = {"raw": [], "filled": [], "net": []}
        for source in self.held_out:
            count = min(len(source), self.config.train.check_samples)
            for i in np.linspace(0, len(source) - 1, count).astype(int):
                self._measure(source, int(i), of)
        self.net.load_state_dict(own)
        self.net.train()
        rows = {name: metrics.pooled(each) for name, each in of.items()}
        return {f"{name}: {kind}": m for name, kinds in rows.items() for kind, m in kinds.items()}

    def _measure(self, source: Source, index: int, of: dict[str, list[metrics.Measured]]) -> None:
        sample = source[index]
        if is_blank(sample):
            print(f"warning: {sample.name}: the true depth is empty; it is left out", file=sys.stderr, flush=True)
            return
        raw = raw_of(sample, self.config, np.random.default_rng([self.config.seed, 3, index]))
        multiple = 16 if self.config.model.kind == "tiny" else 14
        height, width = (side // multiple * multiple for side in raw.shape)
        truth, material = sample.need_truth()[:height, :width], sample.material
        raw, color = raw[:height, :width], sample.color[:height, :width].transpose(2, 0, 1)
        filled = filled_of(sample, raw, (slice(height), slice(width)))
        planes = {"color": color.astype(np.float32) / 255, "raw": raw, "filled": filled, "truth": truth}
        batch = {n: torch.from_numpy(np.ascontiguousarray(p))[None].to(self.device) for n, p in planes.items()}
        with torch.no_grad():
            refined = predict(self.net, batch, self.config)[0].float().cpu().numpy()
        limits = (self.config.train.loss.near_m, self.config.train.loss.far_m)
        material = material[:height, :width] if material is not None else None
        with np.errstate(divide="ignore"):
            for name, depth in (("raw", raw), ("filled", 1 / filled), ("net", 1 / refined)):
                of[name].append(metrics.measure(depth, truth, *limits, material))

    def finish(self) -> None:
        """Write the model and its metrics."""
        weights = self.weights()
        checkpoint.save(self.folder / "model.pt", weights)
        if self.config.model.kind == "tiny":
            self.net.load_state_dict(weights)
            try:
                export_tiny(self.net.cpu(), self.folder / "tiny.onnx")
            except LabError as e:
                print(f"warning: {e}; model.pt is complete", file=sys.stderr, flush=True)
            self.net.to(self.device)
        found = self.check()
        if found:
            print(metrics.table(found))
        numbers = _without_nan({n: dataclasses.asdict(m) for n, m in found.items()})
        text = json.dumps(numbers, indent=1, ensure_ascii=False, allow_nan=False)
        write_atomically(self.folder / "metrics.json", (text + "\n").encode())


def _without_nan(value: Any) -> Any:
    """The same with NaN as None: JSON has no NaN."""
    if isinstance(value, dict):
        return {k: _without_nan(v) for k, v in value.items()}
    return None if isinstance(value, float) and math.isnan(value) else value


class _Log:
    """A line of JSON per step, and TensorBoard and a bar where their packages are installed."""

    def __init__(self, folder: Path, step: int, steps: int):
        path = folder / "log.jsonl"
        lines = path.read_text().splitlines(keepends=True) if path.exists() else []
        # What came after the checkpoint is done again.
        write_atomically(path, "".join(lines[:step]).encode())
        self.path, self.file = path, path.open("a")
        self.is_full = False
        self.board: Any = None
        self.bar = bar(steps, "step", step)
        try:
            from torch.utils.tensorboard import SummaryWriter

            self.board = SummaryWriter(str(folder / "tensorboard"), purge_step=step)
        except ImportError:
            pass

    def write(self, numbers: dict[str, float]) -> None:
        self._kept(lambda: self.file.write(json.dumps(numbers) + "\n"), self.file.flush)
        if self.board is not None:
            for name in ("loss", "rate", "gradient"):
                self.board.add_scalar(name, numbers[name], numbers["step"])
        self.bar.update()
        self.bar.set_postfix(loss=f"{numbers['loss']:.4f}")

    def _kept(self, *steps: Callable[[], object]) -> None:
        """Run `steps`; a full disk costs lines and not the run."""
        try:
            for step in steps:
                step()
        except OSError as e:
            if not self.is_full:
                print(f"warning: {self.path}: {e}; it lacks lines from here on", file=sys.stderr, flush=True)
            self.is_full = True

    def close(self) -> None:
        self._kept(self.file.close)
        for each in (self.board, self.bar):
            if each is not None:
                self._kept(each.close)


def run(config: Config) -> Path:
    """Train, or go on with a run; returns its folder.

    :raises LabError: when data, configuration or numbers cannot be used.
    """
    folder = Path(config.folder)
    rank, world = int(os.environ.get("RANK", "0")), int(os.environ.get("WORLD_SIZE", "1"))

    def open_all(wanted: tuple[DataConfig, ...]) -> list[Source]:
        return [open_source(d) for d in wanted]

    sources, held_out = open_all(config.data), open_all(config.check)
    licences = {f"{s.data.kind} {s.root}": s.licence for s in sources}
    check_licences(licences, config.ships, say=print if rank == 0 else lambda _: None)
    for source in (*sources, *held_out):
        check_use(source[0], config, str(source.root))
    if config.train.device == "cpu":
        # One thread per process: sums have one order, and OpenMP's threads only wait for each other.
        torch.set_num_threads(1)
    if world > 1:
        dist.init_process_group("gloo" if config.train.device == "cpu" else "nccl")
    try:
        if rank == 0:
            # Where a run lies is not a part of it; how many share a step is.
            plain = dataclasses.asdict(config) | {"folder": "", "processes": world}
            every = (*sources, *held_out)
            keep(folder, plain, {f"{s.data.kind} {s.root}": fingerprint(s.files(), s.root) for s in every})
        if world > 1:
            dist.barrier()
        trainer = _Trainer(config, folder, sources, held_out)
        trainer.train()
        if rank == 0:
            trainer.finish()
    finally:
        if world > 1:
            dist.destroy_process_group()
    return folder


def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns 0, or 1 with a message."""
    parser = argparse.ArgumentParser(prog="python -m depthrig.lab.train", description="Train a depth model")
    parser.add_argument("config", metavar="CONFIG.toml", help="configuration of the run; the same one goes on with it")
    parsed = parser.parse_args(arguments)
    try:
        print(f"complete: {run(read(parsed.config))}")
    except (LabError, OSError) as e:
        print(f"error: {e}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
