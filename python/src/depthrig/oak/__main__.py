"""`python -m depthrig.oak`: an OAK camera, or files in its place, as a camera of a rig."""

from __future__ import annotations

import argparse
import contextlib
import gc
import logging
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from .. import __version__
from .._external import ExternalCamera
from .._layout import ExternalReason
from ..errors import DepthrigError
from . import _sdk
from ._errors import Exit, OakError

if TYPE_CHECKING:
    from ._bridge import Bridge
    from ._source import Source

log = logging.getLogger("depthrig.oak")

_EXAMPLES = """\
in a rig file:
  [[camera]]
  name = "oak"
  backend = "external"
  command = ["python3", "-m", "depthrig.oak", "--serial", "18443010B1D25A0F00"]

exit codes: 0 stopped, or end of the files and all delivered; 2 invalid arguments or installation; 3 no such camera;
4 camera gone; 5 end of the files, and the daemon does not have all of their frames.
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the bridge; return its exit code."""
    options = _parser().parse_args(arguments)
    logging.basicConfig(level=logging.INFO, stream=sys.stderr, format="%(levelname)s %(message)s")
    try:
        return int(_run(options))
    except OakError as e:
        log.error("%s", e)
        return int(e.code)
    except (DepthrigError, ValueError) as e:
        log.error("%s", e)
        return int(Exit.USAGE if isinstance(e, ValueError) else Exit.FAILED)
    except RuntimeError as e:  # the SDK raises this when it loses the camera
        log.error("the SDK failed: %s", e)
        return int(Exit.LOST)
    finally:
        # Objects of the SDK that only the interpreter's end would free make it crash there.
        gc.collect()


def _run(options: argparse.Namespace) -> Exit:
    _sdk.load()
    # These import the SDK, which is now known to be there.
    from . import _device
    from ._bridge import Bridge

    if options.list:
        lines = _device.listing()
        print("\n".join(lines) if lines else "no OAK camera is attached")
        return Exit.DONE
    with contextlib.ExitStack() as stack:
        source = _source(options, stack)
        for note in source.notes:
            log.info("%s", note)
        if options.record is not None:
            _record(source, options.record)
        bridge = Bridge(source, undistorted=not options.keep_distortion)
        stack.enter_context(source.pipeline)
        bridge.start()
        identity = source.identity
        log.info("%s %s: %s", identity.model, identity.serial, ", ".join(map(str, bridge.modes)))
        camera = ExternalCamera(
            options.camera,
            bridge.modes,
            model=identity.model,
            serial=identity.serial,
            firmware=identity.firmware,
            port=identity.port,
            calibration=identity.calibration,
            program=f"depthrig.oak {__version__}",
            rig=options.rig,
            runtime_dir=options.runtime_dir,
        )
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: camera.stop())
        with camera:
            bridge.serve(camera)
            log.info("sent: %s", ", ".join(f"{n} {stream}" for stream, n in bridge.sent.items()))
            if camera.stopped:
                return Exit.DONE
            if options.replay is not None:
                camera.close(ExternalReason.FINISHED, "the files are at their end")
                return _account(bridge)
            camera.close(ExternalReason.DISCONNECTED, "the camera is gone: unplugged, or its firmware stopped")
    raise OakError("the camera is gone: unplugged, or its firmware stopped", Exit.LOST)


def _account(bridge: Bridge) -> Exit:
    """Return whether the daemon has every frame that was played."""
    if bridge.missing:
        what = ", ".join(f"{n} {stream}" for stream, n in bridge.missing.items())
        log.error("frames of the files that the daemon did not get: %s", what)
        return Exit.UNDELIVERED
    if not bridge.confirmed:
        log.error("every frame was sent, but the daemon did not confirm the last ones")
        return Exit.UNDELIVERED
    return Exit.DONE


