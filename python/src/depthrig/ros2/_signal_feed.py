"""A signal of the bus as `JointState` or `PoseStamped`: every sample."""

from __future__ import annotations

import contextlib

from .._signal_description import SignalDescription
from .._signal_reader import SignalReader
from .._signal_sample import SignalSample
from ..errors import Timeout
from . import _messages
from ._clock import Clock
from ._feed import SLICE_S, Feed
from ._names import Qos
from ._node import Node, Publisher


class _Samples(SignalReader):
    """A reader that hands over every sample, once."""

    def __init__(self, name: str, folder: str) -> None:
        self._fresh: list[SignalSample] = []
        super().__init__(name, folder, timeout=0.0, keep=0.1)

    def _keep(self, sample: SignalSample) -> None:
        super()._keep(sample)
        self._fresh.append(sample)

    def take(self) -> list[SignalSample]:
        """Wait a moment and return the samples that came."""
        with contextlib.suppress(Timeout):
            self.wait(SLICE_S)
        fresh, self._fresh = self._fresh, []
        return fresh


class SignalFeed(Feed):
    """The topic of one signal."""

    def __init__(self, node: Node, rig: str, folder: str, name: str, clock: Clock) -> None:
        super().__init__(node, name)
        self._rig = rig
        self._folder = folder
        self._clock = clock

    def serve(self) -> None:
        """Read one sample for the description, announce the topic, and publish while somebody subscribes."""
        description = self._describe()
        declared = None if description is None else _messages.signal_type(description)
        if declared is None:
            self._stop.wait()  # until the signal is gone
            return
        last, ros_type = declared
        topic = f"/{self._rig}/{self.name}/{last}"
        publisher = self.node.publisher(topic, ros_type, Qos.RELIABLE, self.wake)
        self.publishers.append(publisher)
        while not self.stopped:
            if publisher.wanted:
                with contextlib.closing(_Samples(self.name, self._folder)) as reader:
                    self._publish(reader, publisher)
            else:
                self.wait_for_change()

    def _describe(self) -> SignalDescription | None:
        with contextlib.closing(_Samples(self.name, self._folder)) as reader:
            while not self.stopped:
                for sample in reader.take():
                    return sample.description
        return None

    def _publish(self, reader: _Samples, publisher: Publisher) -> None:
        missed = 0
        while publisher.wanted and not self.stopped:
            for sample in reader.take():
                utc_ns = self._clock.utc_ns(sample.time_ns)
                publisher.put(_messages.signal(sample.description, sample.raw, utc_ns))
            publisher.count.missed += reader.missed - missed
            missed = reader.missed
