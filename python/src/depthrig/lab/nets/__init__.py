"""Networks by configuration."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import torch

from ..config import ModelConfig
from ..errors import LabError, first_line
from .cdm import Cdm
from .noise import NoiseConv, NoiseNet
from .tiny import Tiny
from .vit import SIZES

__all__ = ["Cdm", "NoiseConv", "NoiseNet", "Tiny", "build", "load_weights", "noise_net"]


def build(config: ModelConfig) -> Any:
    """Return the network, with the weights that the configuration names."""
    if config.kind == "tiny":
        net: Any = Tiny(config.width)
    elif config.kind == "cdm":
        net = Cdm(SIZES[config.encoder])
    else:
        net = noise_net(config)
    if config.weights is not None:
        load_weights(net, Path(config.weights))
    return net


def noise_net(config: ModelConfig) -> NoiseConv | NoiseNet:
    """Return a hole or value model of the configured form."""
    channels = 4 if config.refined_input else 3
    return NoiseConv(channels, config.width) if config.encoder == "conv" else NoiseNet(SIZES[config.encoder], channels)


def load_weights(net: Any, path: Path) -> list[str]:
    """Load a state into a network; returns the names that the file lacks.

    Names of a wrapper (`module.`) are taken off. A tensor that the network does not have, or of another shape, is
    refused; so is a file that shares nothing with it.

    :raises LabError: names the file and the first tensor that does not fit.
    """
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, pickle.UnpicklingError, EOFError, ValueError) as e:
        raise LabError(f"{path}: not a file of torch.save: {first_line(e)}") from None
    if isinstance(state, dict) and isinstance(state.get("model"), dict):
        state = state["model"]
    if not isinstance(state, dict) or not all(torch.is_tensor(v) for v in state.values()):
        raise LabError(f"{path}: not a state of tensors by name")
    state = {str(k).removeprefix("module."): v for k, v in state.items()}
    own = net.state_dict()
    for name, tensor in state.items():
        if name not in own:
            raise LabError(f"{path}: tensor {name} is not of this network; choose another kind or encoder")
        if tensor.shape != own[name].shape:
            shapes = f"{list(tensor.shape)}, {list(own[name].shape)} is wanted"
            raise LabError(f"{path}: tensor {name} is {shapes}; choose another kind or encoder")
    missing = [name for name in own if name not in state]
    if len(missing) == len(own):
        raise LabError(f"{path}: no tensors")
    net.load_state_dict(state, strict=False)
    return missing
