"""Measure how long a frame takes from publishing to a readable array.

python latency.py d435/depth [--frames 300] [--warm-up 30] [--json]

Each sample is CLOCK_MONOTONIC when `frame.array` exists, minus the header's `publish_time_ns`. Reading the pixels is
not part of it. Frames of a replay are refused: their publish times are those of the recording.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time

import numpy as np

import depthrig


def measure(stream: depthrig.Stream, frames: int, warm_up: int) -> tuple[np.ndarray, depthrig.Header]:
    """Return the latency of `frames` frames in nanoseconds, and the last header."""
    samples = np.empty(frames, np.int64)
    for i in range(-warm_up, frames):
        frame = stream.next(timeout=10)
        array = frame.array
        now = time.monotonic_ns()
        if frame.header.replayed:
            raise SystemExit("this is a replay, whose frames carry the publish times of the recording")
        if i >= 0:
            samples[i] = now - frame.header.publish_time_ns
        header = frame.header
        del frame, array
    return samples, header


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("stream", help="CAMERA/STREAM, such as d435/depth")
    parser.add_argument("--rig", help="by default the only one that runs")
    parser.add_argument("--runtime-dir", help="by default this user's")
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--warm-up", type=int, default=30, help="frames before them that are not counted")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()

    with depthrig.Stream(options.stream, options.rig, options.runtime_dir) as stream:
        cpu = time.process_time()
        wall = time.monotonic()
        samples, header = measure(stream, options.frames, options.warm_up)
        cpu_share = (time.process_time() - cpu) / (time.monotonic() - wall)
        missed = stream.missed
    p50, p99, worst = (float(np.percentile(samples, q)) / 1e3 for q in (50, 99, 100))
    result = {
        "stream": header.stream_id,
        "image": f"{header.width}x{header.height} {header.format_name}",
        "frames": options.frames,
        "missed": missed,
        "p50_us": round(p50, 1),
        "p99_us": round(p99, 1),
        "max_us": round(worst, 1),
        "cpu_percent_of_a_core": round(cpu_share * 100, 2),
        "conditions": {
            "python": platform.python_version(),
            "numpy": np.__version__,
            "kernel": platform.release(),
            "cores": os.cpu_count(),
            "load_average_1min": round(os.getloadavg()[0], 1),
        },
    }
    if options.json:
        print(json.dumps(result, indent=2))
        return
    c = result["conditions"]
    print(f"{result['stream']}, {result['image']}, {options.frames} frames, {missed} missed")
    print(f"publish to readable array: p50 {p50:.1f} us, p99 {p99:.1f} us, max {worst:.1f} us")
    print(f"this process used {cpu_share * 100:.2f} % of a core; {c}")


if __name__ == "__main__":
    main()
