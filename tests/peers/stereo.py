"""Compares depthrig's stereo with OpenCV's semi-global matching on the same pairs. Needs OpenCV and NumPy.

    cargo build --release -p depthrig
    python tests/peers/stereo.py --depthrig target/release/depthrig --pair ALOE_L ALOE_R ALOE_GT 1 224 [--pair ...]

Each --pair is: left image, right image, true disparity of the left one (an image of 8 or 16 bits, .pfm or .npy), the
number that its values are divided by, how many disparities to search, and optionally mask:FILE, an image that is 255
where both cameras see (Middlebury's mask0nocc.png), or right:FILE, the true disparity of the right image. 0 and
non-finite values are unknown. Pairs that need more than 256 disparities are halved first. For example, of Middlebury's:

    --pair view1.png view5.png disp1.png 1 240 right:disp5.png       2005, 2006, full size (half: 2, third: 3)
    --pair im2.ppm im6.ppm disp2.pgm 8 32                             2001
    --pair im0.png im1.png disp0GT.pfm 1 144 mask:mask0nocc.png       2014, evaluation 3

It prints for each pair bad-2.0 (share of the pixels whose disparity is wrong by more than two), invalid (share without
a disparity), and their sum, over the pixels with a true disparity that the right camera sees too: those of the mask;
else those whose disparity the right truth repeats within one; else those that no nearer one of the left truth hides.
For images of 1280x720 with 128 disparities it prints the CPU time on one core, the best of alternating rounds. OpenCV's
images are padded on the left by as many pixels as disparities are searched, so that it loses no pixel; its speed is
measured without that, which makes it a tenth faster. With --rows 0.5 1 ... nothing is compared: it prints depthrig's
result when the right image lies so many pixels lower than it should. Exit code 1 when one of these targets is missed:

- quality: at most 0.25 of MODE_HH's and 0.6 of MODE_SGBM_3WAY's CPU time,
- performance: at most 1/2.5 of quality's,
- quality: bad-2.0 + invalid no worse than the best of OpenCV's.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

MODES = {
    "SGBM_3WAY": cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    "SGBM": cv2.STEREO_SGBM_MODE_SGBM,
    "HH": cv2.STEREO_SGBM_MODE_HH,
    "HH4": cv2.STEREO_SGBM_MODE_HH4,
}
PRESETS = ["performance", "quality", "ultra"]


def opencv(mode: str, disparities: int) -> cv2.StereoSGBM:
    """As its documentation recommends, with blocks of 3x3, which are its best on these pairs."""
    return cv2.StereoSGBM.create(0, disparities, 3, 8 * 9, 32 * 9, 1, 63, 5, 100, 2, MODES[mode])


def seen_by_both(truth: np.ndarray) -> np.ndarray:
    """Pixels with a true disparity that no nearer one hides from the right camera."""
    height, width = truth.shape
    seen = np.zeros(truth.shape, bool)
    columns = np.arange(width)
    for y in range(height):
        d = truth[y]
        known = np.isfinite(d)
        there = np.where(known, np.round(columns - np.where(known, d, 0)), -1).astype(int)
        known &= there >= 0
        nearest = np.full(width, -np.inf)
        np.maximum.at(nearest, there[known], d[known])
        seen[y, known] = d[known] >= nearest[there[known]] - 1
    return seen


def seen_by_right_truth(truth: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Pixels whose true disparity is that of the right image's pixel too, within one."""
    rows, columns = np.indices(truth.shape)
    known = np.isfinite(truth)
    there = np.where(known, np.round(columns - np.where(known, truth, 0)), -1).astype(int)
    other = right[rows, np.clip(there, 0, truth.shape[1] - 1)]
    return known & (there >= 0) & (np.abs(other - truth) <= 1.01)


def score(disparity: np.ndarray, truth: np.ndarray, seen: np.ndarray) -> tuple[float, float]:
    """Percent of the seen pixels that are wrong by more than 2, and that have none."""
    valid = np.isfinite(disparity)
    wrong = valid & (np.abs(np.where(valid, disparity, 0) - truth) > 2)
    return 100 * wrong[seen].mean(), 100 * (~valid)[seen].mean()


def read(path: str, how: int) -> np.ndarray:
    found = cv2.imread(path, how)
    if found is None:
        sys.exit(f"{path}: OpenCV cannot read it as an image")
    return found


def pfm(path: str) -> np.ndarray:
    """One channel of floats, rows from the bottom; a scale below 0 means little-endian."""
    kind, size, scale, data = Path(path).read_bytes().split(b"\n", 3)
    if kind.strip() != b"Pf":
        sys.exit(f"{path} is not a PFM file of one channel")
    width, height = (int(n) for n in size.split())
    return np.frombuffer(data, "<f4" if float(scale) < 0 else ">f4", width * height).reshape(height, width)[::-1]


