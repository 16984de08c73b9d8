"""Measure what LeRobot's camera plug-in costs over a bare subscriber of the same stream.

python lerobot_camera.py [--seconds 40] [--json]

It needs the packages `lerobot` and `lerobot_camera_depthrig`, and runs a rig of a simulated camera with images of 640x480 at
30 Hz (`DEPTHRIG_BIN`, else `depthrig`). Readers take turns of a second: the plug-in's `async_read()`, a subscriber that
keeps each image as LeRobot does (`Stream`, `latest()` else `next()`, `copy()`), and one that only looks at it without a
copy; then the plug-in with colour and depth, and a `SetReader` of both with copies. CPU is that of the reading thread for
each image, latency is from publishing the colour image to the last array.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from lerobot_camera_depthrig import DepthrigCamera, DepthrigCameraConfig

import depthrig

RIG = """
rig = "bench"
[[camera]]
name = "front"
backend = "synthetic"
model = "d435"
cheap = true
poses = 1
[[camera.stream]]
name = "color"
width = 640
height = 480
rate_hz = 30.0
[[camera.stream]]
name = "depth"
width = 640
height = 480
rate_hz = 30.0
"""


def block(read: Callable[[], int], seconds: float) -> tuple[list[float], list[float]]:
    """Read for so long; return for each image the CPU time and the latency, microseconds."""
    cpu: list[float] = []
    latency: list[float] = []
    end = time.monotonic() + seconds
    read()  # what has waited meanwhile
    while time.monotonic() < end:
        before = time.thread_time_ns()
        published_ns = read()
        latency.append((time.monotonic_ns() - published_ns) / 1e3)
        cpu.append((time.thread_time_ns() - before) / 1e3)
    return cpu, latency


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=int, default=40)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()

    with tempfile.TemporaryDirectory(prefix="cam", dir="/tmp") as folder:
        (Path(folder) / "rig.toml").write_text(RIG)
        command = [os.environ.get("DEPTHRIG_BIN", "depthrig"), "run", f"{folder}/rig.toml", "--quiet"]
        rig = subprocess.Popen([*command, "--runtime-dir", folder])
        try:
            options_of_camera = {"camera": "front", "runtime_dir": folder, "timeout_s": 60.0}
            camera, both = (DepthrigCamera(DepthrigCameraConfig(use_depth=d, **options_of_camera)) for d in (False, True))
            camera.connect()
            both.connect()
            pair = depthrig.SetReader(["front/color", "front/depth"], runtime_dir=folder, timeout=60)
            streams = [depthrig.Stream("front/color", runtime_dir=folder, timeout=60) for _ in range(2)]

            def plug_in() -> int:
                image = camera.async_read(10_000)
                assert image.shape == (480, 640, 3)
                return camera._group["front/color"].header.publish_time_ns

            def copied() -> int:
                frame = streams[0].latest() or streams[0].next(10)
                image = frame.copy()
                assert image.shape == (480, 640, 3)
                return frame.header.publish_time_ns

            def looked_at() -> int:
                frame = streams[1].latest() or streams[1].next(10)
                assert frame.array.shape == (480, 640, 3)
                return frame.header.publish_time_ns

            def plug_in_both() -> int:
                images = both.async_read(10_000), both.read_latest_depth(10_000)
                assert images[1].shape == (480, 640, 1)
                return both._group["front/color"].header.publish_time_ns

            def copied_both() -> int:
                group = pair.next(10)
                images = [frame.copy() for frame in group.values()]
                assert images[1].shape == (480, 640)
                return group["front/color"].header.publish_time_ns

            readers = {
                "plug_in": plug_in,
                "subscriber": copied,
                "subscriber_without_copy": looked_at,
                "plug_in_both": plug_in_both,
                "subscriber_both": copied_both,
            }
            found: dict[str, list[Any]] = {name: [] for name in readers}
            for _ in range(options.seconds // len(readers)):
                for name, read in readers.items():
                    found[name].append(block(read, 1.0))
            camera.disconnect()
            both.disconnect()
            pair.close()
            for stream in streams:
                stream.close()
        finally:
            rig.send_signal(signal.SIGINT)
            rig.wait()
    result: dict[str, Any] = {}
    for name, blocks in found.items():
        sides = (("cpu_us", 0), ("latency_us", 1))
        result[name] = {what: round(float(np.median(np.concatenate([b[i] for b in blocks]))), 1) for what, i in sides}
        result[name]["images"] = sum(len(b[0]) for b in blocks)
    for name in ("", "_both"):
        result[f"ratio{name}"] = {
            what: round(result[f"plug_in{name}"][what] / result[f"subscriber{name}"][what], 2)
            for what in ("cpu_us", "latency_us")
        }
    result["conditions"] = {
        "python": platform.python_version(),
        "kernel": platform.release(),
        "cores": os.cpu_count(),
        "load_average_1min": round(os.getloadavg()[0], 1),
    }
    if options.json:
        print(json.dumps(result, indent=2))
        return
    for name in readers:
        print(f"{name:<24}" + ", ".join(f"{what} {value}" for what, value in result[name].items()))
    print(f"plug-in over subscriber: colour {result['ratio']}, with depth {result['ratio_both']}; {result['conditions']}")


if __name__ == "__main__":
    main()
