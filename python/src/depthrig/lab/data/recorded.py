"""depthrig's own datasets: `sensor` is the camera; colour is its stream `color`, raw depth its `depth`.

`reference` names a stream whose depth is taken as the truth, such as refined depth that was recorded beside. Depth must
have been recorded registered to colour (same size, intrinsics and pose).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ...codec import decode_depth
from .. import images
from ..config import DataConfig
from ..errors import LabError
from ..sample import Intrinsics, Licence, Sample
from .source import RANGES_M, Source

__all__ = ["Recorded"]

CHANNELS = {"rgb8": 3, "bgr8": 3, "16UC1": 1, "32FC1": 1}


class _Cdr:
    """Reads little-endian CDR, field by field."""

    def __init__(self, data: bytes):
        if data[:2] != b"\x00\x01":
            raise LabError("not little-endian CDR")
        self.data = data
        self.at = 12  # encapsulation, stamp

    def u32(self) -> int:
        self.at = -(-self.at // 4) * 4
        (value,) = struct.unpack_from("<I", self.data, self.at)
        self.at += 4
        return int(value)

    def u8(self) -> int:
        self.at += 1
        return self.data[self.at - 1]

    def bytes(self) -> bytes:
        size = self.u32()
        if size > len(self.data) - self.at:
            raise LabError("message cut short")
        self.at += size
        return self.data[self.at - size : self.at]

    def text(self) -> str:
        return self.bytes().rstrip(b"\0").decode("utf-8", "replace")


def _image(message: bytes) -> tuple[npt.NDArray[Any], str]:
    """Pixels and encoding of a `sensor_msgs/msg/Image`."""
    cdr = _Cdr(message)
    cdr.text()
    height, width, encoding = cdr.u32(), cdr.u32(), cdr.text()
    cdr.u8()
    step, data = cdr.u32(), cdr.bytes()
    if encoding not in CHANNELS:
        raise LabError(f"pixels of {encoding}; use a stream of {', '.join(CHANNELS)} or JPEG")
    dtype = {"16UC1": "<u2", "32FC1": "<f4"}.get(encoding, "u1")
    row = width * CHANNELS[encoding] * np.dtype(dtype).itemsize
    if step < row or step * height != len(data) or not row:
        raise LabError(f"{width}x{height} of {encoding} do not fit {len(data)} bytes")
    rows = np.frombuffer(data, np.uint8).reshape(height, step)[:, :row]
    pixels = np.ascontiguousarray(rows).view(dtype)
    return (pixels.reshape(height, width, 3) if CHANNELS[encoding] == 3 else pixels), encoding


@contextmanager
def _reader(path: Path) -> Iterator[Any]:
    try:
        from mcap.exceptions import McapError
        from mcap.reader import make_reader
    except ImportError as e:
        raise LabError("datasets need the package: pip install mcap") from e
    try:
        with path.open("rb") as f:
            yield make_reader(f)
    except (McapError, OSError, struct.error, ValueError) as e:
        raise LabError(f"{path}: {str(e) or type(e).__name__}; run `depthrig verify`") from None


class Recorded(Source):
    """The sets of a dataset, or of every dataset in a folder, that have both colour and depth of one camera."""

    licence = Licence("your own recordings", ships=True)

    def __init__(self, data: DataConfig):
        super().__init__(data)
        self.splits("train", "all")
        if not data.sensor:
            raise LabError(f'{self.root}: name a camera of the dataset: sensor = "d435"')
        color, depth = f"{data.sensor}/color", f"{data.sensor}/depth"
        self.names = {"color": color, "raw": depth} | ({"truth": data.reference} if data.reference else {})
        here = [self.root] if (self.root / "session.toml").is_file() else sorted(self.root.iterdir())
        self.sets: list[tuple[Path, int]] = []
        self.facts: dict[Path, dict[str, Any]] = {}
        for folder in here:
            if (folder / "session.toml").is_file():
                self._open(folder)
        self.found(len(self.sets), f"dataset with sets of {', '.join(self.names.values())}")

    def _open(self, folder: Path) -> None:
        import tomllib

        path = folder / "session.toml"
        try:
            session = tomllib.loads(path.read_text())
            streams = {s["id"]: s for s in session["streams"]}
            rig = session["rig"]
        except (OSError, ValueError, KeyError, TypeError) as e:
            raise LabError(f"{path}: {type(e).__name__} {e}") from None
        for name in self.names.values():
            if name not in streams:
                raise LabError(f"{path}: no stream {name}; it has {', '.join(streams)}")
        of_color = streams[self.names["color"]]
        for name in self.names.values():
            for key in ("width", "height", "intrinsics", "pose"):
                if streams[name].get(key) != of_color.get(key):
                    raise LabError(
                        f"{path}: {name} has another {key} than {of_color['id']}: depth is not registered to colour"
                    )
        model = str(streams[self.names["raw"]].get("model", "")).lower()
        self.sensor = next((m for m in RANGES_M if m in model.replace(" ", "")), "")
        topics = {what: f"/{rig}/{name}" for what, name in self.names.items()}
        self.facts[folder] = {"topics": topics, "intrinsics": of_color.get("intrinsics")}
        wanted = [f"{t}/camera_info" for t in topics.values()]
        for segment in sorted(folder.glob("seg_*.mcap")):
            seen: dict[int, set[str]] = {}
            with _reader(segment) as reader:
                for _, channel, message in reader.iter_messages([*wanted, f"/{rig}/frame_set"]):
                    seen.setdefault(message.log_time, set()).add(channel.topic)
            # A set without its mark was not recorded.
            complete = {*wanted, f"/{rig}/frame_set"}
            self.sets += [(segment, time) for time, topics_of in sorted(seen.items()) if topics_of == complete]

    def __len__(self) -> int:
        return len(self.sets)

    def __getitem__(self, index: int) -> Sample:
        segment, time = self.sets[index]
        facts = self.facts[segment.parent]
        found: dict[str, Any] = {}
        kinds = ("image_raw", "image_compressed", "depth_compressed")
        by_topic = {f"{topic}/{kind}": what for what, topic in facts["topics"].items() for kind in kinds}
        name = f"{segment}: set at {time}"
        with _reader(segment) as reader:
            for _, channel, message in reader.iter_messages(list(by_topic), starting_at=time, ending_at=time):
                what = by_topic[channel.topic]
                found[what] = self._pixels(what, channel, message.data, f"{name}: {channel.topic}")
        if missing := facts["topics"].keys() - found.keys():
            raise LabError(f"{name}: no {', '.join(sorted(missing))}; run `depthrig verify`")
        of = facts["intrinsics"] or {}
        known = float(of.get("fx", 0)) > 0
        intrinsics = None
        if known:
            fx, fy, cx, cy = (float(of[k]) for k in ("fx", "fy", "cx", "cy"))
            coeffs = tuple(float(c) for c in of.get("coeffs", ()))
            intrinsics = Intrinsics(fx, fy, cx, cy, str(of.get("model", "none")), coeffs)
        return Sample(name, found["color"], self.licence, found["raw"], found.get("truth"), intrinsics)

    @staticmethod
    def _pixels(what: str, channel: Any, data: bytes, where: str) -> npt.NDArray[Any]:
        kind = channel.topic.rsplit("/", 1)[1]
        try:
            if kind == "image_compressed":
                cdr = _Cdr(data)
                cdr.text()
                cdr.text()
                return images.decode_color(cdr.bytes(), where)
            pixels, encoding = (decode_depth(data), "16UC1") if kind == "depth_compressed" else _image(data)
        except (LabError, ValueError, struct.error) as e:
            raise LabError(f"{where}: {str(e).removeprefix(f'{where}: ')}; run `depthrig verify`") from None
        if what == "color":
            if pixels.ndim != 3:
                raise LabError(f"{where}: {encoding} is not colour")
            return np.array(pixels[..., ::-1] if encoding == "bgr8" else pixels)
        if pixels.ndim != 2:
            raise LabError(f"{where}: {encoding} is not depth")
        if encoding == "32FC1":
            return images.metres(pixels)
        # The unit of the channel; 65535 is a reading that some cameras send for none.
        unit = float(channel.metadata["depth_unit_m"])
        if not 1e-6 <= unit <= 1:
            raise LabError(f"{where}: invalid depth unit {unit} m")
        return images.metres(np.where(pixels == 65535, 0, pixels) * unit)

    def files(self) -> Sequence[Path]:
        """Return every file."""
        return sorted({segment for segment, _ in self.sets})
