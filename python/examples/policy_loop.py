"""A depth-only policy in closed loop with a simulated arm, and where its time goes.

python policy_loop.py d435/depth_refined [--hz 10] [--seconds 10] [--max-age 0.5] [--device cpu] [--json]

The policy has the form of the paper's: a ResNet whose first layer takes one channel looks at the depth image, an
MLP at the joints and the gripper, and a diffusion head turns noise into a sequence of actions in a few DDIM steps.
**Its weights are random** (`--seed`): the arm moves, but its motion means nothing. The data path is real: depth
from the rig, at most `--max-age` old, one copy to the device, the network's arithmetic. It needs PyTorch, and a rig:
`depthrig run RIG.toml`. Any depth stream will do, such as d435/depth when no stage refines it.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections import deque
from dataclasses import asdict

import torch
from torch import Tensor, nn

import depthrig
from depthrig.policy import Observation, PolicyLoop, Spread

JOINTS = 7
"""Six of the arm, and the gripper."""
HORIZON = 16
"""Actions that the policy plans."""
EXECUTED = 8
"""Actions that are executed before it plans again, as long as no newer depth is there."""
SIDE = 224
RANGE_M = 3.0
TRAINED_STEPS = 100
"""Steps of the noise schedule; DDIM visits a few of them."""


class Block(nn.Module):
    """A residual block of ResNet-18, with group norm as diffusion policies have it."""

    def __init__(self, inside: int, outside: int, stride: int) -> None:
        super().__init__()
        self.main = nn.Sequential(
            nn.Conv2d(inside, outside, 3, stride, 1, bias=False),
            nn.GroupNorm(outside // 16, outside),
            nn.ReLU(),
            nn.Conv2d(outside, outside, 3, 1, 1, bias=False),
            nn.GroupNorm(outside // 16, outside),
        )
        self.skip: nn.Module = nn.Identity()
        if stride != 1 or inside != outside:
            self.skip = nn.Conv2d(inside, outside, 1, stride, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        """Return features of `outside` channels."""
        return torch.relu(self.main(x) + self.skip(x))


def resnet18() -> nn.Module:
    """ResNet-18 with a first layer of one channel: (N, 1, H, W) to (N, 512)."""
    layers: list[nn.Module] = [
        nn.Conv2d(1, 64, 7, 2, 3, bias=False),
        nn.GroupNorm(4, 64),
        nn.ReLU(),
        nn.MaxPool2d(3, 2, 1),
    ]
    width = 64
    for outside, stride in ((64, 1), (128, 2), (256, 2), (512, 2)):
        layers += [Block(width, outside, stride), Block(outside, outside, 1)]
        width = outside
    return nn.Sequential(*layers, nn.AdaptiveAvgPool2d(1), nn.Flatten())


class Denoiser(nn.Module):
    """Predicts the noise in a sequence of actions: 1-d convolutions that the observation shifts and scales (FiLM)."""

    def __init__(self, seen: int, width: int = 128) -> None:
        super().__init__()
        self.time = nn.Sequential(nn.Linear(64, 128), nn.Mish(), nn.Linear(128, 64))
        self.enter = nn.Conv1d(JOINTS, width, 5, padding=2)
        self.convs = nn.ModuleList(
            nn.Sequential(nn.Conv1d(width, width, 5, padding=2), nn.GroupNorm(8, width), nn.Mish()) for _ in range(4)
        )
        self.films = nn.ModuleList(nn.Linear(seen + 64, 2 * width) for _ in range(4))
        self.leave = nn.Conv1d(width, JOINTS, 1)

    def forward(self, actions: Tensor, step: int, seen: Tensor) -> Tensor:
        """Return the noise in `actions`, (N, JOINTS, HORIZON)."""
        rates = torch.exp(torch.arange(32, device=seen.device) * (-math.log(1e4) / 31)) * step
        embedded = self.time(torch.cat([rates.sin(), rates.cos()])).expand(len(seen), -1)
        condition = torch.cat([seen, embedded], dim=1)
        x = self.enter(actions)
        for conv, film in zip(self.convs, self.films):
            scale, shift = film(condition).unsqueeze(-1).chunk(2, dim=1)
            x = x + conv(x) * (1 + scale) + shift
        return self.leave(x)


class Policy(nn.Module):
    """Depth image and joints to a sequence of actions."""

    def __init__(self, ddim_steps: int) -> None:
        super().__init__()
        self.encoder = resnet18()
        self.body = nn.Sequential(nn.Linear(JOINTS, 64), nn.ReLU(), nn.Linear(64, 64))
        self.head = Denoiser(512 + 64)
        # The squared-cosine schedule (Nichol and Dhariwal 2021).
        grid = torch.arange(TRAINED_STEPS + 1) / TRAINED_STEPS
        kept = torch.cos((grid + 0.008) / 1.008 * math.pi / 2) ** 2
        self.kept = (kept[1:] / kept[0]).clamp(1e-4, 1.0).tolist()
        self.steps = [round(i * (TRAINED_STEPS - 1) / (ddim_steps - 1)) for i in range(ddim_steps)][::-1]

    @torch.inference_mode()
    def forward(self, depth_m: Tensor, joints: Tensor, noise: torch.Generator) -> Tensor:
        """Return (HORIZON, JOINTS) joint positions, of a (H, W) image in metres and the joints now."""
        image = (depth_m / RANGE_M).clamp_(0, 1)[None, None]
        # Nearest: between depth and no depth lies no depth.
        image = nn.functional.interpolate(image, (SIDE, SIDE), mode="nearest")
        seen = torch.cat([self.encoder(image), self.body(joints[None])], dim=1)
        x = torch.randn(1, JOINTS, HORIZON, generator=noise).to(seen.device)
        for step, following in zip(self.steps, [*self.steps[1:], -1]):
            # DDIM without noise (Song et al. 2021, eq. 12 with sigma 0).
            kept, kept_then = self.kept[step], self.kept[following] if following >= 0 else 1.0
            error = self.head(x, step, seen)
            clean = ((x - math.sqrt(1 - kept) * error) / math.sqrt(kept)).clamp(-1, 1)
            x = math.sqrt(kept_then) * clean + math.sqrt(1 - kept_then) * error
        return x[0].T


class Arm:
    """A simulated arm: joints that follow their targets with a lag. Its motion does not show in the camera's image."""

    def __init__(self) -> None:
        self.joints = torch.zeros(JOINTS)

    def follow(self, target: Tensor, seconds: float, lag_s: float = 0.2) -> None:
        """Move towards `target` for `seconds`."""
        self.joints += (target.cpu() - self.joints) * (1 - math.exp(-seconds / lag_s))


