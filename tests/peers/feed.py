"""Compares sending images to a NumPy array in another process: depthrig, pyzmq, zenoh and dora-rs. `make bench-feed`.

Every round runs every transport once, a sender and a receiver in processes of their own, in another order each time.
For each it prints the medians over the rounds of p50 and p99, and the medians of the ratios inside the rounds, so that
a busy computer slows both sides.

`publish` is from right before the call that sends an image until the receiver has a NumPy array of it (the Rust
subscriber: its header and pixels). `total` begins with the image in the sender's own memory, so it contains the copy
into shared memory where there is one. pyzmq sends a NumPy array as it is, through a Unix socket; dora-rs makes its copy
inside the call that sends. depthrig's reader wakes shortly before a frame is due; `prepare=False` disables that.
Everything stays on this computer: shared memory and Unix sockets; dora's own daemon
listens on the loopback interface.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import random
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
ENDS = str(HERE / "feed_ends.py")
SIZE = (1280, 720)
IMAGES = {"z16": ("<u2", 2), "rgb8": ("|u1", 3)}
PEERS = {
    "pyzmq": ("zmq", "ipc PUB/SUB, copy=False, high-water mark 4"),
    "zenoh": ("zenoh", "shared memory over a Unix socket, no scouting"),
    "dora-rs": ("dora", "`dora run` with two Python nodes, its daemon in between"),
}
OURS, RUST, PLAIN = "depthrig, Python", "depthrig, Rust", "... prepare=False"


class Failed(Exception):
    """A transport did not deliver its images."""


def commands(way: str, args: argparse.Namespace, config: dict[str, Any], path: str) -> list[list[str]]:
    """The processes of a transport, the sender first."""
    python = [sys.executable, ENDS]
    if way in (RUST, OURS, PLAIN):
        folder, shape = config["folder"], f"{SIZE[0]}x{SIZE[1]}"
        send = [args.latency, "send", folder, config["format"], shape, str(args.fps)]
        frames = [str(args.frames), str(args.warm_up)]
        receive = [args.latency, "receive", folder, "feed/image", *frames]
        ours = "depthrig" if way == OURS else "plain"
        return [send, receive if way == RUST else [*python, ours, "receive", path]]
    name = PEERS[way][0]
    if name == "dora":
        flow = Path(config["folder"]) / "flow.yml"
        node = {e: f"{ENDS} dora {e} {path}" for e in ("send", "receive")}
        flow.write_text(
            f"nodes:\n"
            f"  - id: sender\n    path: {sys.executable}\n    args: {node['send']}\n    outputs: [image]\n"
            f"  - id: receiver\n    path: {sys.executable}\n    args: {node['receive']}\n"
            f"    inputs:\n      image:\n        source: sender/image\n        queue_size: 4\n"
        )
        return [[str(Path(sys.executable).parent / "dora"), "run", str(flow)]]
    return [[*python, name, "send", path], [*python, name, "receive", path]]


def end(process: subprocess.Popen[bytes]) -> None:
    """End a process that we started, and its children: each has a group of its own."""
    for sign in (signal.SIGINT, signal.SIGKILL):
        if process.poll() is None or sign == signal.SIGKILL:
            try:
                os.killpg(process.pid, sign)
            except ProcessLookupError:
                return
            try:
                process.wait(5)
            except subprocess.TimeoutExpired:
                continue


def run(way: str, image: str, args: argparse.Namespace) -> dict[str, list[int]]:
    """One run of one transport."""
    dtype, size = IMAGES[image]
    shape = [SIZE[1], SIZE[0], 3] if image == "rgb8" else [SIZE[1], SIZE[0]]
    folder = tempfile.mkdtemp(prefix="feed", dir="/tmp")  # short, because sockets live below it
    result = Path(folder) / "result.json"
    config = {
        "format": image,
        "bytes": SIZE[0] * SIZE[1] * size,
        "shape": shape,
        "dtype": dtype,
        "fps": args.fps,
        "frames": args.frames,
        "warm_up": args.warm_up,
        "folder": folder,
        "result": str(result),
    }
    path = Path(folder) / "config.json"
    path.write_text(json.dumps(config))
    first = ["chrt", "--fifo", "10"] if args.fifo else []
    quiet = {**os.environ, "RUST_LOG": "error", "DORA_LOG_LEVEL": "error"}  # dora logs a line for each image
    processes: list[subprocess.Popen[bytes]] = []
    log = Path(folder) / "stderr.txt"
    out = Path(folder) / "stdout.txt"
    try:
        with log.open("wb") as err, out.open("wb") as stdout:
            for i, command in enumerate(commands(way, args, config, str(path))):
                pin = ["taskset", "--cpu-list", str(args.pin[i % len(args.pin)])] if args.pin else []
                processes.append(
                    subprocess.Popen(
                        [*first, *pin, *command],
                        stdout=stdout,
                        stderr=err,
                        cwd=folder,
                        env=quiet,
                        start_new_session=True,
                    )
                )
                time.sleep(0.3)
            deadline = time.monotonic() + 30 + (args.frames + args.warm_up) / args.fps
            while not result.exists():
                ended = processes[-1].poll()
                if way == RUST and ended == 0:
                    return json.loads(out.read_text().splitlines()[-1])
                if (ended is not None and not result.exists()) or time.monotonic() > deadline:
                    raise Failed(f"{way} ended with {ended}:\n{(log.read_text() + out.read_text())[-3000:]}")
                time.sleep(0.05)
            return json.loads(result.read_text())
    finally:
        for process in reversed(processes):
            end(process)
        shutil.rmtree(folder, ignore_errors=True)


def percentile(samples: list[int], share: float) -> float:
    return sorted(samples)[min(len(samples) - 1, int(len(samples) * share))] / 1e3


def compare(image: str, args: argparse.Namespace) -> dict[str, Any]:
    """All rounds with one kind of image."""
    ways = [RUST, OURS, PLAIN, *args.peers]
    rounds: list[dict[str, dict[str, float]]] = []
    for number in range(args.rounds):
        order = random.Random(number).sample(ways, len(ways))
        this: dict[str, dict[str, float]] = {}
        for way in order:
            samples = run(way, image, args)
            this[way] = {
                f"{name}_p{q}": percentile(samples[name], q / 100) for name in ("publish", "total") for q in (50, 99)
            }
        rounds.append(this)
        print(
            f"  {image} round {number + 1}: " + ", ".join(f"{w} {this[w]['publish_p50']:.0f}" for w in ways),
            flush=True,
        )
    rows = {way: {k: statistics.median(r[way][k] for r in rounds) for k in rounds[0][way]} for way in ways}
    for way in ways:
        rows[way]["to_rust"] = statistics.median(r[way]["publish_p50"] / r[RUST]["publish_p50"] for r in rounds)
        rows[way]["to_ours"] = statistics.median(r[way]["publish_p50"] / r[OURS]["publish_p50"] for r in rounds)
        rows[way]["total_to_ours"] = statistics.median(r[way]["total_p50"] / r[OURS]["total_p50"] for r in rounds)
    return {"image": image, "bytes": SIZE[0] * SIZE[1] * IMAGES[image][1], "rows": rows, "rounds": rounds}


def text(result: dict[str, Any]) -> str:
    lines = [
        f"\n{SIZE[0]}x{SIZE[1]} {result['image']}, {result['bytes']} bytes an image; microseconds, medians of the rounds",
        f"{'':<20}{'publish p50':>12}{'p99':>9}{'total p50':>11}{'p99':>9}{'p50 / Rust':>12}{'p50 / ours':>12}{'total / ours':>14}",
    ]
    for way, r in result["rows"].items():
        lines.append(
            f"{way:<20}{r['publish_p50']:>12.1f}{r['publish_p99']:>9.1f}{r['total_p50']:>11.1f}{r['total_p99']:>9.1f}"
            f"{r['to_rust']:>12.2f}{r['to_ours']:>12.2f}{r['total_to_ours']:>14.2f}"
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--latency", required=True, help="the built example `latency` of depthrig-bus")
    parser.add_argument("--images", nargs="+", default=list(IMAGES), choices=list(IMAGES))
    parser.add_argument("--peers", nargs="*", default=list(PEERS), choices=list(PEERS))
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--frames", type=int, default=150)
    parser.add_argument("--warm-up", type=int, default=20)
    parser.add_argument("--fps", type=float, default=30)
    parser.add_argument("--fifo", action="store_true", help="real-time priority for every process of every transport")
    parser.add_argument("--pin", type=int, nargs="*", help="cores of each sender and receiver [default: none]")
    parser.add_argument("--json", type=Path, help="write all measurements to this file")
    parser.add_argument("--check", action="store_true", help="exit code 1 when a target is missed")
    args = parser.parse_args()
    args.latency = str(Path(args.latency).resolve())
    load = os.getloadavg()[0]
    cpu = Path("/proc/cpuinfo").read_text().splitlines()
    model = next(line.split(": ")[1].strip() for line in cpu if line.startswith("model name"))
    print(
        f"{os.cpu_count()} x {model}, Linux {platform.release()}, Python {platform.python_version()}, load average {load:.1f}"
    )
    print(
        f"pinning: {args.pin or 'none'}; priority: {'real time (SCHED_FIFO 10)' if args.fifo else 'ordinary'}, for every process"
    )
    packages = {"pyzmq": "pyzmq", "zenoh": "eclipse-zenoh", "dora-rs": "dora-rs"}
    for way in args.peers:
        print(f"{way} {version(packages[way])}: {PEERS[way][1]}")
    print(f"{args.rounds} rounds of {args.frames} images at {args.fps:g} Hz after {args.warm_up}", flush=True)
    results = [compare(image, args) for image in args.images]
    for result in results:
        print(text(result))
    kept = True
    print("\nPromises")
    for result in results:
        rows = result["rows"]
        promises = [
            ("p50 over the Rust subscriber's: at most 3.5", rows[OURS]["to_rust"], rows[OURS]["to_rust"] <= 3.5)
        ]
        promises += [
            (f"{w}'s p50 over depthrig's: at least 4", rows[w]["to_ours"], rows[w]["to_ours"] >= 4) for w in args.peers
        ]
        for what, measured, ok in promises:
            kept &= ok
            print(f"  {'ok    ' if ok else 'MISSED'} {result['image']}, {what}: measured {measured:.2f}")
    if args.json:
        args.json.write_text(json.dumps({"cpu": model, "load_before": load, "results": results}, indent=1) + "\n")
    sys.exit(1 if args.check and not kept else 0)


if __name__ == "__main__":
    main()
