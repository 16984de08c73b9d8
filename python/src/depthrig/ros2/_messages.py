"""The small messages: IMU samples, signals, poses of the streams, diagnostics; as a recording has them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from .._header import Pose
from .._signal_description import SignalDescription
from . import _types

_SI = {
    "rad": "position",
    "m": "position",
    "rad/s": "velocity",
    "m/s": "velocity",
    "N": "effort",
    "Nm": "effort",
    "N m": "effort",
    "N*m": "effort",
    "N·m": "effort",
}
_OK, _WARN, _ERROR = 0, 1, 2


def imu(sample: Any, stamp: Any) -> bytes:
    """Return `sensor_msgs/Imu` of a sample of :data:`depthrig.MOTION_DTYPE`; -1 marks what is not measured."""
    orientation = _types.make("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0)
    values: list[Any] = [orientation, _covariance(False)]
    for name in ("gyro_rad_s", "accel_m_s2"):
        measured = sample[name].astype(np.float64)
        values += [_vector(measured), _covariance(not np.isnan(measured).all())]
    return _types.encode(_types.IMU, _types.make(_types.IMU, stamp, *values))


def _covariance(known: bool) -> npt.NDArray[np.float64]:
    matrix = np.zeros(9)
    if not known:
        matrix[0] = -1.0
    return matrix


def _vector(xyz: Sequence[float]) -> Any:
    return _types.make("geometry_msgs/msg/Vector3", *(float(v) for v in xyz))


def transforms(poses: Mapping[str, Pose], mount: str, utc_ns: int) -> bytes:
    """Return `tf2_msgs/TFMessage` from the mount to each of these frames."""
    stamp = _types.header(utc_ns, mount)
    all_of_them = []
    for frame, pose in poses.items():
        rotation = _types.make("geometry_msgs/msg/Quaternion", *pose.rotation_xyzw)
        transform = _types.make("geometry_msgs/msg/Transform", _vector(pose.translation_m), rotation)
        all_of_them.append(_types.make("geometry_msgs/msg/TransformStamped", stamp, frame, transform))
    return _types.encode(_types.TRANSFORMS, _types.make(_types.TRANSFORMS, all_of_them))


def signal_type(description: SignalDescription) -> tuple[str, str] | None:
    """Return the last part of the topic and the type of a signal; None if ROS has no type for it."""
    if description.kind == "pose":
        return "pose", _types.POSE
    if description.kind == "joints" and _array(description) is not None:
        return "joint_states", _types.JOINTS
    return None


def _array(description: SignalDescription) -> str | None:
    """Return the array of `JointState` for the unit that all joints have. Units are not converted."""
    arrays = {_SI.get(field.unit) for field in description.fields}
    return arrays.pop() if len(arrays) == 1 else None


def signal(description: SignalDescription, raw: bytes, utc_ns: int) -> bytes:
    """Return the message of a signal's sample."""
    stamp = _types.header(utc_ns, description.frame)
    values = description.struct.unpack_from(raw)
    if description.kind == "pose":
        point = _types.make("geometry_msgs/msg/Point", *values[:3])
        pose = _types.make("geometry_msgs/msg/Pose", point, _types.make("geometry_msgs/msg/Quaternion", *values[3:7]))
        return _types.encode(_types.POSE, _types.make(_types.POSE, stamp, pose))
    which = _array(description)
    arrays = [np.array(values if which == name else (), np.float64) for name in ("position", "velocity", "effort")]
    names = [field.name for field in description.fields]
    return _types.encode(_types.JOINTS, _types.make(_types.JOINTS, stamp, names, *arrays))


def diagnostics(status: Mapping[str, Any], own: Mapping[str, str], utc_ns: int) -> bytes:
    """Return `diagnostic_msgs/DiagnosticArray` of the rig's status, one entry for each camera, and of this program."""
    rig = status.get("rig", "")
    entries = [_camera(rig, camera) for camera in status.get("cameras", ())]
    skipped = any(value != "0" for key, value in own.items() if key.endswith(("skipped", "missed")))
    message = "frames or samples were skipped" if skipped else "ok"
    entries.append(_entry(_WARN if skipped else _OK, f"{rig}/ros2", message, "", own))
    if not status.get("cameras"):
        entries.append(_entry(_ERROR, f"{rig}/daemon", "the rig does not answer", "", {}))
    message = _types.make(_types.DIAGNOSTICS, _types.header(utc_ns, ""), entries)
    return _types.encode(_types.DIAGNOSTICS, message)


def _camera(rig: str, camera: Mapping[str, Any]) -> Any:
    values = {"reconnects": str(camera["reconnects"])}
    for stream in camera["streams"]:
        name = stream["id"].rpartition("/")[2]
        values[f"{name}.rate_hz"] = f"{stream['rate_hz']:.2f}"
        for count in ("captured", "delivered"):
            values[f"{name}.{count}"] = str(stream[count])
        for reason, lost in stream["dropped"].items():
            values[f"{name}.dropped_{reason}"] = str(lost)
        values[f"{name}.latency_p99_ms"] = f"{stream['latency_p99_ms']:.3f}"
    warnings = camera["warnings"]
    for i, warning in enumerate(warnings):
        values[f"warning {i + 1}"] = warning
    state = camera["state"]
    level = _ERROR if state == "failed" else _OK if state == "streaming" and not warnings else _WARN
    return _entry(level, f"{rig}/{camera['name']}", camera["message"] or state, camera["serial"], values)


def _entry(level: int, name: str, message: str, hardware: str, values: Mapping[str, str]) -> Any:
    pairs = [_types.make("diagnostic_msgs/msg/KeyValue", key, value) for key, value in values.items()]
    return _types.make("diagnostic_msgs/msg/DiagnosticStatus", level, name, message, hardware, pairs)