def main() -> None:
    """Run the loop and print its budget."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("stream", nargs="?", default="d435/depth_refined", help="default: %(default)s")
    parser.add_argument("--rig", help="by default the only one that runs")
    parser.add_argument("--hz", type=float, default=10, help="how often the arm is given an action")
    parser.add_argument("--seconds", type=float, default=10)
    parser.add_argument("--max-age", type=float, default=0.5, help="seconds; on older depth it does not act")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--ddim-steps", type=int, default=8)
    parser.add_argument("--threads", type=int, help="of PyTorch on the CPU")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    if options.ddim_steps < 2:
        parser.error("--ddim-steps: at least 2")
    if options.threads:
        torch.set_num_threads(options.threads)
    torch.manual_seed(options.seed)
    noise = torch.Generator().manual_seed(options.seed)
    policy = Policy(options.ddim_steps).to(options.device).eval()
    arm = Arm()
    policy(torch.zeros(8, 8, device=options.device), arm.joints.to(options.device), noise)  # what is done once
    plan: list[Tensor] = []
    seen_last: list[depthrig.Header] = []
    copies: deque[float] = deque()

    def act(seen: Observation) -> list[float]:
        # A newer image is a reason to plan anew; without one the plan goes on.
        if seen.is_new or not plan:
            began = time.perf_counter()
            depth = seen.frames["depth"].torch(options.device, metres=True)
            synchronise(options.device)
            copies.append(time.perf_counter() - began)
            plan[:] = policy(depth, arm.joints.to(options.device), noise).cpu()[:EXECUTED]
            seen_last[:] = [seen.frames["depth"].header]
        target = plan.pop(0)
        arm.follow(target, 1 / options.hz)
        return target.tolist()

    joints = [f"joint_{i}" for i in range(JOINTS - 1)] + ["gripper"]
    with (
        depthrig.Signal("policy_loop/action", joints, unit="rad", kind="joints") as action,
        PolicyLoop(
            {"depth": options.stream}, action=action, hz=options.hz, max_age=options.max_age, rig=options.rig, timeout=10
        ) as loop,
    ):
        end = time.monotonic() + options.seconds
        while time.monotonic() < end:
            if not loop.step(act):
                plan.clear()  # the arm holds still
        report = loop.report()
    weights = f"random, seed {options.seed}: the actions mean nothing"
    source: dict[str, object] = {"stream": options.stream, "device": options.device, "plans": len(copies)}
    for header in seen_last:
        source["image"] = f"{header.width}x{header.height} {header.format_name}"
        if header.refinement is not None:
            source |= {"engine": header.refinement.engine, "model": header.refinement.model or "none"}
    copy = Spread.of(copies)
    if options.json:
        result = {"weights": weights, **source, **json.loads(report.to_json()), "torch_copy": copy and asdict(copy)}
        print(json.dumps({**result, "joints": [round(float(j), 4) for j in arm.joints]}, indent=2))
        return
    print(f"weights {weights}")
    print(", ".join(f"{k} {v}" for k, v in source.items()))
    print(report)
    if copy is not None:
        print(f"{'torch copy':<15}{copy.p50_ms:>9.2f}{copy.p99_ms:>9.2f}{copy.max_ms:>9.2f}   the frame to a tensor in metres")


def synchronise(device: str) -> None:
    """Wait until the device has finished, so that the elapsed time can be measured."""
    if device.startswith("cuda"):
        torch.cuda.synchronize()


if __name__ == "__main__":
    main()
