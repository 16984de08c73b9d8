"""The decoder of depth images against a slow model, and against images that the Rust encoder packed."""

from __future__ import annotations

import json
import random
import struct
from pathlib import Path

import numpy as np
import pytest

from depthrig.codec import decode_depth, unpack_depth

try:
    from compression import zstd
except ImportError:
    zstd = pytest.importorskip("backports.zstd")

PACKED = Path(__file__).parent / "data" / "packed_depth.json"


def pack(image: np.ndarray, pad: int = 0) -> bytes:
    """The format page in the plainest code."""
    height, width = image.shape
    palette = sorted({int(v) for v in image.flat})
    ranks = [[palette.index(int(v)) for v in row] for row in image]
    steps = [v - (palette[i - 1] if i else 0) for i, v in enumerate(palette)]

    def rank(y, x):
        return ranks[y][x] if y >= 0 and x >= 0 else 0

    folded = []
    for y in range(height):
        for x in range(width):
            west, north, northwest = rank(y, x - 1), rank(y - 1, x), rank(y - 1, x - 1)
            predicted = sorted([west, north, west + north - northwest])[1]
            left = (rank(y, x) - predicted + 32768) % 65536 - 32768
            folded.append(2 * left if left >= 0 else -2 * left - 1)
    body = bytes(v & 255 for v in steps) + bytes(v >> 8 for v in steps)
    body += bytes(v & 255 for v in folded) + bytes(v >> 8 for v in folded)
    body += bytes(range(1, pad + 1)) * height
    return struct.pack("<I", len(palette)) + zstd.compress(body)


def message(data: bytes, height: int, width: int, step: int, frame_id=b"cam", codec=b"rank/1") -> bytes:
    out = b"\0\1\0\0" + struct.pack("<iI", 5, 6)

    def text(s):
        nonlocal out
        out += b"\0" * (-len(out) % 4) + struct.pack("<I", len(s) + 1) + s + b"\0"

    text(frame_id)
    out += b"\0" * (-len(out) % 4) + struct.pack("<III", height, width, step)
    text(codec)
    return out + b"\0" * (-len(out) % 4) + struct.pack("<I", len(data)) + data


def images(n):
    rng = random.Random(7)
    for _ in range(n):
        height, width = rng.randint(1, 12), rng.randint(1, 15)
        top = rng.choice([1, 3, 800, 65536])
        yield np.array([[rng.randrange(top) for _ in range(width)] for _ in range(height)], np.uint16)


def test_what_the_model_packs_is_unpacked() -> None:
    for i, image in enumerate(images(150)):
        height, width = image.shape
        pad = i % 3
        data, step = pack(image, pad), 2 * width + pad
        got = decode_depth(message(data, height, width, step, b"c" * (i % 5)))
        assert got.dtype == np.uint16
        assert np.array_equal(got, image), i
        assert np.array_equal(unpack_depth(list(data), height, width, step), image)


def test_every_value_at_once() -> None:
    image = (np.arange(65536, dtype=np.uint32) * 40503).astype(np.uint16).reshape(512, 128)
    # The model's palette.index would take minutes here; ranks are the values themselves.
    ranks = np.zeros((513, 129), np.int64)
    ranks[1:, 1:] = image
    west, north, corner = ranks[1:, :-1], ranks[:-1, 1:], ranks[:-1, :-1]
    predicted = np.sort(np.stack([west, north, west + north - corner]), axis=0)[1]
    left = (ranks[1:, 1:] - predicted + 32768) % 65536 - 32768
    folded = np.where(left >= 0, 2 * left, -2 * left - 1).ravel()
    steps = np.array([0] + [1] * 65535)
    planes = [steps & 255, steps >> 8, folded & 255, folded >> 8]
    data = struct.pack("<I", 65536) + zstd.compress(b"".join(p.astype(np.uint8).tobytes() for p in planes))
    assert np.array_equal(unpack_depth(data, 512, 128), image)


def test_what_rust_packed_is_unpacked() -> None:
    """The file is made by `DEPTHRIG_BLESS=1 cargo test -p depthrig-recorder --test it python`."""
    cases = json.loads(PACKED.read_text())
    assert len(cases) >= 4
    for case in cases:
        image = np.frombuffer(bytes.fromhex(case["pixels"]), np.uint8).reshape(case["height"], case["step"])
        expected = np.ascontiguousarray(image[:, : 2 * case["width"]]).view("<u2")
        assert np.array_equal(decode_depth(bytes.fromhex(case["message"])), expected), case["name"]


def test_damage_is_a_value_error_and_never_another() -> None:
    rng = random.Random(3)
    image = next(iter(images(1)))
    height, width = image.shape
    good = message(pack(image), height, width, 2 * width)
    wrong = 0
    for _ in range(600):
        damaged = bytearray(good)
        damaged[rng.randrange(len(damaged))] = rng.randrange(256)
        try:
            decode_depth(bytes(damaged[: rng.choice([len(damaged), rng.randrange(len(damaged))])]))
        except ValueError:
            wrong += 1
    assert wrong > 200


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda d: (d, 4, 5, 10, b"rank/2"), 'packed with "rank/2"'),
        (lambda d: (d, 4, 5, 9, b"rank/1"), "invalid 16-bit image"),
        (lambda d: (d, 1 << 20, 1 << 20, 1 << 21, b"rank/1"), "invalid 16-bit image"),
        (lambda d: (d, 40, 50, 100, b"rank/1"), "unpacks to"),
        (lambda d: (d[:3], 4, 5, 10, b"rank/1"), "cut short"),
        (lambda d: (b"\xff" * 4 + d[4:], 4, 5, 10, b"rank/1"), "does not fit 20 pixels"),
    ],
)
def test_lies_are_refused(change, why) -> None:
    data, height, width, step, codec = change(pack(np.arange(20, dtype=np.uint16).reshape(4, 5)))
    with pytest.raises(ValueError, match=why):
        decode_depth(message(data, height, width, step, codec=codec))
