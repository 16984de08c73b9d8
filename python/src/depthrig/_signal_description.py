"""The description of a signal, which every sample carries as JSON: the mirror of bus/src/signal/description.rs."""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from . import _layout as layout
from ._runtime import check_name
from .errors import BadSignal, VersionMismatch

_CODES = {"f64": "d", "f32": "f", "i64": "q", "bool": "?", "text": "I"}
_DTYPES = {"f64": "<f8", "f32": "<f4", "i64": "<i8", "bool": "?"}
assert list(_CODES) == list(layout.SIGNAL_TYPES)
_MAX_FIELD_NAME, _MAX_UNIT, _MAX_FRAME = 64, 32, 64


class SignalField(NamedTuple):
    """One field of a signal."""

    name: str
    """Its name, unique among the signal's."""
    type: str = "f64"
    """Type of its elements: `f64`, `f32`, `i64`, `bool`, or `text`, of which there is one at most, as the last field."""
    count: int = 1  # type: ignore[assignment]
    """Its elements."""
    unit: str = ""
    """The unit of its elements, such as `rad`."""


_POSE = (SignalField("translation_m", "f64", 3, "m"), SignalField("rotation_xyzw", "f64", 4))


class SignalDescription:
    """Name, kind and fields of a signal."""

    def __init__(self, name: str, kind: str, frame: str, fields: Sequence[SignalField], text: str | None = None) -> None:
        device, slash, signal = name.partition("/")
        if not slash:
            raise ValueError(f"invalid signal name {name!r}: write DEVICE/SIGNAL, such as arm/joint_position")
        check_name(device, "device")
        check_name(signal, "signal")
        self.name = name
        """Its name, `DEVICE/SIGNAL`."""
        self.kind = kind
        """`fields`, `joints` (a float for each joint) or `pose`."""
        self.frame = frame
        """The frame that a pose is in; empty for other kinds."""
        self.fields = tuple(fields)
        """Its fields, in the order of the values."""
        problem = _problem(kind, frame, self.fields)
        if problem:
            raise ValueError(f"signal {name}: {problem}")
        self.json = _to_json(name, kind, frame, self.fields) if text is None else text
        """The description as samples carry it."""
        raw = self.json.encode()
        if len(raw) > layout.SIGNAL_MAX_DESCRIPTION_BYTES:
            raise ValueError(
                f"signal {name}: its description has {len(raw)} bytes, {layout.SIGNAL_MAX_DESCRIPTION_BYTES} is the "
                "most; use fewer or shorter names, or one field of several elements"
            )
        self.hash = fnv(raw)
        """FNV-1a (64 bits) of the JSON."""
        self.has_text = self.fields[-1].type == "text"
        codes, end, offsets = "<", 0, []
        for field in self.fields:
            size = layout.SIGNAL_TYPES[field.type]
            pad = -end % size
            offsets.append(end + pad)
            codes += "x" * pad + f"{field.count}{_CODES[field.type]}"
            end += pad + size * field.count
            if end > layout.SIGNAL_MAX_VALUES_BYTES:
                raise ValueError(f"signal {name}: its values have more than {layout.SIGNAL_MAX_VALUES_BYTES} bytes")
        self.struct = struct.Struct(codes)
        """All values but the characters of a text, whose length is the last one."""
        self.elements = [field.type for field in self.fields for _ in range(field.count)]
        """The type of each element, in order."""
        self.numeric = [field for field in self.fields if field.type != "text"]
        types = {field.type for field in self.fields}
        self.plain: npt.DTypeLike | None = _DTYPES.get(types.pop()) if len(types) == 1 else None
        """NumPy's type of all elements, if they have the same one."""
        self.dtype = np.dtype(
            {
                "names": [field.name for field in self.numeric],
                "formats": [
                    _DTYPES[f.type] if f.count == 1 else (_DTYPES[f.type], (f.count,)) for f in self.numeric
                ],
                "offsets": offsets[: len(self.numeric)],
                "itemsize": end,
            }
        )

    def field(self, name: str) -> SignalField:
        """Return the field `name`; KeyError without one."""
        for field in self.fields:
            if field.name == name:
                return field
        raise KeyError(f"signal {self.name} has no field {name!r}; it has: {', '.join(f.name for f in self.fields)}")

    def same(self, other: SignalDescription) -> bool:
        """Whether both say the same, in whatever words."""
        return (self.name, self.kind, self.frame, self.fields) == (other.name, other.kind, other.frame, other.fields)

    def __repr__(self) -> str:
        return f"<SignalDescription {self.name} ({self.kind}): {', '.join(f.name for f in self.fields)}>"


