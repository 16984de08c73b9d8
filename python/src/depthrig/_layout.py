"""The layout of the bus, generated from Rust (bus/tests/python_layout.rs). Do not edit.

Run `DEPTHRIG_UPDATE=1 cargo test -p depthrig-bus --test python_layout` after a change in Rust.
"""

from __future__ import annotations

import enum
import struct
from typing import NamedTuple

SCHEMA = "depthrig.frame/1"
HEADER_TYPE = "depthrig.FrameHeader.v1"
HEADER_VERSION = 1
HEADER_SIZE = 768
HEADER_ALIGN = 64
HEADER_MAGIC = b"DRFH"
SET_HEADER_TYPE = "depthrig.SetHeader.v1"
SET_HEADER_SIZE = 40
SET_HEADER_ALIGN = 8
SET_RECORD_SIZE = 96
MOTION_SAMPLE_SIZE = 64
SHM_PREFIX = "depthrig_"
IOX_FOLDER = "iox2"
RUNTIME_DIR_VARIABLE = "DEPTHRIG_RUNTIME_DIR"

# Cameras that another process serves: docs/external.md
EXTERNAL_VERSION = 1
EXTERNAL_SCHEMA = "depthrig.external/1"
EXTERNAL_PREFIX = "depthrig.external"
EXTERNAL_LOCK_SUFFIX = ".external"
EXTERNAL_OFFER_TYPE = "depthrig.ExternalOffer.v1"
EXTERNAL_OFFER_SIZE = 568
EXTERNAL_OFFER_MAGIC = b"DREO"
EXTERNAL_MODE_TYPE = "depthrig.ExternalMode.v1"
EXTERNAL_MODE_SIZE = 320
EXTERNAL_ANSWER_TYPE = "depthrig.ExternalAnswer.v1"
EXTERNAL_ANSWER_SIZE = 376
EXTERNAL_ANSWER_MAGIC = b"DREA"
EXTERNAL_FRAME_TYPE = "depthrig.ExternalFrame.v1"
EXTERNAL_FRAME_SIZE = 128
EXTERNAL_FRAME_MAGIC = b"DREF"
EXTERNAL_ALIGN = 8
EXTERNAL_HEARTBEAT_S = 0.2
EXTERNAL_SILENCE_S = 2.0
EXTERNAL_MAX_MODES = 64
EXTERNAL_MAX_STREAMS = 16
EXTERNAL_MAX_FRAME_BYTES = 268435456
EXTERNAL_TEXT_SIZE = 256
EXTERNAL_FRAME_SLOTS = 8
EXTERNAL_MAX_PUBLISHERS = 4
EXTERNAL_MAX_SUBSCRIBERS = 4
EXTERNAL_BUFFER = 4
EXTERNAL_MAX_HELD = 4
EXTERNAL_MAX_NODES = 16
EXTERNAL_MAX_EVENT_PORTS = 8
EXTERNAL_EVENT_ID = 1
EXTERNAL_RIG_VARIABLE = "DEPTHRIG_RIG"
EXTERNAL_CAMERA_VARIABLE = "DEPTHRIG_CAMERA"

# Signals: docs/signals.md
SIGNAL_VERSION = 1
SIGNAL_SCHEMA = "depthrig.signal/1"
SIGNAL_PREFIX = "depthrig.signal"
SIGNAL_LOCK_SUFFIX = ".signal"
SIGNAL_HEADER_TYPE = "depthrig.SignalHeader.v1"
SIGNAL_HEADER_SIZE = 128
SIGNAL_HEADER_ALIGN = 8
SIGNAL_MAGIC = b"DRSG"
SIGNAL_DESCRIPTION_VERSION = 1
SIGNAL_KINDS = ("fields", "joints", "pose")
SIGNAL_TYPES = {"f64": 8, "f32": 4, "i64": 8, "bool": 1, "text": 4}
SIGNAL_MAX_DESCRIPTION_BYTES = 4096
SIGNAL_MAX_VALUES_BYTES = 4096
SIGNAL_MAX_AHEAD_NS = 100000000
SIGNAL_SLOTS = 544
SIGNAL_BUFFER = 512
SIGNAL_MAX_HELD = 2
SIGNAL_MAX_PUBLISHERS = 4
SIGNAL_MAX_SUBSCRIBERS = 8
SIGNAL_MAX_NODES = 16


