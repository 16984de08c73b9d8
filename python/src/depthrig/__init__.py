"""Read the streams of a depthrig camera rig as NumPy arrays in shared memory, and serve cameras to it.

>>> import depthrig
>>> with depthrig.Stream("d435/depth") as stream:
...     frame = stream.next(timeout=1.0)
...     print(frame.header.sequence, frame.array.shape, frame.depth_m().max())
"""

from __future__ import annotations

from ._external import ExternalCamera
from ._external_mode import ExternalMode
from ._external_session import ExternalSession, Lent
from ._frame import MOTION_DTYPE, Frame
from ._group import FrameGroup, SetReader
from ._header import Header, Intrinsics, Pose, Refinement
from ._layout import (
    ClockDomain,
    Distortion,
    DropReason,
    ExternalClock,
    ExternalReason,
    FrameFlags,
    MotionFlags,
    PixelFormat,
    StageStep,
)
from ._runtime import running_rigs
from ._sets import FrameSet, Sets
from ._stream import Stream, streams
from .errors import (
    AmbiguousRig,
    BadFrame,
    BusError,
    CameraRefused,
    CameraServed,
    DepthrigError,
    HoldingTooMany,
    RigNotRunning,
    Stale,
    StreamGone,
    StreamNotFound,
    Timeout,
    VersionMismatch,
)

__version__ = "0.1.0"

__all__ = [
    "MOTION_DTYPE",
    "AmbiguousRig",
    "BadFrame",
    "BusError",
    "CameraRefused",
    "CameraServed",
    "ClockDomain",
    "DepthrigError",
    "Distortion",
    "DropReason",
    "ExternalCamera",
    "ExternalClock",
    "ExternalMode",
    "ExternalReason",
    "ExternalSession",
    "Frame",
    "FrameFlags",
    "FrameGroup",
    "FrameSet",
    "Header",
    "HoldingTooMany",
    "Intrinsics",
    "Lent",
    "MotionFlags",
    "PixelFormat",
    "Pose",
    "Refinement",
    "RigNotRunning",
    "SetReader",
    "Sets",
    "StageStep",
    "Stale",
    "Stream",
    "StreamGone",
    "StreamNotFound",
    "Timeout",
    "VersionMismatch",
    "running_rigs",
    "streams",
]
