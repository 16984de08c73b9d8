"""`python -m depthrig.view`: the streams of a running rig in the rerun viewer, each where it is on the mount.

Of each stream the newest frame is sent, at most `--rate` times a second. Images are at `/RIG/CAMERA/STREAM`, with
`Transform3D` and `Pinhole` from the frame's header, so that the viewer unprojects depth into points. The timeline is
`capture`, the time of the exposure.
"""

from __future__ import annotations

import argparse
import importlib
import logging
import math
import signal
import sys
import threading
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ._frame import Frame
from ._layout import PixelFormat
from ._runtime import holder, not_running, pick_rig
from ._runtime import runtime_dir as default_runtime_dir
from ._stream import Stream, streams
from .errors import DepthrigError, StreamGone, StreamNotFound

if TYPE_CHECKING:
    from types import ModuleType

log = logging.getLogger("depthrig.view")

INSTALL = "pip install './python[view]' in a checkout of depthrig"
RATE_HZ = 10.0
"""Frames of a stream that are sent in a second, unless asked otherwise."""
_LOOK_S = 1.0
_SHORTEST_REST_S = 0.002
_RAW = {PixelFormat.YUYV: "YUY2", PixelFormat.NV12: "NV12"}
_GREY = (PixelFormat.MONO8, PixelFormat.MONO16, PixelFormat.CONFIDENCE8, PixelFormat.DISPARITY_F32)

_EXAMPLES = """\
examples:
  python -m depthrig.view                                  into a viewer, which is started if none runs
  python -m depthrig.view --connect rerun+http://127.0.0.1:9876/proxy
  python -m depthrig.view --save rig.rrd --seconds 10 d435/color d435/depth
"""


class View:
    """Frames of a rig as entities of a rerun recording.

    `recording` is a `rerun.RecordingStream`. With `jpeg`, a quality, colour is sent as JPEG: a tenth of the memory.
    """

    def __init__(self, rerun: ModuleType, recording: Any, jpeg: int | None = None) -> None:
        self._rerun = rerun
        self._recording = recording
        self._jpeg = jpeg
        self._placed: dict[str, tuple[Any, ...]] = {}

    def log(self, frame: Frame) -> bool:
        """Log a frame; return whether it is one that can be shown."""
        header = frame.header
        entity = f"/{header.rig}/{header.stream_id}"
        image = self._image(frame)
        if image is None:
            return False
        self._recording.set_time("capture", duration=np.timedelta64(header.capture_time_ns, "ns"))
        self._place(entity, frame)
        self._recording.log(entity, image)
        return True

    def _place(self, entity: str, frame: Frame) -> None:
        """Log pose and intrinsics if they are not those that were logged last."""
        header = frame.header
        size = (header.width, header.height)
        placed = (header.pose, header.intrinsics, size)
        if self._placed.get(entity) == placed:
            return
        self._placed[entity] = placed
        pose, k = header.pose, header.intrinsics
        parts = [self._rerun.Transform3D(translation=pose.translation_m, quaternion=pose.rotation_xyzw)]
        if k.is_known:
            # x right, y down, z forward. rerun knows no distortion.
            camera = self._rerun.ViewCoordinates.RDF
            parts.append(self._rerun.Pinhole(image_from_camera=k.matrix(), resolution=size, camera_xyz=camera))
        for part in parts:
            self._recording.log(entity, part, static=True)

    def _image(self, frame: Frame) -> Any:
        """Return the frame as an archetype; None for one that has no image."""
        rr, header = self._rerun, frame.header
        pixels = header.pixel_format
        if pixels is PixelFormat.Z16:
            return rr.DepthImage(np.array(frame.array), meter=1.0 / (header.depth_unit_m or 1e-3))
        if pixels is PixelFormat.DEPTH_F32:
            return rr.DepthImage(np.nan_to_num(frame.array, posinf=0.0, neginf=0.0), meter=1.0)
        if pixels is PixelFormat.MJPEG:
            return rr.EncodedImage(contents=frame.array.tobytes(), media_type="image/jpeg")
        if pixels in _RAW:
            form = getattr(rr.PixelFormat, _RAW[pixels])
            return rr.Image(bytes=frame.array.tobytes(), width=header.width, height=header.height, pixel_format=form)
        if pixels is PixelFormat.UYVY:
            swapped = np.ascontiguousarray(np.asarray(frame.array).reshape(-1, 2)[:, ::-1]).tobytes()
            form = rr.PixelFormat.YUY2
            return rr.Image(bytes=swapped, width=header.width, height=header.height, pixel_format=form)
        if pixels in (PixelFormat.RGB8, PixelFormat.BGR8):
            image = rr.Image(np.array(frame.array), color_model="RGB" if pixels is PixelFormat.RGB8 else "BGR")
            return image if self._jpeg is None else image.compress(jpeg_quality=self._jpeg)
        if pixels in _GREY:
            return rr.Image(np.array(frame.array), color_model="L")
        return None


