#!/usr/bin/env python3
"""Computes `reference_pixels.csv`: CRC-32 of the pixels of PNGs, decoded with nothing but Python's own library, and of
JPEGs, decoded by Pillow (libjpeg-turbo).

An independent witness for drivers/sim/tests/files_real.rs: it shares no code with the decoders that the drivers use.
16-bit pixels count as little-endian, as they travel on the bus.

    python3 reference_pixels.py FOLDER_OF_THE_TEST_DATA > reference_pixels.csv
"""

import struct
import sys
import zlib
from pathlib import Path

FILES = [
    "lingbot_depth/0/rgb.png",
    "lingbot_depth/2/rgb.png",
    "lingbot_depth/1/rgb.jpg",
    "lingbot_depth/3/rgb.jpg",
    *(f"lingbot_depth/{i}/raw_depth.png" for i in range(4)),
    "cdm_d405/color_26.png",
    "cdm_d405/depth_26.png",
]


def paeth(a: int, b: int, c: int) -> int:
    p = a + b - c
    pa, pb, pc = abs(p - a), abs(p - b), abs(p - c)
    return a if pa <= pb and pa <= pc else b if pb <= pc else c


def decode_jpeg(path: Path) -> tuple[int, int, int, bytes]:
    from PIL import Image

    with Image.open(path) as image:
        assert image.mode == "RGB"
        return *image.size, 3, image.tobytes()


def decode(data: bytes) -> tuple[int, int, int, bytes]:
    """Width, height, bytes per pixel and pixels of a PNG that is neither interlaced nor has a palette."""
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    at, packed = 8, b""
    while at < len(data):
        length, name = struct.unpack(">I4s", data[at : at + 8])
        body = data[at + 8 : at + 8 + length]
        (crc,) = struct.unpack(">I", data[at + 8 + length : at + 12 + length])
        assert crc == zlib.crc32(name + body)
        if name == b"IHDR":
            width, height, bits, color, _, _, interlaced = struct.unpack(">IIBBBBB", body)
            assert not interlaced and color in (0, 2) and bits in (8, 16)
        elif name == b"IDAT":
            packed += body
        at += 12 + length
    bpp = bits // 8 * (3 if color == 2 else 1)
    raw, stride = zlib.decompress(packed), width * bpp
    above, rows = bytes(stride), []
    for y in range(height):
        kind, row = raw[y * (stride + 1)], bytearray(raw[y * (stride + 1) + 1 : (y + 1) * (stride + 1)])
        for x in range(stride):
            a = row[x - bpp] if x >= bpp else 0
            b, c = above[x], above[x - bpp] if x >= bpp else 0
            row[x] = (row[x] + (0, a, b, (a + b) // 2, paeth(a, b, c))[kind]) & 255
        above = bytes(row)
        rows.append(above)
    pixels = b"".join(rows)
    if bits == 16:
        swapped = bytearray(pixels)
        swapped[0::2], swapped[1::2] = pixels[1::2], pixels[0::2]
        pixels = bytes(swapped)
    return width, height, bpp, pixels


def main() -> None:
    root = Path(sys.argv[1])
    print("file,width,height,bytes_per_pixel,crc32")
    for name in FILES:
        path = root / name
        width, height, bpp, pixels = decode_jpeg(path) if path.suffix == ".jpg" else decode(path.read_bytes())
        print(f"{name},{width},{height},{bpp},{zlib.crc32(pixels):08x}")


if __name__ == "__main__":
    main()