class PixelFormat(enum.IntEnum):
    """How the pixels of a frame are stored."""

    RGB8 = 1
    BGR8 = 2
    MONO8 = 3
    MONO16 = 4
    Z16 = 5
    DEPTH_F32 = 6
    YUYV = 7
    UYVY = 8
    NV12 = 9
    MJPEG = 10
    CONFIDENCE8 = 11
    DISPARITY_F32 = 12
    MOTION = 13


# Per format: NumPy's element type, its bytes, and how many of them a pixel has.
ELEMENTS = {
    PixelFormat.RGB8: ("|u1", 1, 3),
    PixelFormat.BGR8: ("|u1", 1, 3),
    PixelFormat.MONO8: ("|u1", 1, 1),
    PixelFormat.MONO16: ("<u2", 2, 1),
    PixelFormat.Z16: ("<u2", 2, 1),
    PixelFormat.DEPTH_F32: ("<f4", 4, 1),
    PixelFormat.YUYV: ("|u1", 1, 2),
    PixelFormat.UYVY: ("|u1", 1, 2),
    PixelFormat.NV12: ("|u1", 1, 1),
    PixelFormat.CONFIDENCE8: ("|u1", 1, 1),
    PixelFormat.DISPARITY_F32: ("<f4", 4, 1),
}


class DropReason(enum.IntEnum):
    """Why a captured frame never reached its channel."""

    DEVICE_GAP = 0
    INCOMPLETE = 1
    WRONG_SIZE = 2
    DEVICE_ERROR = 3
    OUT_OF_ORDER = 4
    NO_SLOT = 5
    ABANDONED = 6
    QUEUE_FULL = 7


class Distortion(enum.IntEnum):
    """The distortion model of a camera."""

    UNKNOWN = 0
    NONE = 1
    BROWN_CONRADY = 2
    INVERSE_BROWN_CONRADY = 3
    KANNALA_BRANDT4 = 4
    RATIONAL = 5


class ClockDomain(enum.IntEnum):
    """Where a capture time comes from."""

    ARRIVAL = 0
    DEVICE = 1
    KERNEL = 2


class StageStep(enum.IntEnum):
    """A step of computing a derived frame, by its place in `stage_ns`."""

    WAIT = 0
    REGISTER = 1
    PREPARE = 2
    INFER = 3
    FINISH = 4
    TOTAL = 5


class FrameFlags(enum.IntFlag):
    """Facts about a frame, one bit each."""

    REPLAYED = 1
    TIME_UNCERTAIN = 2
    CLOCK_WARMUP = 4
    EPOCH_CHANGED = 8
    DERIVED = 16
    HARDWARE_TRIGGERED = 32
    LATE = 64
    SYNTHETIC = 128
    HEADER_TIME = 256
    METADATA_LOST = 512
    LATENCY_MEASURED = 1024
    LATENCY_CALIBRATED = 2048


class MotionFlags(enum.IntFlag):
    """Facts about an IMU sample, one bit each."""

    FRAME_SYNC = 1
    ACCEL_CLIPPED = 2
    GYRO_CLIPPED = 4


class SignalFlags(enum.IntFlag):
    """Facts about a sample of a signal, one bit each."""

    REPLAYED = 1
    TIME_UNCERTAIN = 2
    PUBLISH_TIME = 4
    INTERPOLATED = 8


class ExternalState(enum.IntEnum):
    """State of a process that serves a camera."""

    IDLE = 0
    STARTING = 1
    RUNNING = 2
    REFUSED = 3
    ENDED = 4


class ExternalWant(enum.IntEnum):
    """The daemon's request to a process that serves a camera."""

    STOP = 0
    RUN = 1
    REFUSED = 2


class ExternalReason(enum.IntEnum):
    """Why one side refuses, or a process ends."""

    NONE = 0
    VERSION = 1
    INVALID = 2
    UNSUPPORTED = 3
    NOT_FOUND = 4
    BUSY = 5
    PERMISSION = 6
    DISCONNECTED = 7
    DEVICE = 8
    FINISHED = 9


class ExternalClock(enum.IntEnum):
    """Which clock stamps the frames of a mode."""

    ARRIVAL = 0
    DEVICE = 1
    DEVICE_HEADER = 2
    HOST = 3


class ExternalModeFlags(enum.IntFlag):
    """Facts about a mode, one bit each."""

    SIMULATED = 1


class ExternalFrameFlags(enum.IntFlag):
    """Facts about a frame, one bit each."""

    DAMAGED = 1
    HARDWARE_TRIGGERED = 2
    METADATA_LOST = 4


