"""The paper's split in two namespaces of one computer: seven cameras, four here and three there, a wire that is cut in the middle, one dataset.

    tests/link/demo.py DEPTHRIG [--seconds S] [--cut S] [--rate 1gbit] [--keep DIR]

Prints what was recorded, lost, pulled and joined, how right the clocks were, how late live frames of the other computer are, and which of these is what
docs/two-computers.md promises. Ends with 1 if anything is missing. `tools/demo-two-hosts.sh` builds depthrig first.
"""

from __future__ import annotations

import argparse
import http.client
import json
import re
import shutil
import socket
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from hosts import TwoHosts, wait_for, why_not

# Not a whole number of periods of frame sets, which would hide a grid that is off.
SHIFT_NS = 1_234_567_890_123
HERE_CAMERAS = 4
RENDER_S = 600.0
SETTLE_S = 10.0
MIRRORED = "l515/depth"
MIRROR_FRAMES = 90
# Of a clock reading, seconds: from one to the next, and what the digits of a status leave out.
CLOCK_PERIOD_S = 0.1
DIGITS_S = 1e-9


class ControlSocket(http.client.HTTPConnection):
    """HTTP to a daemon."""

    def __init__(self, path: Path) -> None:
        super().__init__("localhost", timeout=10)
        self.path = path

    def connect(self) -> None:
        self.sock = socket.socket(socket.AF_UNIX)
        self.sock.settimeout(10)
        self.sock.connect(str(self.path))


