"""Topics of ROS 2 that become signals of the rig: `JointState` and `PoseStamped`."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from typing import Any

import zenoh

from .._runtime import PathLike
from ..errors import DepthrigError
from . import _names, _types
from ._inbound_signal import InboundSignals, Refused
from ._names import Qos
from ._node import Node

log = logging.getLogger("depthrig.ros2")

TYPES = (_types.JOINTS, _types.POSE)
_WAITING = 1024
_LARGEST = 1 << 20
"""Bytes of the largest message that is looked at."""
_REPEAT_S = 10.0


class Inbound:
    """Subscribes to topics, and publishes what comes as signals in one thread."""

    def __init__(self, node: Node, topics: list[str], runtime_dir: PathLike) -> None:
        self._node = node
        self._signals = {topic: InboundSignals(topic, runtime_dir) for topic in topics}
        # Callbacks only enqueue: zenoh waits for them.
        self._waiting: deque[tuple[str, str, Any]] = deque(maxlen=_WAITING)
        self._come = threading.Event()
        self._stop = False
        self._said: dict[tuple[str, str], float] = {}
        self._tokens: dict[str, zenoh.LivelinessToken] = {}
        self.published = dict.fromkeys(topics, 0)
        """Samples by topic."""
        self.refused = dict.fromkeys(topics, 0)
        """Messages that did not become samples, by topic; the log says why."""
        self.overrun = 0
        """Messages that were dropped because more waited than fit."""
        self._subscribers: list[Any] = [self._subscribe(topic, ros_type) for topic in topics for ros_type in TYPES]
        tokens = f"@ros2_lv/{node.domain}/**"
        self._subscribers.append(node.session.liveliness().declare_subscriber(tokens, self._announced, history=True))
        self._thread = threading.Thread(target=self._run, name="inbound", daemon=True)
        self._thread.start()

    def signal_names(self) -> set[str]:
        """Return the signals that are published here."""
        return {name for signals in self._signals.values() for name in signals.names}

    def _subscribe(self, topic: str, ros_type: str) -> Any:
        def came(sample: zenoh.Sample) -> None:
            self._enqueue(topic, ros_type, sample.payload)

        # Any hash: Humble has none, and the layout is the same.
        key = _names.key(self._node.domain, topic, _names.dds_name(ros_type), "*")
        return self._node.session.declare_subscriber(key, came)

    def _announced(self, sample: zenoh.Sample) -> None:
        found = _names.published_types(str(sample.key_expr))
        if found is not None and found[0] in self._signals and sample.kind == zenoh.SampleKind.PUT:
            self._enqueue(*found, None)

    def _enqueue(self, topic: str, ros_type: str, payload: Any) -> None:
        if len(self._waiting) == _WAITING:
            self.overrun += 1
        self._waiting.append((topic, ros_type, payload))
        self._come.set()

    def _run(self) -> None:
        while not self._stop:
            self._come.wait()
            self._come.clear()
            while self._waiting and not self._stop:
                topic, ros_type, payload = self._waiting.popleft()
                if payload is None:
                    self._match(topic, ros_type)
                else:
                    self._take(topic, ros_type, payload)

    def _match(self, topic: str, dds_type: str) -> None:
        """Announce the subscriber, once a publisher shows the topic's type: tools take one type for each topic."""
        ros_type = next((name for name in TYPES if _names.dds_name(name) == dds_type), None)
        if ros_type is None:
            wanted = " or ".join(TYPES)
            self._say(topic, f"its type is {dds_type}; a topic of {wanted} can become a signal")
        elif topic not in self._tokens:
            self._tokens[topic], _ = self._node.announce("MS", topic, ros_type, Qos.RELIABLE)

    def _take(self, topic: str, ros_type: str, payload: Any) -> None:
        try:
            if len(payload) > _LARGEST:
                raise Refused(f"it has {len(payload)} bytes, {_LARGEST} is the most")
            try:
                message = _types.decode(ros_type, payload.to_bytes())
            except Exception as e:  # rosbags raises what NumPy, struct and codecs raise
                raise Refused(f"it is not a {ros_type} in CDR ({type(e).__name__}: {e})") from None
            before = self._signals[topic].names
            self.published[topic] += self._signals[topic].publish(ros_type, message)
            for name in self._signals[topic].names:
                if name not in before:
                    log.info("%s is signal %s", topic, name)
        except (Refused, DepthrigError) as e:
            self.refused[topic] += 1
            self._say(topic, f"a message is refused: {e}")
        except Exception:
            self.refused[topic] += 1
            log.exception("%s: a message ends in an error of this program", topic)

    def _say(self, topic: str, what: str) -> None:
        """Log a problem of a topic, the same one at most every 10 s."""
        kind = (topic, what[:60])
        now = time.monotonic()
        if len(self._said) > _WAITING:
            self._said.clear()
        if now >= self._said.get(kind, 0.0):
            self._said[kind] = now + _REPEAT_S
            log.error("%s: %s", topic, what)

    def close(self) -> None:
        """Stop, and free the signals for others."""
        for subscriber in self._subscribers:
            subscriber.undeclare()
        self._stop = True
        self._come.set()
        self._thread.join()
        for token in self._tokens.values():
            token.undeclare()
        for signals in self._signals.values():
            signals.close()
