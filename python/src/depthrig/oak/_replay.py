"""Plays files in place of a camera, through a pipeline of the SDK that runs on this computer alone.

A folder holds either the output of `--record`, `color.mcap` and `depth.mcap` in the SDK's own format, or images:
`color/*.png|jpg` and `depth/*.png` (16 bit, millimetres), paired in the order of their names. `calibration.json` beside
them is a calibration as the SDK writes it (`CalibrationHandler.eepromToJsonFile`).
"""

from __future__ import annotations

import datetime
import importlib
import struct
import time
from pathlib import Path
from typing import Any

import depthai as dai
import numpy as np
import numpy.typing as npt

from . import _lens
from ._errors import Exit, OakError
from ._sdk import INSTALL
from ._source import CALIBRATION, Identity, Source

_LAST_FRAMES_S = 0.5
"""How long the last frames have to be taken before the pipeline ends, and its queues with it."""
# Of an MCAP file: a record is an opcode and a length; the footer is the last one, with the place of the summary.
_RECORD = struct.Struct("<BQ")
_FOOTER = struct.Struct("<BQQQI8s")
_MAGIC = b"\x89MCAP0\r\n"
_FOOTER_OPCODE, _STATISTICS_OPCODE = 2, 11
_MOST_OF_A_SUMMARY = 64 << 20
_IMAGES = (".png", ".jpg", ".jpeg")
_STREAMS = ("color", "depth")
_CLOCK_BEGINS = 100.0
"""Start of the clock of a camera that plays images, seconds: a value that the computer's clock cannot have."""


def open_folder(
    folder: Path, *, serial: str | None, rate_hz: float, loop: bool, streams: tuple[str, ...] = _STREAMS
) -> Source:
    """Build a pipeline that plays the files of `folder`; nothing runs yet.

    Raises OakError for a folder that has no frames, or files that cannot be read, naming them.
    """
    if not folder.is_dir():
        raise OakError(f"{folder} is not a folder", Exit.USAGE)
    calibration = _calibration(folder / CALIBRATION)
    pipeline = dai.Pipeline(False)
    files = {name: folder / f"{name}.mcap" for name in streams if (folder / f"{name}.mcap").is_file()}
    if files:
        outputs = _recordings(pipeline, files, loop)
        counts = {} if loop else {name: _messages(path) for name, path in files.items()}
    else:
        outputs, counts = _images(pipeline, folder, streams, calibration, rate_hz, loop)
    data = calibration.getEepromData() if calibration is not None else None
    model = (data.productName or data.deviceName or data.boardName) if data is not None else ""
    identity = Identity(
        model=model or "OAK",
        serial=serial or folder.resolve().name,
        firmware=f"depthai {dai.__version__}",
        port=folder.resolve().name,
        calibration=f"file {CALIBRATION}" if calibration is not None else "none",
    )
    return Source(
        pipeline=pipeline,
        outputs=outputs,
        identity=identity,
        rate_hz=rate_hz,
        calibration=calibration,
        sockets=dict.fromkeys(outputs, dai.CameraBoardSocket.CAM_A),
        frames=None if loop else counts,
        notes=[f"no camera: files of {folder} are played"],
    )


def _calibration(path: Path) -> dai.CalibrationHandler | None:
    if not path.exists():
        return None
    try:
        return dai.CalibrationHandler(path)
    except (RuntimeError, ValueError) as e:
        raise OakError(f"{path} is not a calibration of an OAK camera ({e})", Exit.USAGE) from e


def _recordings(pipeline: dai.Pipeline, files: dict[str, Path], loop: bool) -> dict[str, dai.Node.Output]:
    """Add the SDK's own player for each file: frames with the numbers and times that they were recorded with."""
    outputs = {}
    for name, path in files.items():
        player = pipeline.create(dai.node.ReplayMessage)
        player.setReplayFile(path)
        player.setLoop(loop)
        outputs[name] = player.out
    return outputs