# (name, offset, element type, elements)
FIELDS = (
    ("magic", 0, "u8", 4),
    ("version", 4, "u16", 1),
    ("size", 6, "u16", 1),
    ("sequence", 8, "u64", 1),
    ("device_sequence", 16, "u64", 1),
    ("set_id", 24, "u64", 1),
    ("device_time", 32, "u64", 1),
    ("device_tick_ns", 40, "f64", 1),
    ("capture_time_ns", 48, "i64", 1),
    ("capture_uncertainty_ns", 56, "u64", 1),
    ("arrival_time_ns", 64, "i64", 1),
    ("publish_time_ns", 72, "i64", 1),
    ("exposure_ns", 80, "u64", 1),
    ("captured", 88, "u64", 1),
    ("dropped", 96, "u64", 8),
    ("source_sequence", 160, "u64", 1),
    ("depth_unit_m", 168, "f64", 1),
    ("intrinsics.fx", 176, "f64", 1),
    ("intrinsics.fy", 184, "f64", 1),
    ("intrinsics.cx", 192, "f64", 1),
    ("intrinsics.cy", 200, "f64", 1),
    ("intrinsics.coeffs", 208, "f64", 8),
    ("intrinsics.model", 272, "u32", 1),
    ("intrinsics.reserved", 276, "u32", 1),
    ("pose.translation_m", 280, "f64", 3),
    ("pose.rotation_xyzw", 304, "f64", 4),
    ("clock_domain", 336, "u32", 1),
    ("clock_epoch", 340, "u32", 1),
    ("flags", 344, "u32", 1),
    ("format", 348, "u32", 1),
    ("width", 352, "u32", 1),
    ("height", 356, "u32", 1),
    ("stride", 360, "u32", 1),
    ("payload_len", 364, "u32", 1),
    ("gain", 368, "f32", 1),
    ("temperature_c", 372, "f32", 1),
    ("rig", 376, "u8", 32),
    ("camera", 408, "u8", 32),
    ("stream", 440, "u8", 32),
    ("model", 472, "u8", 32),
    ("serial", 504, "u8", 32),
    ("source_color_sequence", 536, "u64", 1),
    ("source_color_capture_time_ns", 544, "i64", 1),
    ("stage_ns", 552, "u64", 6),
    ("refiner", 600, "u8", 32),
    ("refiner_model", 632, "u8", 32),
    ("latency_ns", 664, "u64", 1),
    ("reserved", 672, "u64", 12),
)


# (name, offset, element type, elements)
SET_FIELDS = (
    ("set_id", 0, "u64", 1),
    ("tick_ns", 8, "i64", 1),
    ("spread_ns", 16, "i64", 1),
    ("incomplete", 24, "u64", 1),
    ("members", 32, "u32", 1),
    ("present", 36, "u32", 1),
)


# (name, offset, element type, elements)
MOTION_FIELDS = (
    ("time_ns", 0, "i64", 1),
    ("device_time", 8, "u64", 1),
    ("sequence", 16, "u64", 1),
    ("uncertainty_ns", 24, "u32", 1),
    ("accel_offset_ns", 28, "i32", 1),
    ("gyro_rad_s", 32, "f32", 3),
    ("accel_m_s2", 44, "f32", 3),
    ("temperature_c", 56, "f32", 1),
    ("flags", 60, "u32", 1),
)


# (name, offset, element type, elements)
EXTERNAL_OFFER_FIELDS = (
    ("magic", 0, "u8", 4),
    ("version", 4, "u16", 1),
    ("size", 6, "u16", 1),
    ("instance", 8, "u64", 1),
    ("number", 16, "u64", 1),
    ("sent_ns", 24, "i64", 1),
    ("session", 32, "u64", 1),
    ("state", 40, "u32", 1),
    ("reason", 44, "u32", 1),
    ("modes", 48, "u32", 1),
    ("pid", 52, "u32", 1),
    ("model", 56, "u8", 32),
    ("serial", 88, "u8", 32),
    ("firmware", 120, "u8", 32),
    ("port", 152, "u8", 32),
    ("calibration", 184, "u8", 32),
    ("program", 216, "u8", 32),
    ("text", 248, "u8", 256),
    ("reserved", 504, "u64", 8),
)


