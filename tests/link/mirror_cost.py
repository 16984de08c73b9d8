#!/usr/bin/env python3
"""What live frames of another computer cost: `make bench-mirror`, or tests/link/mirror_cost.py DEPTHRIG.

Two namespaces joined by a wire, an OpenSSH server, and one simulated camera of 1280x720 at 30 Hz, colour and depth, on the other one. In turns nobody reads
its streams here, a subscriber of each does, and zenoh carries as many bytes for two programs in Python. Of each turn it prints the time from publishing there
to publishing here, the frames that were left out, and the cores of everything on both computers beyond those of a turn without readers: the subscribers are
neither's. Then the daemon here is stopped for some seconds, while a subscriber there reads: the memory of the daemon there, and the age of that subscriber's
frames. Ratios are within the run.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import depthrig
import numpy as np
from hosts import HERE, TwoHosts, wait_for

SHIFT_NS = 1_234_567_890_123
STREAMS = ("moving/color", "moving/depth")
RATE_HZ = 30.0
ZENOH = f"tcp/{HERE}:7448"
KEYS = {"color": 1280 * 720 * 3, "depth": 1280 * 720 * 2}
TICKS = os.sysconf("SC_CLK_TCK")
RIG = 'rig = "mount"\n[control]\ntcp = "off"\n[recording]\ndirectory = "{folder}/data"\nreserve_mb = 64\nmin_minutes = 0\n[link]\n'
CAMERA = '[[camera]]\nname = "{name}"\nbackend = "synthetic"\nmodel = "d435"\ncheap = true\n' + "".join(
    f'[[camera.stream]]\nname = "{stream}"\nwidth = {{width}}\nheight = {{height}}\nrate_hz = {{rate}}\n' for stream in KEYS
)


def zenoh_session(end: str) -> Any:
    import zenoh

    settings = zenoh.Config()
    settings.insert_json5("scouting/multicast/enabled", "false")
    settings.insert_json5(f"{end}/endpoints", json.dumps([ZENOH]))
    settings.insert_json5("connect/endpoints" if end == "listen" else "listen/endpoints", "[]")
    return zenoh.open(settings)


def zenoh_send() -> None:
    """Sends images at the camera's rate until it is ended."""
    session = zenoh_session("connect")
    publishers = [(session.declare_publisher(f"mount/{key}"), bytes(size)) for key, size in KEYS.items()]
    begun = time.monotonic()
    for n in range(1 << 30):
        time.sleep(max(0.0, begun + n / RATE_HZ - time.monotonic()))
        for publisher, image in publishers:
            publisher.put(image)


def zenoh_receive(path: str) -> None:
    """Writes down how many bytes came, until it is ended."""
    session = zenoh_session("listen")
    total = 0

    def take(sample: Any) -> None:
        nonlocal total
        total += len(sample.payload.to_bytes())

    subscribers = [session.declare_subscriber(f"mount/{key}", take) for key in KEYS]
    while subscribers:
        time.sleep(0.05)
        Path(path).write_text(str(total))


def network(pid: object) -> str:
    try:
        return os.readlink(f"/proc/{pid}/ns/net")
    except OSError:
        return ""


def together(works: list[Callable[[], None]]) -> None:
    """Does all of them at once."""
    with ThreadPoolExecutor(len(works)) as pool:
        for done in [pool.submit(work) for work in works]:
            done.result()


