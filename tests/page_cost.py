#!/usr/bin/env python3
"""What the live page costs the rig that it shows: `make bench-page`, or tests/page_cost.py DEPTHRIG.

Seven simulated cameras, fourteen streams of 1280x720 at 30 Hz, recorded at 5 Hz. In turns nobody looks, one program reads what a page reads (every stream
640 columns wide at 10 Hz), two do, and a program without any connection works as much as one of those did: on a computer with few cores that alone delays
the cameras. Of each turn it prints the cores of the daemon's threads, the age of the images, and the time from capture to the channel of the recorded
frames; then, in Chromium, the first paint of the page and the age of its images when they are drawn. Ratios are within the run.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import shutil
import signal
import statistics
import struct
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlsplit

from websockets.sync.client import connect

CAMERAS = 7
RIG = 'rig = "cost"\n[control]\ntcp = "127.0.0.1:0"\n[sets]\nrate_hz = 5.0\n[recording]\nreserve_mb = 64\n' + "".join(
    f'[[camera]]\nname = "c{i}"\nbackend = "synthetic"\nmodel = "generic"\ncheap = true\n'
    + "".join(
        f'[[camera.stream]]\nname = "{s}"\nwidth = 1280\nheight = 720\nrate_hz = 30.0\n' for s in ("color", "depth")
    )
    for i in range(CAMERAS)
)
WATCH = [{"stream": f"c{i}/{s}", "width": 640, "rate_hz": 10} for i in range(CAMERAS) for s in ("color", "depth")]
HEAD = struct.Struct("<HBBHHHHHHQqqfI")
TICKS = os.sysconf("SC_CLK_TCK")
THREADS = ("viewers", "api")


def ask(binary: str, *arguments: str) -> str:
    return subprocess.run([binary, *arguments], capture_output=True, text=True, check=True).stdout


def look(address: str, token: str, stop: multiprocessing.synchronize.Event, ages: multiprocessing.Queue) -> None:
    """Read what a page reads, and give each credit back at once."""
    seen = []
    with connect(address, max_size=None, compression=None) as socket:
        socket.send(json.dumps({"token": token}))
        socket.send(json.dumps({"watch": WATCH}))
        while not stop.is_set():
            data = socket.recv(10)
            if isinstance(data, bytes):
                captured = HEAD.unpack(data[: HEAD.size])[10]
                seen.append(time.monotonic_ns() - captured)
                socket.send('{"credit": 1}')
    ages.put((seen, time.process_time()))


def work(share: float, stop: multiprocessing.synchronize.Event) -> None:
    """Use this share of a core, 10 ms at a time, with a copy of memory as reading an image is."""
    block = bytes(230_000)
    while not stop.is_set():
        began = time.process_time()
        while time.process_time() - began < 0.01 * share:
            bytearray(block)
        time.sleep(0.01 * (1 - share))


@contextmanager
def beside(
    target: Callable[..., None], arguments: list[tuple], stop: multiprocessing.synchronize.Event
) -> Iterator[None]:
    processes = [multiprocessing.Process(target=target, args=a) for a in arguments]
    for process in processes:
        process.start()
    try:
        yield
    finally:
        stop.set()
        for process in processes:
            process.join(20)


def used(process_id: int) -> dict[str, int]:
    """Ticks of the threads of the daemon by name."""
    ticks: dict[str, int] = defaultdict(int)
    for task in Path(f"/proc/{process_id}/task").iterdir():
        name, fields = (task / "stat").read_text().rsplit(")", 1)
        ticks[name.split("(", 1)[1]] += sum(map(int, fields.split()[11:13]))
    return ticks


def quantile(values: list[float], q: float) -> float:
    return sorted(values)[min(len(values) - 1, int(q * len(values)))] if values else float("nan")


# Of each image the page was sent: its age when it was sent, and from its arrival until its credit was given back, which the page does when it has drawn it.
WATCHED_SOCKET = """
window.ages = [];
const Plain = WebSocket;
window.WebSocket = class extends Plain {
  constructor(...args) {
    super(...args);
    const waiting = [];
    this.addEventListener("message", ({ data }) => {
      if (data instanceof ArrayBuffer) {
        waiting.push([Number(new DataView(data).getBigInt64(32, true)) / 1e6, performance.now()]);
      }
    });
    const send = this.send.bind(this);
    this.send = (text) => {
      send(text);
      for (let n = JSON.parse(text).credit ?? 0; n > 0 && waiting.length > 0; n -= 1) {
        const [age, came] = waiting.shift();
        window.ages.push(age + performance.now() - came);
      }
    };
  }
};
"""


def in_chromium(url: str, token: str, seconds: float) -> dict[str, object]:
    """Seconds from the start of loading to the first paint with content, and the age of images when they are drawn."""
    chromium = shutil.which("chromium")
    if chromium is None:
        return {}
    from playwright.sync_api import sync_playwright

    times = []
    with sync_playwright() as p:
        browser = p.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        for _ in range(5):
            page = browser.new_page(viewport={"width": 1600, "height": 1000})
            page.add_init_script(WATCHED_SOCKET)
            page.goto(f"{url}#token={token}")
            page.wait_for_function("performance.getEntriesByName('first-contentful-paint').length > 0")
            times.append(page.evaluate("performance.getEntriesByName('first-contentful-paint')[0].startTime") / 1000)
            if len(times) == 5:
                page.wait_for_timeout(3000)
                page.evaluate("window.ages.length = 0")
                page.wait_for_timeout(1000 * seconds)
                ages = page.evaluate("window.ages")
            page.close()
        browser.close()
    drawn = {"drawn_age_ms": [quantile(ages, q) for q in (0.5, 0.99)], "drawn_per_second": len(ages) / seconds}
    return {"first_paint_s": statistics.median(times), **drawn}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("depthrig", help="the binary")
    parser.add_argument("--seconds", type=float, default=8, help="of a turn")
    parser.add_argument("--rounds", type=int, default=4)
    parser.add_argument("--json", type=Path, help="write the numbers there")
    args = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="dc-", dir="/dev/shm"))
    daemon = None
    try:
        os.environ["DEPTHRIG_RUNTIME_DIR"] = str(folder / "run")
        (folder / "rig.toml").write_text(RIG)
        command = [args.depthrig, "run", str(folder / "rig.toml"), "--record", str(folder / "data")]
        with (folder / "log").open("w") as log:
            daemon = subprocess.Popen(command, stdout=log, stderr=log)
        return measure(args, folder, daemon)
    finally:
        if daemon is not None and daemon.poll() is None:
            daemon.send_signal(signal.SIGINT)
            daemon.wait(60)
        shutil.rmtree(folder)


def measure(args: argparse.Namespace, folder: Path, daemon: subprocess.Popen[bytes]) -> int:
    deadline = time.monotonic() + 120
    while True:
        shown = subprocess.run([args.depthrig, "open", "--print"], capture_output=True, text=True, check=False)
        if shown.returncode == 0:
            break
        if daemon.poll() is not None or time.monotonic() > deadline:
            print(f"the rig does not run: {(folder / 'log').read_text()[-2000:]}", file=sys.stderr)
            return 1
        time.sleep(0.5)
    url, token = shown.stdout.strip().split("#token=")
    address = f"ws://{urlsplit(url).netloc}/v1/live"
    time.sleep(5)  # The cameras and their first sets.
    turns: dict[str, list[tuple[int, int]]] = defaultdict(list)
    cores: dict[str, list[dict[str, float]]] = defaultdict(list)
    ages: dict[str, list[int]] = defaultdict(list)
    share = 0.2

    def turn(name: str, target: Callable[..., None], count: int) -> float:
        stop, results = multiprocessing.Event(), multiprocessing.Queue()
        is_page = target is look
        arguments = [(address, token, stop, results) if is_page else (share, stop)] * count
        busy = 0.0
        with beside(target, arguments, stop):
            time.sleep(1.5)
            before, began = used(daemon.pid), time.monotonic_ns()
            time.sleep(args.seconds)
            after, ended = used(daemon.pid), time.monotonic_ns()
            stop.set()
            for _ in range(count if is_page else 0):
                seen, cpu = results.get(timeout=20)
                ages[name] += seen
                busy += cpu / (args.seconds + 1.5)
        passed = (ended - began) * 1e-9
        turns[name].append((began, ended))
        cores[name].append({t: (n - before.get(t, 0)) / TICKS / passed for t, n in after.items()})
        return busy / max(count, 1)

    for _ in range(args.rounds):
        turn("nobody", work, 0)
        busy = turn("one page", look, 1)
        turn("two pages", look, 2)
        # As much as the program that reads, and the two threads of the daemon.
        share = min(1.0, busy + sum(cores["one page"][-1].get(t, 0) for t in THREADS))
        turn("other work", work, 1)
        time.sleep(1)
    chromium = in_chromium(url, token, args.seconds)
    daemon.send_signal(signal.SIGINT)
    daemon.wait(60)
    (dataset,) = (p.parent for p in (folder / "data").rglob("session.toml"))
    frames = [json.loads(line) for line in ask(args.depthrig, "cat", str(dataset), "--json").splitlines()]
    sets = {f["set"] for f in frames}
    report: dict[str, object] = {"cores": os.cpu_count(), "load": os.getloadavg()[0], "chromium": chromium}
    report["sets"] = len(sets)
    report["frames_missing"] = len(sets) * len(WATCH) - len(frames)
    for name, spans in turns.items():
        waits = [
            (f["publish_time_ns"] - f["capture_time_ns"]) * 1e-6
            for f in frames
            if any(a <= f["capture_time_ns"] < b for a, b in spans)
        ]
        report[name] = {
            "daemon_cores": statistics.median(sum(c.values()) for c in cores[name]),
            "page_cores": statistics.median(sum(c.get(t, 0) for t in THREADS) for c in cores[name]),
            "age_ms": [quantile([a * 1e-6 for a in ages[name]], q) for q in (0.5, 0.99)],
            "images_per_second": len(ages[name]) / (len(spans) * (args.seconds + 1.5)),
            "publish_ms": [quantile(waits, q) for q in (0.5, 0.9, 0.99)],
            "frames": len(waits),
        }
    print(json.dumps(report, indent=1))
    if args.json:
        args.json.write_text(json.dumps(report))
    return 0


if __name__ == "__main__":
    sys.exit(main())
