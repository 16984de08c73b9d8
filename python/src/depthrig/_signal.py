"""Publishing a signal: small typed samples beside the images, such as the state and the actions of a robot."""

from __future__ import annotations

import ctypes
import os
import struct
import sys
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from . import _bus
from . import _layout as layout
from ._bus import Bus
from ._layout import SignalFlags
from ._ports import SIGNAL, SIGNALS, Bell, Sender
from ._runtime import PathLike, holder_of, runtime_dir, take_lock
from ._signal_description import _POSE, SignalDescription, SignalField
from .errors import BusError, SignalTaken

HEAD = struct.Struct("<4sHHQQqqQQIIII7Q")
"""The header of a sample."""
assert HEAD.size == layout.SIGNAL_HEADER_SIZE
_OFFSETS = {name: offset for name, offset, _, _ in layout.SIGNAL_FIELDS}
# The parts that change with every sample: sequence, session, the two times, the uncertainty; payload length, flags.
_TIMES = struct.Struct("<QQqqQ").pack_into
_ENDING = struct.Struct("<II").pack_into
assert (_OFFSETS["sequence"], _OFFSETS["description_hash"], _OFFSETS["payload_len"], _OFFSETS["flags"]) == (8, 48, 60, 64)
_PUBLISH_TIME = int(SignalFlags.PUBLISH_TIME)
_TIME_UNCERTAIN = int(SignalFlags.TIME_UNCERTAIN)