def true_disparity(path: str, scale: float) -> np.ndarray:
    if path.endswith(".npy"):
        truth = np.load(path)
    elif path.endswith(".pfm"):
        truth = pfm(path)
    else:
        truth = read(path, cv2.IMREAD_UNCHANGED)
        truth = truth[..., 0] if truth.ndim == 3 else truth
    truth = truth.astype(np.float32)
    truth[(truth == 0) | ~np.isfinite(truth)] = np.nan
    return truth / scale


def seen_by(sixth: str | None, truth: np.ndarray, scale: float) -> np.ndarray:
    """The pixels that count, by the optional part of a --pair."""
    if sixth is None:
        return seen_by_both(truth)
    kind, _, path = sixth.partition(":")
    if kind == "mask":
        seen = np.isfinite(truth) & (read(path, cv2.IMREAD_GRAYSCALE) == 255)
    elif kind == "right":
        seen = seen_by_right_truth(truth, true_disparity(path, scale))
    else:
        sys.exit(f"{sixth}: the sixth of a --pair is mask:FILE or right:FILE")
    return seen


def ours(
    args: argparse.Namespace,
    left: Path,
    right: Path,
    preset: str,
    disparities: int,
    folder: Path,
    *more: str,
) -> np.ndarray:
    out = folder / "disparity.npy"
    command = [args.depthrig, "stereo", left, right, "--preset", preset, "--max-disparity", disparities, "--out", out, "--overwrite", *more]
    subprocess.run([str(c) for c in command], check=True, stdout=subprocess.DEVNULL)
    return np.load(out)