# (name, offset, element type, elements)
EXTERNAL_MODE_FIELDS = (
    ("stream", 0, "u8", 32),
    ("rate_hz", 32, "f64", 1),
    ("depth_unit_m", 40, "f64", 1),
    ("intrinsics.fx", 48, "f64", 1),
    ("intrinsics.fy", 56, "f64", 1),
    ("intrinsics.cx", 64, "f64", 1),
    ("intrinsics.cy", 72, "f64", 1),
    ("intrinsics.coeffs", 80, "f64", 8),
    ("intrinsics.model", 144, "u32", 1),
    ("intrinsics.reserved", 148, "u32", 1),
    ("pose.translation_m", 152, "f64", 3),
    ("pose.rotation_xyzw", 176, "f64", 4),
    ("tick_ps", 208, "u64", 1),
    ("format", 216, "u32", 1),
    ("width", 220, "u32", 1),
    ("height", 224, "u32", 1),
    ("clock", 228, "u32", 1),
    ("counter_bits", 232, "u32", 1),
    ("sequence_bits", 236, "u32", 1),
    ("flags", 240, "u32", 1),
    ("reserved_word", 244, "u32", 1),
    ("reserved", 248, "u64", 9),
)


# (name, offset, element type, elements)
EXTERNAL_ANSWER_FIELDS = (
    ("magic", 0, "u8", 4),
    ("version", 4, "u16", 1),
    ("size", 6, "u16", 1),
    ("instance", 8, "u64", 1),
    ("number", 16, "u64", 1),
    ("sent_ns", 24, "i64", 1),
    ("session", 32, "u64", 1),
    ("want", 40, "u32", 1),
    ("reason", 44, "u32", 1),
    ("modes", 48, "u32", 1),
    ("pid", 52, "u32", 1),
    ("text", 56, "u8", 256),
    ("reserved", 312, "u64", 8),
)


# (name, offset, element type, elements)
EXTERNAL_FRAME_FIELDS = (
    ("magic", 0, "u8", 4),
    ("version", 4, "u16", 1),
    ("size", 6, "u16", 1),
    ("instance", 8, "u64", 1),
    ("session", 16, "u64", 1),
    ("sequence", 24, "u64", 1),
    ("device_sequence", 32, "u64", 1),
    ("device_time", 40, "u64", 1),
    ("arrival_time_ns", 48, "i64", 1),
    ("exposure_ns", 56, "u64", 1),
    ("gain", 64, "f32", 1),
    ("temperature_c", 68, "f32", 1),
    ("format", 72, "u32", 1),
    ("width", 76, "u32", 1),
    ("height", 80, "u32", 1),
    ("payload_len", 84, "u32", 1),
    ("flags", 88, "u32", 1),
    ("reserved_word", 92, "u32", 1),
    ("reserved", 96, "u64", 4),
)


# (name, offset, element type, elements)
SIGNAL_FIELDS = (
    ("magic", 0, "u8", 4),
    ("version", 4, "u16", 1),
    ("size", 6, "u16", 1),
    ("sequence", 8, "u64", 1),
    ("session", 16, "u64", 1),
    ("time_ns", 24, "i64", 1),
    ("publish_time_ns", 32, "i64", 1),
    ("uncertainty_ns", 40, "u64", 1),
    ("description_hash", 48, "u64", 1),
    ("description_len", 56, "u32", 1),
    ("payload_len", 60, "u32", 1),
    ("flags", 64, "u32", 1),
    ("reserved_word", 68, "u32", 1),
    ("reserved", 72, "u64", 7),
)


class IntrinsicsFields(NamedTuple):
    """The fields of Rust's `Intrinsics`."""

    fx: float
    """Focal length along x, pixels; 0 when no calibration is known."""
    fy: float
    """Focal length along y, pixels."""
    cx: float
    """Principal point x, pixels."""
    cy: float
    """Principal point y, pixels."""
    coeffs: tuple[float, ...]
    """Distortion coefficients in the order that `Distortion` names; unused ones are 0."""
    model: int
    """Wire code of the `Distortion` model."""
    reserved: int
    """Zero."""


class PoseFields(NamedTuple):
    """The fields of Rust's `Pose`."""

    translation_m: tuple[float, ...]
    """Translation in metres."""
    rotation_xyzw: tuple[float, ...]
    """Rotation as a unit quaternion x, y, z, w."""


