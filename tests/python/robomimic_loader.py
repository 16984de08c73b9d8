"""Reads an HDF5 export with robomimic's own loader, for test_demonstrations.py.

usage: python robomimic_loader.py FILE OUT.npz FILTER OBSERVATION…

Runs in the environment of the package `lerobot`, which has PyTorch. Writes what the loader hands to a training.
"""

from __future__ import annotations

import contextlib
import json
import sys

import numpy as np
import robomimic.utils.obs_utils as observations
from robomimic.utils.dataset import SequenceDataset


def main() -> None:
    path, out, key, *names = sys.argv[1:]
    ends = {"low_dim": "state", "rgb": "color", "depth": "depth"}
    of = {kind: [n for n in names if n.endswith(end)] for kind, end in ends.items()}
    with contextlib.redirect_stdout(sys.stderr):
        observations.initialize_obs_utils_with_obs_specs([{"obs": of}])
        dataset = SequenceDataset(
            path,
            obs_keys=names,
            dataset_keys=["actions", "rewards", "dones"],
            filter_by_attribute=key,
            load_next_obs=False,
        )
        items = [dataset[i] for i in range(len(dataset))]
    arrays = {k: np.stack([item[k][0] for item in items]) for k in ("actions", "rewards", "dones")}
    arrays |= {k: np.stack([item["obs"][k][0] for item in items]) for k in names}
    np.savez(out, **arrays)
    print(json.dumps(dataset.demos))


if __name__ == "__main__":
    main()
