"""The source of frames: a running pipeline of the SDK, of a camera or of files, with a queue for each stream."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import depthai as dai

CALIBRATION = "calibration.json"
"""The file with the calibration, beside recordings and images."""
QUEUE = 4
"""Frames that may wait for the bridge; the oldest is replaced, and its number is missing from the camera's count."""


@dataclass
class Identity:
    """Description of the camera."""

    model: str
    serial: str
    firmware: str = ""
    port: str = ""
    calibration: str = "none"
    """Where the calibration comes from."""


@dataclass
class Source:
    """A pipeline that can be started, and its queues by stream name."""

    pipeline: dai.Pipeline
    outputs: dict[str, dai.Node.Output]
    """The outputs that feed the queues, for recording."""
    identity: Identity
    rate_hz: float
    calibration: dai.CalibrationHandler | None = None
    """The camera's calibration; None without one."""
    sockets: dict[str, dai.CameraBoardSocket] = field(default_factory=dict)
    """The sensor that each stream looks from."""
    notes: list[str] = field(default_factory=list)
    """Notes for the user, one line each."""
    frames: dict[str, int] | None = None
    """Frames of each stream, for files that are played once; None for an endless source."""
    queues: dict[str, dai.MessageQueue] = field(default_factory=dict)

    def open_queues(self) -> None:
        """Make a queue for each output; before the pipeline is started."""
        for name, output in self.outputs.items():
            self.queues[name] = output.createOutputQueue(maxSize=QUEUE, blocking=False)
