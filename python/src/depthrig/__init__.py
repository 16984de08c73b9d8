"""Read the streams of a depthrig camera rig as NumPy arrays in shared memory, serve cameras to it, publish signals.

>>> import depthrig
>>> with depthrig.Stream("d435/depth") as stream:
...     frame = stream.next(timeout=1.0)
...     print(frame.header.sequence, frame.array.shape, frame.depth_m().max())
"""

from __future__ import annotations

from ._clock_map import ClockMap, MappedTime
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
    SignalFlags,
    StageStep,
)
from ._recording import Episode, Recording
from ._runtime import running_rigs
from ._sets import FrameSet, Sets
from ._signal import Signal, signals
from ._signal_description import SignalDescription, SignalField
from ._signal_reader import SignalReader
from ._signal_recorded import recorded_signal
from ._signal_sample import SignalSample, SignalWindow
from ._stream import Stream, streams
from .errors import (
    AmbiguousRig,
    BadFrame,
    BadSignal,
    BusError,
    CameraRefused,
    CameraServed,
    DepthrigError,
    HoldingTooMany,
    RigNotRunning,
    RigRefused,
    SignalChanged,
    SignalGap,
    SignalNotFound,
    SignalOutside,
    SignalTaken,
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
    "BadSignal",
    "BusError",
    "CameraRefused",
    "CameraServed",
    "ClockDomain",
    "ClockMap",
    "DepthrigError",
    "Distortion",
    "DropReason",
    "Episode",
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
    "MappedTime",
    "MotionFlags",
    "PixelFormat",
    "Pose",
    "Recording",
    "Refinement",
    "RigNotRunning",
    "RigRefused",
    "SetReader",
    "Sets",
    "Signal",
    "SignalChanged",
    "SignalDescription",
    "SignalField",
    "SignalFlags",
    "SignalGap",
    "SignalNotFound",
    "SignalOutside",
    "SignalReader",
    "SignalSample",
    "SignalTaken",
    "SignalWindow",
    "StageStep",
    "Stale",
    "Stream",
    "StreamGone",
    "StreamNotFound",
    "Timeout",
    "VersionMismatch",
    "recorded_signal",
    "running_rigs",
    "signals",
    "streams",
]