class HeaderFields:
    """The fields of Rust's `FrameHeader`, read from its bytes."""

    __slots__ = ("_raw",)

    def __init__(self, raw: bytes) -> None:
        self._raw = raw

    @property
    def magic(self) -> bytes:
        """The bytes `DRFH`."""
        return self._raw[0:4]

    @property
    def version(self) -> int:
        """`HEADER_VERSION`."""
        return int(struct.unpack_from("<H", self._raw, 4)[0])

    @property
    def size(self) -> int:
        """`HEADER_SIZE`."""
        return int(struct.unpack_from("<H", self._raw, 6)[0])

    @property
    def sequence(self) -> int:
        """Number of this frame on its channel: 1, 2, 3, … without a gap as published. A subscriber that sees a gap was too slow."""
        return int(struct.unpack_from("<Q", self._raw, 8)[0])

    @property
    def device_sequence(self) -> int:
        """The device's own frame counter, unwrapped."""
        return int(struct.unpack_from("<Q", self._raw, 16)[0])

    @property
    def set_id(self) -> int:
        """The frame set this frame belongs to; 0 on the live path, where sets are assembled after publishing."""
        return int(struct.unpack_from("<Q", self._raw, 24)[0])

    @property
    def device_time(self) -> int:
        """Raw device time in ticks, unwrapped to 64 bits."""
        return int(struct.unpack_from("<Q", self._raw, 32)[0])

    @property
    def device_tick_ns(self) -> float:
        """Nanoseconds per device tick."""
        return float(struct.unpack_from("<d", self._raw, 40)[0])

    @property
    def capture_time_ns(self) -> int:
        """Middle of the exposure on the host clock."""
        return int(struct.unpack_from("<q", self._raw, 48)[0])

    @property
    def capture_uncertainty_ns(self) -> int:
        """The capture time is right within this much, nanoseconds."""
        return int(struct.unpack_from("<Q", self._raw, 56)[0])

    @property
    def arrival_time_ns(self) -> int:
        """When the last byte of the frame had arrived."""
        return int(struct.unpack_from("<q", self._raw, 64)[0])

    @property
    def publish_time_ns(self) -> int:
        """When the frame was published on this channel."""
        return int(struct.unpack_from("<q", self._raw, 72)[0])

    @property
    def exposure_ns(self) -> int:
        """Exposure time, nanoseconds; 0 when unknown."""
        return int(struct.unpack_from("<Q", self._raw, 80)[0])

    @property
    def captured(self) -> int:
        """Frames the device has captured on this stream so far, this one included: `captured = sequence + Σ dropped`."""
        return int(struct.unpack_from("<Q", self._raw, 88)[0])

    @property
    def dropped(self) -> tuple[int, ...]:
        """Frames lost so far, indexed by `DropReason`."""
        return struct.unpack_from("<8Q", self._raw, 96)

    @property
    def source_sequence(self) -> int:
        """For a derived stream, `sequence` of its source frame (the depth frame where there are several); else 0."""
        return int(struct.unpack_from("<Q", self._raw, 160)[0])

    @property
    def depth_unit_m(self) -> float:
        """Metres per unit of depth; 0 when the pixels are not depth."""
        return float(struct.unpack_from("<d", self._raw, 168)[0])

    @property
    def clock_domain(self) -> int:
        """Which clock the capture time comes from: a `ClockDomain` code."""
        return int(struct.unpack_from("<I", self._raw, 336)[0])

    @property
    def clock_epoch(self) -> int:
        """Number of the clock map in force; it changes whenever the map is restarted."""
        return int(struct.unpack_from("<I", self._raw, 340)[0])

    @property
    def flags(self) -> int:
        """`FrameFlags` bits."""
        return int(struct.unpack_from("<I", self._raw, 344)[0])

    @property
    def format(self) -> int:
        """`PixelFormat` code."""
        return int(struct.unpack_from("<I", self._raw, 348)[0])

    @property
    def width(self) -> int:
        """Pixels per row."""
        return int(struct.unpack_from("<I", self._raw, 352)[0])

    @property
    def height(self) -> int:
        """Rows."""
        return int(struct.unpack_from("<I", self._raw, 356)[0])

    @property
    def stride(self) -> int:
        """Bytes from one row to the next."""
        return int(struct.unpack_from("<I", self._raw, 360)[0])

    @property
    def payload_len(self) -> int:
        """Bytes of the payload."""
        return int(struct.unpack_from("<I", self._raw, 364)[0])

    @property
    def gain(self) -> float:
        """Sensor gain as the device reports it; 0 when unknown."""
        return float(struct.unpack_from("<f", self._raw, 368)[0])

    @property
    def temperature_c(self) -> float:
        """Sensor temperature in °C; NaN when unknown."""
        return float(struct.unpack_from("<f", self._raw, 372)[0])

    @property
    def rig(self) -> str:
        """Name of the rig, zero-padded UTF-8."""
        return _text(self._raw[376:408])

    @property
    def camera(self) -> str:
        """Name of the camera, zero-padded UTF-8."""
        return _text(self._raw[408:440])

    @property
    def stream(self) -> str:
        """Name of the stream, zero-padded UTF-8."""
        return _text(self._raw[440:472])

    @property
    def model(self) -> str:
        """Camera model, zero-padded UTF-8."""
        return _text(self._raw[472:504])

    @property
    def serial(self) -> str:
        """Camera serial number, zero-padded UTF-8."""
        return _text(self._raw[504:536])

    @property
    def source_color_sequence(self) -> int:
        """For depth computed from depth and colour, `sequence` of the colour frame; else 0."""
        return int(struct.unpack_from("<Q", self._raw, 536)[0])

    @property
    def source_color_capture_time_ns(self) -> int:
        """Middle of the exposure of that colour frame on the host clock; else 0. `capture_time_ns` is that of the depth frame."""
        return int(struct.unpack_from("<q", self._raw, 544)[0])

    @property
    def stage_ns(self) -> tuple[int, ...]:
        """Duration of each step of computing a derived frame, nanoseconds, indexed by `StageStep`; else 0."""
        return struct.unpack_from("<6Q", self._raw, 552)

    @property
    def refiner(self) -> str:
        """Method that computed a derived frame, such as `fill` or `onnxruntime 1.31.1 cpu fp32`, zero-padded UTF-8."""
        return _text(self._raw[600:632])

    @property
    def refiner_model(self) -> str:
        """The model that it used, such as `cdm-d435@1f2e3d4c`, zero-padded UTF-8; empty when it needs none."""
        return _text(self._raw[632:664])

    @property
    def latency_ns(self) -> int:
        """Constant latency of the delivery that `capture_time_ns` is free of, nanoseconds; 0 when none is known. How it is known is in the flags `FrameFlags::LATENCY_MEASURED` and `FrameFlags::LATENCY_CALIBRATED`."""
        return int(struct.unpack_from("<Q", self._raw, 664)[0])

    @property
    def reserved(self) -> tuple[int, ...]:
        """Zero; space for later fields of this version."""
        return struct.unpack_from("<12Q", self._raw, 672)

    def _intrinsics(self) -> IntrinsicsFields:
        return IntrinsicsFields(
            float(struct.unpack_from("<d", self._raw, 176)[0]),
            float(struct.unpack_from("<d", self._raw, 184)[0]),
            float(struct.unpack_from("<d", self._raw, 192)[0]),
            float(struct.unpack_from("<d", self._raw, 200)[0]),
            struct.unpack_from("<8d", self._raw, 208),
            int(struct.unpack_from("<I", self._raw, 272)[0]),
            int(struct.unpack_from("<I", self._raw, 276)[0]),
        )

    def _pose(self) -> PoseFields:
        return PoseFields(
            struct.unpack_from("<3d", self._raw, 280),
            struct.unpack_from("<4d", self._raw, 304),
        )