class Bench:
    """Both computers with their daemons."""

    def __init__(self, binary: str, folder: Path, rate: str, seconds: float) -> None:
        self.binary, self.folder, self.seconds = binary, folder, seconds
        self.hosts = TwoHosts(folder, SHIFT_NS, rate)
        self.runtime = {host: folder / f"r-{host}" for host in ("here", "there")}
        for path in self.runtime.values():
            path.mkdir(mode=0o700)
        ssh = self.hosts.serve_ssh()
        socket = self.runtime["there"] / "mount.sock"
        links = {
            "here": f'host = "right"\nlisten = "{HERE}:7447"\n[[link.hosts]]\nname = "left"\nssh = "{ssh}"\nsocket = "{socket}"\n'
            f"mirror = {json.dumps(STREAMS)}\n" + CAMERA.format(name="own", width=64, height=48, rate=5.0),
            "there": f'host = "left"\nrecorder = "{HERE}:7447"\n' + CAMERA.format(name="moving", width=1280, height=720, rate=RATE_HZ),
        }
        for host, text in links.items():
            (folder / f"{host}.toml").write_text(RIG.format(folder=folder / host) + text)
        self.daemons = {host: self.start(host, binary, "run", str(folder / f"{host}.toml")) for host in links}
        wait_for("the clock", lambda: self.host()["has_clock"])
        wait_for("the streams", lambda: all(m["state"] == "unread" for m in self.host()["mirrors"]))

    def start(self, host: str, *command: str) -> subprocess.Popen[bytes]:
        log = self.folder / f"{host}.log"
        return self.hosts.start(host, log, *command, DEPTHRIG_RUNTIME_DIR=str(self.runtime[host]))

    def host(self) -> dict[str, Any]:
        try:
            text = self.hosts.run("here", self.binary, "status", "--json", codes=(0, 3), DEPTHRIG_RUNTIME_DIR=str(self.runtime["here"]))
        except AssertionError:
            return {"has_clock": False, "mirrors": [{"state": "waiting"}]}
        return json.loads(text)["hosts"]["hosts"][0]

    def processor_s(self) -> float:
        """Seconds of processors that everything on both computers has had."""
        places = {network(daemon.pid) for daemon in self.daemons.values()}
        total = 0
        for stat in Path("/proc").glob("[0-9]*/stat"):
            if network(stat.parent.name) in places:
                try:
                    fields = stat.read_text().rpartition(")")[2].split()
                except OSError:
                    continue
                total += sum(map(int, fields[11:15]))
        return total / TICKS

    def cores(self, work: Callable[[], Any]) -> float:
        """Cores that all of it needs, while `work` is done."""
        before, begun = self.processor_s(), time.monotonic()
        work()
        return (self.processor_s() - before) / (time.monotonic() - begun)

    def mirrored(self) -> tuple[float, dict[str, tuple[np.ndarray, int, float]]]:
        """Cores, and of each stream the times from there to here in ms, frames left out, and frames a second."""
        sources = {s: [depthrig.Stream(s, "mount", self.runtime[host], timeout=60) for host in ("here", "there")] for s in STREAMS}
        wait_for("live frames", lambda: all(m["state"] == "live" for m in self.host()["mirrors"]))
        time.sleep(3.0)
        results: dict[str, tuple[np.ndarray, int, float]] = {}

        def read(stream: str) -> None:
            frames: list[dict[int, tuple[int, int]]] = [{}, {}]

            def take(source: depthrig.Stream, seen: dict[int, tuple[int, int]]) -> None:
                end = time.monotonic() + self.seconds
                while time.monotonic() < end:
                    with source.next(timeout=10) as frame:
                        h = frame.header
                        seen[h.device_sequence] = h.publish_time_ns, sum(h.dropped)

            together([lambda n=n: take(sources[stream][n], frames[n]) for n in range(2)])
            here, there = frames
            added = np.array([here[n][0] - (there[n][0] - SHIFT_NS) for n in here if n in there]) / 1e6
            lost = [dropped for _, dropped in here.values()]
            results[stream] = added, lost[-1] - lost[0], len(here) / self.seconds

        cores = self.cores(lambda: together([lambda stream=stream: read(stream) for stream in STREAMS]))
        for pair in sources.values():
            for source in pair:
                source.close()
        wait_for("nobody reads", lambda: all(m["state"] == "unread" for m in self.host()["mirrors"]))
        return cores, results

    def zenoh(self) -> tuple[float, float]:
        """Cores, and bytes a second that zenoh carries."""
        count = self.folder / "count"
        count.write_text("0")
        environment = {"RUST_LOG": "off"}
        receive = self.hosts.start("here", self.folder / "zenoh.log", sys.executable, __file__, "zenoh", "receive", str(count), **environment)
        time.sleep(1.0)
        send = self.hosts.start("there", self.folder / "zenoh.log", sys.executable, __file__, "zenoh", "send", **environment)
        read = lambda: int(count.read_text() or 0)  # noqa: E731
        wait_for("bytes by zenoh", lambda: read() > 0)
        time.sleep(1.0)
        before, begun = read(), time.monotonic()
        cores = self.cores(lambda: time.sleep(self.seconds))
        rate = (read() - before) / (time.monotonic() - begun)
        for process in (send, receive):
            process.kill()
            process.wait()
        return cores, rate

    def memory_mb(self, host: str) -> float:
        status = Path(f"/proc/{self.daemons[host].pid}/status").read_text()
        return int(next(line for line in status.splitlines() if line.startswith("RssAnon")).split()[1]) / 1e3

    def ages(self) -> np.ndarray:
        """Ages in ms of frames that a subscriber on the other computer reads."""
        seen = []
        with depthrig.Stream(STREAMS[1], "mount", self.runtime["there"], timeout=60) as source:
            end = time.monotonic() + self.seconds
            while time.monotonic() < end:
                with source.next(timeout=10) as frame:
                    seen.append((time.monotonic_ns() + SHIFT_NS - frame.header.capture_time_ns) / 1e6)
        return np.array(seen)

    def stalled(self) -> None:
        """The daemon here is stopped while it mirrors."""
        with depthrig.Stream(STREAMS[0], "mount", self.runtime["here"], timeout=60) as color, depthrig.Stream(STREAMS[1], "mount", self.runtime["here"], timeout=60):
            color.next(timeout=10).release()
            rows = []
            for _ in range(3):
                before = self.memory_mb("there"), self.ages()
                self.daemons["here"].send_signal(signal.SIGSTOP)
                try:
                    rows.append((*before, self.ages(), self.memory_mb("there")))
                finally:
                    self.daemons["here"].send_signal(signal.SIGCONT)
                time.sleep(3.0)
        p99 = [np.percentile(stopped, 99) / np.percentile(running, 99) for _, running, stopped, _ in rows]
        memory = max(after - before for before, _, _, after in rows)
        print(f"  stalled peer: memory there {memory:+.1f} MB, p99 of the age of its own subscriber's frames x {statistics.median(p99):.2f}", flush=True)


