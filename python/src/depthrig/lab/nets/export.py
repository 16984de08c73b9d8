"""`tiny` as ONNX (opset 17), for ONNX Runtime in the daemon. Fill and normalisation stay outside."""

from __future__ import annotations

import importlib.util
import io
import warnings
from pathlib import Path

import torch

from ..errors import LabError
from ..record import write_atomically
from .tiny import CHANNELS, MULTIPLE, Tiny

__all__ = ["OPSET", "export_tiny"]

OPSET = 17


def export_tiny(net: Tiny, path: Path) -> None:
    """Write the network: inputs `x` (batch, 6, height, width) and `filled` (batch, height, width), output `refined`.

    :raises LabError: when the package `onnx`, which PyTorch exports with, is not installed.
    """
    if importlib.util.find_spec("onnx") is None:
        raise LabError(f"{path}: not written: pip install onnx")
    height, width = 4 * MULTIPLE, 6 * MULTIPLE
    example = (torch.zeros(1, CHANNELS, height, width), torch.ones(1, height, width))
    axes = {0: "batch", 1: "height", 2: "width"}
    dynamic = {"x": {0: "batch", 2: "height", 3: "width"}, "filled": axes, "refined": axes}
    out = io.BytesIO()
    training = net.training
    net.eval()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # this exporter is old, and the newer one needs another package
        torch.onnx.export(
            net,
            example,
            out,
            opset_version=OPSET,
            input_names=["x", "filled"],
            output_names=["refined"],
            dynamic_axes=dynamic,
            dynamo=False,
        )
    net.train(training)
    write_atomically(path, out.getvalue())
