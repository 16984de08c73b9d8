"""From one source on the bus to its topics, in a thread of its own. Nothing is read while nobody subscribes."""

from __future__ import annotations

import logging
import threading

import zenoh

from ..errors import DepthrigError
from ._node import Node, Publisher

log = logging.getLogger("depthrig.ros2")

SLICE_S = 0.2
"""How often a feed that waits for the bus looks whether it is still wanted."""


class Feed:
    """The base of the feeds: a thread that ends with its source, and says why."""

    def __init__(self, node: Node, name: str) -> None:
        self.name = name
        self.node = node
        self.publishers: list[Publisher] = []
        self._stop = threading.Event()
        self._changed = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    @property
    def is_alive(self) -> bool:
        """Whether it still runs; one that has ended is to be made anew."""
        return self._thread.is_alive()

    @property
    def stopped(self) -> bool:
        """Whether it is asked to end."""
        return self._stop.is_set()

    def wake(self) -> None:
        """Look again who subscribes."""
        self._changed.set()

    def wait_for_change(self) -> None:
        """Wait until subscribers come or go, or a moment."""
        self._changed.wait(SLICE_S * 5)
        self._changed.clear()

    def stop(self) -> None:
        """Ask it to end."""
        self._stop.set()
        self._changed.set()

    def join(self) -> None:
        """Wait until it has ended and its topics are taken back."""
        self._thread.join()

    def serve(self) -> None:
        """Publish until it is stopped; may raise DepthrigError when the source is gone."""
        raise NotImplementedError

    def _run(self) -> None:
        try:
            self.serve()
        except DepthrigError as e:
            log.info("%s", e)
        except zenoh.ZError as e:
            log.error("%s: zenoh refuses a message (%s)", self.name, e)
        except Exception:
            log.exception("%s: its topics end with an error of this program; they begin anew", self.name)
        finally:
            for publisher in self.publishers:
                publisher.close()
