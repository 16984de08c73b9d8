"""Signals out of a dataset: what an MCAP reader decoded, as arrays."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from ._signal_description import parse_description
from ._signal_sample import SignalWindow, check_values


def recorded_signal(description: str, messages: Iterable[Any]) -> SignalWindow:
    """The samples of a recorded signal as arrays, bit by bit as they were published.

    `messages` are the decoded `depthrig_msgs/msg/SignalSamples` of its topic `/RIG/DEVICE/SIGNAL/samples`, in their order,
    and `description` is the metadata of that name of their channel. Raises BadSignal for a description that cannot be
    read, and for values that are not those of it.
    """
    described = parse_description(description.encode(), "a recorded signal")
    times_ns: list[int] = []
    raws: list[bytes] = []
    for message in messages:
        for sample in message.samples:
            raw = bytes(sample.values)
            check_values(described, raw, described.name)
            times_ns.append(sample.time_ns)
            raws.append(raw)
    return SignalWindow(described, times_ns, raws)
