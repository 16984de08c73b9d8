"""Measure how long a policy's observation takes: two depth images, one colour image, the joints at their time.

python policy.py [--seconds 20] [--hz 10] [--json]

It runs a rig of two simulated cameras (`DEPTHRIG_BIN`, else `depthrig`) with images of 640x480 at 30 Hz and publishes 14
joints at 200 Hz. The loop of `depthrig.policy` observes at `--hz`; in turn with it, at the same rate, bare subscribers take the
newest frame of each stream and the newest sample. Both times are from the first call to the last array, without waiting.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

import depthrig
from depthrig.policy import Observation, PolicyLoop

JOINTS = [f"joint_{i}" for i in range(14)]
IMAGES = {"wrist": "wrist/depth", "front": "front/depth", "color": "front/color"}
CAMERA = """
[[camera]]
name = "{name}"
backend = "synthetic"
model = "d435"
cheap = true
poses = 1
"""
STREAM = """[[camera.stream]]
name = "{stream}"
width = 640
height = 480
rate_hz = 30.0
"""


@contextmanager
def rig(folder: Path) -> Iterator[None]:
    """Run a rig of two simulated cameras."""
    text = 'rig = "bench"\n'
    for name in ("wrist", "front"):
        text += CAMERA.format(name=name) + "".join(STREAM.format(stream=s) for s in ("color", "depth"))
    (folder / "rig.toml").write_text(text)
    command = [os.environ.get("DEPTHRIG_BIN", "depthrig"), "run", str(folder / "rig.toml"), "--quiet"]
    process = subprocess.Popen([*command, "--runtime-dir", str(folder)])
    try:
        yield
    finally:
        process.send_signal(signal.SIGINT)
        process.wait()


@contextmanager
def arm(folder: Path, hz: float = 200.0) -> Iterator[None]:
    """Publish the joints from a thread."""
    stop = threading.Event()

    def move() -> None:
        with depthrig.Signal("arm/joint_position", JOINTS, unit="rad", kind="joints", runtime_dir=folder) as joints:
            while not stop.wait(1 / hz):
                joints.publish([0.1] * len(JOINTS))

    thread = threading.Thread(target=move)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def bare(streams: list[depthrig.Stream], joints: depthrig.SignalReader) -> int:
    """Take the newest frame of each stream and the newest sample; return how many arrays that are."""
    frames = [stream.latest() for stream in streams]
    sample = joints.latest()
    arrays = [frame.array for frame in frames if frame is not None]
    return len(arrays) + (sample is not None and len(sample.values) > 0)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=int, default=20)
    parser.add_argument("--hz", type=float, default=10.0)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()

    observed: list[float] = []
    subscribers: list[float] = []
    with tempfile.TemporaryDirectory(prefix="pol", dir="/tmp") as name:
        folder = Path(name)
        with rig(folder), arm(folder):
            signals = {"joints": "arm/joint_position"}
            with PolicyLoop(IMAGES, signals, hz=options.hz, runtime_dir=folder, timeout=60) as loop:
                streams = [depthrig.Stream(stream, runtime_dir=folder) for stream in IMAGES.values()]
                joints = depthrig.SignalReader("arm/joint_position", folder)
                for stream in streams:
                    stream.next(timeout=60)

                def policy(seen: Observation) -> None:
                    began = time.perf_counter()
                    arrays = [seen[name] for name in (*IMAGES, "joints")]
                    observed.append(loop._times.assembly[-1] + time.perf_counter() - began)
                    assert len(arrays) == len(IMAGES) + 1

                loop.run(policy, seconds=2)
                for _ in range(options.seconds // 2):
                    loop.run(policy, seconds=1)
                    for _ in range(int(options.hz)):
                        time.sleep(1 / options.hz)
                        began = time.perf_counter()
                        if bare(streams, joints) == len(IMAGES) + 1:
                            subscribers.append(time.perf_counter() - began)
                report = loop.report()
                for stream in streams:
                    stream.close()
                joints.close()
    times = {
        name: {f"p{q}": round(float(np.percentile(np.array(side) * 1e3, q)), 3) for q in (50, 99)}
        for name, side in (("observation_ms", observed), ("bare_subscribers_ms", subscribers))
    }
    result: dict[str, Any] = {
        **times,
        "ratio_of_medians": round(times["observation_ms"]["p50"] / times["bare_subscribers_ms"]["p50"], 2),
        "observations": report.observations,
        "no_sample": report.no_sample["joints"],
        "stale": report.stale,
        "conditions": {
            "python": platform.python_version(),
            "kernel": platform.release(),
            "cores": os.cpu_count(),
            "load_average_1min": round(os.getloadavg()[0], 1),
        },
    }
    if options.json:
        print(json.dumps(result, indent=2))
        return
    print(f"observation of {len(IMAGES)} images of 640x480 and {len(JOINTS)} joints: {result['observation_ms']} ms")
    print(f"bare subscribers: {result['bare_subscribers_ms']} ms; ratio of the medians {result['ratio_of_medians']}")
    print(", ".join(f"{k} {result[k]}" for k in ("observations", "no_sample", "stale", "conditions")))


if __name__ == "__main__":
    main()
