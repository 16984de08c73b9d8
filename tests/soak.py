#!/usr/bin/env python3
"""Runs the daemon for a while, seven cameras and a recording, subscribers that come and go, and looks whether its memory
stays where it is. `depthrig bench soak` does the same for the recorder alone, faster than time passes; this is the whole
process in its own time.

Exit status: 0 flat and nothing lost unexplained, 1 not so, 2 it could not be run."""

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

BAR_MB_PER_MIN = 1.0
WARM_UP_S = 180  # until then the allocator takes its working size, see docs/performance.md
EVERY_S = 2
TAP_EVERY_S = 20
CLOSING_S = 120  # so long may a recording take to be closed
SETS_PER_S = 5  # of the default rig; half of them must be there, because a busy computer refuses some


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("depthrig", type=Path, help="the program, a release")
    parser.add_argument("--minutes", type=float, default=12.0)
    parser.add_argument("--config", type=Path, help="a rig file, with a stream d435/color, instead of the default one with cameras without images")
    return parser.parse_args()


def rig_file(depthrig: Path, folder: Path) -> Path:
    """The default rig. Its cameras send patterns, which cost little, and segments are short, so that many end."""
    text = subprocess.run([depthrig, "config", "show"], check=True, capture_output=True, text=True).stdout
    text = text.replace("# cheap = false", "cheap = true").replace("# segment_max_s = 60", "segment_max_s = 20")
    # Where the comment is not repeated for each camera, the key still must be.
    cameras = text.split("[[camera]]\n")
    cameras = [cameras[0]] + [c if "\ncheap = true" in c else re.sub(r"(?m)^(model = .*)$", r"\1\ncheap = true", c) for c in cameras[1:]]
    path = folder / "rig.toml"
    path.write_text("[[camera]]\n".join(cameras))
    return path


def memory_mb(pid: int) -> tuple[float, float]:
    """Its own memory, and the shared memory that it has touched, MB."""
    fields = dict(re.findall(r"^(\w+):\s+(\d+) kB$", Path(f"/proc/{pid}/status").read_text(), re.MULTILINE))
    return int(fields["RssAnon"]) / 1e3, int(fields["RssShmem"]) / 1e3


def slope_mb_per_min(samples: list[tuple[float, float]]) -> float:
    """By least squares."""
    n = len(samples)
    mean_t, mean_m = (sum(s[i] for s in samples) / n for i in (0, 1))
    over = sum((t - mean_t) * (m - mean_m) for t, m in samples)
    return 60 * over / sum((t - mean_t) ** 2 for t, _ in samples)


def main() -> int:
    args = arguments()
    seconds = args.minutes * 60
    if seconds < WARM_UP_S + 60:
        print(f"at least {(WARM_UP_S + 60) / 60:.0f} minutes: the first {WARM_UP_S} s are left out")
        return 2
    if not args.depthrig.is_file():
        print(f"{args.depthrig} is not there: cargo build --release --bin depthrig")
        return 2
    with tempfile.TemporaryDirectory(prefix="rig", dir="/tmp") as name:
        folder = Path(name)
        os.environ["DEPTHRIG_RUNTIME_DIR"] = str(folder / "run")
        (folder / "run").mkdir(mode=0o700)
        rig = args.config or rig_file(args.depthrig, folder)
        with (folder / "log").open("wb") as log:
            command = [args.depthrig, "run", rig, "--record", folder / "data", "--seconds", str(seconds)]
            daemon = subprocess.Popen(command, stdout=log, stderr=log)
        try:
            own, taps = watch(daemon, args.depthrig, seconds)
            code = ended(daemon)
        finally:
            if daemon.poll() is None:
                daemon.kill()
                daemon.wait()
        datasets = [p.parent for p in (folder / "data").rglob("session.toml")]
        if code not in (0, 3) or len(datasets) != 1:
            print((folder / "log").read_text(errors="replace")[-1500:], end="")
        if len(datasets) != 1 or sum(t >= WARM_UP_S for t, *_ in own) < 2:
            print(f"the daemon ended with {code} after {own[-1][0] if own else 0:.0f} s; it could not be measured")
            return 2
        verified = subprocess.run([args.depthrig, "verify", datasets[0], "--json"], capture_output=True, text=True)
        enough = args.config is not None or json.loads(verified.stdout)["sets"] >= SETS_PER_S * seconds / 2
        return report(own, taps, code, verified, enough)


def ended(process: subprocess.Popen) -> int:
    """Its exit status; one that does not end in a while is asked to, and then killed."""
    for last_word in (process.terminate, process.kill):
        try:
            return process.wait(CLOSING_S)
        except subprocess.TimeoutExpired:
            last_word()
    return process.wait()


def watch(daemon: subprocess.Popen, depthrig: Path, seconds: float) -> tuple[list[tuple[float, float, float]], list[int]]:
    """Seconds, its own memory and the shared memory in MB, until the time is over; how the subscribers ended that came."""
    start, samples, subscribers = time.monotonic(), [], []
    while daemon.poll() is None:
        at = time.monotonic() - start
        if at > seconds:
            break  # it is closing the recording
        try:
            samples.append((at, *memory_mb(daemon.pid)))
        except (OSError, KeyError):
            break  # it is ending
        if at > len(subscribers) * TAP_EVERY_S + 5 and at < seconds - 10:
            tap = [depthrig, "tap", "d435/color", "--count", "60"]
            subscribers.append(subprocess.Popen(tap, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL))
        time.sleep(EVERY_S)
    return samples, [ended(subscriber) for subscriber in subscribers]


def report(
    samples: list[tuple[float, float, float]],
    taps: list[int],
    code: int,
    verified: subprocess.CompletedProcess,
    enough: bool,
) -> int:
    late = [(t, own) for t, own, _ in samples if t >= WARM_UP_S]
    slope = slope_mb_per_min(late)
    minutes = sorted({int(t // 60) for t, _, _ in samples})
    for name, column in (("own", 1), ("shared", 2)):
        mean = [[s[column] for s in samples if int(s[0] // 60) == m] for m in minutes]
        print(f"mean {name} MB of each minute:", " ".join(f"{sum(v) / len(v):.1f}" for v in mean))
    found = json.loads(verified.stdout)
    print(f"{len(taps)} subscribers came and went, {sum(tap != 0 for tap in taps)} of them with an error")
    print(f"the daemon ended with {code}, verify with {verified.returncode}: {found['sets']} sets, {found['frames']} frames")
    if not enough:
        print("too few sets: the recording did not last")
    print(f"slope after {WARM_UP_S} s: {slope:+.3f} MB per minute (bar {BAR_MB_PER_MIN})")
    # 3: frames were lost and are accounted for, as on a busy computer.
    good = enough and not any(taps) and code in (0, 3) and verified.returncode in (0, 3)
    return 0 if slope < BAR_MB_PER_MIN and good else 1


if __name__ == "__main__":
    sys.exit(main())
