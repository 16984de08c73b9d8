#!/usr/bin/env python3
"""Runs the official camera depth model on one pair of images and writes its input and output, for
`cargo run -p depthrig-cdm --example parity`.

usage: PYTHONPATH=.../manip-as-in-sim-suite/cdm cdm_official.py ENCODER WEIGHTS.safetensors RGB.png DEPTH.png UNITS_PER_METRE INPUT_SIZE
       OUT.safetensors [--crop X,Y,WIDTH,HEIGHT] [--turn]
(needs torch, torchvision, opencv-python, safetensors; the official code is at github.com/ByteDance-Seed/manip-as-in-sim-suite)
"""
import argparse

import cv2
import numpy as np
import torch
from rgbddepth.dpt import RGBDDepth
from safetensors.torch import load_file, save_file

SIZES = {
    "vits": (64, [48, 96, 192, 384]),
    "vitb": (128, [96, 192, 384, 768]),
    "vitl": (256, [256, 512, 1024, 1024]),
    "vitg": (384, [1536] * 4),
}
MAX_DEPTH_M = 6.0


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("encoder", "weights", "rgb", "depth"):
        parser.add_argument(name)
    parser.add_argument("units_per_metre", type=float)
    parser.add_argument("input_size", type=int)
    parser.add_argument("out")
    parser.add_argument("--crop", help="this part of the images: X,Y,WIDTH,HEIGHT")
    parser.add_argument("--turn", action="store_true", help="rows become columns")
    args = parser.parse_args()

    rgb = cv2.imread(args.rgb)[:, :, ::-1]
    raw = cv2.imread(args.depth, cv2.IMREAD_UNCHANGED)
    if args.crop:
        x, y, w, h = map(int, args.crop.split(","))
        rgb, raw = rgb[y : y + h, x : x + w], raw[y : y + h, x : x + w]
    if args.turn:
        rgb, raw = rgb.transpose(1, 0, 2), raw.T
    rgb, raw = np.ascontiguousarray(rgb), np.ascontiguousarray(raw)
    # As the official script does it before it calls the network.
    metres = raw.astype(float) / args.units_per_metre
    metres[metres > MAX_DEPTH_M] = 0
    inverse = np.divide(1, metres, out=np.zeros_like(metres), where=metres > 0)

    features, channels = SIZES[args.encoder]
    network = RGBDDepth(encoder=args.encoder, features=features, out_channels=channels)
    network.load_state_dict(load_file(args.weights), strict=True)
    network.eval()
    with torch.no_grad():
        x, _ = network.image2tensor(rgb, inverse, args.input_size)
        y = network.forward(x)
        full = network.infer_image(rgb, inverse, input_size=args.input_size)
    tensors = {
        "rgb": torch.from_numpy(rgb.astype(np.float32)),
        "raw": torch.from_numpy(raw.astype(np.float32)),
        "units_per_metre": torch.tensor([args.units_per_metre]),
        "input_size": torch.tensor([float(args.input_size)]),
        "x": x.contiguous(),
        "y": y.contiguous(),
        "inv_full": torch.from_numpy(full.copy()),
    }
    save_file(tensors, args.out)
    print(f"{args.out}: {tuple(x.shape)}, inverse depth from {full.min():.3f} to {full.max():.3f} 1/m")


if __name__ == "__main__":
    main()
