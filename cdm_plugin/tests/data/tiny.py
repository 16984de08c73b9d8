#!/usr/bin/env python3
"""Writes tiny_gelu.safetensors and tiny_swiglu.safetensors: networks of the official code (manip-as-in-sim-suite/cdm on PYTHONPATH), far
smaller than any that is published, one for each kind of feed-forward layer, with random weights, inputs of several sizes and
their outputs. Weights and inputs are 16-bit floats, so that the files are small; the networks compute in 32 bits.

usage: PYTHONPATH=.../manip-as-in-sim-suite/cdm tiny.py FOLDER      (torch 2.11.0, safetensors 0.8.0)
"""
import sys
from pathlib import Path

import numpy as np
import torch
from rgbddepth import dpt
from rgbddepth.dinov2 import DinoVisionTransformer
from safetensors.numpy import save_file

# Height and width: odd and even numbers of patches, one patch, one row, one column, the size of the learnt grid.
SIZES = [(42, 70), (14, 14), (14, 84), (84, 14), (70, 70), (98, 126)]


def write(path, feed_forward, seed):
    def encoder(model_name):
        return DinoVisionTransformer(img_size=70, patch_size=14, embed_dim=16, depth=4, num_heads=2, mlp_ratio=4, init_values=1.0,
                                     ffn_layer=feed_forward, block_chunks=0, interpolate_antialias=False, interpolate_offset=0.1)

    dpt.DINOv2 = encoder
    network = dpt.RGBDDepth(encoder="vits", features=8, out_channels=[4, 6, 8, 10])
    network.intermediate_layer_idx = {"vits": [0, 1, 2, 3]}
    random = np.random.Generator(np.random.PCG64(seed))
    tensors = {}
    for name, value in network.state_dict().items():
        spread = 0.5 if value.ndim < 2 or "embed" in name or "token" in name else 1 / np.sqrt(value[0].numel())
        numbers = random.standard_normal(tuple(value.shape)) * spread
        if ".norm" in name and name.endswith("weight"):
            numbers = 1 + 0.2 * numbers
        if name == "depth_head_rgbd.scratch.output_conv2.2.bias":
            numbers += 2
        tensors[name] = np.ascontiguousarray(numbers.astype(np.float16))
    network.load_state_dict({name: torch.from_numpy(value.astype(np.float32)) for name, value in tensors.items()})
    for height, width in SIZES:
        x = random.standard_normal((1, 4, height, width)).astype(np.float16)
        x[:, 3] = np.abs(x[:, 3])
        with torch.no_grad():
            y = network.eval()(torch.from_numpy(x.astype(np.float32))).numpy()
        print(f"{path.name} {height}x{width}: y from {y.min()} to {y.max()}")
        tensors |= {f"x_{height}x{width}": x, f"y_{height}x{width}": y.reshape(1, height, width)}
    save_file(tensors, path)


def main():
    folder = Path(sys.argv[1])
    write(folder / "tiny_gelu.safetensors", "mlp", 11)
    write(folder / "tiny_swiglu.safetensors", "swiglufused", 7)


if __name__ == "__main__":
    main()
