"""Frames as PyTorch tensors: the right numbers, one copy, memory that stays; and the message without PyTorch."""

from __future__ import annotations

import gc
import importlib.util
import os
import subprocess
import sys
import tracemalloc
import types
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import depthrig
from fake_rig import FakeRig
from rig import WAIT_S

needs_torch = pytest.mark.skipif(importlib.util.find_spec("torch") is None, reason="PyTorch is not installed")
RANDOM = np.random.default_rng(3)
DEPTH = RANDOM.integers(0, 65536, (240, 320), dtype=np.uint16)
COLOR = RANDOM.integers(0, 256, (240, 320, 3), dtype=np.uint8)
LARGE = RANDOM.integers(0, 65536, (720, 1280), dtype=np.uint16)
METRES = RANDOM.random((240, 320), dtype=np.float32)


@pytest.fixture
def fake_rig(folder: Path) -> Iterator[FakeRig]:
    with FakeRig(folder) as publisher:
        yield publisher


def stream(folder: Path) -> depthrig.Stream:
    return depthrig.Stream("cam/depth", rig="mount", runtime_dir=folder, timeout=WAIT_S)


@pytest.fixture
def frame_of(fake_rig: FakeRig, folder: Path) -> Any:
    """Publishes an image and returns the frame of it."""
    channel = fake_rig.channel("cam/depth", slot=LARGE.nbytes)
    s = stream(folder)

    def frame_of(pixels: np.ndarray, **fields: Any) -> depthrig.Frame:
        channel.send(1, pixels, **fields)
        return s.next(WAIT_S)

    return frame_of


@needs_torch
@pytest.mark.parametrize("pixels", [DEPTH, COLOR, METRES], ids=["z16", "rgb8", "f32"])
def test_the_tensor_has_the_pixels_and_is_ones_own(frame_of: Any, pixels: np.ndarray) -> None:
    frame = frame_of(pixels)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        tensor = frame.torch()
    assert tuple(tensor.shape) == pixels.shape
    assert str(tensor.dtype) == f"torch.{pixels.dtype.name}"
    np.testing.assert_array_equal(tensor.numpy(), pixels)
    assert tensor.data_ptr() != frame.array.ctypes.data
    tensor.numpy()[:] = 0
    np.testing.assert_array_equal(frame.array, pixels)


@needs_torch
def test_metres(frame_of: Any) -> None:
    frame = frame_of(DEPTH, depth_unit_m=0.0001)
    tensor = frame.torch(metres=True)
    assert str(tensor.dtype) == "torch.float32"
    np.testing.assert_array_equal(tensor.numpy(), np.nan_to_num(frame.depth_m()))
    floats = METRES.copy()
    floats[0, :4] = np.nan, np.inf, -np.inf, -1
    tensor = frame_of(floats).torch(metres=True)
    floats[0, :4] = 0
    np.testing.assert_array_equal(tensor.numpy(), floats)
    with pytest.raises(TypeError, match="cam/depth carries rgb8, which is not depth"):
        frame_of(COLOR).torch(metres=True)
    with pytest.raises(depthrig.BadFrame, match="states no depth unit"):
        frame_of(DEPTH, depth_unit_m=0.0).torch(metres=True)


@needs_torch
@pytest.mark.parametrize("metres", [False, True])
def test_one_copy_and_no_other_memory(frame_of: Any, metres: bool) -> None:
    """PyTorch's operations are listed, and NumPy's memory is counted: neither makes a second image."""
    import torch
    from torch.utils._python_dispatch import TorchDispatchMode

    frame = frame_of(LARGE)
    out = torch.empty(LARGE.shape, dtype=torch.float32 if metres else torch.uint16)
    calls: list[str] = []

    class Listing(TorchDispatchMode):
        def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
            calls.append(str(func))
            return func(*args, **(kwargs or {}))

    with Listing():
        tensor = frame.torch(metres=metres)
        assert frame.torch(metres=metres, out=out) is out
    assert [c for c in calls if "detach" not in c] == ["aten.empty.memory_format"]
    np.testing.assert_array_equal(out.numpy(), tensor.numpy())
    tracemalloc.start()
    try:
        frame.torch(metres=metres)
        frame.torch(metres=metres, out=out)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    # NumPy multiplies in blocks, which are smaller than an image by far.
    assert peak < LARGE.nbytes // 4


