"""Configuration of a run: TOML into frozen dataclasses.

Every key is checked: an unknown one, a value of the wrong type or out of range is refused with its line.
"""

from __future__ import annotations

import dataclasses
import platform
import re
import types
import typing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from .errors import LabError

__all__ = ["Config", "DataConfig", "LossConfig", "ModelConfig", "SynthesisConfig", "TrainConfig", "parse", "read"]


def _within(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise LabError(f"{name} = {value} is out of range {low}..={high}")


def _one_of(name: str, value: str, known: tuple[str, ...]) -> None:
    if value not in known:
        raise LabError(f'{name} = "{value}" is unknown; use {", ".join(known)}')


@dataclass(frozen=True)
class ModelConfig:
    """The network."""

    kind: str = "tiny"
    """`tiny`, `cdm` (the official form), `hole` or `value` (noise models of a camera)."""
    encoder: str = "vits"
    """Encoder of `cdm`, `hole` and `value`: `vits`, `vitb` or `vitl`. `conv`, of `hole` and `value` alone, is a U-Net."""
    width: int = 48
    """Channels of the first stage of `tiny` and of `conv`."""
    weights: str | None = None
    """State to begin with: a file of `torch.save(net.state_dict())`. Names that it lacks stay as they are drawn."""
    refined_input: bool = False
    """`hole` and `value`: refined depth as a fourth input. The paper's form has colour alone."""

    def __post_init__(self) -> None:
        _one_of("kind", self.kind, ("tiny", "cdm", "hole", "value"))
        _one_of("encoder", self.encoder, ("vits", "vitb", "vitl", "conv"))
        if self.encoder == "conv" and self.kind == "cdm":
            raise LabError('encoder = "conv" is one of noise models; kind = "cdm" needs vits, vitb or vitl')
        _within("width", self.width, 8, 256)
        if self.width % 8:
            raise LabError(f"width = {self.width} is not a multiple of 8")


@dataclass(frozen=True)
class DataConfig:
    """One dataset."""

    kind: str
    """Layout: a name of `depthrig.lab.data.KINDS`."""
    path: str
    split: str = "train"
    sensor: str = ""
    """HAMMER: `d435`, `l515` or `tof`. ClearGrasp: `d415` or `d435`. ByteCameraDepth, our datasets: the camera."""
    unit_m: float | None = None
    """ByteCameraDepth: metres per unit of 16-bit depth, where it is not that of the model."""
    weight: float = 1.0
    """How often its samples are drawn, relative to their number."""
    reference: str = ""
    """depthrig's datasets: the stream that is taken as truth, such as `d435/depth_refined`."""

    def __post_init__(self) -> None:
        _within("weight", self.weight, 0.001, 1000)
        if self.unit_m is not None:
            _within("unit_m", self.unit_m, 1e-5, 1.0)


@dataclass(frozen=True)
class SynthesisConfig:
    """Raw depth made from true depth, for datasets without a sensor."""

    sensor: str = "none"
    """`stereo` or `tof`, or `none`: raw depth as the dataset has it. A `value` model needs to know what measured it."""
    focal_baseline: float = 30.0
    """Focal length times baseline of the stereo sensor, pixels times metres, at a width of 640."""
    value: str | None = None
    """`make_shards`: state of the camera's value model, of `model.encoder`."""
    hole: str | None = None
    """The same of its hole model."""
    filter: bool = True
    """Whether value noise is filtered along the truth (the guided filter), but for a tenth of the images."""
    strength: float = 1.0
    """Factor of every high-frequency noise; 0 is none."""

    def __post_init__(self) -> None:
        _one_of("sensor", self.sensor, ("none", "stereo", "tof"))
        _within("focal_baseline", self.focal_baseline, 1.0, 1000.0)
        _within("strength", self.strength, 0.0, 10.0)


@dataclass(frozen=True)
class LossConfig:
    """The loss."""

    space: str = "inverse"
    """Errors are of `inverse` depth, 1/m, of its logarithm (`log`), in which near and far count alike, or of depth as a
    part of filled depth's error in that image (`fill`; `tiny` alone, without the two weights below)."""
    gradient: float = 0.5
    """Weight of the difference of gradients; the paper prints 1, PromptDA has 0.5."""
    missing: float = 1.0
    """Weight of a pixel whose raw depth is missing or wrong by more than 5 %, relative to one that was measured."""
    worse: float = 1.0
    """`fill`: weight of how much worse an image became."""
    off_m: float = 0.1
    """`fill`: added to filled depth's error where the change is a part of it, metres. The more, the more do images with large errors count."""
    steady: float = 0.0
    """`fill`: weight of how much depth in holes changes with the sensor's noise. Above 0 each crop comes twice, measured again."""
    near_m: float = 0.1
    far_m: float = 6.0

    def __post_init__(self) -> None:
        _one_of("space", self.space, ("inverse", "log", "fill"))
        _within("worse", self.worse, 0, 100)
        _within("off_m", self.off_m, 0.001, 100)
        _within("steady", self.steady, 0, 100)
        _within("gradient", self.gradient, 0, 100)
        _within("missing", self.missing, 0.01, 100)
        _within("near_m", self.near_m, 0.01, 100)
        _within("far_m", self.far_m, self.near_m, 1000)


@dataclass(frozen=True)
class TrainConfig:
    """The loop."""

    steps: int = 1000
    batch: int = 8
    """Samples of one step in one process."""
    crop: tuple[int, int] = (192, 256)
    """Height and width of the crop; multiples of 16 for `tiny`, any for `conv`, of 14 for the others."""
    flip: bool = False
    """Mirrored images half of the time, of ToF depth that is made here. What stereo misses lies left of things."""
    color_jitter: float = 0.2
    rate: float = 2.5e-3
    head_rate: float = 1.0
    """Factor of the rate for all but the encoders of a ViT."""
    schedule: str = "onecycle"
    """`onecycle` (cosine up over a third, cosine down), `cosine` (after `warmup` steps) or `constant`."""
    warmup: int = 0
    weight_decay: float = 0.01
    clip: float = 1.0
    ema: float = 0.0
    """Decay of the averaged weights, such as 0.999; 0 is none."""
    bf16: bool = False
    device: str = "cpu"
    """`cpu` or `cuda`."""
    workers: int = 0
    """Processes that read ahead."""
    checkpoint_every: int = 500
    check_every: int = 0
    """Steps between two evaluations of `check`; 0 is at the end only."""
    check_samples: int = 64
    loss: LossConfig = field(default_factory=LossConfig)

    def __post_init__(self) -> None:
        _within("steps", self.steps, 1, 10**9)
        _within("batch", self.batch, 1, 4096)
        for side in self.crop:
            _within("crop", side, 14, 4096)
        _one_of("schedule", self.schedule, ("onecycle", "cosine", "constant"))
        _one_of("device", self.device, ("cpu", "cuda"))
        _within("rate", self.rate, 1e-9, 1.0)
        _within("head_rate", self.head_rate, 1e-3, 1e3)
        _within("warmup", self.warmup, 0, self.steps)
        _within("weight_decay", self.weight_decay, 0, 1)
        _within("clip", self.clip, 1e-3, 1e6)
        _within("ema", self.ema, 0, 0.999999)
        _within("color_jitter", self.color_jitter, 0, 1)
        _within("workers", self.workers, 0, 256)
        _within("checkpoint_every", self.checkpoint_every, 1, 10**9)
        _within("check_every", self.check_every, 0, 10**9)
        _within("check_samples", self.check_samples, 1, 10**9)


@dataclass(frozen=True)
class Config:
    """A run."""

    name: str
    folder: str
    """Where the run is written."""
    data: tuple[DataConfig, ...]
    ships: bool = False
    """Whether the model will be passed on: data whose licence forbids it is refused."""
    seed: int = 1
    check: tuple[DataConfig, ...] = ()
    """Held-out data."""
    model: ModelConfig = field(default_factory=ModelConfig)
    synthesis: SynthesisConfig = field(default_factory=SynthesisConfig)
    train: TrainConfig = field(default_factory=TrainConfig)

    def __post_init__(self) -> None:
        if not self.data:
            raise LabError("there is no [[data]]; name at least one dataset")
        _within("seed", self.seed, 0, 2**63 - 1)
        if self.model.kind == "value" and self.synthesis.sensor == "none":
            raise LabError('kind = "value" needs sensor = "stereo" or "tof" under [synthesis]: what measured raw depth')
        of_vit = 1 if self.model.encoder == "conv" else 14
        multiple = 16 if self.model.kind == "tiny" else of_vit
        if any(side % multiple for side in self.train.crop):
            raise LabError(
                f"crop = {list(self.train.crop)} are not multiples of {multiple}, as {self.model.kind} needs"
            )
        if self.train.loss.space == "fill" and self.model.kind != "tiny":
            raise LabError(f'loss.space = "fill" is for tiny alone; use "inverse" or "log" for {self.model.kind}')
        if self.train.loss.steady > 0 and self.train.loss.space != "fill":
            raise LabError('loss.steady needs loss.space = "fill"')
        if self.train.flip and self.synthesis.sensor != "tof":
            raise LabError('flip = true needs sensor = "tof": a stereo camera misses what lies left of things')


def _line_of(text: str, where: tuple[str, ...]) -> str:
    """`line 3, ` of the key at `where`: names of tables, numbers of arrays, the key."""
    table: list[str] = []
    seen: dict[str, int] = {}
    for number, line in enumerate(text.splitlines(), 1):
        if header := re.match(r"\s*(\[\[?)\s*([^\]]+?)\s*\]", line):
            name = header[2].replace('"', "")
            table = name.split(".")
            if header[1] == "[[":
                seen[name] = seen.get(name, -1) + 1
                table = [*table, str(seen[name])]
            if tuple(table) == where:
                return f"line {number}, "
        key = re.match(r'\s*"?([\w-]+(?:\.[\w-]+)*)"?\s*=', line)
        if key and (*table, *key[1].split(".")) == where:
            return f"line {number}, "
    return ""


def _value(kind: Any, value: Any, where: tuple[str, ...], text: str) -> Any:
    """`value` as `kind`, which is what the field of a dataclass is declared to be."""
    origin = typing.get_origin(kind)
    if origin is types.UnionType:
        kind = next(k for k in typing.get_args(kind) if k is not type(None))
        return _value(kind, value, where, text)
    if dataclasses.is_dataclass(kind):
        if not isinstance(value, dict):
            raise LabError(f"{_line_of(text, where)}{'.'.join(where)} is not a table")
        return _table(kind, value, where, text)
    if origin is tuple:
        kinds = typing.get_args(kind)
        if not isinstance(value, list):
            raise LabError(f"{_line_of(text, where)}{'.'.join(where)} is not a list")
        if kinds[-1] is Ellipsis:
            return tuple(_value(kinds[0], v, (*where, str(i)), text) for i, v in enumerate(value))
        if len(value) != len(kinds):
            raise LabError(f"{_line_of(text, where)}{'.'.join(where)} has {len(value)} values, {len(kinds)} are wanted")
        return tuple(_value(k, v, where, text) for k, v in zip(kinds, value))
    if kind is float and type(value) is int:
        return float(value)
    if type(value) is not kind:
        wanted, found = getattr(kind, "__name__", kind), type(value).__name__
        raise LabError(f"{_line_of(text, where)}{'.'.join(where)} is a {found}; a {wanted} is wanted")
    return value


def _table(cls: Any, table: dict[str, Any], where: tuple[str, ...], text: str) -> Any:
    kinds = typing.get_type_hints(cls)
    for key in table:
        if key not in kinds:
            line = _line_of(text, (*where, key))
            raise LabError(f"{line}unknown key {'.'.join((*where, key))}; known are {', '.join(kinds)}")
    for f in dataclasses.fields(cls):
        has_default = f.default is not dataclasses.MISSING or f.default_factory is not dataclasses.MISSING
        if f.name not in table and not has_default:
            raise LabError(f"{_line_of(text, where)}{'.'.join((*where, f.name))} is missing")
    values = {key: _value(kinds[key], value, (*where, key), text) for key, value in table.items()}
    try:
        return cls(**values)
    except LabError as e:
        key = str(e).split(" ", 1)[0]
        line = _line_of(text, (*where, key)) or _line_of(text, where)
        raise LabError(f"{line}{'.'.join((*where, str(e)))}") from None


def parse(text: str, name: str = "configuration") -> Config:
    """Return the configuration in `text`.

    :raises LabError: when it is not TOML, or a key or value is invalid; names `name` and the line.
    """
    try:
        import tomllib
    except ImportError:
        raise LabError(f"depthrig.lab needs Python 3.11 or later; this is {platform.python_version()}") from None
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as e:
        raise LabError(f"{name}: {e}") from None
    try:
        config = _table(Config, table, (), text)
    except LabError as e:
        raise LabError(f"{name}: {e}") from None
    assert isinstance(config, Config)
    return config


def read(path: str | Path) -> Config:
    """Return the configuration in a file; relative paths in it are relative to its folder.

    :raises LabError: as `parse`, and when the file cannot be read.
    """
    path = Path(path)
    try:
        text = path.read_text("utf-8")
    except (OSError, UnicodeDecodeError) as e:
        raise LabError(f"{path}: {e}") from None
    config = parse(text, str(path))
    base = path.resolve().parent

    def moved(d: DataConfig) -> DataConfig:
        return dataclasses.replace(d, path=str(base / d.path))

    weights = config.model.weights
    model = dataclasses.replace(config.model, weights=weights and str(base / weights))
    data, check = tuple(map(moved, config.data)), tuple(map(moved, config.check))
    synthesis = config.synthesis
    synthesis = dataclasses.replace(
        synthesis,
        value=synthesis.value and str(base / synthesis.value),
        hole=synthesis.hole and str(base / synthesis.hole),
    )
    return dataclasses.replace(
        config, folder=str(base / config.folder), data=data, check=check, model=model, synthesis=synthesis
    )
