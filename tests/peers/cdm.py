#!/usr/bin/env python3
"""The network in depthrig's engines beside the official code in PyTorch: time, CPU, memory and agreement, in one run.

usage: cdm.py OFFICIAL WEIGHTS --network PROGRAM [--sizes 252,518] [--rounds 5] [--threads 2] [--torch T]... [--engine E]...

OFFICIAL is a checkout of the folder `cdm` of github.com/ByteDance-Seed/manip-as-in-sim-suite (its code is not part of
this repository), or `lab`: the same network in depthrig.lab, with fused attention. WEIGHTS is a file of its state, trained or
not, .safetensors or of torch.save; PROGRAM the example `network` of depthrig-cdm (cargo build --release -p depthrig-cdm
--example network). PyTorch runs as DEVICE/PRECISION (cpu/fp32, cpu/bf16, cuda/fp16), of which the first is what the others are
compared with; an engine is DEVICE/PRECISION[/LIBRARY]. Needs torch, numpy, safetensors, and what the official code imports
(opencv, torchvision).

The engines alternate: in each round every engine runs once at every size, so that load on the computer affects all. It
compares CPU time of all threads, best of the rounds, and wall time, best and median.
"""
import argparse, json, pathlib, statistics, subprocess, sys, tempfile, time
import numpy as np

SIZES = {"vits": (64, [48, 96, 192, 384]), "vitb": (128, [96, 192, 384, 768]),
         "vitl": (256, [256, 512, 1024, 1024]), "vitg": (384, [1536] * 4)}


class Torch:
    def __init__(self, official, weights, encoder, threads, way):
        import torch
        from safetensors.torch import load_file
        torch.set_num_threads(threads)
        # What `fp32` says, as in depthrig.
        torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = False
        self.device, precision = way.split("/")
        self.torch, self.type = torch, {"fp32": None, "bf16": torch.bfloat16, "fp16": torch.float16}[precision]
        self.name = f"torch {torch.__version__.split('+')[0]} {self.device} {precision}"
        if str(official) == "lab":
            from depthrig.lab.nets.cdm import Cdm
            from depthrig.lab.nets.vit import SIZES as LAB
            self.model = Cdm(LAB[encoder])
        else:
            sys.path.insert(0, str(official))
            from rgbddepth.dpt import RGBDDepth
            features, levels = SIZES[encoder]
            self.model = RGBDDepth(encoder=encoder, features=features, out_channels=levels)
        state = load_file(weights) if weights.endswith(".safetensors") else torch.load(weights, weights_only=True)
        self.model.load_state_dict(state, strict=True)
        self.model.eval().to(self.device)
        # On a GPU all of it is in 16 bits, as in depthrig; on a CPU not every operator has a kernel for them.
        self.is_whole = self.type is not None and self.device != "cpu"
        if self.is_whole:
            self.model.to(self.type)

    def run(self, x):
        torch = self.torch
        cast = self.type is not None and not self.is_whole
        with torch.inference_mode(), torch.autocast(self.device, self.type, enabled=cast):
            given = torch.from_numpy(x)
            if self.device != "cpu":
                given = given.pin_memory()
            wall, cpu = time.perf_counter(), time.process_time()
            y = self.model(given.to(self.device, self.type if self.is_whole else None)).float().cpu()
            wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        return y[0].numpy(), wall, cpu, None


class Ours:
    def __init__(self, program, weights, engine, threads, folder):
        device, precision, *library = engine.split("/", 2)
        command = [program, weights, device, precision, str(threads), *library]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self.folder = folder
        self.name = self.process.stdout.readline().strip()
        if not self.name:
            sys.exit(f"{' '.join(command)}: failed")

    def run(self, x):
        height, width = x.shape[-2:]
        given, result = self.folder / "x.f32", self.folder / "y.f32"
        x.astype("<f4").tofile(given)
        self.process.stdin.write(f"{height} {width} {given} {result}\n")
        self.process.stdin.flush()
        wall, cpu, peak = self.process.stdout.readline().split()
        return np.fromfile(result, "<f4").reshape(height, width), float(wall), float(cpu), int(peak)


def image(size):
    """A network's input of a 1280x720 camera at this size, of smooth colour and depth with holes."""
    height = round(size / 14) * 14
    width = round(1280 / 720 * size / 14) * 14
    v, u = np.mgrid[0:height, 0:width].astype(np.float32) / height
    rgb = [np.sin(9 * u + 5 * v * k) + 0.3 * np.cos(40 * v * u + k) for k in (1, 2, 3)]
    inverse = 1 / (0.5 + u + 0.5 * v)
    inverse[np.sin(31 * u) * np.cos(23 * v) > 0.8] = 0
    return np.stack([*rgb, inverse])[None].astype(np.float32)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("official", type=pathlib.Path)
    parser.add_argument("weights")
    parser.add_argument("--network", required=True)
    parser.add_argument("--encoder", default="vits", choices=SIZES)
    parser.add_argument("--sizes", default="252,518")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--engine", action="append", default=[])
    parser.add_argument("--torch", action="append", metavar="DEVICE/PRECISION", help="[default: cpu/fp32]")
    parser.add_argument("--json", type=pathlib.Path)
    args = parser.parse_args()

    rows = []
    with tempfile.TemporaryDirectory() as folder:
        folder = pathlib.Path(folder)
        ways = args.torch or ["cpu/fp32"]
        engines = [Torch(args.official, args.weights, args.encoder, args.threads, way) for way in ways]
        for engine in args.engine or ["cpu/fp32"]:
            engines.append(Ours(args.network, args.weights, engine, args.threads, folder))
        for size in map(int, args.sizes.split(",")):
            x, times, outputs, peaks = image(size), {}, {}, {}
            for _ in range(args.rounds):
                for engine in engines:
                    y, wall, cpu, peak = engine.run(x)
                    outputs[engine.name], peaks[engine.name] = y, peak
                    times.setdefault(engine.name, []).append((wall, cpu))
            reference = engines[0].name
            best = lambda name, i: min(t[i] for t in times[name])
            for name, runs in times.items():
                difference = np.abs(outputs[name] - outputs[reference])
                relative = (difference / np.maximum(outputs[reference], 1e-3)).mean()
                rows.append({
                    "size": size, "engine": name, "cpu_s": best(name, 1), "cpu_ratio": best(name, 1) / best(reference, 1),
                    "wall_s": best(name, 0), "wall_median_s": statistics.median(t[0] for t in runs),
                    "wall_ratio": best(name, 0) / best(reference, 0), "max_abs": float(difference.max()),
                    "mean_relative_percent": float(100 * relative), "peak_mb": peaks[name],
                })
    print("| size | engine | CPU s (best) | of the first | wall s best / median | of the first | max abs 1/m | mean rel % | peak MB |")
    print("|---|---|---|---|---|---|---|---|---|")
    for r in rows:
        print(f"| {r['size']} | {r['engine']} | {r['cpu_s']:.4f} | {r['cpu_ratio']:.2f} | {r['wall_s']:.4f} / "
              f"{r['wall_median_s']:.4f} | {r['wall_ratio']:.2f} | {r['max_abs']:.1e} | {r['mean_relative_percent']:.4f} | "
              f"{r['peak_mb'] or '-'} |")
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