def parse_description(raw: bytes, what: str) -> SignalDescription:
    """Return the description of a sample; raise BadSignal unless it is a valid one."""
    try:
        text = raw.decode()
        values = json.loads(text)
        if values["version"] != layout.SIGNAL_DESCRIPTION_VERSION:
            raise VersionMismatch(
                f"{what}: its description has version {values['version']}, this package reads version "
                f"{layout.SIGNAL_DESCRIPTION_VERSION}; install the `depthrig` package of the publisher's version"
            )
        fields = [SignalField(f["name"], f["type"], f.get("count", 1), f.get("unit", "")) for f in values["fields"]]
        return SignalDescription(values["name"], values["kind"], values.get("frame", ""), fields, text)
    except (ValueError, KeyError, TypeError, AttributeError) as e:
        raise BadSignal(f"{what}: invalid description of a signal: {e}") from e


def _to_json(name: str, kind: str, frame: str, fields: Sequence[SignalField]) -> str:
    """Write the same bytes as Rust: no spaces, and nothing that has its default value."""

    def one(field: SignalField) -> dict[str, Any]:
        values: dict[str, Any] = {"name": field.name, "type": field.type}
        if field.count != 1:
            values["count"] = field.count
        if field.unit:
            values["unit"] = field.unit
        return values

    values: dict[str, Any] = {"version": layout.SIGNAL_DESCRIPTION_VERSION, "name": name, "kind": kind}
    if frame:
        values["frame"] = frame
    values["fields"] = [one(field) for field in fields]
    return json.dumps(values, separators=(",", ":"), ensure_ascii=False)


def _is_plain(text: Any, most: int) -> bool:
    # Control characters are those of Unicode's category Cc, as in Rust.
    return (
        isinstance(text, str)
        and len(text.encode("utf-8", "surrogatepass")) <= most
        and not any(ord(c) < 0x20 or 0x7F <= ord(c) < 0xA0 or 0xD800 <= ord(c) < 0xE000 for c in text)
    )


def _problem(kind: str, frame: str, fields: Sequence[SignalField]) -> str | None:
    """Return the rule that the fields break, or None."""
    if kind not in layout.SIGNAL_KINDS:
        return f"unknown kind {kind!r}; there are {', '.join(layout.SIGNAL_KINDS)}"
    if not _is_plain(frame, _MAX_FRAME):
        return f"its frame has more than {_MAX_FRAME} bytes or control characters"
    names = set()
    for index, field in enumerate(fields):
        if not field.name or not _is_plain(field.name, _MAX_FIELD_NAME):
            return f"the name of field {index} has not 1 to {_MAX_FIELD_NAME} bytes without control characters"
        name = field.name
        if name in names:
            return f"two fields are named {name!r}"
        names.add(name)
        if field.type not in layout.SIGNAL_TYPES:
            return f"field {name!r} has the unknown type {field.type!r}; there are {', '.join(layout.SIGNAL_TYPES)}"
        if not _is_plain(field.unit, _MAX_UNIT):
            return f"the unit of field {name!r} has more than {_MAX_UNIT} bytes or control characters"
        if type(field.count) is not int or field.count < 1:
            return f"field {name!r} has no elements"
        if field.type == "text" and (field.count != 1 or index + 1 != len(fields)):
            return f"text field {name!r} is not one text at the end of the fields"
        if kind == "joints" and (field.type not in ("f64", "f32") or field.count != 1):
            return f"joint {name!r} is not one float (f64 or f32)"
    if not fields:
        return "it has no fields"
    if kind == "pose":
        if tuple(fields) != _POSE:
            return "a pose has the fields translation_m (3 f64, m) and rotation_xyzw (4 f64) and no others"
        return None if frame else "the frame of its pose is not named"
    return "it is not a pose, and has a frame" if frame else None


def fnv(raw: bytes) -> int:
    """Return FNV-1a with 64 bits."""
    value = 0xCBF29CE484222325
    for byte in raw:
        value = (value ^ byte) * 0x100000001B3 & 0xFFFFFFFFFFFFFFFF
    return value
