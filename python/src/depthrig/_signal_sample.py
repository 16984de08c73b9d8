"""Samples of a signal as a reader has them: one, or a window of them as arrays."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ._layout import SignalFlags
from ._signal_description import SignalDescription
from .errors import BadSignal

# Above this cosine of half the angle between two rotations the arc is a straight line within 1e-6 of its length.
_NEARLY_EQUAL = 0.999999
_FLOATS = ("f64", "f32")


@dataclass(frozen=True)
class SignalSample:
    """One sample, in memory of its own. `sample["elbow"]` is the value of a field. Times are nanoseconds."""

    description: SignalDescription
    """Name, kind and fields of the signal."""
    sequence: int
    """Number of the sample of its publisher: 1, 2, 3, …"""
    session: int
    """Identifies one publisher's life; that of a later one is larger."""
    time_ns: int
    """When the values were measured, on the clock of :func:`time.monotonic_ns`."""
    publish_time_ns: int
    """When the sample was published."""
    uncertainty_ns: int
    """`time_ns` is right within this much; 0 when the publisher states none."""
    flags: SignalFlags
    """Facts about the sample."""
    raw: bytes
    """The values as they were published."""

    @property
    def values(self) -> npt.NDArray[Any]:
        """All values as one array; ValueError if they have several types."""
        return np.frombuffer(bytearray(self.raw), _plain(self.description))

    def __getitem__(self, name: str) -> Any:
        """Return the value of a field: a number, a bool, a text, or an array of several elements."""
        field = self.description.field(name)
        if field.type == "text":
            return self.raw[self.description.struct.size :].decode()
        array = np.frombuffer(bytearray(self.raw[: self.description.struct.size]), self.description.dtype)[0][name]
        return array if field.count > 1 else array.item()

    @property
    def age_s(self) -> float:
        """Seconds since the values were measured. A replayed sample has the time of its recording."""
        return (time.monotonic_ns() - self.time_ns) / 1e9

    @property
    def replayed(self) -> bool:
        """Whether a replay publishes it."""
        return SignalFlags.REPLAYED in self.flags

    @property
    def interpolated(self) -> bool:
        """Whether it was computed between two samples."""
        return SignalFlags.INTERPOLATED in self.flags


class SignalWindow:
    """Consecutive samples of a signal as arrays: `window["elbow"]` has the values of a field."""

    def __init__(self, description: SignalDescription, times_ns: list[int], raws: list[bytes]) -> None:
        self.description = description
        """Name, kind and fields of the signal."""
        self.times_ns: npt.NDArray[np.int64] = np.array(times_ns, np.int64)
        """When each sample was measured, rising."""
        self._raws = raws

    @property
    def values(self) -> npt.NDArray[Any]:
        """All values, a row for each sample; ValueError if they have several types."""
        array = np.frombuffer(bytearray(b"".join(self._raws)), _plain(self.description))
        return array.reshape(len(self._raws), len(self.description.elements))

    def __getitem__(self, name: str) -> Any:
        """Return the values of a field: an array with a row for each sample, or a list of texts."""
        field = self.description.field(name)
        size = self.description.struct.size
        if field.type == "text":
            return [raw[size:].decode() for raw in self._raws]
        return np.frombuffer(bytearray(b"".join(raw[:size] for raw in self._raws)), self.description.dtype)[name]

    def __len__(self) -> int:
        return len(self._raws)

    def __repr__(self) -> str:
        return f"<SignalWindow of {self.description.name}, {len(self)} samples>"


def _plain(description: SignalDescription) -> npt.DTypeLike:
    if description.plain is None:
        raise ValueError(
            f"signal {description.name} has no array of all values, because they have several types or a text; read its "
            f"fields by name: {', '.join(field.name for field in description.fields)}"
        )
    return description.plain


def check_values(description: SignalDescription, raw: bytes, what: str) -> None:
    """Raise BadSignal unless the values are as long as the description says."""
    size = description.struct.size
    if not description.has_text:
        if len(raw) != size:
            raise BadSignal(f"{what}: invalid sample: its values have {len(raw)} bytes, not {size}")
        return
    stated = int.from_bytes(raw[size - 4 : size], "little")
    if len(raw) != size + stated:
        raise BadSignal(f"{what}: invalid sample: its text has {len(raw) - size} bytes and says {stated}")
    try:
        raw[size:].decode()
    except UnicodeDecodeError as e:
        raise BadSignal(f"{what}: invalid sample: its text is not UTF-8") from e


def between(before: SignalSample, after: SignalSample, time_ns: int) -> SignalSample:
    """Return the sample at a time between two: floats on a line, rotations on the shorter arc, all else from before."""
    description = before.description
    share = (time_ns - before.time_ns) / (after.time_ns - before.time_ns)
    unpack, size = description.struct.unpack_from, description.struct.size
    pairs = zip(description.elements, unpack(before.raw), unpack(after.raw))
    values = [(1.0 - share) * a + share * b if kind in _FLOATS and a != b else a for kind, a, b in pairs]
    if description.kind == "pose":
        values[3:] = slerp(unpack(before.raw)[3:], unpack(after.raw)[3:], share)
    return replace(
        before,
        time_ns=time_ns,
        uncertainty_ns=max(before.uncertainty_ns, after.uncertainty_ns),
        flags=before.flags | after.flags | SignalFlags.INTERPOLATED,
        raw=description.struct.pack(*values) + before.raw[size:],
    )


def slerp(start: tuple[float, ...], end: tuple[float, ...], share: float) -> list[float]:
    """Return the rotation `share` of the way on the shorter arc; NaN when one of the quaternions has no length."""
    p, q = _unit(start), _unit(end)
    dot = sum(a * b for a, b in zip(p, q))
    # A quaternion and its negative are one rotation.
    sign, cosine = (-1.0, -dot) if dot < 0.0 else (1.0, dot)
    a, b = 1.0 - share, share
    if cosine <= _NEARLY_EQUAL:
        angle = math.acos(cosine)
        a, b = math.sin(a * angle) / math.sin(angle), math.sin(b * angle) / math.sin(angle)
    return _unit(tuple(a * x + sign * b * y for x, y in zip(p, q)))


def _unit(q: tuple[float, ...]) -> list[float]:
    length = math.sqrt(sum(x * x for x in q))
    return [x / length if length > 0.0 else math.nan for x in q]
