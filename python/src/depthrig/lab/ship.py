"""Writes the files of `tiny` that ship: `python -m depthrig.lab.ship CONFIG.toml --real DATA --depthrig FILE --out DIR`.

The run of the configuration must be complete. `tiny.onnx` is the network, `tiny.toml` its record: how it was made, what
it is made of, and what it reached. `default` in it is true when every gate (`depthrig.lab.gates`) is reached.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from pathlib import Path
from typing import Any

import torch

from .config import Config, read
from .errors import LabError
from .gates import judge, load_tiny, measure_all
from .nets.export import export_tiny
from .record import write_atomically

__all__ = ["BYTES_MAX", "main", "record", "ship"]

BYTES_MAX = 4 << 20
"""Size of `tiny.onnx` at most: it is embedded in the program."""
LICENCE = "MIT OR Apache-2.0"
VERSION = 4
"""Goes up with each network that ships."""


def _toml(value: Any) -> str:
    """A value as TOML."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return repr(round(value, 6))
    if isinstance(value, int):
        return str(value)
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_toml(v) for v in value) + "]"
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{_key(k)} = {_toml(v)}" for k, v in value.items()) + " }"
    return json.dumps(str(value), ensure_ascii=False)


def _key(name: str) -> str:
    is_bare = name.isascii() and name.replace("-", "").replace("_", "").isalnum()
    return name if is_bare else json.dumps(name, ensure_ascii=False)


def _table(name: str, values: dict[str, Any]) -> list[str]:
    return ["", f"[{name}]", *(f"{_key(k)} = {_toml(v)}" for k, v in values.items() if v is not None)]


def _arguments(folder: Path) -> dict[str, Any]:
    """What the generator wrote beside its shards: its version, arguments and number of samples."""
    for path in sorted(folder.glob("*.json")):
        try:
            found = json.loads(path.read_text())
            return {"generator": found["generator"], **found["arguments"]}
        except (ValueError, KeyError, TypeError):
            continue
    return {}


def _run_before(config: Config) -> dict[str, Any] | None:
    """Return `run.json` of the run that made the weights with which this one began; None where it began with none.

    :raises LabError: when it is not beside them.
    """
    if config.model.weights is None:
        return None
    path = Path(config.model.weights).parent / "run.json"
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError) as e:
        raise LabError(f"{path}: {e}; what ships says how its first weights were made: keep it beside them") from None
    assert isinstance(found, dict)
    return found


def record(config: Config, run: dict[str, Any], found: dict[str, Any], gates: dict[str, Any], onnx: bytes) -> str:
    """Return `tiny.toml`.

    :param run: `run.json`.
    :param found: what `measure_all` found; `gates` is what `judge` made of it.
    :raises LabError: when the run that made the first weights left no `run.json`.
    """
    lines = [
        "# Record of tiny.onnx, written by `make train-tiny`.",
        'architecture = "tiny"',
        f"version = {VERSION}",
        f"width = {config.model.width}",
        f"licence = {_toml(LICENCE)}",
        f"sha256 = {_toml(hashlib.sha256(onnx).hexdigest())}",
        "# Whether `auto` may choose it: every gate below is reached.",
        f"default = {_toml(all(g['reached'] for g in gates.values()))}",
    ]
    for name, gate in gates.items():
        lines += _table(f"gates.{_key(name)}", gate)
    for name, values in found.items():
        if all(isinstance(v, dict) for v in values.values()):
            for kind, line in values.items():
                lines += _table(f"metrics.{_key(name)}.{_key(kind)}", line)
        else:
            lines += _table(f"metrics.{_key(name)}", values)
    for of, wanted in (("data", config.data), ("held-out", config.check)):
        for each in wanted:
            path = Path(each.path)
            hashed = next((h for name, h in run["data"].items() if name.endswith(f" {path}")), None)
            lines += _table(f"{of}.{_key(path.name)}", {"sha256": hashed, **_arguments(path)})
    for table, each_run in (("train-before", _run_before(config)), ("train", run)):
        if each_run is not None:
            made = each_run["config"]
            lines += _table(table, {"seed": made["seed"], "processes": made["processes"], **made["train"]})
    lines += _table("versions", run["versions"])
    return "\n".join(lines) + "\n"


def ship(config: Config, folder: Path, program: Path, out: Path, most: int | None = None) -> dict[str, Any]:
    """Measure the run of a configuration and write both files; returns the gates.

    :param folder: real images.
    :param program: depthrig, for its `fill`.
    :param most: held-out images to measure; None is all.
    :raises LabError: when the run is not complete, or the network is larger than `BYTES_MAX`.
    """
    run_folder = Path(config.folder)
    state = run_folder / "model.pt"
    if not state.is_file():
        raise LabError(f"{run_folder}: the run is not complete; train it first")
    if len(config.check) != 1:
        raise LabError(f"{len(config.check)} held-out datasets; name one [[check]]")
    net = load_tiny(state, config.model.width)
    run = json.loads((run_folder / "run.json").read_text())
    if run["config"]["name"] != config.name or run["config"]["seed"] != config.seed:
        raise LabError(f"{run_folder}: of another run; train this one first")
    found = measure_all(net, Path(config.check[0].path), folder, program, most)
    gates = judge(found)
    out.mkdir(parents=True, exist_ok=True)
    part = run_folder / "ship.onnx"
    export_tiny(net, part)
    onnx = part.read_bytes()
    part.unlink()
    if len(onnx) > BYTES_MAX:
        raise LabError(f"tiny.onnx has {len(onnx)} bytes, more than {BYTES_MAX}; choose a smaller width")
    write_atomically(out / "tiny.onnx", onnx)
    write_atomically(out / "tiny.toml", record(config, run, found, gates, onnx).encode())
    return gates


def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns 0, or 1 with a message."""
    parser = argparse.ArgumentParser(prog="python -m depthrig.lab.ship", description="Write the files of tiny")
    parser.add_argument("config", metavar="CONFIG.toml", help="configuration of the complete run")
    parser.add_argument("--real", type=Path, required=True, metavar="DIR", help="folder of real images")
    parser.add_argument("--depthrig", type=Path, required=True, metavar="FILE", help="the program, for fill")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of tiny.onnx and tiny.toml")
    parser.add_argument("--most", type=int, metavar="N", help="held-out images to measure [default: all]")
    parsed = parser.parse_args(arguments)
    torch.set_num_threads(1)
    try:
        gates = ship(read(parsed.config), parsed.real, parsed.depthrig, parsed.out, parsed.most)
    except LabError as e:
        print(f"error: {e}", file=sys.stderr)
        return 1
    for name, gate in gates.items():
        verdict = "reached" if gate["reached"] else "NOT reached"
        print(f"{name}: {gate['found']:.4f}, limit {gate['limit']:.2f}: {verdict}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