class Clock:
    """How far the clock of the session is off on the other computer, whose true offset is known, while this is open."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.readings: list[tuple[float, float]] = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._read, daemon=True)

    def __enter__(self) -> Clock:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(20)

    def _read(self) -> None:
        while not self._stop.wait(CLOCK_PERIOD_S):
            connection = ControlSocket(self.path)
            try:
                connection.request("GET", "/v1/status")
                link = json.loads(connection.getresponse().read())["link"]
            except OSError:
                continue
            finally:
                connection.close()
            self.readings.append(((link["offset_s"] + SHIFT_NS / 1e9) * 1e6, link["uncertainty_us"]))

    def row(self) -> tuple[str, str, str, bool]:
        errors = sorted(abs(error) for error, _ in self.readings)
        outside = sum(abs(error) > uncertainty + DIGITS_S * 1e6 for error, uncertainty in self.readings)
        p99 = errors[int(0.99 * (len(errors) - 1))]
        said = f"p50 {statistics.median(errors):.1f}, p99 {p99:.1f} us; {outside} of {len(errors)} outside of the stated uncertainty"
        return "error of the clock", said, "p99 50 us; 0", p99 <= 50 and outside == 0


# What was measured, its value, what was promised, and whether that is so.
Row = tuple[str, str, str, bool]


class Side:
    """A computer with its daemon."""

    def __init__(self, hosts: TwoHosts, binary: str, host: str, name: str, folder: Path, runtime: Path) -> None:
        self.hosts, self.binary, self.host, self.name = hosts, binary, host, name
        self.data = folder / name
        self.runtime = runtime / name
        self.runtime.mkdir(mode=0o700)
        self.rig_file = folder / f"{name}.toml"
        self.log = folder / f"{name}.log"

    def ask(self, *arguments: str, codes: tuple[int, ...] = (0,)) -> str:
        return self.hosts.run(self.host, self.binary, *arguments, codes=codes, DEPTHRIG_RUNTIME_DIR=str(self.runtime))

    def status(self) -> dict:
        return json.loads(self.ask("status", "--json", codes=(0, 3)))

    def start(self) -> None:
        self.hosts.start(self.host, self.log, self.binary, "run", str(self.rig_file), DEPTHRIG_RUNTIME_DIR=str(self.runtime))

    def is_ready(self) -> bool:
        try:
            status = self.status()
        except AssertionError:
            return False
        return status["preparing"] is None and all(c["state"] == "streaming" for c in status["cameras"])


def split(config: str, right: Side, left: Side, ssh: str) -> None:
    """The rig files of both computers, from one of all cameras."""
    top, *cameras = config.split("\n[[camera]]")
    lines = [line for line in top.splitlines() if line and not line.startswith("#")]
    link = {
        right.name: f'listen = "10.77.0.1:7447"\n[[link.hosts]]\nname = "{left.name}"\nssh = "{ssh}"\nsocket = "{left.runtime}/mount.sock"\nmirror = ["{MIRRORED}"]',
        left.name: 'recorder = "10.77.0.1:7447"',
    }
    parts = {right.name: cameras[:HERE_CAMERAS], left.name: cameras[HERE_CAMERAS:]}
    for side in (right, left):
        text = []
        for line in lines:
            text.append(line)
            if line == "[recording]":
                text += [f'directory = "{side.data}"', "min_minutes = 0"]
            elif line == "[control]":
                text.append('tcp = "off"')
        text += ["[link]", f'host = "{side.name}"', link[side.name]]
        side.rig_file.write_text("\n".join(text) + "\n" + "".join(f"\n[[camera]]{camera}" for camera in parts[side.name]))


def row(name: str, info: dict) -> str:
    spread = info["spread"]
    frames = sum(stream["frames"] for stream in info["streams"])
    sets = f"{info['sets']:5} {info['sets'] - info['incomplete_sets']:9} {frames:7}"
    return f"  {name:14} {len(info['streams']):7} {sets} {spread['p50_ns'] / 1e6:8.1f} {spread['max_ns'] / 1e6:8.1f} {info['bytes'] / 1e6:9.1f}"


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("binary")
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--cut", type=float, default=5.0)
    parser.add_argument("--rate", default="1gbit")
    parser.add_argument("--keep", type=Path)
    options = parser.parse_args()
    if why := why_not():
        print(f"skipped: {why}")
        return 0
    folder = options.keep or Path(tempfile.mkdtemp(prefix="depthrig-two-"))
    folder.mkdir(parents=True, exist_ok=True)
    runtime = Path(tempfile.mkdtemp(prefix="d2", dir="/tmp"))
    try:
        with TwoHosts(folder, SHIFT_NS, options.rate) as hosts:
            return session(hosts, options, folder, runtime)
    finally:
        shutil.rmtree(runtime, ignore_errors=True)
        if options.keep is None:
            shutil.rmtree(folder, ignore_errors=True)


def cut_wire(hosts: TwoHosts, seconds: float, link: Callable[[], dict]) -> list[Row]:
    """Cuts the wire for so long: when that is seen, and when the other computer is back."""
    begun = time.monotonic()
    hosts.cut()
    seen_s = float("inf")
    while time.monotonic() < begun + seconds:
        if seen_s == float("inf") and link()["state"] == "absent":
            seen_s = time.monotonic() - begun
        time.sleep(0.05)
    hosts.heal()
    healed = time.monotonic()
    # A connection that the cut has ended is missed a little later.
    time.sleep(0.2)
    wait_for("the wire is back", lambda: link()["state"] == "connected")
    return [(f"wire cut for {healed - begun:.1f} s", f"seen after {seen_s:.1f} s, back {time.monotonic() - healed:.1f} s after it was whole", "", True)]


def mirrored(hosts: TwoHosts, right: Side, left: Side) -> list[Row]:
    """How late live frames of the other computer are, beside the same stream there."""
    latency = re.compile(r"latency ([\d.]+) ms")
    tap = ("tap", MIRRORED, "--count", str(MIRROR_FRAMES))
    with ThreadPoolExecutor(2) as pool:
        here, there = pool.map(lambda side: [float(ms) for ms in latency.findall(side.ask(*tap))], (right, left))
    added = statistics.median(here) - statistics.median(there)
    said = f"{len(here)} frames of {MIRRORED}, p50 {added:+.1f} ms"
    # Of a slow wire nothing is promised.
    bar = "25 ms" if hosts.rate in ("1gbit", "10gbit") else ""
    return [("added by mirroring", said, bar, added <= 25)]


def session(hosts: TwoHosts, options: argparse.Namespace, folder: Path, runtime: Path) -> int:
    right = Side(hosts, options.binary, "here", "right", folder, runtime)
    left = Side(hosts, options.binary, "there", "left", folder, runtime)
    split(right.ask("config", "show"), right, left, hosts.serve_ssh())
    right.start()
    left.start()
    print("two computers, clocks 1234.567890123 s apart; rendering what the cameras see (kept for next time)", flush=True)
    wait_for("the cameras", lambda: right.is_ready() and left.is_ready(), RENDER_S)
    link = lambda: right.status()["hosts"]["hosts"][0]  # noqa: E731
    wait_for("the other computer", lambda: link()["has_clock"])
    wait_for("its live frames", lambda: link()["mirrors"][0]["state"] != "waiting")
    # The ticks of both find their place, 2 ms each time.
    time.sleep(SETTLE_S)
    print(right.ask("record", "start", "--name", "demo", "--scene", "table"), end="", flush=True)
    with Clock(left.runtime / "mount.sock") as seen_clock:
        begun = time.monotonic()
        mirror = mirrored(hosts, right, left)
        time.sleep(max(0.0, (options.seconds - options.cut) / 2 - (time.monotonic() - begun)))
        cut = cut_wire(hosts, options.cut, link) if options.cut > 0 else []
        time.sleep((options.seconds - options.cut) / 2)
    print(right.ask("record", "stop", codes=(0, 3)), end="", flush=True)
    begun = time.monotonic()
    parts = lambda: right.status()["hosts"]["session"]["parts"]  # noqa: E731
    wait_for("the part", lambda: all(part["is_complete"] for part in parts()), 10 * options.seconds)
    pulled_s = time.monotonic() - begun
    wait_for("the joined dataset", lambda: right.status()["hosts"]["session"]["joined"] not in ("waiting", "joining"), 600)
    joined_s = time.monotonic() - begun
    print(right.ask("status", codes=(0, 3)).split("\n\n")[0])

    info = {name: json.loads(right.ask("info", "--json", str(right.data / name))) for name in ("demo", "demo_left", "demo_joined")}
    print(f"\n  {'dataset':14} {'streams':>7} {'sets':>5} {'complete':>9} {'frames':>7} {'p50 ms':>8} {'max ms':>8} {'MB':>9}")
    for name, title in (("demo", "right's part"), ("demo_left", "left's part"), ("demo_joined", "joined")):
        print(row(title, info[name]))
    spreads = {name: of["spread"]["max_ns"] / 1e6 for name, of in info.items()}
    one_host = max(spreads["demo"], spreads["demo_left"])
    frames = {name: sum(stream["frames"] for stream in of["streams"]) for name, of in info.items()}
    missing = frames["demo"] + frames["demo_left"] - frames["demo_joined"]
    incomplete = info["demo_joined"]["incomplete_sets"]
    table = [
        ("frames of the parts that are missing", str(missing), "0", missing == 0),
        ("incomplete sets", str(incomplete), "the first and the last at most, of one computer alone", incomplete <= 2),
        ("widest set, joined", f"{spreads['demo_joined']:.1f} ms", f"{one_host + 1:.1f} ms (one computer's + 1)", spreads["demo_joined"] <= one_host + 1),
        seen_clock.row(),
        *mirror,
        *cut,
        ("pulled after the end", f"{pulled_s:.1f} s", f"{options.seconds:.0f} s (the session's length)", pulled_s <= options.seconds),
        ("joined after the end", f"{joined_s:.1f} s", "", True),
    ]
    print()
    for name, value, bar, is_met in table:
        said = f" (promised: {bar}; {'met' if is_met else 'MISSED'})" if bar else ""
        print(f"  {name:38} {value}{said}", flush=True)
    print()
    findings = json.loads(right.ask("verify", "--json", str(right.data / "demo_joined"), codes=(0, 1, 3)))["findings"]
    for finding in findings:
        print(f"  {finding['severity']}: {finding['message']}")
    # Beside the running rig, whose signals have the same names.
    apart = runtime / "replay"
    apart.mkdir(mode=0o700)
    print(right.ask("replay", str(right.data / "demo_joined"), "--as-fast-as-possible", "-q", "--runtime-dir", str(apart)), end="")
    if missing != 0:
        print("frames are missing in the joined dataset", file=sys.stderr)
        return 1
    return 1 if any(finding["severity"] == "broken" for finding in findings) else 0


if __name__ == "__main__":
    sys.exit(main())
