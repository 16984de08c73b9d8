"""Opens an exported dataset with LeRobot's own loader and compares the result.

usage: python lerobot_loader.py (DATASET EXPECTED)...

Runs in the environment of the package `lerobot` (`make test` installs it), called by test_lerobot.py. EXPECTED holds
`STREAM.npy` (every row is this) or `STREAM.ROW.npy` / `STREAM.ROW.jpg` (rows of each episode). For each dataset it
prints a line of JSON: frames, episodes, fps, images compared. Statistics are compared with those that the package's
own functions compute.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import lerobot
import numpy as np
import torch
from lerobot.datasets import compute_stats
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from PIL import Image

KNOWS_DEPTH = tuple(map(int, lerobot.__version__.split(".")[:2])) >= (0, 6)
"""Earlier versions hand 16-bit images over as signed numbers, and know nothing of depth."""


def expectations(folder: Path) -> dict[tuple[str, int | None], np.ndarray]:
    found = {}
    for file in folder.iterdir():
        stream, *row = file.name.removesuffix(file.suffix).split(".")
        pixels = np.asarray(Image.open(file).convert("RGB")) if file.suffix == ".jpg" else np.load(file)
        found[stream, int(row[0]) if row else None] = pixels
    return found


def tensor(pixels: np.ndarray) -> np.ndarray:
    """An image as the loader returns it: channels first; bytes as 0 to 1, 16 bits unchanged."""
    planes = np.moveaxis(pixels, -1, 0) if pixels.ndim == 3 else pixels[None]
    if pixels.dtype == np.uint16:
        return planes.astype(np.float32) if KNOWS_DEPTH else planes.astype(np.int16)
    return planes.astype(np.float32) / np.float32(255)


def check_stats(ds: LeRobotDataset) -> None:
    """`stats.json` against the package's own code on the package's own samples."""
    per_episode = []
    for episode in range(ds.num_episodes):
        meta = ds.meta.episodes[episode]
        first, length = meta["dataset_from_index"], meta["length"]
        stats = {}
        for key in ds.meta.camera_keys:
            mask = key.replace("observation.images.", "missing.")
            samples = [ds[first + i] for i in compute_stats.sample_indices(length)]
            planes = [s[key].numpy() for s in samples if not s[mask]]
            array = np.stack([compute_stats.auto_downsample_height_width(p) for p in planes]).astype(np.float64)
            found = compute_stats.get_feature_stats(array, axis=(0, 2, 3), keepdims=True)
            stats[key] = {k: v if k == "count" else np.squeeze(v, axis=0) for k, v in found.items()}
        per_episode.append(stats)
    expected = compute_stats.aggregate_stats(per_episode)
    for key, of_key in expected.items():
        spread = float((of_key["max"] - of_key["min"]).max())
        assert ds.meta.stats[key].keys() == of_key.keys()
        for name, value in of_key.items():
            got = ds.meta.stats[key][name]
            assert got.shape == value.shape, (key, name, got.shape, value.shape)
            # Two JPEG decoders differ by a step or two; a bin of the quantiles is a 5000th of the spread.
            margin = 0 if name == "count" else (3 / 255 if spread <= 1 else spread / 2000)
            np.testing.assert_allclose(got, value, rtol=1e-5, atol=margin, err_msg=f"{key} {name}")


def check(root: Path, expected: dict[tuple[str, int | None], np.ndarray]) -> None:
    ds = LeRobotDataset("depthrig/test", root=root)
    compared = 0
    assert len(ds) == ds.meta.total_frames
    for i in range(len(ds)):
        item = ds[i]
        row = item["frame_index"].item()
        assert item["index"].item() == i
        assert abs(item["timestamp"].item() - row / ds.fps) < 1e-4
        assert item["capture.utc_ns"].dtype == torch.int64
        assert isinstance(item["task"], str)
        assert item["task"]
        for key in ds.meta.camera_keys:
            stream = key.removeprefix("observation.images.")
            if item[f"missing.{stream}"]:
                assert not item[key].any()
                continue
            want = expected.get((stream, None), expected.get((stream, row)))
            if want is not None:
                np.testing.assert_array_equal(item[key].numpy(), tensor(want), err_msg=f"{key} of row {i}")
                compared += 1
    if KNOWS_DEPTH:
        assert sorted(ds.meta.depth_keys) == sorted(k for k in ds.meta.camera_keys if k.endswith("depth"))
        # In metres, where the format has a name for the unit.
        metres = LeRobotDataset("depthrig/test", root=root, depth_output_unit="m")
        for key in ds.meta.depth_keys:
            factor = 0.001 if ds.meta.features[key]["info"].get("depth_unit") == "mm" else 1.0
            torch.testing.assert_close(metres[0][key], ds[0][key] * factor)
    # As training reads it: a batch, with a neighbour in time, and one episode of several.
    key = ds.meta.camera_keys[0]
    pairs = LeRobotDataset("depthrig/test", root=root, delta_timestamps={key: [-1 / ds.fps, 0.0]})
    batch = next(iter(torch.utils.data.DataLoader(pairs, batch_size=3)))
    assert batch[key].shape == (3, 2, *ds[0][key].shape)
    torch.testing.assert_close(batch[key][1, 0], ds[0][key])
    last = LeRobotDataset("depthrig/test", root=root, episodes=[ds.num_episodes - 1])
    assert len(last) == ds.meta.episodes[ds.num_episodes - 1]["length"]
    if KNOWS_DEPTH:
        check_stats(ds)
    said = {"frames": len(ds), "episodes": ds.num_episodes, "fps": ds.fps, "images_compared": compared}
    print(json.dumps({**said, "lerobot": lerobot.__version__}))


for dataset, images in zip(sys.argv[1::2], sys.argv[2::2], strict=True):
    check(Path(dataset), expectations(Path(images)))
