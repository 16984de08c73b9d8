"""A message of ROS 2 as samples of signals: names, times and what is refused."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Mapping, Sequence
from typing import Any

from .._runtime import PathLike
from .._signal import Signal
from . import _types
from ._clock import read_offset

_UNITS = {"position": "rad", "velocity": "rad/s", "effort": "N m"}
_LONGEST_NAME = 31
_OLDEST_S = 10.0


class Refused(Exception):
    """A message does not become a sample; the message of this error says why and what to do."""


def signal_name(topic: str) -> str:
    """Return the name of a topic's signal: `/arm/joint_states` is `arm/joint_states`, `/pose` is `ros/pose`."""
    parts = [re.sub(r"[^a-z0-9_]", "_", part.lower()) for part in topic.strip("/").split("/")]
    device = "_".join(parts[:-1]) or "ros"
    return f"{_bounded(device)}/{_bounded(parts[-1], _LONGEST_NAME - len('_velocity'))}"


def _bounded(name: str, most: int = _LONGEST_NAME) -> str:
    return (name if name[:1].isalpha() else f"t{name}")[:most]


class InboundSignals:
    """The signals that one topic becomes: one for a pose, and up to three for joint states."""

    def __init__(self, topic: str, runtime_dir: PathLike) -> None:
        self._name = signal_name(topic)
        self._runtime_dir = runtime_dir
        self._signals: dict[str, Signal] = {}

    @property
    def names(self) -> list[str]:
        """The signals that are published so far."""
        return [signal.name for signal in self._signals.values()]

    def publish(self, ros_type: str, message: Any) -> int:
        """Publish the samples of a message; return how many. Raises Refused, and DepthrigError of the bus."""
        time_ns, uncertainty_ns = _time(message.header.stamp)
        samples = self._joints(message) if ros_type == _types.JOINTS else [self._pose(message)]
        for signal, values in samples:
            try:
                signal.publish(values, time_ns, uncertainty_ns=uncertainty_ns)
            except ValueError as e:
                raise Refused(str(e)) from None
        return len(samples)

    def _joints(self, message: Any) -> list[tuple[Signal, Mapping[str, float]]]:
        names = list(message.name)
        if len(set(names)) != len(names):
            raise Refused("two joints have the same name")
        samples: list[tuple[Signal, Mapping[str, float]]] = []
        for array, unit in _UNITS.items():
            values = [float(v) for v in getattr(message, array)]
            if not values:
                continue
            if len(values) != len(names):
                raise Refused(f"it names {len(names)} joints and has {len(values)} values of {array}")
            signal = self._signals.get(array)
            if signal is None:
                name = self._name if array == "position" else f"{self._name}_{array}"
                signal = self._open(array, name, names, unit=unit, kind="joints")
            expected = [field.name for field in signal.description.fields]
            if set(expected) != set(names):
                raise Refused(
                    f"its joints are {_list(names)}, those of signal {signal.name} are {_list(expected)}; let each "
                    "publisher have a topic of its own, or start this program again"
                )
            samples.append((signal, dict(zip(names, values))))
        if not samples:
            raise Refused("it has no values")
        return samples

    def _pose(self, message: Any) -> tuple[Signal, list[float]]:
        frame = str(message.header.frame_id)
        signal = self._signals.get("pose")
        if signal is None:
            signal = self._open("pose", self._name, None, frame=frame, kind="pose")
        if signal.description.frame != frame:
            raise Refused(
                f"its pose is in frame {frame!r}, those of signal {signal.name} are in {signal.description.frame!r}; "
                "start this program again if the frame has changed"
            )
        position, rotation = message.pose.position, message.pose.orientation
        values = [position.x, position.y, position.z, rotation.x, rotation.y, rotation.z, rotation.w]
        if not all(math.isfinite(v) for v in values):
            raise Refused("its pose has numbers that are not finite")
        return signal, values

    def _open(self, key: str, name: str, fields: Sequence[str] | None, **about: Any) -> Signal:
        try:
            signal = Signal(name, fields, runtime_dir=self._runtime_dir, **about)
        except ValueError as e:
            raise Refused(str(e)) from None
        self._signals[key] = signal
        return signal

    def close(self) -> None:
        """Stop publishing."""
        for signal in self._signals.values():
            signal.close()
        self._signals.clear()


def _time(stamp: Any) -> tuple[int | None, int]:
    """Return a stamp on the host's clock, with its uncertainty; None for a message without one: it is now."""
    utc_ns = int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
    if utc_ns == 0:
        return None, 0
    offset = read_offset()
    time_ns = utc_ns - offset.ns
    age_s = (time.monotonic_ns() - time_ns) / 1e9
    if age_s > _OLDEST_S:
        raise Refused(
            f"its stamp is {age_s:.1f} s old; stamps are UTC, not simulated time, and the "
            "clocks of both computers must agree"
        )
    return time_ns, offset.uncertainty_ns


def _list(names: Sequence[str]) -> str:
    return ", ".join(names[:8]) + (f" and {len(names) - 8} more" if len(names) > 8 else "")
