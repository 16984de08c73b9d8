"""Shards: tar files in the WebDataset layout, written whole or not at all.

A sample is a run of members with one key: ``KEY.color.png``, ``KEY.truth.png``, ``KEY.raw.png``, optionally
``KEY.filled.png`` and ``KEY.material.png``, and last ``KEY.json``. KEY is ten digits, the number of the sample in the
whole run.
A file with its final name ends in the two zero blocks of tar; one that does not was cut and is refused.
"""

from __future__ import annotations

import dataclasses
import fcntl
import json
import os
import re
import tarfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from .errors import LabError
from .images import decode_png, encode_png
from .record import fsync_folder, write_atomically
from .sample import MATERIALS, Intrinsics, Licence, Sample

__all__ = ["FORMAT", "TRUTH_UNIT_M", "Entry", "Shard", "ShardWriter", "list_shards", "part_of", "read_sample", "stream"]

FORMAT = 1
TRUTH_UNIT_M = 1e-4
BLOCK = 512
MEMBERS_MAX = 1 << 28
"""Larger members are refused."""
NAME = re.compile(r"(?P<key>\d{10})\.(?P<what>color\.png|truth\.png|raw\.png|filled\.png|material\.png|json)")
OURS = "MIT OR Apache-2.0"
SHIPPING = {OURS, "MIT", "Apache-2.0", "BSD-3-Clause", "CC0-1.0", "CC BY 4.0", "CC BY-SA 3.0", "your own recordings"}
"""Licences of shards under which a model may ship."""


@dataclass(frozen=True)
class Entry:
    """Where the members of one sample lie: offset and size by name (`color.png`, `json`)."""

    key: str
    members: dict[str, tuple[int, int]] = field(default_factory=dict)


def list_shards(folder: Path) -> list[Path]:
    """Return the complete shards in a folder, in order; unfinished ones (`.part`) are left out.

    :raises LabError: when there are none.
    """
    if not folder.is_dir():
        raise LabError(f"{folder}: no such folder")
    found = sorted(p for p in folder.iterdir() if re.fullmatch(r".+-\d{6}\.tar", p.name))
    if not found:
        parts = sum(p.name.endswith(".tar.part") for p in folder.iterdir())
        raise LabError(f"{folder}: no shards (NAME-000000.tar){f', {parts} unfinished ones' if parts else ''}")
    return found


def _header(file: BinaryIO, path: Path) -> tarfile.TarInfo | None:
    """The next header; None is the end of the archive, which is checked."""
    at = file.tell()
    block = file.read(BLOCK)
    if block == bytes(BLOCK):
        rest = file.read(BLOCK)
        if rest != bytes(BLOCK):
            raise LabError(f"{path}: cut short: it does not end in two zero blocks; make this shard again")
        return None
    try:
        return tarfile.TarInfo.frombuf(block, "utf-8", "strict")
    except (tarfile.TarError, UnicodeDecodeError) as e:
        what = "cut short" if len(block) < BLOCK else f"no tar header ({e})"
        raise LabError(f"{path}: {what} at byte {at}; make this shard again") from None


