"""Compares depthrig with other recorders on the same images. `make bench-peers` runs it.

Every round runs every writer once, each in a process of its own and in another order each time. It prints medians over
the rounds, and for each other writer the medians of the ratios inside the rounds: a busy computer slows both sides.
"""

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

import frames

HERE = Path(__file__).resolve().parent
DEPTHRIG = {
    "depthrig, none": {"color": "raw", "compression": "none"},
    # As from a rig, where the live feed wants the memory of the pixels back before the disk has taken them.
    "depthrig, none, memory lent": {"color": "raw", "compression": "none", "lent": True},
    "depthrig, zstd": {"color": "raw"},
    "depthrig, PNG and zstd": {"color": "png"},
    "depthrig, PNG and rank": {"color": "png", "depth": "rank"},
    "depthrig, JPEG and zstd (default)": {},
    "depthrig, JPEG and rank": {"depth": "rank"},
}
PEERS = [
    "mcap, none",
    "mcap, lz4",
    "mcap, zstd",
    "foxglove-sdk, none",
    "foxglove-sdk, lz4",
    "foxglove-sdk, zstd",
    "foxglove-sdk, zstd level 1",
    "rosbag, none",
    "rosbag, lz4",
    "PNG files (cv2)",
    "mcap, zstd, JPEG by cv2",
]
# Bytes of messages around the pixels differ by less than this; it is no difference between formats.
SAME_BYTES = 1.002


def lossy(writer: str) -> bool:
    return "JPEG" in writer


def measure(writer: str, args: argparse.Namespace, images: Path, sets: int) -> dict:
    """One run; the files it wrote are removed."""
    with tempfile.TemporaryDirectory(dir=args.dir) as tmp:
        out = str(Path(tmp) / "out")
        if writer in DEPTHRIG:
            command = [args.depthrig, json.dumps(DEPTHRIG[writer]), str(images), str(sets), out]
        else:
            command = [sys.executable, str(HERE / "writers.py"), writer, str(images), str(sets), out]
        done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
        if done.returncode:
            raise SystemExit(f"{writer} failed:\n{done.stderr[-2000:]}")
        return json.loads(done.stdout.splitlines()[-1])


def compare(args: argparse.Namespace, images: Path, source: str) -> dict:
    """All writers on one set of images."""
    writers = list(DEPTHRIG) + PEERS
    runs: dict[str, list[dict]] = {w: [] for w in writers}
    for n in range(args.rounds):
        turn = (n * 5) % len(writers)
        for writer in writers[turn:] + writers[:turn]:
            if sys.stderr.isatty():
                print(f"\rround {n + 1} of {args.rounds}, {writer:<40}", end="\r", file=sys.stderr)
            runs[writer].append(measure(writer, args, images, args.sets))
    median = lambda writer, f: statistics.median(map(f, runs[writer]))  # noqa: E731
    rows = {
        w: {
            "mb_per_cpu_s": median(w, lambda r: r["raw_bytes"] / 1e6 / r["cpu_s"]),
            "cpu_ms_per_pair": median(w, lambda r: 1e3 * r["cpu_s"] / r["pairs"]),
            "mb_per_pair": median(w, lambda r: r["disk_bytes"] / 1e6 / r["pairs"]),
            "ratio": median(w, lambda r: r["raw_bytes"] / r["disk_bytes"]),
            "lossy": lossy(w),
        }
        for w in writers
    }
    against = {}
    for peer in PEERS:
        against[peer] = {}
        for ours in (w for w in DEPTHRIG if lossy(w) == lossy(peer)):
            rounds = list(zip(runs[peer], runs[ours]))
            cpu = statistics.median(p["cpu_s"] / o["cpu_s"] for p, o in rounds)
            size = statistics.median(p["disk_bytes"] / o["disk_bytes"] for p, o in rounds)
            against[peer][ours] = {"speed": cpu, "size": size, "ahead": cpu > 1 and size * SAME_BYTES >= 1}
    return {"images": source, "rows": rows, "against": against, "runs": runs}


def text(result: dict) -> str:
    """The tables of one set of images."""
    lines = [f"\nPictures: {result['images']}", f"{'':<34}{'MB/CPU s':>10}{'CPU ms/pair':>13}{'MB/pair':>9}{'ratio':>7}"]
    for group in (False, True):
        lines.append("Colour as JPEG quality 95 4:4:4, depth lossless" if group else "Lossless")
        for writer, r in sorted(result["rows"].items(), key=lambda x: -x[1]["mb_per_cpu_s"]):
            if r["lossy"] == group:
                numbers = f"{r['mb_per_cpu_s']:>10.0f}{r['cpu_ms_per_pair']:>13.2f}{r['mb_per_pair']:>9.3f}{r['ratio']:>7.2f}"
                lines.append(f"  {writer:<32}{numbers}")
    lines.append("For each other writer, depthrig's way that is furthest ahead on both (else nearest to it)")
    for peer, ours in result["against"].items():
        name, best = max(ours.items(), key=lambda x: (x[1]["ahead"], min(x[1]["speed"], x[1]["size"])))
        verdict = "ahead " if best["ahead"] else "BEHIND"
        lines.append(f"  {verdict} {peer:<28} {name:<34} speed x{best['speed']:.2f}, size x{best['size']:.2f}")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--depthrig", required=True, help="the built example bench_frames")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--sets", type=int, default=6, help="sets of seven pairs in each run")
    # In memory: the CPU time of writing a page to a disk depends on the disk's other load.
    memory = "/dev/shm" if Path("/dev/shm").is_dir() and shutil.disk_usage("/dev/shm").free > 2 << 30 else None
    parser.add_argument("--dir", default=memory, help="folder for temporary files [default: %(default)s]")
    parser.add_argument("--json", type=Path, help="write all measurements to this file")
    parser.add_argument("--check", action="store_true", help="exit code 1 when a writer is not beaten on both")
    args = parser.parse_args()
    data = Path(os.environ.get("DEPTHRIG_TEST_DATA", HERE.parents[2] / "shared/data"))
    if not data.is_dir():
        raise SystemExit(f"the real images are not at {data}; set DEPTHRIG_TEST_DATA to their folder")
    if shutil.disk_usage(args.dir or tempfile.gettempdir()).free < 2 << 30:
        raise SystemExit("less than 2 GiB of disk left; free some or choose another --dir")
    load = Path("/proc/loadavg").read_text().split()[0]
    model = next(l.split(": ")[1].strip() for l in Path("/proc/cpuinfo").open() if l.startswith("model name"))
    print(f"{os.cpu_count()} x {model}, load average {load} before; {args.rounds} rounds of {7 * args.sets} pairs in {args.dir}")
    results = []
    with tempfile.TemporaryDirectory(dir=args.dir) as tmp:
        for name, (pairs, source) in (("real", frames.real(data)), ("synthetic", frames.synthetic())):
            path = Path(tmp) / name
            frames.save(path, pairs, source)
            results.append(compare(args, path, source))
            print(text(results[-1]), flush=True)
    if args.json:
        args.json.write_text(json.dumps({"cpu": model, "load_before": load, "results": results}, indent=1) + "\n")
    behind = [p for r in results for p, ours in r["against"].items() if not any(o["ahead"] for o in ours.values())]
    sys.exit(1 if args.check and behind else 0)


if __name__ == "__main__":
    main()
