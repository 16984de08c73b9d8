"""Frames as PyTorch tensors. PyTorch is imported when it is first asked for, and only then."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ._layout import PixelFormat
from .errors import BadFrame

if TYPE_CHECKING:
    import torch

    from ._frame import Frame


def _import_torch() -> Any:
    try:
        return importlib.import_module("torch")
    except ImportError as e:
        raise ImportError(
            f"tensors need PyTorch, which cannot be imported ({e}): pip install torch. Frame.array needs only NumPy"
        ) from e


def tensor(
    frame: Frame,
    device: str | torch.device,
    metres: bool,
    out: torch.Tensor | None,
    copy: bool,
) -> torch.Tensor:
    """Do the work of :meth:`depthrig.Frame.torch`."""
    pt = _import_torch()
    target = pt.device(device)
    pixels = frame.array
    unit = _unit(frame) if metres else None
    if not copy:
        return _shared(pt, frame, target, metres, out)
    shape = pixels.shape
    if target.type == "cpu":
        dtype = pt.float32 if metres else _dtype(pt, pixels.dtype)
        result = pt.empty(shape, dtype=dtype) if out is None else _fitting(pt, out, shape, dtype, target)
        if unit is None or pixels.dtype == np.float32:
            np.copyto(result.numpy(), pixels)
            return result if unit is None else _without_holes(result)
        # As `depth_m` does it: multiplied in double precision, rounded once.
        np.multiply(pixels, np.float64(unit), out=result.numpy(), casting="same_kind")
        return result
    # 16 bits travel as int16 when they are to be converted there: not every device computes with uint16.
    if metres and pixels.dtype == np.uint16:
        pixels = pixels.view(np.int16)
    host = pt.empty(shape, dtype=_dtype(pt, pixels.dtype), pin_memory=target.type == "cuda")
    np.copyto(host.numpy(), pixels)
    # PyTorch does not reuse the pinned memory before the transfer has ended.
    if unit is None:
        if out is None:
            return host.to(target, non_blocking=True)
        return _fitting(pt, out, shape, host.dtype, target).copy_(host, non_blocking=True)
    there = host.to(target, non_blocking=True)
    if there.dtype == pt.int16:
        there = there.to(pt.int32).bitwise_and_(0xFFFF).to(pt.float32).mul_(unit)
    else:
        there = _without_holes(there)
    return there if out is None else _fitting(pt, out, shape, pt.float32, target).copy_(there)


def _unit(frame: Frame) -> float:
    """Return metres per unit of the frame's depth; 1.0 for one that is in metres already."""
    header = frame.header
    if header.pixel_format is PixelFormat.DEPTH_F32:
        return 1.0
    if header.pixel_format is not PixelFormat.Z16:
        raise TypeError(f"{header.stream_id} carries {header.format_name}, which is not depth")
    if not header.depth_unit_m > 0:
        raise BadFrame(f"{header.stream_id}: its header states no depth unit")
    return header.depth_unit_m


def _without_holes(metres: Any) -> Any:
    """Set invalid depth to 0, in place: NaN, infinite and negative."""
    return metres.nan_to_num_(nan=0.0, posinf=0.0, neginf=0.0).clamp_(min=0.0)


def _dtype(pt: Any, dtype: npt.DTypeLike) -> Any:
    name = np.dtype(dtype).name
    found = getattr(pt, name, None)
    if found is None:
        raise TypeError(
            f"PyTorch {pt.__version__} has no {name}: install 2.3 or later, or use depth_m() and torch.from_numpy"
        )
    return found


def _fitting(pt: Any, out: Any, shape: tuple[int, ...], dtype: Any, device: Any) -> Any:
    same_device = out.device.type == device.type and device.index in (None, out.device.index)
    if tuple(out.shape) != shape or out.dtype != dtype or not same_device:
        raise ValueError(
            f"out is {tuple(out.shape)} {out.dtype} on {out.device}, the frame is {shape} {dtype} on {device}"
        )
    return out


def _shared(pt: Any, frame: Frame, target: Any, metres: bool, out: Any) -> Any:
    if target.type != "cpu" or metres or out is not None:
        raise ValueError("copy=False shares the memory of the pixels as they are: on the CPU, without metres and out")
    # PyTorch has no read-only tensors and warns of every array that is one; this array is seen by nobody else.
    pixels = frame._array(read_only=False)
    _dtype(pt, pixels.dtype)
    return pt.from_numpy(pixels)