def _source(options: argparse.Namespace, stack: contextlib.ExitStack) -> Source:
    from . import _device, _replay

    streams = tuple(options.streams)
    if options.replay is not None:
        return _replay.open_folder(
            options.replay,
            serial=options.serial,
            rate_hz=options.fps,
            loop=not options.once,
            streams=streams,
        )
    wishes = _device.Wishes(
        serial=options.serial,
        size=options.size,
        rate_hz=options.fps,
        color=options.color,
        streams=streams,
        preset=options.preset.upper().replace("-", "_"),
        dots=options.dots,
        flood=options.flood,
        undistorted=not options.keep_distortion,
        usb2=options.usb2,
        timeout_s=options.wait,
    )
    source, device = _device.open_camera(wishes)
    stack.callback(device.close)
    return source


def _record(source: Source, folder: Path) -> None:
    """Let the SDK write every frame into `folder`, for `--replay`."""
    if folder.exists() and any(folder.iterdir()):
        raise OakError(f"{folder} is not empty; a recording is written into a folder of its own", Exit.USAGE)
    import depthai as dai

    from ._source import CALIBRATION

    folder.mkdir(parents=True, exist_ok=True)
    for name, output in source.outputs.items():
        writer = source.pipeline.create(dai.node.RecordMessage)
        writer.setRecordFile(folder / f"{name}.mcap")
        output.link(writer.input)
    if source.calibration is not None and not source.calibration.eepromToJsonFile(folder / CALIBRATION):
        raise OakError(f"{folder / CALIBRATION} cannot be written")


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    try:
        return int(width), int(height)
    except ValueError:
        raise argparse.ArgumentTypeError(f"invalid size {text!r}; write it as 1280x720") from None


def _share(text: str) -> float:
    value = float(text)
    if not 0 <= value <= 1:
        raise argparse.ArgumentTypeError(f"{text} is out of range 0 to 1")
    return value


def _rate(text: str) -> float:
    value = float(text)
    if not 0 < value <= 240:
        raise argparse.ArgumentTypeError(f"rate {text} is out of range 0 to 240 Hz")
    return value


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="depthrig-oak",
        description=__doc__,
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--camera", help="camera name in the rig file [default: set by the daemon]")
    parser.add_argument("--rig", help="rig name [default: set by the daemon, else the only one running]")
    parser.add_argument("--runtime-dir", help="runtime folder [default: this user's]")
    parser.add_argument("--serial", help="serial number of the camera; required with several attached")
    parser.add_argument("--replay", type=Path, metavar="FOLDER", help="play the files of FOLDER in place of a camera")
    parser.add_argument("--once", action="store_true", help="play them once, from the first session, and exit")
    parser.add_argument("--record", type=Path, metavar="FOLDER", help="also write every frame into FOLDER for --replay")
    parser.add_argument("--wait", type=float, default=5.0, metavar="SECONDS", help="how long to look for the camera")
    parser.add_argument("--list", action="store_true", help="list the attached cameras and exit")
    parser.add_argument("--streams", nargs="+", choices=("color", "depth"), default=["color", "depth"])
    parser.add_argument("--size", type=_size, default=(1280, 720), metavar="WxH", help="of colour, and so of depth")
    parser.add_argument("--fps", type=_rate, default=30.0, help="frames per second")
    parser.add_argument("--color", choices=("bgr8", "rgb8", "nv12"), default="bgr8", help="pixel format of colour")
    parser.add_argument("--preset", default="default", help="of the camera's stereo, such as fast-density, robotics")
    parser.add_argument("--dots", type=_share, metavar="0..1", help="intensity of the infrared dot projector")
    parser.add_argument("--flood", type=_share, metavar="0..1", help="intensity of the infrared flood light")
    parser.add_argument(
        "--keep-distortion", action="store_true", help="keep colour distorted; depth is not aligned to it"
    )
    parser.add_argument("--usb2", action="store_true", help="keep to USB2")
    return parser


if __name__ == "__main__":
    sys.exit(main())