def _text(field: bytes) -> str:
    """Text in a zero-padded field; an invalid tail is left out, as Rust does."""
    field = field.split(b"\0", 1)[0]
    try:
        return field.decode("utf-8")
    except UnicodeDecodeError as e:
        return field[: e.start].decode("utf-8")


class SetHeaderFields:
    """The fields of Rust's `SetHeader`, read from its bytes."""

    __slots__ = ("_raw",)

    def __init__(self, raw: bytes) -> None:
        self._raw = raw

    @property
    def set_id(self) -> int:
        """Number of the set: 1, 2, 3, …"""
        return int(struct.unpack_from("<Q", self._raw, 0)[0])

    @property
    def tick_ns(self) -> int:
        """The moment the set is for, nanoseconds on the host clock."""
        return int(struct.unpack_from("<q", self._raw, 8)[0])

    @property
    def spread_ns(self) -> int:
        """Latest minus earliest capture time of its frames, nanoseconds."""
        return int(struct.unpack_from("<q", self._raw, 16)[0])

    @property
    def incomplete(self) -> int:
        """Sets so far that lacked a stream."""
        return int(struct.unpack_from("<Q", self._raw, 24)[0])

    @property
    def members(self) -> int:
        """Members in the payload, present and missing."""
        return int(struct.unpack_from("<I", self._raw, 32)[0])

    @property
    def present(self) -> int:
        """Members that are present."""
        return int(struct.unpack_from("<I", self._raw, 36)[0])
