"""depthrig's registration beside librealsense's `align`: the same depth, taking turns. Needs pyrealsense2 and OpenCV.

    cargo build --release -p depthrig-calib --example align_frames
    python tests/peers/align.py --depthrig target/release/examples/align_frames

Each pair of modes is played through a software device of librealsense, so that `align` has intrinsics and extrinsics as
from a camera. It prints the best CPU time of a frame on each side, from rounds that alternate on one core, how many
pixels have depth on each side, and how many of the pixels that `align` covers are covered by ours. The values differ by
design: `align` keeps depth along depth's axis as the pixel beside the ray measured it. With cameras that are not turned
against each other (the last rows) both axes are one, and depth must agree within what it changes from pixel to pixel.
librealsense honours the distortion of colour for one lens model only, MODIFIED_BROWN_CONRADY; where a lens is named it is
used on that side with the same coefficients. A Kinect's lenses are honoured on our side alone, where they cost time.
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
D405 = ([0.0004, 0.0003, -0.0002], [0.00002, 0.00001, -0.00003])
D415 = ([0.0021, -0.0013, 0.0017], [0.01511, 0.00008, 0.00021])
D435 = ([0.0031, -0.0019, 0.0042], [0.01475, 0.00013, 0.00027])
D455 = ([-0.0012, 0.0027, -0.0008], [-0.05923, -0.00011, 0.00041])
L515 = ([0.0109, 0.0071, -0.0032], [0.00021, 0.0141, -0.0047])
KINECT = ([-0.1034, 0.0032, 0.0018], [-0.0320, -0.0020, 0.0039])
LENS = [-0.0553, 0.0642, 0.0007, 0.0002, -0.0201]
KINECT_LENSES = ([0.44, -0.06, 0.0001, -0.0001, 0.004, 0.78, 0.03, 0.02],
                 [0.55, -2.6, 0.0006, -0.0002, 1.53, 0.43, -2.4, 1.46])  # fmt: skip


def mode(width: int, height: int, focal: float) -> tuple:
    """Size and fx, fy, cx, cy of a mode whose principal point is a little off the middle."""
    return (width, height), [focal, focal * 0.9995, width / 2 + 1.7, height / 2 - 1.3]


# Depth's and colour's mode, pose, colour's lens on both sides, and lenses of depth and colour on ours.
PAIRS = [
    ("D405", mode(1280, 720, 648.0), mode(1280, 720, 646.5), D405, None, None),
    ("D405", mode(848, 480, 429.3), mode(1280, 720, 646.5), D405, LENS, None),
    ("D415", mode(1280, 720, 905.4), mode(1280, 720, 920.3), D415, None, None),
    ("D415", mode(848, 480, 599.8), mode(1920, 1080, 1380.5), D415, None, None),
    ("D435", mode(1280, 720, 641.3), mode(1280, 720, 911.8), D435, None, None),
    ("D435, lens", mode(1280, 720, 641.3), mode(1280, 720, 911.8), D435, LENS, None),
    ("D435", mode(848, 480, 424.9), mode(1280, 720, 911.8), D435, None, None),
    ("D435", mode(640, 480, 390.0), mode(640, 480, 613.0), D435, None, None),
    ("D435", mode(640, 480, 390.0), mode(1920, 1080, 1367.7), D435, None, None),
    ("D435", mode(424, 240, 212.5), mode(1280, 720, 911.8), D435, None, None),
    ("D435", mode(1280, 720, 641.3), mode(640, 480, 607.9), D435, None, None),
    ("D455", mode(1280, 720, 638.9), mode(1280, 720, 643.2), D455, None, None),
    ("D455, lens", mode(1280, 720, 638.9), mode(1280, 720, 643.2), D455, LENS, None),
    ("D455, lens", mode(848, 480, 423.3), mode(1280, 800, 643.2), D455, LENS, None),
    ("D455", mode(640, 480, 386.1), mode(1280, 720, 643.2), D455, None, None),
    ("L515", mode(1024, 768, 731.9), mode(1920, 1080, 1358.3), L515, None, None),
    ("L515", mode(640, 480, 457.4), mode(1280, 720, 905.5), L515, None, None),
    ("L515", mode(1024, 768, 731.9), mode(960, 540, 679.1), L515, None, None),
    ("Kinect", mode(640, 576, 504.1), mode(1280, 720, 608.2), KINECT, None, KINECT_LENSES),
    ("Kinect", mode(640, 576, 504.1), mode(1920, 1080, 912.4), KINECT, None, KINECT_LENSES),
    ("Kinect", mode(640, 576, 504.1), mode(3840, 2160, 1824.7), KINECT, None, KINECT_LENSES),
    ("Kinect", mode(320, 288, 252.0), mode(1280, 720, 608.2), KINECT, None, KINECT_LENSES),
    ("Kinect", mode(320, 288, 252.0), mode(1920, 1080, 912.4), KINECT, None, KINECT_LENSES),
    ("Kinect", mode(512, 512, 252.2), mode(1920, 1080, 912.4), KINECT, None, KINECT_LENSES),
    ("Kinect", mode(1024, 1024, 504.4), mode(1920, 1080, 912.4), KINECT, None, KINECT_LENSES),
    ("not turned", mode(1280, 720, 641.3), mode(1280, 720, 911.8), ([0.0] * 3, [0.01475, 0.0, 0.0]), None, None),
    ("not turned", mode(848, 480, 424.9), mode(1280, 720, 643.2), ([0.0] * 3, [-0.0592, 0.0, 0.0]), None, None),
]


def read_bag(path: Path) -> np.ndarray:
    """The first depth image of a recording of the RealSense viewer."""
    pipe, config = rs.pipeline(), rs.config()
    config.enable_device_from_file(str(path), repeat_playback=False)
    profile = pipe.start(config)
    profile.get_device().as_playback().set_real_time(False)
    depth = np.asanyarray(pipe.wait_for_frames().get_depth_frame().get_data()).copy()
    pipe.stop()
    return depth


def images(data: Path) -> list[tuple[str, np.ndarray, float]]:
    """Real depth with its unit."""
    found = [("cdm_d405", cv2.imread(str(data / "cdm_d405/depth_26.png"), cv2.IMREAD_UNCHANGED), 0.0001)]
    found.append(("lingbot", cv2.imread(str(data / "lingbot_depth/0/raw_depth.png"), cv2.IMREAD_UNCHANGED), 0.001))
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
        """Both images as a frame set. The first ones of a device come alone."""
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
    if angle == 0.0:
        return [0.0, 0.0, 0.0, 1.0]
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


def agree(theirs: np.ndarray, ours: np.ndarray) -> float:
    """How many pixels of `ours` are within the range of `theirs` in the 5x5 pixels around, and half a percent: ours takes
    the mean of five pixels of a surface, theirs each with its noise."""
    kernel = np.ones((5, 5), np.uint8)
    far = cv2.dilate(theirs, kernel).astype(int)
    near = cv2.erode(np.where(theirs == 0, 65535, theirs).astype(np.uint16), kernel).astype(int)
    both = (theirs > 0) & (ours > 0)
    within = (ours >= near * 0.995 - 1) & (ours <= far * 1.005 + 1)
    return float(within[both].mean())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--depthrig", required=True, type=lambda p: str(Path(p).resolve()), help="the built align_frames")
    parser.add_argument("--turns", type=int, default=20, help="frames of each round")
    parser.add_argument("--rounds", type=int, default=3, help="rounds, each side in turn")
    parser.add_argument("--image", type=int, help="number of the one image to use [default: all]")
    parser.add_argument("--check", action="store_true", help="exit code 1 unless no slower, covering 99 %% and agreeing")
    args = parser.parse_args()
    data = Path(os.environ.get("DEPTHRIG_TEST_DATA", HERE.parents[2] / "shared/data"))
    if not data.is_dir():
        raise SystemExit(f"the real images are not at {data}; set DEPTHRIG_TEST_DATA to their folder")
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    failed = False
    found = images(data)
    found = found if args.image is None else found[args.image : args.image + 1]
    print(f"pyrealsense2 {rs.__version__}, load average {os.getloadavg()[0]:.1f}, best CPU time of a frame on one core")
    print(f"{'camera':<12}{'depth to colour':<23}{'image':<18}{'align ms':>9}{'ours ms':>9}{'ratio':>7}{'align has':>11}{'ours has':>10}{'of theirs':>11}{'agree':>10}")
    for name, (size, depth_k), color, pose, lens, lenses in PAIRS:
        for source, image, unit in found:
            depth = np.ascontiguousarray(cv2.resize(image, size, interpolation=cv2.INTER_NEAREST))
            model = rs.distortion.modified_brown_conrady if lens else rs.distortion.none
            device = Device((size, depth_k), color, model, lens or [0.0] * 5, pose, unit)
            frames = device.pair(depth, np.zeros((color[0][1], color[0][0], 3), np.uint8))
            align = rs.align(rs.stream.color)
            of_depth = {"model": "rational", "coeffs": lenses[0]} if lenses else {"model": "none", "coeffs": [0.0] * 8}
            of_color = {"model": "inverse_brown_conrady" if lens else "none", "coeffs": [*(lens or [0.0] * 5), 0.0, 0.0, 0.0]}
            if lenses:
                of_color = {"model": "rational", "coeffs": lenses[1]}
            setup = {
                "depth": {"size": size, "pinhole": depth_k, **of_depth},
                "color": {"size": color[0], "pinhole": color[1], **of_color},
                "color_from_depth": {"translation_m": pose[1], "rotation_xyzw": quaternion(pose[0])},
                "unit_m": unit,
            }
            times: tuple[list[int], list[int]] = ([], [])
            with tempfile.TemporaryDirectory() as folder:
                for _ in range(args.rounds):
                    a, t = theirs(frames, align, args.turns)
                    times[0].extend(t)
                    b, t = ours(args, setup, depth, Path(folder))
                    times[1].extend(t)
            best = [min(t) / 1e6 for t in times]
            covered = float((b[a > 0] > 0).mean())
            is_turned = any(pose[0])
            same = 1.0 if is_turned else agree(a, b)
            failed |= best[1] > best[0] or (covered < 0.99 and not lenses) or same < 0.998
            modes = f"{size[0]}x{size[1]} {color[0][0]}x{color[0][1]}"
            print(f"{name:<12}{modes:<23}{source:<18}{best[0]:>9.2f}{best[1]:>9.2f}{best[1] / best[0]:>7.2f}{(a > 0).mean():>11.3%}{(b > 0).mean():>10.3%}"
                  f"{covered:>11.3%}{'' if is_turned else f'{same:.4%}':>10}", flush=True)  # fmt: skip
    sys.exit(1 if args.check and failed else 0)


if __name__ == "__main__":
    main()
