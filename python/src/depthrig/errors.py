"""The package's errors; every message names the stream, what happened and what to do."""

from __future__ import annotations


class DepthrigError(Exception):
    """Any error of this package."""


class RigNotRunning(DepthrigError):
    """The rig is not running; the message names those that are."""


class RigRefused(DepthrigError):
    """The rig refuses a call; the message says why and what to do."""

    def __init__(self, message: str, kind: str) -> None:
        super().__init__(message)
        self.kind = kind
        """`bad_input`, `not_found`, `in_use`, `wrong_state`, `no_space`, `permission_denied`, `unreachable` or `other`."""


class AmbiguousRig(DepthrigError):
    """Several rigs run and none was named."""


class StreamNotFound(DepthrigError):
    """The rig has no such stream; the message names those that it has."""


class StreamGone(DepthrigError):
    """The stream or signal has no publisher any more. The same object goes on when there is one again."""


class Timeout(DepthrigError, TimeoutError):
    """No frame came in time."""


class Stale(DepthrigError):
    """The newest depth is older than the reader allows; the message names the age and the stream."""

    def __init__(self, message: str, age_s: float | None = None, max_age_s: float | None = None) -> None:
        super().__init__(message)
        self.age_s = age_s
        """Seconds since the middle of the newest frame's exposure; None when no frame has come at all."""
        self.max_age_s = max_age_s
        """The age that was allowed, seconds."""


class HoldingTooMany(DepthrigError):
    """This subscriber holds as many frames as it may; delete some, or work on copies."""


class VersionMismatch(DepthrigError):
    """The two sides speak different versions of depthrig or iceoryx2."""


class BadFrame(DepthrigError):
    """A frame's header contradicts its pixels."""


class BusError(DepthrigError):
    """The shared memory cannot be used: permissions, limits, or a failure of iceoryx2."""


class CameraServed(DepthrigError):
    """Another process serves the camera; the message names it."""


class CameraRefused(DepthrigError):
    """The daemon refuses the camera that this process offers; the message is the daemon's."""


class SignalNotFound(DepthrigError):
    """Nobody publishes the signal; the message names those that are published."""


class SignalTaken(DepthrigError):
    """Another process publishes the signal; the message names it."""


class SignalChanged(DepthrigError):
    """Another publisher of the signal took over, with other fields. The reader goes on with them when it is asked again."""


class SignalGap(DepthrigError):
    """Two samples of a signal are further apart than the reader allows."""

    def __init__(self, message: str, gap_s: float) -> None:
        super().__init__(message)
        self.gap_s = gap_s
        """Seconds between the two samples."""


class SignalOutside(DepthrigError):
    """A time is not between two samples of the signal that are kept; nothing is extrapolated."""


class BadSignal(DepthrigError):
    """A sample of a signal contradicts its description."""