def _images(
    pipeline: dai.Pipeline,
    folder: Path,
    streams: tuple[str, ...],
    calibration: dai.CalibrationHandler | None,
    rate_hz: float,
    loop: bool,
) -> tuple[dict[str, dai.Node.Output], dict[str, int]]:
    """Add a node that turns images into frames; return its outputs and how many images each has."""
    paths = {name: _listed(folder / name) for name in streams}
    paths = {name: found for name, found in paths.items() if found}
    if not paths:
        raise OakError(
            f"{folder} has neither recordings ({' or '.join(f'{n}.mcap' for n in streams)}) nor images "
            f"({' or '.join(f'{n}/*.png' for n in streams)})",
            Exit.USAGE,
        )
    counts = {name: len(found) for name, found in paths.items()}
    if len(set(counts.values())) > 1:
        listed = ", ".join(f"{n} {name}" for name, n in counts.items())
        raise OakError(f"{folder}: its images do not form pairs, there are {listed}", Exit.USAGE)
    frames = {name: [_read(name, path) for path in found] for name, found in paths.items()}
    transformations = {name: _transformation(calibration, images[0]) for name, images in frames.items()}
    kinds = {2: dai.ImgFrame.Type.RAW16, 3: dai.ImgFrame.Type.BGR888i}

    class Images(dai.node.ThreadedHostNode):
        """Replaces the sensor: images at their time, with numbers and times of a clock of its own."""

        def __init__(self) -> None:
            super().__init__()
            self.ports = {name: self.createOutput() for name in frames}

        def run(self) -> None:
            began = start = time.monotonic()
            number = 0
            while self.isRunning() and (loop or number < next(iter(counts.values()))):
                due = number / rate_hz
                if not loop:  # the consumer may have blocked this: delays are not made up by a burst
                    start = max(start, time.monotonic() - due)
                time.sleep(max(0.0, start + due - time.monotonic()))
                for name, port in self.ports.items():
                    images = frames[name]
                    image = images[number % len(images)]
                    frame = dai.ImgFrame()
                    frame.setCvFrame(image, kinds[image.ndim])
                    frame.setSequenceNum(number)
                    frame.setTimestamp(datetime.timedelta(seconds=began + due))
                    frame.setTimestampDevice(datetime.timedelta(seconds=_CLOCK_BEGINS + due))
                    transformation = transformations[name]
                    if transformation is not None:
                        frame.setTransformation(transformation)
                    port.send(frame)
                number += 1
            time.sleep(_LAST_FRAMES_S)
            self.stopPipeline()

    return dict(pipeline.create(Images).ports), counts


def _messages(path: Path) -> int:
    """Return the number of messages of a recording: the statistics in the summary of an MCAP file (mcap.dev/spec).

    Raises OakError for a file without statistics, such as one that was not written to its end.
    """
    with path.open("rb") as file:
        size = file.seek(0, 2)
        file.seek(max(0, size - _FOOTER.size))
        end = file.read()
        if len(end) == _FOOTER.size:
            opcode, length, start, _, _, magic = _FOOTER.unpack(end)
            if (opcode, length, magic) == (_FOOTER_OPCODE, 20, _MAGIC) and 0 < start < size:
                file.seek(start)
                summary = file.read(min(size - start, _MOST_OF_A_SUMMARY))
                at = 0
                while at + 9 <= len(summary):
                    opcode, length = _RECORD.unpack_from(summary, at)
                    if opcode == _STATISTICS_OPCODE and at + 17 <= len(summary):
                        return int.from_bytes(summary[at + 9 : at + 17], "little")
                    at += 9 + length
    raise OakError(
        f"{path} has no summary, so it was not written to its end; play it without --once, or record it again",
        Exit.USAGE,
    )


def _listed(folder: Path) -> list[Path]:
    return sorted(p for p in folder.iterdir() if p.suffix.lower() in _IMAGES) if folder.is_dir() else []


def _read(stream: str, path: Path) -> npt.NDArray[Any]:
    """Read an image: blue, green, red for colour, 16 bits for depth."""
    try:
        pillow = importlib.import_module("PIL.Image")
    except ImportError as e:
        raise OakError(f"images are read with Pillow, which cannot be imported ({e}); {INSTALL}", Exit.USAGE) from e
    try:
        with pillow.open(path) as image:
            if stream == "color":
                return np.ascontiguousarray(np.asarray(image.convert("RGB"))[..., ::-1])
            depth = np.asarray(image)
    except OSError as e:
        raise OakError(f"{path} cannot be read ({e})", Exit.USAGE) from e
    if depth.ndim != 2 or depth.dtype.kind not in "iu" or depth.min() < 0 or depth.max() > 0xFFFF:
        raise OakError(
            f"{path} is not a depth image: it needs one channel of 16 bits, not {depth.shape} {depth.dtype}", Exit.USAGE
        )
    return np.ascontiguousarray(depth.astype(np.uint16))


def _transformation(
    calibration: dai.CalibrationHandler | None, image: npt.NDArray[Any]
) -> dai.ImgTransformation | None:
    """Return the SDK's description of how a frame was taken; None without a calibration."""
    height, width = image.shape[:2]
    socket = dai.CameraBoardSocket.CAM_A
    if calibration is None or _lens.of_calibration(calibration, socket, width, height, True) is None:
        return None
    return dai.ImgTransformation(width, height, calibration.getCameraIntrinsics(socket, width, height))
