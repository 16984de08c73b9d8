"""A rig for the tests: the Rust example publisher as a real process, stepped frame by frame."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from depthrig import Header, PixelFormat

WAIT_S = 20.0
"""Longer than anything takes on a loaded machine: only for tests that would otherwise hang."""
ROOT = Path(__file__).resolve().parents[2]


def build_publisher() -> str:
    """The example publisher: from the environment, else built now."""
    return build_example("publish")


def build_example(name: str) -> str:
    """An example of the bus: beside the publisher that the environment names, else built now."""
    if "DEPTHRIG_TEST_PUBLISHER" in os.environ:
        return str(Path(os.environ["DEPTHRIG_TEST_PUBLISHER"]).with_name(name))
    command = ["cargo", "build", "-p", "depthrig-bus", "--example", name, "--message-format=json"]
    built = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, check=True)
    messages = map(json.loads, built.stdout.splitlines())
    paths = [m["executable"] for m in messages if m.get("target", {}).get("name") == name and m.get("executable")]
    assert paths, f"cargo built no example {name}"
    return paths[-1]


@contextmanager
def child(command: list[str], **options: Any) -> Iterator[subprocess.Popen[str]]:
    """A process that ends with the block, whatever ends the block."""
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options) as process:
        try:
            yield process
        finally:
            process.kill()


class Publisher:
    """A publisher process that publishes exactly on command."""

    def __init__(self, binary: str, folder: Path, *options: str, rig: str = "example") -> None:
        self.folder = folder
        self.process = subprocess.Popen(
            [binary, str(folder), "--rig", rig, "--step", *options],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self._line() == "ready"

    def _line(self) -> str:
        assert self.process.stdout is not None
        line = self.process.stdout.readline().strip()
        assert line, "the publisher ended"
        return line

    def publish(self, frames: int = 1) -> int:
        """Publish `frames` frames of every stream; returns the last one's sequence number."""
        assert self.process.stdin is not None
        self.process.stdin.write(f"{frames}\n")
        self.process.stdin.flush()
        return int(self._line())

    def stop(self) -> None:
        assert self.process.stdin is not None
        if self.process.poll() is None:
            self.process.stdin.close()
            self.process.wait(WAIT_S)

    def kill(self) -> None:
        """kill -9: no destructor runs."""
        self.process.kill()
        self.process.wait(WAIT_S)

    def __enter__(self) -> Publisher:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()


def pattern_rows(header: Header) -> np.ndarray:
    """The bytes that the publisher writes, row by row and without padding, computed here from its documentation."""
    pixel_format = header.pixel_format
    assert pixel_format is not None
    if pixel_format is PixelFormat.MJPEG:
        rows, row_bytes = 1, header.payload_len
    else:
        rows = header.height * 3 // 2 if pixel_format is PixelFormat.NV12 else header.height
        size = {1: 3, 2: 3, 3: 1, 4: 2, 5: 2, 6: 4, 7: 2, 8: 2, 9: 1, 11: 1, 12: 4, 13: 64}[int(pixel_format)]
        row_bytes = header.width * size
    if pixel_format is PixelFormat.DEPTH_F32:
        metres = np.add.outer(np.arange(rows), np.arange(header.width)) + header.sequence
        metres = (metres / 1024).astype(np.float32)
        metres[0, :3] = np.nan, 0, -1
        return metres.view(np.uint8)
    values = np.add.outer(np.arange(rows) * 13, np.arange(row_bytes) * 7) + header.sequence * 31
    return values.astype(np.uint8)


def assert_pixels(array: np.ndarray, header: Header) -> None:
    """Every byte of `array` is what the publisher wrote into frame `header.sequence`."""
    got = np.ascontiguousarray(array).view(np.uint8).reshape(-1)
    np.testing.assert_array_equal(got, pattern_rows(header).reshape(-1))
