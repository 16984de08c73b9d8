"""Measure how long publishing a signal takes, and how much CPU signals cost.

python signals.py [--signals 20] [--fields 7] [--rate 1000] [--seconds 20] [--readers 1] [--json]

Publishes so many signals of so many doubles at a rate, in turn with a bare loop of the iceoryx2 wheel that sends samples of
the same bytes over as many channels and raises their events: each has every other second. A time is that of one publish
call. The readers, in processes of their own, read every signal twenty times a second; nobody reads the bare channels.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from typing import Any

import numpy as np

import depthrig
from depthrig import _layout as layout
from depthrig._bus import Bus
from depthrig._ports import SIGNAL, SIGNALS, Bell, Sender

_READ = """
import sys, time
import depthrig
readers = [depthrig.SignalReader(f"bench/s{i}", sys.argv[1], 60.0) for i in range(int(sys.argv[2]))]
print("ready", flush=True)
while True:
    for reader in readers:
        reader.latest()
    time.sleep(0.05)
"""


class Bare:
    """A channel as a program would open it that uses iceoryx2 itself: a copy into a loaned slot, and the event."""

    def __init__(self, bus: Bus, name: str, size: int) -> None:
        self._sender = Sender(bus, name, SIGNAL, size, layout.SIGNAL_SLOTS, SIGNALS)
        self._publisher = self._sender._publisher
        self._notifier = Bell(bus, name, SIGNALS)._notifier
        self._size = size
        self._bytes = ctypes.create_string_buffer(size)
        self._address = ctypes.addressof(self._bytes)

    def publish(self, values: Any) -> None:
        """Send a sample, whatever the values are."""
        sample = self._publisher.loan_slice_uninit(self._size).assume_init()
        ctypes.memmove(sample.user_header_ptr, self._address, layout.SIGNAL_HEADER_SIZE)
        ctypes.memmove(sample.payload_ptr, self._address, self._size)
        sample.send()
        self._notifier.notify()


def block(channels: list[Any], values: list[Any], rate: float, seconds: float) -> tuple[list[int], float, float]:
    """Publish for so long; return the time of each call in nanoseconds, the CPU share, and the rate that was reached."""
    clock = time.perf_counter_ns
    times = []
    rounds = int(rate * seconds)
    start, cpu = time.monotonic(), time.process_time()
    for k in range(rounds):
        rest = start + k / rate - time.monotonic()
        if rest > 0:
            time.sleep(rest)
        row = values[k % len(values)]
        for channel in channels:
            before = clock()
            channel.publish(row)
            times.append(clock() - before)
    wall = time.monotonic() - start
    return times, (time.process_time() - cpu) / wall, rounds / wall


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--signals", type=int, default=20)
    parser.add_argument("--fields", type=int, default=7)
    parser.add_argument("--rate", type=float, default=1000.0)
    parser.add_argument("--seconds", type=int, default=20)
    parser.add_argument("--readers", type=int, default=1, help="processes that read")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()

    with tempfile.TemporaryDirectory(prefix="sig", dir="/tmp") as folder:
        names = [f"joint_{i}" for i in range(options.fields)]
        signals = [
            depthrig.Signal(f"bench/s{i}", names, unit="rad", kind="joints", runtime_dir=folder)
            for i in range(options.signals)
        ]
        size = signals[0]._start + 8 * options.fields
        bus = Bus.at(folder)
        bare = [Bare(bus, f"bare/s{i}", size) for i in range(options.signals)]
        readers = [
            subprocess.Popen(
                [sys.executable, "-c", _READ, folder, str(options.signals)], stdout=subprocess.PIPE, text=True
            )
            for _ in range(options.readers)
        ]
        try:
            for reader in readers:
                assert reader.stdout is not None
                reader.stdout.readline()
            values = np.random.default_rng(1).normal(size=(100, options.fields)).tolist()
            found: dict[str, list[Any]] = {"signal": [], "bare": []}
            for _ in range(options.seconds // 2):
                found["bare"].append(block(bare, values, options.rate, 1.0))
                found["signal"].append(block(signals, values, options.rate, 1.0))
        finally:
            for reader in readers:
                reader.kill()
                reader.wait()
            for signal in signals:
                signal.close()
            bare.clear()
            bus.clean_dead()
    result: dict[str, Any] = {"signals": options.signals, "fields": options.fields, "rate_hz": options.rate, "bytes": size}
    for side, blocks in found.items():
        times = np.concatenate([b[0] for b in blocks]) / 1e3
        p50, p99, p999 = np.percentile(times, (50, 99, 99.9))
        result[side] = {
            "p50_us": round(float(p50), 2),
            "p99_us": round(float(p99), 2),
            "p999_us": round(float(p999), 2),
            "cpu_percent_of_a_core": round(100 * float(np.mean([b[1] for b in blocks])), 1),
            "reached_hz": round(float(np.mean([b[2] for b in blocks])), 1),
        }
    result["conditions"] = {
        "python": platform.python_version(),
        "kernel": platform.release(),
        "cores": os.cpu_count(),
        "load_average_1min": round(os.getloadavg()[0], 1),
        "readers": options.readers,
    }
    if options.json:
        print(json.dumps(result, indent=2))
        return
    for side in ("signal", "bare"):
        print(f"{side:>6}: " + ", ".join(f"{name} {value}" for name, value in result[side].items()))
    print(f"{options.signals} signals of {options.fields} doubles ({size} bytes) at {options.rate:g} Hz; {result['conditions']}")


if __name__ == "__main__":
    main()