def pair_of(pair: list[str]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, int]:
    """Left, right, truth, which pixels count, and how many disparities to search: 256 at most."""
    left_path, right_path, truth_path, scale, disparities, *sixth = pair
    left, right = (read(p, cv2.IMREAD_GRAYSCALE) for p in (left_path, right_path))
    truth, disparities = true_disparity(truth_path, float(scale)), int(disparities)
    if not left.shape == right.shape == truth.shape:
        sys.exit(f"{left_path}: left {left.shape}, right {right.shape} and truth {truth.shape} are of several sizes")
    seen = seen_by(sixth[0] if sixth else None, truth, float(scale))
    while disparities > 256:
        size = (left.shape[1] // 2, left.shape[0] // 2)
        left, right = (cv2.resize(p, size, interpolation=cv2.INTER_AREA) for p in (left, right))
        truth, seen = (a[1 : 2 * size[1] : 2, 1 : 2 * size[0] : 2] for a in (truth / 2, seen))
        disparities = -(-disparities // 2)
    return left, right, truth, seen, disparities


def lowered(image: np.ndarray, by: float) -> np.ndarray:
    """The image moved down by so many pixels, parts of them by cubic interpolation."""
    rows, columns = np.indices(image.shape, np.float32)
    return cv2.remap(image, columns, rows - np.float32(by), cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)


def apart(args: argparse.Namespace, folder: Path) -> None:
    """Print the effect of rows that are apart."""
    files = [folder / "left.png", folder / "right.png"]
    for pair in args.pair:
        left, right, truth, seen, disparities = pair_of(pair)
        print(f"{pair[0]} ({left.shape[1]}x{left.shape[0]}, {disparities} disparities)")
        cv2.imwrite(str(files[0]), left)
        for by in args.rows:
            cv2.imwrite(str(files[1]), lowered(right, by))
            line = []
            for preset in PRESETS:
                kept = [] if args.correct_rows else ["--keep-rows"]
                found = ours(args, *files, preset, disparities, folder, *kept)
                bad, invalid = score(found, truth, seen)
                filled = 100 * np.isfinite(found).mean()
                line.append(f"{preset} bad-2.0 {bad:5.2f} invalid {invalid:5.2f} filled {filled:5.1f}")
            print(f"  {by:5.2f} px: " + ", ".join(line))


def quality(args: argparse.Namespace, folder: Path) -> bool:
    kept = True
    for pair in args.pair:
        left, right, truth, seen, disparities = pair_of(pair)
        # Both sides get the same grey images.
        files = [folder / "left.png", folder / "right.png"]
        for file, image in zip(files, (left, right), strict=True):
            cv2.imwrite(str(file), image)
        print(f"{pair[0]} ({left.shape[1]}x{left.shape[0]}, {disparities} disparities)")
        sums = {}
        for mode in MODES:
            rounded = -(-disparities // 16) * 16
            wide = [cv2.copyMakeBorder(p, 0, 0, rounded, 0, cv2.BORDER_REPLICATE) for p in (left, right)]
            found = opencv(mode, rounded).compute(*wide)[:, rounded:].astype(np.float32) / 16
            found[found < 0] = np.nan
            bad, invalid = score(found, truth, seen)
            sums[mode] = bad + invalid
            print(f"  OpenCV {mode:12} bad-2.0 {bad:5.2f} %  invalid {invalid:5.2f} %  sum {bad + invalid:5.2f}")
        for preset in PRESETS:
            bad, invalid = score(ours(args, *files, preset, disparities, folder), truth, seen)
            sums[preset] = bad + invalid
            print(f"  depthrig {preset:12} bad-2.0 {bad:5.2f} %  invalid {invalid:5.2f} %  sum {bad + invalid:5.2f}")
        best = min(sums[mode] for mode in MODES)
        ok = sums["quality"] <= best
        kept &= ok
        print(f"  {'ok    ' if ok else 'MISSED'} quality is no worse than OpenCV's best: {sums['quality']:.2f} of {best:.2f}")
    return kept


def speed(args: argparse.Namespace, folder: Path) -> bool:
    left, right = (read(p, cv2.IMREAD_GRAYSCALE) for p in args.pair[0][:2])
    size = (1280, round(left.shape[0] * 1280 / left.shape[1]))
    left, right = (cv2.resize(p, size, interpolation=cv2.INTER_AREA) for p in (left, right))
    if size[1] < 720:
        left, right = (np.vstack([p] * (720 // size[1] + 1)) for p in (left, right))
    left, right = (np.ascontiguousarray(p[:720]) for p in (left, right))
    files = [folder / "left.png", folder / "right.png"]
    for file, image in zip(files, (left, right), strict=True):
        cv2.imwrite(str(file), image)
    times: dict[str, list[float]] = {}
    for _ in range(args.rounds):
        command = [args.depthrig, "bench", "stereo", "--left", files[0], "--right", files[1], "--rounds", 3, "--json"]
        report = json.loads(subprocess.run([str(c) for c in command], check=True, capture_output=True).stdout)
        for cost in report["costs"]:
            times.setdefault(cost["preset"], []).append(cost["cpu_ms_best"])
        for mode in ("SGBM_3WAY", "HH"):
            matcher = opencv(mode, 128)
            matcher.compute(left, right)
            for _ in range(3):
                start = time.thread_time()
                matcher.compute(left, right)
                times.setdefault(mode, []).append(1000 * (time.thread_time() - start))
    best = {name: min(values) for name, values in times.items()}
    print(f"1280x720, 128 disparities, one thread, CPU ms, best of {args.rounds} rounds (vectors of {report['vectors']}):")
    print("  " + ", ".join(f"{name} {value:.1f}" for name, value in best.items()))
    kept = True
    for what, value, bar in [
        ("quality over HH", best["quality"] / best["HH"], 0.25),
        ("quality over SGBM_3WAY", best["quality"] / best["SGBM_3WAY"], 0.6),
        ("performance over quality", best["performance"] / best["quality"], 1 / 2.5),
    ]:
        kept &= value <= bar
        print(f"  {'ok    ' if value <= bar else 'MISSED'} {what}: {value:.3f}, at most {bar:g}")
    return kept


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--depthrig", default="target/release/depthrig")
    parser.add_argument(
        "--pair",
        nargs="+",
        action="append",
        metavar="FILE",
        help="LEFT RIGHT TRUTH SCALE DISPARITIES [mask:FILE | right:FILE]",
    )
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--rows", nargs="+", type=float, metavar="PX", help="measure only the effect of row offsets")
    parser.add_argument("--correct-rows", action="store_true", help="with --rows: with the offset corrected")
    parser.add_argument("--no-speed", action="store_true", help="compare only the disparities, not the CPU time")
    args = parser.parse_args()
    for pair in args.pair or []:
        if len(pair) not in (5, 6):
            parser.error("a --pair is LEFT RIGHT TRUTH SCALE DISPARITIES [mask:FILE | right:FILE]")
    if not args.pair:
        data = Path(__file__).resolve().parents[2] / "../shared/data/opencv_aloe_stereo"
        args.pair = [[str(data / "aloeL.jpg"), str(data / "aloeR.jpg"), str(data / "aloeGT.png"), "1", "224"]]
    cv2.setNumThreads(1)
    print(f"OpenCV {cv2.__version__}")
    with tempfile.TemporaryDirectory() as folder:
        if args.rows:
            apart(args, Path(folder))
            return
        fast = args.no_speed or speed(args, Path(folder))
        good = quality(args, Path(folder))
    sys.exit(0 if fast and good else 1)


if __name__ == "__main__":
    main()