def row(name: str, added: np.ndarray, lost: int, rate_hz: float) -> str:
    return f"  {name:14} {np.median(added):8.1f} {np.percentile(added, 99):8.1f} {rate_hz:8.1f} {lost:9}"


def measure(options: argparse.Namespace, rate: str) -> None:
    with tempfile.TemporaryDirectory(prefix="dmc", dir="/tmp") as folder:
        bench = Bench(options.binary, Path(folder), rate, options.seconds)
        with bench.hosts:
            rest = bench.cores(lambda: time.sleep(options.seconds))
            print(f"wire of {rate}, while nobody reads: {rest:.2f} cores of both computers", flush=True)
            print(f"  {'stream':14} {'p50 ms':>8} {'p99 ms':>8} {'Hz':>8} {'left out':>9}")
            costs, peers = [], []
            for _ in range(options.rounds):
                cores, results = bench.mirrored()
                for stream in STREAMS:
                    print(row(stream, *results[stream]), flush=True)
                coding = {m["stream"]: m["coding"] for m in bench.host()["mirrors"]}
                carried = sum(KEYS[s.split("/")[1]] * results[s][2] for s in STREAMS) / 1e9
                costs.append((cores - rest) / carried)
                print(f"  as {' and '.join(coding.values())}: {cores - rest:.2f} cores more, {costs[-1]:.2f} s for a GB of images", end="; ", flush=True)
                cores, carried = bench.zenoh()
                peers.append((cores - rest) / carried * 1e9)
                print(f"zenoh {carried / 1e9:.3f} GB/s, {peers[-1]:.2f} s for a GB", flush=True)
            print(f"  processors for the same bytes, median: {statistics.median(c / p for c, p in zip(costs, peers)):.2f} x zenoh (not encrypted)")
            if rate == "10gbit":
                bench.stalled()


def main() -> None:
    if sys.argv[1:3] == ["zenoh", "send"]:
        return zenoh_send()
    if sys.argv[1:3] == ["zenoh", "receive"]:
        return zenoh_receive(sys.argv[3])
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("binary")
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--rate", action="append")
    options = parser.parse_args()
    for rate in options.rate or ["10gbit", "1gbit"]:
        measure(options, rate)


if __name__ == "__main__":
    main()
