"""Files in place of a camera, through a pipeline of the SDK that runs on this computer alone.

A folder holds either what `--record` wrote, `color.mcap` and `depth.mcap` in the SDK's own format, or pictures:
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
_PICTURES = (".png", ".jpg", ".jpeg")
_STREAMS = ("color", "depth")
_CLOCK_BEGINS = 100.0
"""What the clock of a camera made of pictures shows at its start, seconds: none that the computer's could be."""


def open_folder(
    folder: Path, *, serial: str | None, rate_hz: float, loop: bool, streams: tuple[str, ...] = _STREAMS
) -> Source:
    """Build a pipeline that plays the files of `folder`; nothing runs yet.

    Raises OakError for a folder that has no frames, or files that cannot be read, naming them.
    """
    if not folder.is_dir():
        raise OakError(f"{folder} is no folder", Exit.USAGE)
    calibration = _calibration(folder / CALIBRATION)
    pipeline = dai.Pipeline(False)
    files = {name: folder / f"{name}.mcap" for name in streams if (folder / f"{name}.mcap").is_file()}
    if files:
        outputs = _recordings(pipeline, files, loop)
        counts = {} if loop else {name: _messages(path) for name, path in files.items()}
    else:
        outputs, counts = _pictures(pipeline, folder, streams, calibration, rate_hz, loop)
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
        raise OakError(f"{path} is no calibration of an OAK camera ({e})", Exit.USAGE) from e


def _recordings(pipeline: dai.Pipeline, files: dict[str, Path], loop: bool) -> dict[str, dai.Node.Output]:
    """Add the SDK's own player for each file: frames with the numbers and times that they were recorded with."""
    outputs = {}
    for name, path in files.items():
        player = pipeline.create(dai.node.ReplayMessage)
        player.setReplayFile(path)
        player.setLoop(loop)
        outputs[name] = player.out
    return outputs


def _pictures(
    pipeline: dai.Pipeline,
    folder: Path,
    streams: tuple[str, ...],
    calibration: dai.CalibrationHandler | None,
    rate_hz: float,
    loop: bool,
) -> tuple[dict[str, dai.Node.Output], dict[str, int]]:
    """Add a node that makes frames of pictures; returns its outputs and how many pictures each has."""
    paths = {name: _listed(folder / name) for name in streams}
    paths = {name: found for name, found in paths.items() if found}
    if not paths:
        raise OakError(
            f"{folder} has neither recordings ({' or '.join(f'{n}.mcap' for n in streams)}) nor pictures "
            f"({' or '.join(f'{n}/*.png' for n in streams)})",
            Exit.USAGE,
        )
    counts = {name: len(found) for name, found in paths.items()}
    if len(set(counts.values())) > 1:
        told = ", ".join(f"{n} {name}" for name, n in counts.items())
        raise OakError(f"{folder}: its pictures are no pairs, there are {told}", Exit.USAGE)
    frames = {name: [_read(name, path) for path in found] for name, found in paths.items()}
    transformations = {name: _transformation(calibration, pictures[0]) for name, pictures in frames.items()}
    kinds = {2: dai.ImgFrame.Type.RAW16, 3: dai.ImgFrame.Type.BGR888i}

    class Pictures(dai.node.ThreadedHostNode):
        """The sensor that is not there: pictures at their time, with numbers and times of a clock of its own."""

        def __init__(self) -> None:
            super().__init__()
            self.ports = {name: self.createOutput() for name in frames}

        def run(self) -> None:
            began = start = time.monotonic()
            number = 0
            while self.isRunning() and (loop or number < next(iter(counts.values()))):
                due = number / rate_hz
                if not loop:  # whoever takes the frames may have let this wait: what is late is not made good by a burst
                    start = max(start, time.monotonic() - due)
                time.sleep(max(0.0, start + due - time.monotonic()))
                for name, port in self.ports.items():
                    pictures = frames[name]
                    picture = pictures[number % len(pictures)]
                    frame = dai.ImgFrame()
                    frame.setCvFrame(picture, kinds[picture.ndim])
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

    return dict(pipeline.create(Pictures).ports), counts


def _messages(path: Path) -> int:
    """Return how many messages a recording says it has: the statistics in the summary of an MCAP file (mcap.dev/spec).

    Raises OakError for a file that has none, as one has that was not written to its end.
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
    return sorted(p for p in folder.iterdir() if p.suffix.lower() in _PICTURES) if folder.is_dir() else []


def _read(stream: str, path: Path) -> npt.NDArray[Any]:
    """Read a picture: blue, green, red for colour, 16 bits for depth."""
    try:
        image = importlib.import_module("PIL.Image")
    except ImportError as e:
        raise OakError(f"pictures are read with Pillow, which cannot be imported ({e}); {INSTALL}", Exit.USAGE) from e
    try:
        with image.open(path) as picture:
            if stream == "color":
                return np.ascontiguousarray(np.asarray(picture.convert("RGB"))[..., ::-1])
            depth = np.asarray(picture)
    except OSError as e:
        raise OakError(f"{path} cannot be read ({e})", Exit.USAGE) from e
    if depth.ndim != 2 or depth.dtype.kind not in "iu" or depth.min() < 0 or depth.max() > 0xFFFF:
        raise OakError(
            f"{path} is no depth: one channel of 16 bits is needed, it has {depth.shape} {depth.dtype}", Exit.USAGE
        )
    return np.ascontiguousarray(depth.astype(np.uint16))


def _transformation(
    calibration: dai.CalibrationHandler | None, picture: npt.NDArray[Any]
) -> dai.ImgTransformation | None:
    """Return what the SDK hangs onto a frame to say how it was taken; None without a calibration."""
    height, width = picture.shape[:2]
    socket = dai.CameraBoardSocket.CAM_A
    if calibration is None or _lens.of_calibration(calibration, socket, width, height, True) is None:
        return None
    return dai.ImgTransformation(width, height, calibration.getCameraIntrinsics(socket, width, height))