class Follower:
    """Reads the newest frames of streams, those that come later included.

    `only` names the streams; without it all of the rig that have images.
    """

    def __init__(
        self, view: View, rig: str, runtime_dir: str, rate_hz: float = RATE_HZ, only: Iterable[str] = ()
    ) -> None:
        self._view = view
        self._rig = rig
        self._runtime_dir = runtime_dir
        self._period = 1.0 / rate_hz
        self._only = frozenset(only)
        self._open: dict[str, Stream] = {}
        self._due: dict[str, float] = {}
        self._without_image: set[str] = set()
        self.sent: dict[str, int] = {}
        """Frames of each stream that were sent."""

    def run(self, stop: threading.Event, seconds: float = math.inf) -> None:
        """Follow until `stop` is set, so many seconds have passed, or the rig ends."""
        self._look()
        look = time.monotonic() + _LOOK_S
        # Opening the streams of a large rig takes a second.
        end = time.monotonic() + seconds
        while not stop.is_set() and (now := time.monotonic()) < end:
            if now >= look:
                if holder(self._runtime_dir, self._rig) is None:
                    log.info("rig %s has ended", self._rig)
                    return
                self._look()
                look = now + _LOOK_S
            for name in list(self._open):
                if self._due[name] <= now:
                    self._take(name, now)
            next_due = min(self._due.values(), default=look)
            stop.wait(max(_SHORTEST_REST_S, min(next_due, look, end) - time.monotonic()))

    def close(self) -> None:
        """Close all streams."""
        for name in list(self._open):
            self._drop(name)

    def _look(self) -> None:
        present = set(streams(self._rig, self._runtime_dir))
        wanted = present & self._only if self._only else present
        for name in wanted - self._open.keys() - self._without_image:
            try:
                self._open[name] = Stream(name, self._rig, self._runtime_dir, timeout=0.0, prepare=False)
            except (StreamNotFound, StreamGone) as e:
                log.debug("%s", e)
                continue
            self._due[name] = time.monotonic()
            self.sent.setdefault(name, 0)

    def _take(self, name: str, now: float) -> None:
        stream = self._open[name]
        try:
            frame = stream.latest()
        except StreamGone:
            self._drop(name)
            return
        if frame is None:
            # Looked for again soon: it may be as old as this pause when it is found.
            self._due[name] = now + min(0.005, self._period)
            if not stream.is_live:
                self._drop(name)
            return
        with frame:
            if not self._view.log(frame):
                self._without_image.add(name)
                self._drop(name)
                return
        self.sent[name] += 1
        self._due[name] = max(self._due[name] + self._period, now)

    def _drop(self, name: str) -> None:
        self._open.pop(name).close()
        self._due.pop(name, None)


def load() -> Any:
    """Import `rerun` and return it; raises RuntimeError when it is not installed."""
    try:
        return importlib.import_module("rerun")
    except ImportError as e:
        raise RuntimeError(f"the `rerun` package cannot be imported ({e}); {INSTALL}") from e


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; return its exit code: 0 done, 1 failed."""
    options = _parser().parse_args(arguments)
    logging.basicConfig(level=logging.INFO, stream=sys.stderr, format="%(levelname)s %(message)s")
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    try:
        rerun = load()
        folder = default_runtime_dir(options.runtime_dir)
        rig = pick_rig(folder, options.rig)
        if holder(folder, rig) is None:
            raise not_running(folder, rig)
        recording = rerun.RecordingStream(f"depthrig {rig}")
        _connect(rerun, recording, options)
        follower = Follower(View(rerun, recording, options.jpeg), rig, folder, options.rate, options.streams)
        try:
            follower.run(stop, options.seconds)
        finally:
            follower.close()
            recording.flush()
            recording.disconnect()
    except (DepthrigError, RuntimeError, ValueError) as e:
        log.error("%s", e)
        return 1
    log.info("%s", ", ".join(f"{name} {count}" for name, count in sorted(follower.sent.items())) or "no stream")
    return 0


def _connect(rerun: ModuleType, recording: Any, options: argparse.Namespace) -> None:
    if options.save is not None:
        recording.save(str(options.save))
    elif options.connect is not None:
        recording.connect_grpc(options.connect)
    else:
        # A viewer that is there already is used.
        recording.spawn()


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m depthrig.view",
        description="Show the streams of a running rig in the rerun viewer",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("streams", nargs="*", metavar="CAMERA/STREAM", help="streams to show [default: all]")
    parser.add_argument("--rig", help="rig to use [default: the only one running]")
    parser.add_argument("--runtime-dir", metavar="DIR", help="runtime folder of the rig [default: that of this user]")
    target = parser.add_mutually_exclusive_group()
    target.add_argument("--connect", metavar="URL", help="send to the viewer at URL instead of the one on port 9876")
    target.add_argument("--save", metavar="FILE", type=Path, help="write an .rrd file and start no viewer")
    parser.add_argument("--rate", metavar="HZ", type=_rate, default=RATE_HZ, help="frames a second of each stream [10]")
    parser.add_argument("--jpeg", metavar="Q", type=_quality, help="send colour as JPEG of quality Q, 1 to 100")
    parser.add_argument("--seconds", metavar="N", type=float, default=math.inf, help="stop after N seconds")
    return parser


def _rate(text: str) -> float:
    rate = float(text)
    if not 0 < rate <= 1000:
        raise argparse.ArgumentTypeError(f"{text} is out of range 0..=1000")
    return rate


def _quality(text: str) -> int:
    quality = int(text)
    if not 1 <= quality <= 100:
        raise argparse.ArgumentTypeError(f"{text} is out of range 1..=100")
    return quality


if __name__ == "__main__":
    sys.exit(main())
