"""A node of ROS 2 in a zenoh session: its publishers and subscribers, announced by liveliness tokens."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import zenoh

from . import _names, _types
from ._names import Qos

log = logging.getLogger("depthrig.ros2")

_HEARTBEAT_S = 0.5


@dataclass
class Count:
    """What happened on one topic."""

    sent: int = 0
    """Messages given to zenoh, which does not report whether they arrive."""
    skipped: int = 0
    """Frames that were published on the rig while somebody listened, and are not sent: newer ones had come."""
    missed: int = 0
    """Samples of IMUs and signals that were published on the rig while somebody listened, and are not sent."""


class Node:
    """The node, and the factory of its endpoints. Those with the same topic share a count."""

    def __init__(self, session: zenoh.Session, domain: int, name: str) -> None:
        self.session = session
        self.domain = domain
        self.name = name
        self.counts: dict[str, Count] = {}
        """By topic, also of those that are no longer there."""
        self._zid = str(session.info.zid())
        self._number = 0
        self._lock = threading.Lock()
        self._token = session.liveliness().declare_token(_names.node_token(domain, self._zid, name))

    def publisher(self, topic: str, ros_type: str, qos: Qos, wake: Callable[[], None]) -> Publisher:
        """Announce a publisher. `wake` is called when subscribers come or go."""
        return Publisher(self, topic, ros_type, qos, wake)

    def announce(self, kind: str, topic: str, ros_type: str, qos: Qos) -> tuple[zenoh.LivelinessToken, str]:
        """Declare the token of an endpoint, `MP` or `MS`; return it with its text."""
        with self._lock:
            self._number += 1
            number = self._number
        about = f"{_types.about(ros_type)}/{qos.value}"
        text = _names.endpoint_token(self.domain, self._zid, self.name, number, kind, topic, about)
        return self.session.liveliness().declare_token(text), text

    def key(self, topic: str, ros_type: str) -> str:
        """Return the key of a topic's messages."""
        return _names.key(self.domain, topic, _names.dds_name(ros_type), _types.type_hash(ros_type))

    def close(self) -> None:
        """Take back the node's token; its endpoints are closed before."""
        self._token.undeclare()


class Publisher:
    """A publisher of one topic. One thread at a time may publish."""

    def __init__(self, node: Node, topic: str, ros_type: str, qos: Qos, wake: Callable[[], None]) -> None:
        self.topic = topic
        self.type = ros_type
        self.count = node.counts.setdefault(topic, Count())
        self._wake = wake
        self._sequence = 0
        self._wanted = qos is Qos.LATCHED
        self._publisher: Any
        self._listener: Any = None
        # rmw_zenoh blocks only for "reliable, keep all", which none of these is.
        options: dict[str, Any] = {"congestion_control": zenoh.CongestionControl.DROP}
        if ros_type not in (_types.IMAGE, _types.COMPRESSED, _types.POINTS):
            # Not behind the fragments of images.
            options["priority"] = zenoh.Priority.DATA_HIGH
        if qos is Qos.LATCHED:
            # As rmw_zenoh does it: subscribers that come later ask its cache.
            self._publisher = zenoh.ext.declare_advanced_publisher(
                node.session,
                node.key(topic, ros_type),
                cache=zenoh.ext.CacheConfig(max_samples=1),
                publisher_detection=True,
                sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=_HEARTBEAT_S, sporadic_heartbeat=None),
                **options,
            )
        else:
            self._publisher = node.session.declare_publisher(node.key(topic, ros_type), **options)
            self._listener = self._publisher.declare_matching_listener(self._matched)
            self._wanted |= self._publisher.matching_status.matching
        self._token, text = node.announce("MP", topic, ros_type, qos)
        self._gid = _names.identity(text)

    def _matched(self, status: Any) -> None:
        self._wanted = status.matching
        self._wake()

    @property
    def wanted(self) -> bool:
        """Whether somebody subscribes."""
        return self._wanted

    def put(self, payload: bytes | bytearray) -> None:
        """Publish a message in CDR."""
        self._sequence += 1
        beside = _names.attachment(self._sequence, time.time_ns(), self._gid)
        self._publisher.put(payload, attachment=beside)
        self.count.sent += 1

    def close(self) -> None:
        """Take back the token and stop publishing."""
        self._wanted = False
        self._token.undeclare()
        if self._listener is not None:
            self._listener.undeclare()
        self._publisher.undeclare()
