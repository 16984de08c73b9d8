"""Trains a very small ACT policy of LeRobot on an exported dataset, to see that it can.

usage: python lerobot_train.py DATASET CAMERA STEPS

Runs in the environment of the package `lerobot`, called by test_demonstrations.py. Prints a line of JSON: the losses, and what the
dataset says of itself. Nothing is downloaded: the backbone begins with random weights.
"""

from __future__ import annotations

import json
import sys

import torch
from lerobot.configs.types import FeatureType
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.factory import make_pre_post_processors
from lerobot.utils.feature_utils import dataset_to_policy_features

CHUNK = 4


def main() -> None:
    root, camera, steps = sys.argv[1], sys.argv[2], int(sys.argv[3])
    torch.manual_seed(1)
    torch.set_num_threads(1)
    meta = LeRobotDataset("depthrig/test", root=root).meta
    features = dataset_to_policy_features(meta.features)
    outputs = {k: f for k, f in features.items() if f.type is FeatureType.ACTION}
    inputs = {k: f for k, f in features.items() if k in ("observation.state", camera)}
    config = ACTConfig(
        input_features=inputs,
        output_features=outputs,
        chunk_size=CHUNK,
        n_action_steps=CHUNK,
        dim_model=32,
        n_heads=2,
        dim_feedforward=32,
        n_encoder_layers=1,
        n_vae_encoder_layers=1,
        latent_dim=4,
        pretrained_backbone_weights=None,
        device="cpu",
    )
    dataset = LeRobotDataset(
        "depthrig/test", root=root, delta_timestamps={"action": [i / meta.fps for i in range(CHUNK)]}
    )
    policy = ACTPolicy(config)
    before, _ = make_pre_post_processors(config, dataset_stats=meta.stats)
    optimiser = torch.optim.AdamW(policy.parameters(), lr=1e-3)
    loader = torch.utils.data.DataLoader(dataset, batch_size=4, shuffle=True)
    losses: list[float] = []
    policy.train()
    while len(losses) < steps:
        for batch in loader:
            loss, _ = policy.forward(before(batch))
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            losses.append(loss.item())
    print(
        json.dumps(
            {
                "losses": losses[:steps],
                "episodes": meta.total_episodes,
                "frames": meta.total_frames,
                "tasks": list(meta.tasks.index),
                "state": meta.features["observation.state"]["names"],
                "action": list(outputs["action"].shape),
                "success": sum(bool(row["next.success"]) for row in dataset.hf_dataset.select_columns("next.success")),
            }
        )
    )


if __name__ == "__main__":
    main()
