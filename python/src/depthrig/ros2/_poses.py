"""`/tf_static`: where each stream's frame is on the mount, sent again whenever one changes."""

from __future__ import annotations

import threading
import time

from .._header import Pose
from . import _messages, _names, _types
from ._node import Node


class Poses:
    """The poses of all streams, in one latched message."""

    def __init__(self, node: Node, rig: str) -> None:
        self._publisher = node.publisher("/tf_static", _types.TRANSFORMS, _names.Qos.LATCHED, lambda: None)
        self._mount = _names.mount_frame(rig)
        self._poses: dict[str, Pose] = {}
        self._lock = threading.Lock()

    def place(self, frame: str, pose: Pose) -> None:
        """State the pose of a frame; sends all of them if it is a new one."""
        if self._poses.get(frame) == pose:
            return
        with self._lock:
            self._poses[frame] = pose
            self._publisher.put(_messages.transforms(self._poses, self._mount, time.time_ns()))

    def forget(self) -> None:
        """Forget all poses: another daemon states its own."""
        with self._lock:
            self._poses.clear()

    def close(self) -> None:
        """Stop publishing."""
        self._publisher.close()
