"""Answers requests about an attached RealSense camera with Intel's own library: one JSON object a line in, one out.

Runs in the guest; the scenario `librealsense` asks. Images go into a file, so that they are compared byte by byte."""

import json
import math
import os
import sys
import time

import pyrealsense2 as rs

# librealsense prints to this; its log stays off the shared folder, where every line makes the guest wait.
rs.log_to_file(rs.log_severity.warn, os.environ.get("LIBREALSENSE_LOG", "/tmp/librealsense.log"))

METADATA = {
    name: value
    for name in dir(rs.frame_metadata_value)
    if isinstance(value := getattr(rs.frame_metadata_value, name), rs.frame_metadata_value)
}
# What an option prints as differs between versions; its number does not.
OPTIONS = {int(value): name for name in dir(rs.option) if isinstance(value := getattr(rs.option, name), rs.option)}
context = rs.context()
device = None


def short(value) -> str:
    """`stream.depth` as `depth`."""
    return str(value).rpartition(".")[2]


def number(value):
    """Not every number of librealsense's is one of JSON's."""
    return value if math.isfinite(value) else None


def profile_of(p) -> dict:
    found = {"stream": short(p.stream_type()), "index": p.stream_index(), "format": short(p.format()), "rate": p.fps()}
    if p.is_video_stream_profile():
        video = p.as_video_stream_profile()
        found |= {"width": video.width(), "height": video.height()}
    return found


def sensor_named(name: str):
    return next(s for s in device.query_sensors() if s.get_info(rs.camera_info.name) == name)


def open_camera(serial: str) -> dict:
    global device
    devices = list(context.query_devices())
    serials = [d.get_info(rs.camera_info.serial_number) for d in devices]
    if serial not in serials:
        return {"error": f"no camera {serial}; there are {serials}"}
    device = devices[serials.index(serial)]
    info = {}
    for name in dir(rs.camera_info):
        key = getattr(rs.camera_info, name)
        if isinstance(key, rs.camera_info) and device.supports(key):
            info[name] = device.get_info(key)
    sensors = []
    firsts = {}
    for sensor in device.query_sensors():
        seen = {}
        profiles = []
        for p in sensor.get_stream_profiles():
            found = profile_of(p)
            profiles.append(found)
            firsts.setdefault(f"{found['stream']} {found['index']}", p)
            # Unrectified images are for calibration and have intrinsics of their own, or none.
            if not p.is_video_stream_profile() or found["format"] in ("y16", "raw16"):
                continue
            key = f"{found['stream']} {found['index']} {found['width']} {found['height']}"
            if key in seen:
                continue
            try:
                i = p.as_video_stream_profile().get_intrinsics()
                seen[key] = {"pinhole": [i.fx, i.fy, i.ppx, i.ppy], "model": short(i.model), "coefficients": list(i.coeffs)}
            except RuntimeError as error:
                seen[key] = {"error": str(error)}
        entry = {"name": sensor.get_info(rs.camera_info.name), "profiles": profiles, "intrinsics": seen}
        if sensor.is_depth_sensor():
            entry["depth_unit"] = sensor.as_depth_sensor().get_depth_scale()
        sensors.append(entry)
    depth = firsts.get("depth 0")
    poses = {}
    for name, p in firsts.items():
        if depth is not None:
            # Column after column.
            e = depth.get_extrinsics_to(p)
            poses[name] = {"rotation": list(e.rotation), "translation": list(e.translation)}
    motion = {}
    for name, p in firsts.items():
        if p.is_motion_stream_profile():
            motion[name] = [list(row) for row in p.as_motion_stream_profile().get_motion_intrinsics().data]
    return {"info": info, "sensors": sensors, "from_depth": poses, "motion": motion}


def options(sensor: str) -> dict:
    found = {}
    s = sensor_named(sensor)
    for option in s.get_supported_options():
        try:
            r = s.get_option_range(option)
            value = s.get_option(option)
        except RuntimeError as error:
            found[OPTIONS[int(option)]] = {"error": str(error)}
            continue
        bounds = {"min": r.min, "max": r.max, "step": r.step, "default": r.default, "value": value}
        found[OPTIONS[int(option)]] = {key: number(value) for key, value in bounds.items()} | {"fixed": s.is_option_read_only(option)}
    return found