class Signal:
    """A signal that this process publishes: `Signal("arm/joint_position", fields=["shoulder", "elbow"], unit="rad")`.

    >>> with depthrig.Signal("arm/joint_position", ["shoulder", "elbow"], unit="rad", kind="joints") as signal:
    ...     signal.publish([0.1, -0.7])

    `fields` are names, each of one float in `unit`, or :class:`SignalField`, in the order of the values. `kind` is
    `fields`, `joints` (a float for each joint), or `pose`, which has no fields to name but a `frame`: its values are
    x, y, z in metres and the quaternion x, y, z, w. `runtime_dir` is the runtime folder, by default that of this user.

    One process publishes a signal; SignalTaken names it. It needs no rig and no daemon. A signal is for one thread.
    """

    def __init__(
        self,
        name: str,
        fields: Sequence[str | SignalField] | None = None,
        *,
        unit: str = "",
        kind: str = "fields",
        frame: str = "",
        runtime_dir: PathLike | None = None,
    ) -> None:
        self._sender: Sender | None = None
        if kind == "pose" and fields is None:
            fields = _POSE
        named = [SignalField(f, unit=unit) if isinstance(f, str) else SignalField(*f) for f in fields or ()]
        self.description = SignalDescription(name, kind, frame, named)
        """Name, kind and fields."""
        self.name = name
        folder = _runtime_dir(runtime_dir)
        taken = take_lock(_lock_path(folder, name), os.path.basename(sys.argv[0]) or "python")
        if isinstance(taken, str):
            raise SignalTaken(
                f"signal {name} is published already, by {taken}; end that first, or publish another signal"
            )
        self._lock = taken
        try:
            bus = Bus.at(folder)
            bus.clean_dead()  # remains of killed processes count against the limits of the channel
            text = self.description.json.encode()
            start = len(text) + -len(text) % 8
            most = layout.SIGNAL_MAX_VALUES_BYTES if self.description.has_text else self.description.struct.size
            channel = f"{layout.SIGNAL_PREFIX}/{name}"
            sender = Sender(bus, channel, SIGNAL, start + most, layout.SIGNAL_SLOTS, SIGNALS)
            self._bell = Bell(bus, channel, SIGNALS)
        except BaseException:
            os.close(self._lock)
            raise
        self._forks = _bus._forks
        self._start = start
        self._head = ctypes.create_string_buffer(layout.SIGNAL_HEADER_SIZE)
        self._body = ctypes.create_string_buffer(start + layout.SIGNAL_MAX_VALUES_BYTES)
        ctypes.memmove(self._body, text, len(text))
        self._addresses = ctypes.addressof(self._head), ctypes.addressof(self._body)
        self.session = time.monotonic_ns()
        """Identifies this publisher in the headers of its samples."""
        self._sequence = 0
        self._last_ns = -(1 << 63)
        fixed = (layout.SIGNAL_MAGIC, layout.SIGNAL_VERSION, layout.SIGNAL_HEADER_SIZE, 0, self.session, 0, 0, 0)
        HEAD.pack_into(self._head, 0, *fixed, self.description.hash, len(text), 0, 0, 0, *(0,) * 7)
        # All elements are floats: values are then packed as they come.
        self._plain = set(self.description.elements) <= {"f64", "f32"}
        self._pack = self.description.struct.pack_into
        self._size = self.description.struct.size
        self._sender = sender

    def publish(
        self,
        values: Sequence[Any] | np.ndarray[Any, Any] | Mapping[str, Any],
        time_ns: int | None = None,
        *,
        uncertainty_ns: int = 0,
        time_uncertain: bool = False,
    ) -> int:
        """Publish a sample and return its number. Never waits for a reader.

        `values` has an item for each field, in their order, or one for each element of all fields; or it is a mapping
        from names of fields. `time_ns` is when they were measured, on the clock of :func:`time.monotonic_ns`; now by
        default. `uncertainty_ns` is how far it may be off, 0 if unknown; `time_uncertain` that it may be by more.

        Raises ValueError when the values do not fit the fields, and for a time that is not after that of the sample
        before or lies more than 0.1 s ahead of the clock; then there is no such sample. Raises BusError when a sample is
        lost, which readers see as a gap.
        """
        sender = self._sender
        if sender is None:
            raise ValueError(f"signal {self.name} was closed")
        if _bus._forks != self._forks:
            raise BusError(f"signal {self.name} was opened before this process was forked; publish it in one process")
        now = time.monotonic_ns()
        flags = _TIME_UNCERTAIN if time_uncertain else 0
        if time_ns is None:
            flags |= _PUBLISH_TIME
            # A stated time may lie ahead of the clock by a little.
            time_ns = now if now > self._last_ns else self._last_ns + 1
        else:
            time_ns = self._checked(time_ns, now)
        start = self._start
        length = start + self._size
        try:
            if self._plain:
                self._pack(self._body, start, *values)
            else:
                length = start + self._write(values)
        except (struct.error, OverflowError, TypeError):  # by name, nested, or wrong
            self._write(values)
        sequence = self._sequence + 1
        _TIMES(self._head, 8, sequence, self.session, time_ns, now, uncertainty_ns)
        _ENDING(self._head, 60, length, flags)
        # Counted from here on: a sample that cannot be sent is a gap.
        self._sequence = sequence
        self._last_ns = time_ns
        head, body = self._addresses
        if not sender.send_copy(head, layout.SIGNAL_HEADER_SIZE, body, length):
            raise BusError(f"signal {self.name}: sample {sequence} is lost: there is no free slot for it")
        self._bell.ring()
        return sequence

    def welcome(self) -> None:
        """Deliver the last sample to readers that came since. Publishing does it as well."""
        if self._sender is None:
            raise ValueError(f"signal {self.name} was closed")
        self._sender.welcome()

    def _checked(self, time_ns: int, now: int) -> int:
        try:
            time_ns = time_ns.__index__()
        except AttributeError:
            raise ValueError(f"signal {self.name}: {time_ns!r} is not a time in whole nanoseconds") from None
        if time_ns <= self._last_ns:
            raise ValueError(
                f"signal {self.name}: time {time_ns} ns is not after that of the sample before, {self._last_ns} ns; each "
                "sample has a later time"
            )
        if time_ns > now + layout.SIGNAL_MAX_AHEAD_NS:
            raise ValueError(
                f"signal {self.name}: time {time_ns} ns lies {(time_ns - now) // 1_000_000} ms ahead of the clock, at most "
                f"{layout.SIGNAL_MAX_AHEAD_NS // 1_000_000} ms are possible; times are those of time.monotonic_ns(), not "
                "UTC and not those of a device"
            )
        return time_ns

    def _write(self, values: Any) -> int:
        """Write the values behind the description and return how many bytes they have."""
        description = self.description
        items = self._items(values)
        text = b""
        if description.has_text:
            if not isinstance(items[-1], str):
                raise ValueError(f"signal {self.name}: field {description.fields[-1].name!r} is a text, not {items[-1]!r}")
            text = items[-1].encode()
            if self._size + len(text) > layout.SIGNAL_MAX_VALUES_BYTES:
                raise ValueError(
                    f"signal {self.name}: its values have {self._size + len(text)} bytes, "
                    f"{layout.SIGNAL_MAX_VALUES_BYTES} is the most"
                )
            items[-1] = len(text)
        for kind, item in zip(description.elements, items):
            if kind == "bool" and not isinstance(item, (bool, np.bool_)):
                raise ValueError(f"signal {self.name}: {item!r} is not a bool")
        try:
            raw = description.struct.pack(*items)
        except (struct.error, OverflowError) as e:
            raise ValueError(f"signal {self.name}: the values {values!r} do not fit its fields: {e}") from None
        raw += text
        ctypes.memmove(self._addresses[1] + self._start, raw, len(raw))
        return len(raw)

    def _items(self, values: Any) -> list[Any]:
        """Return the elements of all fields."""
        fields = self.description.fields
        elements = self.description.elements
        if isinstance(values, Mapping):
            unknown = set(values) ^ {field.name for field in fields}
            if unknown:
                raise ValueError(f"signal {self.name}: fields {sorted(map(str, unknown))} are unknown or have no value")
            values = [values[field.name] for field in fields]
        try:
            items = [values] if isinstance(values, str) else list(values)
        except TypeError:
            raise ValueError(f"signal {self.name}: {values!r} is not a sequence of values") from None
        if len(items) == len(elements):
            return items
        if len(items) == len(fields):
            flat: list[Any] = []
            for field, item in zip(fields, items):
                parts = [item] if field.count == 1 else list(item) if np.ndim(item) == 1 else []
                if len(parts) != field.count:
                    raise ValueError(f"signal {self.name}: field {field.name!r} has {field.count} elements, not {item!r}")
                flat += parts
            return flat
        raise ValueError(
            f"signal {self.name}: there are {len(items)} values for {len(fields)} fields of {len(elements)} elements"
        )

    def close(self) -> None:
        """Stop publishing, and free the signal for others."""
        if self._sender is None or _bus._forks != self._forks:  # after a fork it is the parent's
            return
        self._sender = None
        del self._bell
        os.close(self._lock)

    def __enter__(self) -> Signal:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __del__(self) -> None:
        if getattr(self, "_sender", None) is not None:
            self.close()

    def __repr__(self) -> str:
        state = "closed" if self._sender is None else f"at #{self._sequence}"
        return f"<Signal {self.name}, {state}>"


def _lock_path(folder: str, name: str) -> str:
    return os.path.join(folder, name.replace("/", ".") + layout.SIGNAL_LOCK_SUFFIX)


def signals(runtime_dir: PathLike | None = None) -> list[str]:
    """List the signals that a process publishes now, sorted."""
    return published(_runtime_dir(runtime_dir))


def published(folder: str) -> list[str]:
    """List the signals below `folder` whose lock is held, sorted."""
    ending = layout.SIGNAL_LOCK_SUFFIX
    try:
        files = [name for name in os.listdir(folder) if name.endswith(ending)]
    except OSError:
        return []
    held = [name for name in files if holder_of(os.path.join(folder, name)) is not None]
    return sorted(name[: -len(ending)].replace(".", "/") for name in held)


_runtime_dir = runtime_dir