@needs_torch
def test_what_does_not_fit_is_named(frame_of: Any) -> None:
    import torch

    frame = frame_of(DEPTH)
    for out in (torch.empty(3), torch.empty(DEPTH.shape), torch.empty(DEPTH.shape, dtype=torch.uint16, device="meta")):
        with pytest.raises(ValueError, match=r"out is .* the frame is \(240, 320\) torch.uint16 on cpu"):
            frame.torch(out=out)
    for more in ({"metres": True}, {"device": "meta"}, {"out": torch.empty(3)}):
        with pytest.raises(ValueError, match="copy=False shares"):
            frame.torch(copy=False, **more)


@needs_torch
def test_shared_memory_stays_as_long_as_its_tensor(fake_rig: FakeRig, folder: Path) -> None:
    channel = fake_rig.channel("cam/depth")
    s = stream(folder)
    kept = []
    for i in range(16):
        channel.send(1)
        frame = s.next(WAIT_S)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            kept.append(frame.torch(copy=False))
        if i == 0:
            assert kept[0].data_ptr() == frame.array.ctypes.data
        del frame
    channel.send(1)
    with pytest.raises(depthrig.HoldingTooMany):
        s.next(WAIT_S)
    for _ in range(50):
        channel.send(1)
    s.close()
    del s
    gc.collect()
    for i, tensor in enumerate(kept):
        np.testing.assert_array_equal(tensor.numpy(), channel.pixels(i + 1))
    tensor = kept[3][1:]  # a view of it keeps it as well
    kept.clear()
    gc.collect()
    other = stream(folder)
    for _ in range(50):
        channel.send(1)
        other.latest()
    np.testing.assert_array_equal(tensor.numpy(), channel.pixels(4)[1:])


@needs_torch
def test_a_stream_gives_tensors(fake_rig: FakeRig, folder: Path) -> None:
    import time

    channel = fake_rig.channel("cam/depth")
    s = stream(folder)
    assert s.header is None
    for _ in range(3):
        channel.send(time.monotonic_ns())
    np.testing.assert_array_equal(s.torch().numpy(), channel.pixels(3))
    assert s.header is not None
    assert s.header.sequence == 3
    with pytest.raises(depthrig.Timeout):
        s.torch(timeout=0.02)
    with pytest.raises(depthrig.Stale):
        s.torch(max_age=0.02)
    for _ in range(40):  # no tensor holds a slot
        channel.send(time.monotonic_ns())
        tensor = s.torch(max_age=WAIT_S, metres=True)
        assert tensor[0, 0].item() == np.float32(channel.sent * 0.001)


@needs_torch
def test_groups_give_tensors(fake_rig: FakeRig, folder: Path) -> None:
    a, b = fake_rig.channel("a/depth"), fake_rig.channel("b/depth")
    reader = depthrig.SetReader(["a/depth", "b/depth"], rig="mount", runtime_dir=folder, timeout=WAIT_S)
    a.send(5)
    b.send(6)
    tensors = reader.next(WAIT_S).torch()
    assert list(tensors) == ["a/depth", "b/depth"]
    np.testing.assert_array_equal(tensors["b/depth"].numpy(), b.pixels(1))


@needs_torch
def test_another_device_gets_one_transfer(frame_of: Any) -> None:
    """No GPU is needed: PyTorch's device without memory has the same path, but for the pinned memory."""
    frame = frame_of(DEPTH)
    for metres, dtype in ((False, "torch.uint16"), (True, "torch.float32")):
        tensor = frame.torch("meta", metres=metres)
        assert (tensor.device.type, str(tensor.dtype), tuple(tensor.shape)) == ("meta", dtype, DEPTH.shape)


