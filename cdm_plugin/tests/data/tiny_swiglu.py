#!/usr/bin/env python3
"""Writes tiny_swiglu.safetensors: a network of the official code (manip-as-in-sim-suite/cdm on PYTHONPATH), far smaller than any that
is published and with the feed-forward part of the largest, random weights, one input and its output. Weights and input are 16-bit floats,
so that the file is small; the network computes in 32 bits.

usage: PYTHONPATH=.../manip-as-in-sim-suite/cdm tiny_swiglu.py OUT.safetensors      (torch 2.15.0, safetensors 0.8.0)
"""
import sys

import numpy as np
import torch
from rgbddepth import dpt
from rgbddepth.dinov2 import DinoVisionTransformer
from safetensors.numpy import save_file


def encoder(model_name):
    return DinoVisionTransformer(img_size=70, patch_size=14, embed_dim=16, depth=4, num_heads=2, mlp_ratio=4, init_values=1.0,
                                 ffn_layer="swiglufused", block_chunks=0, interpolate_antialias=False, interpolate_offset=0.1)


def main():
    dpt.DINOv2 = encoder
    network = dpt.RGBDDepth(encoder="vits", features=8, out_channels=[4, 6, 8, 10])
    network.intermediate_layer_idx = {"vits": [0, 1, 2, 3]}
    random = np.random.Generator(np.random.PCG64(7))
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
    x = random.standard_normal((1, 4, 42, 70)).astype(np.float16)
    x[:, 3] = np.abs(x[:, 3])
    with torch.no_grad():
        y = network.eval()(torch.from_numpy(x.astype(np.float32))).numpy()
    print(f"y from {y.min()} to {y.max()}")
    save_file({**tensors, "x": x, "y": y}, sys.argv[1])


if __name__ == "__main__":
    main()
