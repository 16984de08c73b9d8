"""Batches of an IMU: `Frame.motion` on them, on memory of our own and in shared memory."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import depthrig
from depthrig import MOTION_DTYPE, Frame, MotionFlags, PixelFormat, Stream
from rig import WAIT_S, Publisher
from test_arrays import frame, header

# The fields as bus/src/motion.rs lists them, packed without the generated table.
_SAMPLE = struct.Struct("<qQQIi3f3ffI")


def batch(n: int, **more: object) -> Frame:
    samples = b"".join(
        _SAMPLE.pack(1000 + i, 20 + i, 2**63 + i, 40, -50, 0.5, -0.25, i, 0.0, -9.75, 1.0, 36.5, 5) for i in range(n)
    )
    return frame(header(PixelFormat.MOTION, n, 1, 64 * n, 64 * n, **more), np.frombuffer(samples, np.uint8))


def test_a_batch_is_a_structured_array_without_a_copy() -> None:
    f = batch(3)
    motion = f.motion
    assert motion.dtype == MOTION_DTYPE and motion.shape == (3,) and MOTION_DTYPE.itemsize == _SAMPLE.size
    assert motion["time_ns"].tolist() == [1000, 1001, 1002]
    assert motion["device_time"].tolist() == [20, 21, 22]
    assert motion["sequence"].tolist() == [2**63, 2**63 + 1, 2**63 + 2]
    assert (motion["uncertainty_ns"][0], motion["accel_offset_ns"][0]) == (40, -50)
    assert motion["gyro_rad_s"].tolist() == [[0.5, -0.25, i] for i in range(3)]
    assert motion["accel_m_s2"][2].tolist() == [0.0, -9.75, 1.0]
    assert motion["temperature_c"][1] == 36.5
    assert MotionFlags(int(motion["flags"][0])) == MotionFlags.FRAME_SYNC | MotionFlags.GYRO_CLIPPED
    assert np.shares_memory(motion["gyro_rad_s"], f.array)
    with pytest.raises(ValueError, match="read-only"):
        motion["time_ns"][0] = 0
    f.release()
    assert motion["time_ns"][2] == 1002, "the array keeps the slot"
    with pytest.raises(ValueError, match="was released"):
        _ = f.motion


def test_an_image_has_no_motion_and_a_batch_no_pixels() -> None:
    image = frame(header(PixelFormat.Z16, 2, 2, 4, 8), np.zeros(8, np.uint8))
    assert not image.is_motion and batch(1).is_motion
    with pytest.raises(TypeError, match="cam/test carries z16 images, not IMU samples"):
        _ = image.motion
    with pytest.raises(TypeError, match="not depth"):
        batch(1).depth_m()
    with pytest.raises(TypeError, match="carries IMU samples"):
        batch(1).torch()


@pytest.mark.parametrize(("width", "height", "stride", "length"), [(2, 2, 128, 256), (2, 1, 64, 128), (2, 1, 128, 127)])
def test_a_header_that_does_not_fit_its_samples_is_refused(width: int, height: int, stride: int, length: int) -> None:
    with pytest.raises(depthrig.BadFrame, match="IMU samples"):
        frame(header(PixelFormat.MOTION, width, height, stride, length), np.zeros(256, np.uint8))


def test_batches_come_out_of_shared_memory_and_sets_know_nothing_of_them(
    start: Callable[..., Publisher], folder: Path
) -> None:
    publisher = start("--formats", "z16,motion")
    unit = Stream("pattern/motion", runtime_dir=folder, timeout=WAIT_S)
    sets = depthrig.Sets(runtime_dir=folder, timeout=WAIT_S)
    publisher.publish(2)
    for sequence in (1, 2):
        f = unit.next(timeout=WAIT_S)
        assert (f.sequence, f.motion.shape, f.header.width, f.header.height) == (sequence, (64,), 64, 1)
        row = (np.arange(64 * 64) * 7 + 31 * sequence).astype(np.uint8)
        assert f.motion["flags"].tolist() == row.reshape(64, 64)[:, 60:].copy().view("<u4").ravel().tolist()
        assert set(sets.next(timeout=WAIT_S).members) == {"pattern/z16", "pattern/missing"}
    assert unit.missed == 0


def test_a_imu_is_in_no_group(start: Callable[..., Publisher], folder: Path) -> None:
    publisher = start("--formats", "z16,motion")
    reader = depthrig.SetReader(["pattern/z16", "pattern/motion"], runtime_dir=folder, timeout=WAIT_S)
    publisher.publish(1)
    with pytest.raises(TypeError, match="pattern/motion carries IMU samples"):
        reader.next(timeout=WAIT_S)
    reader.close()