class Recorded:
    """Fake of PyTorch with a GPU: records the calls, and keeps the GPU's data in NumPy arrays."""

    def __init__(self) -> None:
        self.calls: list[Any] = []
        self.module = types.SimpleNamespace(
            __version__="2.99",
            device=lambda d: types.SimpleNamespace(type=str(d).split(":")[0], index=None),
            empty=self.empty,
            uint8=np.dtype("u1"),
            uint16=np.dtype("u2"),
            int16=np.dtype("i2"),
            int32=np.dtype("i4"),
            float32=np.dtype("f4"),
        )

    def empty(self, shape: Any, dtype: Any, **more: Any) -> Any:
        self.calls.append(("empty", dtype.name, more))
        return RecordedTensor(self, np.empty(shape, dtype), "cpu")


class RecordedTensor:
    def __init__(self, log: Recorded, data: np.ndarray, where: str) -> None:
        self.log, self.data, self.where = log, data, where
        self.dtype, self.shape = data.dtype, data.shape
        self.device = types.SimpleNamespace(type=where, index=0)

    def numpy(self) -> np.ndarray:
        assert self.where == "cpu"
        return self.data

    def to(self, what: Any, **more: Any) -> RecordedTensor:
        if isinstance(what, np.dtype):
            assert self.where == "cuda", "converted on the host"
            return RecordedTensor(self.log, self.data.astype(what), self.where)
        self.log.calls.append(("to", what.type, more))
        return RecordedTensor(self.log, self.data.copy(), what.type)

    def copy_(self, other: RecordedTensor, **more: Any) -> RecordedTensor:
        self.log.calls.append(("copy_", other.where, self.where, more))
        self.data[:] = other.data
        return self

    def bitwise_and_(self, mask: int) -> RecordedTensor:
        self.data &= mask
        return self

    def mul_(self, factor: float) -> RecordedTensor:
        self.data *= np.float32(factor)
        return self


@pytest.mark.parametrize("metres", [False, True])
def test_cuda_goes_through_pinned_memory_in_one_transfer(
    frame_of: Any, monkeypatch: pytest.MonkeyPatch, metres: bool
) -> None:
    """The calls to PyTorch, with a fake GPU; a real one is not tested here."""
    torch = Recorded()
    monkeypatch.setitem(sys.modules, "torch", torch.module)
    frame = frame_of(DEPTH)
    tensor = frame.torch("cuda:0", metres=metres)
    host = "int16" if metres else "uint16"
    assert torch.calls == [("empty", host, {"pin_memory": True}), ("to", "cuda", {"non_blocking": True})]
    expected = np.nan_to_num(frame.depth_m()) if metres else DEPTH
    np.testing.assert_allclose(tensor.data, expected, rtol=1e-6)
    if not metres:
        torch.calls.clear()
        out: Any = RecordedTensor(torch, np.empty_like(DEPTH), "cuda")
        assert frame.torch("cuda:0", out=out) is out
        assert torch.calls == [
            ("empty", "uint16", {"pin_memory": True}),
            ("copy_", "cpu", "cuda", {"non_blocking": True}),
        ]
        np.testing.assert_array_equal(out.data, DEPTH)


def test_a_torch_without_16_bits_is_named(frame_of: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    torch = Recorded()
    del torch.module.uint16
    monkeypatch.setitem(sys.modules, "torch", torch.module)
    with pytest.raises(TypeError, match=r"PyTorch 2\.99 has no uint16: install 2\.3 or later"):
        frame_of(DEPTH).torch()


def test_torch_is_loaded_when_it_is_asked_for_and_missed_with_what_to_do(
    frame_of: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    code = "import sys, depthrig; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], env=os.environ, check=False).returncode == 0
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(ImportError, match=r"tensors need PyTorch, .*pip install torch"):
        frame_of(DEPTH).torch()