class Shard:
    """One shard, open for reading; its index is read when it is opened."""

    def __init__(self, path: Path):
        self.path = path
        self.entries: list[Entry] = []
        try:
            with path.open("rb") as file:
                self._scan(file)
        except OSError as e:
            raise LabError(f"{path}: {e}") from None
        if not self.entries:
            raise LabError(f"{path}: no samples")

    def _scan(self, file: BinaryIO) -> None:
        open_entry: Entry | None = None
        known = set()
        while (header := _header(file, self.path)) is not None:
            at = file.tell()
            if header.size > MEMBERS_MAX or header.size < 0:
                raise LabError(f"{self.path}: {header.name} has {header.size} bytes; at most {MEMBERS_MAX} are read")
            # Beyond the end of a cut file the next header is missing.
            file.seek(at + -(-header.size // BLOCK) * BLOCK)
            if not header.isreg():
                continue
            match = NAME.fullmatch(header.name)
            if match is None:
                raise LabError(f"{self.path}: unknown member {header.name}; install a depthrig that knows it")
            key, what = match["key"], match["what"]
            if open_entry is not None and open_entry.key != key:
                raise LabError(f"{self.path}: sample {open_entry.key} has no json at its end")
            entry = open_entry or Entry(key)
            if key in known or what in entry.members:
                raise LabError(f"{self.path}: {header.name} is there twice")
            entry.members[what] = (at, header.size)
            open_entry = entry
            if what == "json":
                if missing := {"color.png", "truth.png", "raw.png"} - entry.members.keys():
                    raise LabError(f"{self.path}: sample {key} has no {', '.join(sorted(missing))}")
                known.add(key)
                self.entries.append(entry)
                open_entry = None
        if open_entry is not None:
            raise LabError(f"{self.path}: sample {open_entry.key} has no json at its end")

    def __len__(self) -> int:
        return len(self.entries)

    def _read(self, index: int, only: str = "") -> dict[str, bytes]:
        entry = self.entries[index]
        with self.path.open("rb") as file:
            members = {}
            for what, (at, size) in entry.members.items():
                if only and what != only:
                    continue
                file.seek(at)
                members[what] = file.read(size)
                if len(members[what]) != size:
                    raise LabError(f"{self.path}: cut short within {entry.key}.{what}; make this shard again")
        return members

    def __getitem__(self, index: int) -> Sample:
        return read_sample(self._read(index), f"{self.path}: sample {self.entries[index].key}")

    def facts(self, index: int) -> dict[str, Any]:
        """Return what the json of a sample says, such as `sensor` and `scene`."""
        try:
            facts = json.loads(self._read(index, "json")["json"])
        except ValueError as e:
            raise LabError(f"{self.path}: sample {self.entries[index].key}: invalid json: {e}") from None
        return facts if isinstance(facts, dict) else {}


def read_sample(members: dict[str, bytes], where: str) -> Sample:
    """Return the sample of members by name (`color.png`, `json`).

    :raises LabError: when one is damaged or they do not fit together; begins with `where`.
    """
    try:
        facts = json.loads(members["json"])
        if facts["format"] != FORMAT:
            raise LabError(f"{where}: format {facts['format']}, this reads {FORMAT}; install a later depthrig")
        of_camera = facts["intrinsics"]
        fx, fy, cx, cy = (float(of_camera[k]) for k in ("fx", "fy", "cx", "cy"))
        coeffs = tuple(float(c) for c in of_camera.get("coeffs") or ())
        intrinsics = Intrinsics(fx, fy, cx, cy, str(of_camera.get("model", "none")), coeffs)
        units = {"truth.png": float(facts["truth_unit_m"]), "raw.png": float(facts["raw_unit_m"])}
        units["filled.png"] = units["raw.png"]
        size = (int(facts["height"]), int(facts["width"]))
        licence = Licence(str(facts["licence"]), ships=facts["licence"] in SHIPPING)
    except (KeyError, TypeError, ValueError) as e:
        if isinstance(e, LabError):
            raise LabError(f"{where}: {str(e).removeprefix(f'{where}: ')}") from None
        raise LabError(f"{where}: invalid json: {type(e).__name__} {e}") from None
    if bad := [u for u in units.values() if not 1e-6 <= u <= 1]:
        raise LabError(f"{where}: invalid depth unit {bad[0]} m")
    images: dict[str, Any] = {}
    for what in ("color.png", "truth.png", "raw.png", "filled.png", "material.png"):
        if what not in members:
            continue
        image = decode_png(members[what], f"{where}: {what}")
        if image.shape[:2] != size:
            found = f"{image.shape[1]}x{image.shape[0]}"
            raise LabError(f"{where}: {what} is {found}, its json says {size[1]}x{size[0]}")
        wanted = np.uint16 if what in units else np.uint8
        if image.dtype != wanted or image.ndim != (3 if what == "color.png" else 2):
            raise LabError(f"{where}: {what} has {image.dtype} pixels of shape {image.shape}")
        # The unit in float64: in float32 0.0001 is off, and 65535 of it would round twice.
        images[what] = (image * units[what]).astype(np.float32) if what in units else image
    material = images.get("material.png")
    if material is not None and material.max() >= len(MATERIALS):
        raise LabError(f"{where}: material {material.max()} is out of range 0..={len(MATERIALS) - 1}")
    filled = images.get("filled.png")
    return Sample(
        where, images["color.png"], licence, images["raw.png"], images["truth.png"], intrinsics, material, filled
    )


def to_units(depth: npt.NDArray[np.float32], unit_m: float) -> npt.NDArray[np.uint16]:
    """Return metres as whole units; 0 stays 0, and what is beyond 65535 units becomes 0."""
    units = np.rint(depth.astype(np.float64) / unit_m)
    return np.where((units >= 1) & (units <= 65535), units, 0).astype(np.uint16)


def _open_part(path: Path) -> BinaryIO:
    """Open the file of a shard that is being written, emptied and locked.

    :raises LabError: while another process writes it.
    """
    while True:
        file = path.open("ab")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.close()
            raise LabError(f"{path}: another process writes this shard; give each its own --shard") from None
        except OSError:
            pass  # some network file systems have no locks
        # Between opening and locking another process may have completed it and given it its name.
        try:
            named = os.stat(path)
        except FileNotFoundError:
            named = None
        if named is not None and os.path.samestat(os.fstat(file.fileno()), named):
            file.truncate(0)
            return file
        file.close()


class ShardWriter:
    """Writes one shard: ``.tar.part`` until `close`, then synced and renamed. An exception leaves no file behind, and so does
    a shard without samples."""

    def __init__(self, path: Path):
        self.path = path
        self.part = path.with_name(path.name + ".part")
        self.count = 0
        self._file = _open_part(self.part)

    def __enter__(self) -> ShardWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None and self.count:
            self.close()
        else:
            # Removed before it is unlocked.
            self.part.unlink(missing_ok=True)
            self._file.close()

    def _member(self, name: str, data: bytes) -> None:
        info = tarfile.TarInfo(name)
        info.size = len(data)
        self._file.write(info.tobuf(tarfile.USTAR_FORMAT))
        self._file.write(data + bytes(-len(data) % BLOCK))

    def write(self, number: int, sample: Sample, facts: dict[str, Any], raw_unit_m: float = 1e-3) -> None:
        """Append one sample with true and raw depth.

        :param number: of the sample in the whole run.
        :param facts: further entries of its json: `sensor`, `sensor_model`, `seed`, `families`, `scene`.
        """
        camera = sample.need_intrinsics("a shard")
        if sample.raw is None:
            raise LabError(f"{sample.name}: no raw depth, which a shard needs")
        key = f"{number:010d}"
        height, width = sample.color.shape[:2]
        intrinsics = dataclasses.asdict(camera)
        record = {"format": FORMAT, **facts, "intrinsics": intrinsics, "truth_unit_m": TRUTH_UNIT_M}
        record |= {"raw_unit_m": raw_unit_m, "width": width, "height": height, "licence": sample.licence.name}
        self._member(f"{key}.color.png", encode_png(sample.color))
        self._member(f"{key}.truth.png", encode_png(to_units(sample.need_truth(), TRUTH_UNIT_M)))
        self._member(f"{key}.raw.png", encode_png(to_units(sample.raw, raw_unit_m)))
        if sample.filled is not None:
            self._member(f"{key}.filled.png", encode_png(to_units(sample.filled, raw_unit_m)))
        if sample.material is not None:
            self._member(f"{key}.material.png", encode_png(sample.material))
        self._member(f"{key}.json", json.dumps(record).encode())
        self.count += 1

    def close(self) -> None:
        """End the shard and give it its final name."""
        self._file.write(bytes(2 * BLOCK))
        self._file.flush()
        os.fsync(self._file.fileno())
        # Named before it is unlocked.
        self.part.replace(self.path)
        self._file.close()
        fsync_folder(self.path.parent)


def write_description(folder: Path, name: str, version: str, arguments: dict[str, Any], samples: int) -> None:
    """Write `NAME.json` beside the shards."""
    record = {"version": version, "arguments": arguments, "samples": samples}
    write_atomically(folder / f"{name}.json", (json.dumps(record, indent=1) + "\n").encode())


def part_of(text: str) -> tuple[int, int]:
    """Return k and n of `k/n`: the k-th of n parts, counted from 0.

    :raises LabError: when it is not of that form or k is not below n.
    """
    match = re.fullmatch(r"(\d{1,6})/(\d{1,6})", text)
    if match is None or int(match[1]) >= int(match[2]):
        raise LabError(f'invalid part "{text}"; it is K/N with K from 0 to N-1, such as 0/4')
    return int(match[1]), int(match[2])


def _members(path: Path) -> Iterator[tuple[str, dict[str, bytes]]]:
    """Samples of a shard, read from its beginning to its end."""
    with path.open("rb") as file:
        members: dict[str, bytes] = {}
        while (header := _header(file, path)) is not None:
            match = NAME.fullmatch(header.name)
            if match is None or not 0 <= header.size <= MEMBERS_MAX:
                raise LabError(f"{path}: unknown member {header.name}; install a depthrig that knows it")
            data = file.read(header.size)
            if len(data) != header.size or len(file.read(-header.size % BLOCK)) != -header.size % BLOCK:
                raise LabError(f"{path}: cut short within {header.name}; make this shard again")
            members[match["what"]] = data
            if match["what"] == "json":
                if missing := {"color.png", "truth.png", "raw.png"} - members.keys():
                    raise LabError(f"{path}: sample {match['key']} has no {', '.join(sorted(missing))}")
                yield match["key"], members
                members = {}
    if members:
        raise LabError(f"{path}: its last sample has no json")


def stream(
    shards: Sequence[Path], seed: int, epoch: int = 0, part: tuple[int, int] = (0, 1), buffer: int = 256
) -> Iterator[Sample]:
    """Read samples once, in an order that `seed` and `epoch` decide, holding at most `buffer` undecoded ones.

    The order of the shards is drawn, and samples are drawn from the buffer. Of n processes with the same arguments but
    `part`, each gets other shards, and together they get all; with fewer shards than processes each gets other samples.
    """
    k, n = part
    order = np.random.default_rng([seed, epoch]).permutation(len(shards))
    by_shard = len(shards) >= n
    mine = [shards[i] for i in (order[k::n] if by_shard else order)]
    rng = np.random.default_rng([seed, epoch, k])
    held: list[tuple[str, dict[str, bytes]]] = []
    number = 0
    for path in mine:
        for key, members in _members(path):
            number += 1
            if not by_shard and (number - 1) % n != k:
                continue
            held.append((f"{path}: sample {key}", members))
            if len(held) > buffer:
                at = int(rng.integers(len(held)))
                held[at], held[-1] = held[-1], held[at]
                where, drawn = held.pop()
                yield read_sample(drawn, where)
    for at in rng.permutation(len(held)):
        yield read_sample(held[at][1], held[at][0])
