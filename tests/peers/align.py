"""depthrig's registration beside librealsense's `align`: the same depth, taking turns. Needs pyrealsense2 and OpenCV.

    cargo build --release -p depthrig-calib --example align_frames
    python tests/peers/align.py --depthrig target/release/examples/align_frames

Each setup is played through a software device of librealsense, so that `align` has intrinsics and extrinsics as from a
camera. Said are the best CPU time of a frame on each side, from rounds that take turns on one core, and how many pixels
agree within one unit of depth. librealsense honours the distortion of colour for one lens model only,
MODIFIED_BROWN_CONRADY; the setups with a lens use it on that side, with the same coefficients.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
import pyrealsense2 as rs

HERE = Path(__file__).resolve().parent
# Rotation (axis times angle, radians) and translation (metres) of depth in colour, as factory calibrations have them.
D435 = ([0.0031, -0.0019, 0.0042], [0.01475, 0.00013, 0.00027])
D455 = ([-0.0012, 0.0027, -0.0008], [-0.05923, -0.00011, 0.00041])
D435_DEPTH = ((1280, 720), [641.3, 641.3, 642.7, 358.2])
D435_COLOR = ((1280, 720), [911.8, 911.2, 645.1, 364.9])
D455_DEPTH = ((1280, 720), [638.9, 638.9, 636.4, 361.7])
D455_COLOR = ((1280, 720), [643.2, 642.5, 648.8, 366.1])
LENS = [-0.0553, 0.0642, 0.0007, 0.0002, -0.0201]


def read_bag(path: Path) -> np.ndarray:
    """The first depth picture of a recording of the RealSense viewer."""
    pipe, config = rs.pipeline(), rs.config()
    config.enable_device_from_file(str(path), repeat_playback=False)
    profile = pipe.start(config)
    profile.get_device().as_playback().set_real_time(False)
    depth = np.asanyarray(pipe.wait_for_frames().get_depth_frame().get_data()).copy()
    pipe.stop()
    return depth


def pictures(data: Path) -> list[tuple[str, np.ndarray, float]]:
    """Real depth with its unit; 640x480 ones are put four to a picture of 1280x960 and cut to 1280x720."""
    small = [cv2.imread(str(data / f"lingbot_depth/{i}/raw_depth.png"), cv2.IMREAD_UNCHANGED) for i in range(4)]
    small = [p if p.shape == (480, 640) else cv2.resize(p, (640, 480), interpolation=cv2.INTER_NEAREST) for p in small]
    four = np.vstack([np.hstack(small[:2]), np.hstack(small[2:])])[120:840]
    found = [("cdm_d405", cv2.imread(str(data / "cdm_d405/depth_26.png"), cv2.IMREAD_UNCHANGED), 0.0001)]
    found.append(("lingbot, four", np.ascontiguousarray(four), 0.001))
    bag = data / "librealsense_bag/single_depth_color_640x480.bag"
    try:
        found.append(("librealsense bag", read_bag(bag), 0.001))
    except RuntimeError as e:
        print(f"{bag} cannot be read by this librealsense ({e}); left out", file=sys.stderr)
    return found


class Device:
    """A software device with one depth and one colour stream."""

    def __init__(self, depth: tuple, color: tuple, model, coeffs: list[float], pose: tuple, unit: float):
        self.unit, self.count, self.sensors = unit, 0, []
        self.device, self.sync = rs.software_device(), rs.syncer()
        kinds = (("Depth", rs.stream.depth, 2, rs.format.z16, depth, rs.distortion.brown_conrady, [0.0] * 5),
                 ("Color", rs.stream.color, 3, rs.format.rgb8, color, model, coeffs))  # fmt: skip
        for uid, (name, stream, bytes_per_pixel, fmt, (size, pinhole), lens, lens_coeffs) in enumerate(kinds):
            k = rs.intrinsics()
            (k.width, k.height), (k.fx, k.fy, k.ppx, k.ppy) = size, pinhole
            k.model, k.coeffs = lens, lens_coeffs
            v = rs.video_stream()
            v.type, v.index, v.uid, v.fps, v.bpp, v.fmt = stream, 0, uid, 30, bytes_per_pixel, fmt
            v.width, v.height, v.intrinsics = k.width, k.height, k
            sensor = self.device.add_sensor(name)
            self.sensors.append((sensor, sensor.add_video_stream(v), bytes_per_pixel))
        self.sensors[0][0].add_read_only_option(rs.option.depth_units, unit)
        extrinsics = rs.extrinsics()
        extrinsics.rotation = list(cv2.Rodrigues(np.array(pose[0]))[0].T.ravel())
        extrinsics.translation = pose[1]
        self.sensors[0][1].register_extrinsics_to(self.sensors[1][1], extrinsics)
        self.device.create_matcher(rs.matchers.dlr_c)
        for sensor, profile, _ in self.sensors:
            sensor.open(profile)
            sensor.start(self.sync)

    def pair(self, depth: np.ndarray, color: np.ndarray):
        """Both pictures as a frame set. The first ones of a device come alone."""
        for _ in range(50):
            self.count += 1
            for (sensor, profile, bytes_per_pixel), pixels in zip(self.sensors, (depth, color)):
                f = rs.software_video_frame()
                f.pixels, f.bpp, f.stride = pixels, bytes_per_pixel, pixels.shape[1] * bytes_per_pixel
                f.timestamp, f.domain = self.count * 33.0, rs.timestamp_domain.hardware_clock
                f.frame_number, f.profile = self.count, profile.as_video_stream_profile()
                f.depth_units = self.unit if bytes_per_pixel == 2 else 0.0
                sensor.on_video_frame(f)
            for _ in range(20):
                frames = self.sync.poll_for_frames()
                if frames.size() == 2:
                    return frames
                time.sleep(0.01)
        raise SystemExit("the software device gives no pair")


def quaternion(rotation: list[float]) -> list[float]:
    angle = float(np.linalg.norm(rotation))
    axis = np.array(rotation) / angle
    return [*(axis * np.sin(angle / 2)), float(np.cos(angle / 2))]


def theirs(frames, align, turns: int) -> tuple[np.ndarray, list[int]]:
    times = []
    for _ in range(turns):
        began = time.process_time_ns()
        result = align.process(frames)
        times.append(time.process_time_ns() - began)
    return np.asanyarray(result.get_depth_frame().get_data()).copy(), times


def ours(args, setup: dict, depth: np.ndarray, folder: Path) -> tuple[np.ndarray, list[int]]:
    (folder / "setup.json").write_text(json.dumps(setup))
    depth.astype("<u2").tofile(folder / "depth.z16")
    command = [args.depthrig, "setup.json", "depth.z16", "out.z16", str(args.turns), "1"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=300, check=False)
    if done.returncode:
        raise SystemExit(f"align_frames failed: {done.stderr}")
    w, h = setup["color"]["size"]
    return np.fromfile(folder / "out.z16", "<u2").reshape(h, w), json.loads(done.stdout)["cpu_ns"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--depthrig", required=True, type=lambda p: str(Path(p).resolve()), help="the built align_frames")
    parser.add_argument("--turns", type=int, default=20, help="frames of each round")
    parser.add_argument("--rounds", type=int, default=3, help="rounds, each side in turn")
    parser.add_argument("--check", action="store_true", help="exit code 1 unless faster and equal on 99.9 %% of pixels")
    args = parser.parse_args()
    data = Path(os.environ.get("DEPTHRIG_TEST_DATA", HERE.parents[2] / "shared/data"))
    if not data.is_dir():
        raise SystemExit(f"the real pictures are not at {data}; set DEPTHRIG_TEST_DATA to their folder")
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    cameras = [
        ("D435", D435_DEPTH, D435_COLOR, D435, None),
        ("D435, lens", D435_DEPTH, D435_COLOR, D435, LENS),
        ("D455", D455_DEPTH, D455_COLOR, D455, None),
        ("D455, lens", D455_DEPTH, D455_COLOR, D455, LENS),
    ]
    failed = False
    print(f"pyrealsense2 {rs.__version__}, load average {os.getloadavg()[0]:.1f}, best CPU time of a frame on one core")
    print(f"{'camera':<12}{'picture':<18}{'size':<12}{'align ms':>9}{'ours ms':>9}{'ratio':>7}{'equal':>10}{'within 1':>10}")
    for name, (size, depth_k), color, pose, lens in cameras:
        for source, depth, unit in pictures(data):
            h, w = depth.shape
            scaled = [v * w / size[0] for v in depth_k]
            if (w, h) != size:
                scaled[3] = h / 2 - 0.5 + (depth_k[3] - size[1] / 2 + 0.5) * w / size[0]
            model = rs.distortion.modified_brown_conrady if lens else rs.distortion.none
            device = Device(((w, h), scaled), color, model, lens or [0.0] * 5, pose, unit)
            frames = device.pair(depth, np.zeros((color[0][1], color[0][0], 3), np.uint8))
            align = rs.align(rs.stream.color)
            setup = {
                "depth": {"size": [w, h], "pinhole": scaled, "model": "none", "coeffs": [0.0] * 8},
                "color": {"size": color[0], "pinhole": color[1], "coeffs": [*(lens or [0.0] * 5), 0.0, 0.0, 0.0],
                          "model": "inverse_brown_conrady" if lens else "none"},
                "color_from_depth": {"translation_m": pose[1], "rotation_xyzw": quaternion(pose[0])},
                "unit_m": unit,
                "method": "splat",
            }  # fmt: skip
            times: tuple[list[int], list[int]] = ([], [])
            with tempfile.TemporaryDirectory() as folder:
                for _ in range(args.rounds):
                    a, t = theirs(frames, align, args.turns)
                    times[0].extend(t)
                    b, t = ours(args, setup, depth, Path(folder))
                    times[1].extend(t)
            difference = np.abs(a.astype(int) - b.astype(int))
            equal, close = float((difference == 0).mean()), float((difference <= 1).mean())
            best = [min(t) / 1e6 for t in times]
            failed |= best[1] >= best[0] or close < 0.999
            print(f"{name:<12}{source:<18}{f'{w}x{h}':<12}{best[0]:>9.2f}{best[1]:>9.2f}{best[1] / best[0]:>7.2f}{equal:>10.4%}{close:>10.4%}")
    sys.exit(1 if args.check and failed else 0)


if __name__ == "__main__":
    main()