def set_option(sensor: str, option: str, value: float) -> dict:
    s = sensor_named(sensor)
    key = getattr(rs.option, option)
    s.set_option(key, value)
    return {"value": s.get_option(key)}


def matches(p, wanted: dict) -> bool:
    found = profile_of(p)
    return all(found.get(key) == value for key, value in wanted.items())


def stream(sensors: list, frames: int, seconds: float, file: str) -> dict:
    """Streams `frames` of every profile; `sensors` has lists of profiles under the names of sensors, in the order of starting."""
    queue = rs.frame_queue(512, keep_frames=True)
    started = []
    expected = set()
    for entry in sensors:
        s = sensor_named(entry["sensor"])
        chosen = []
        for wanted in entry["profiles"]:
            fitting = [p for p in s.get_stream_profiles() if matches(p, wanted)]
            if not fitting:
                return {"error": f"{entry['sensor']} has no {wanted}"}
            chosen.append(fitting[0])
            expected.add((wanted["stream"], fitting[0].stream_index()))
        s.open(chosen)
        started.append(s)
    for s in started:
        s.start(queue)
    got = {key: [] for key in expected}
    end = time.monotonic() + seconds
    while time.monotonic() < end and any(len(kept) < frames for kept in got.values()):
        success, frame = queue.try_wait_for_frame(200)
        if not success:
            continue
        parts = list(frame.as_frameset()) if frame.is_frameset() else [frame]
        for part in parts:
            p = part.get_profile()
            kept = got.get((short(p.stream_type()), p.stream_index()))
            if kept is not None and len(kept) < frames:
                kept.append(part)
    temperatures = {}
    for s in started:
        names = [(OPTIONS[int(option)], option) for option in s.get_supported_options()]
        for name, option in names:
            if name.endswith("temperature"):
                try:
                    temperatures[name] = s.get_option(option)
                except RuntimeError as error:
                    temperatures[name] = str(error)
    for s in reversed(started):
        s.stop()
        s.close()
    found = []
    with open(file, "wb") as out:
        for kept in got.values():
            for frame in kept:
                entry = profile_of(frame.get_profile())
                entry["time_ms"] = frame.get_timestamp()
                entry["domain"] = short(frame.get_frame_timestamp_domain())
                entry["metadata"] = {
                    name: frame.get_frame_metadata(key) for name, key in METADATA.items() if frame.supports_frame_metadata(key)
                }
                if frame.is_motion_frame():
                    value = frame.as_motion_frame().get_motion_data()
                    entry["value"] = [value.x, value.y, value.z]
                else:
                    pixels = bytes(frame.get_data())
                    entry |= {"offset": out.tell(), "length": len(pixels)}
                    out.write(pixels)
                found.append(entry)
    return {"frames": found, "temperatures": temperatures}


def depth_table() -> dict:
    advanced = rs.rs400_advanced_mode(device)
    table = advanced.get_depth_table()
    names = ("depthUnits", "depthClampMin", "depthClampMax", "disparityMode", "disparityShift")
    return {"enabled": advanced.is_enabled()} | {name: getattr(table, name) for name in names}


def set_depth_table(values: dict) -> dict:
    advanced = rs.rs400_advanced_mode(device)
    table = advanced.get_depth_table()
    for name, value in values.items():
        setattr(table, name, value)
    advanced.set_depth_table(table)
    return depth_table()


def firmware_log() -> dict:
    """Whether the firmware's log has an entry; an empty one is no error."""
    log = device.as_firmware_logger()
    return {"entry": log.get_firmware_log(log.create_message())}


COMMANDS = {
    "firmware_log": firmware_log,
    "open": open_camera,
    "options": options,
    "set": set_option,
    "stream": stream,
    "depth_table": depth_table,
    "set_depth_table": set_depth_table,
}

for line in sys.stdin:
    request = json.loads(line)
    if request["do"] == "quit":
        break
    try:
        answer = COMMANDS[request.pop("do")](**request)
    except Exception as error:  # noqa: BLE001: whatever it is, the scenario reports it
        answer = {"error": f"{type(error).__name__}: {error}"}
    print(json.dumps(answer), flush=True)
# Its threads need seconds to end, and there is nothing to save.
os._exit(0)
