"""Print the header of each frame of a stream, and save the last one as a PNG.

python view.py d435/depth [--count 10] [--png last.png]
"""

from __future__ import annotations

import argparse
import struct
import zlib
from pathlib import Path

import numpy as np

import depthrig


def main() -> None:
    """Five lines of depthrig, and a PNG."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("stream", help="CAMERA/STREAM, such as d435/depth")
    parser.add_argument("--count", type=int, default=10, help="frames to look at")
    parser.add_argument("--png", type=Path, help="where to save the last one")
    options = parser.parse_args()

    with depthrig.Stream(options.stream) as stream:
        for _ in range(options.count):
            frame = stream.next()
            print(frame.header, f"{frame.age_s * 1e3:.1f} ms old, {stream.missed} missed")

    if options.png:
        options.png.write_bytes(png(frame))
        print(f"saved {options.png}")


def png(frame: depthrig.Frame) -> bytes:
    """Return the image as PNG: 8-bit grey or colour, 16-bit grey for depth and infrared."""
    array = frame.array
    if frame.header.format_name == "bgr8":
        array = array[..., ::-1]
    elif frame.header.format_name not in ("rgb8", "mono8", "mono16", "z16", "confidence8"):
        raise SystemExit(f"{frame.header.stream_id} is {frame.header.format_name}, which this example cannot save")
    bits = array.dtype.itemsize * 8
    color = 2 if array.ndim == 3 else 0
    rows = np.ascontiguousarray(array.astype(array.dtype.newbyteorder(">"))).view(np.uint8).reshape(len(array), -1)
    lines = np.hstack([np.zeros((len(rows), 1), np.uint8), rows])  # each row begins with its filter: none

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", array.shape[1], array.shape[0], bits, color, 0, 0, 0)
    body = chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(lines.tobytes(), 6)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + body


if __name__ == "__main__":
    main()
