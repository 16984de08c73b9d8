"""Messages of ROS 2 as bytes: types and their hashes of `rosbags`, and long arrays without an extra copy."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import numpy.typing as npt
from rosbags.typesys import Stores, get_typestore

from ._names import dds_name

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
IMU = "sensor_msgs/msg/Imu"
POINTS = "sensor_msgs/msg/PointCloud2"
JOINTS = "sensor_msgs/msg/JointState"
POSE = "geometry_msgs/msg/PoseStamped"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"

# These types are the same from Humble on, so that one store serves all.
STORE = get_typestore(Stores.ROS2_JAZZY)
_NO_BYTES = np.zeros(0, np.uint8)


@functools.cache
def type_hash(ros_type: str) -> str:
    """Return the hash of a type's description (REP-2011), `RIHS01_` and 64 digits."""
    return str(STORE.hash_rihs01(ros_type))


@functools.cache
def about(ros_type: str) -> str:
    """Return type and hash as keys and tokens have them."""
    return f"{dds_name(ros_type)}/{type_hash(ros_type)}"


def make(ros_type: str, *values: Any) -> Any:
    """Return a message of a type, whose fields are in the order of its definition."""
    return STORE.types[ros_type](*values)


def header(utc_ns: int, frame: str) -> Any:
    """Return a `std_msgs/Header`."""
    seconds, nanoseconds = divmod(utc_ns, 1_000_000_000)
    return make("std_msgs/msg/Header", make("builtin_interfaces/msg/Time", seconds, nanoseconds), frame)


def encode(ros_type: str, message: Any) -> bytes:
    """Return a message in CDR, little-endian, with its head of four bytes."""
    return bytes(STORE.serialize_cdr(message, ros_type))


def decode(ros_type: str, payload: bytes) -> Any:
    """Return the message in these bytes; raises one of many exceptions when they are not one."""
    return STORE.deserialize_cdr(payload, ros_type)


def encode_with(ros_type: str, message: Any, data: npt.NDArray[Any], tail: int = 0) -> bytearray:
    """Return a message whose array `data`, empty in `message`, is these numbers, which are copied once.

    `tail` is how many bytes follow the array in messages of this type. Its elements are bytes, so nothing is aligned.
    """
    raw = encode(ros_type, message)
    start = len(raw) - tail
    payload = bytearray(start + data.nbytes + tail)
    payload[: start - 4] = raw[: start - 4]
    payload[start - 4 : start] = data.nbytes.to_bytes(4, "little")
    space = np.frombuffer(payload, data.dtype if data.nbytes else np.uint8, data.size, start)
    np.copyto(space.reshape(data.shape), data)
    if tail:
        payload[-tail:] = raw[-tail:]
    return payload


def no_bytes() -> npt.NDArray[np.uint8]:
    """Return the empty array that stands for the data in a message for :func:`encode_with`."""
    return _NO_BYTES
