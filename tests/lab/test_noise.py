"""Noise of sensors: against noise that is known, and against slow forms."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch", reason="PyTorch is not installed")

from depthrig.lab import LabError, noise
from depthrig.lab.shards import ShardWriter

import made

FOCAL_BASELINE = 23.0


def slanted(seed: int, sigma: float, smooth: int = 1, size: tuple[int, int] = (288, 360)) -> np.ndarray:
    """Depth of a slanted plane whose disparity has noise of `sigma` px, white or over means of `smooth` pixels in a row."""
    rng = np.random.default_rng(seed)
    height, width = size
    white = rng.standard_normal((height, width + smooth - 1))
    added = sum(white[:, i : i + width] for i in range(smooth)) / np.sqrt(smooth)
    y, x = np.mgrid[:height, :width]
    return (FOCAL_BASELINE / (20 + 0.02 * x - 0.01 * y + sigma * added)).astype(np.float32)


@pytest.mark.parametrize("sigma", [0.03, 0.2])
def test_noise_of_a_plane_is_what_was_added(sigma: float) -> None:
    found = noise.measure([(slanted(1, sigma), FOCAL_BASELINE)])
    # Three of 81 degrees of freedom go into the plane.
    assert found.residual_px[1] == pytest.approx(sigma * np.sqrt(78 / 81), rel=0.03)
    assert abs(found.correlation) < 0.06
    assert (found.images, found.holes, found.long, found.short) == (1, 0, 0, 0)


def test_neighbours_that_share_noise_are_seen() -> None:
    found = noise.measure([(slanted(2, 0.1, smooth=3), FOCAL_BASELINE)])
    assert 0.5 < found.correlation < 0.72  # 2/3, less what the plane takes


def test_holes_are_those_of_a_slow_count() -> None:
    rng = np.random.default_rng(3)
    raw = slanted(3, 0.05, size=(60, 200))
    for _ in range(40):
        y, x, w = int(rng.integers(60)), int(rng.integers(200)), int(rng.integers(1, 60))
        raw[y, x : x + w] = 0
    raw[0, 0] = raw[-1, -1] = 1.0  # the whole image is seen
    found = noise.measure([(raw, FOCAL_BASELINE)])
    lengths = []
    for row in raw:
        length = 0
        for value in [*row, 1.0]:
            if value == 0:
                length += 1
            elif length:
                lengths.append(length)
                length = 0
    assert sorted(noise.hole_runs(raw == 0)) == sorted(lengths)
    assert found.holes == pytest.approx((raw == 0).mean())
    assert found.long == pytest.approx(sum(n for n in lengths if n >= 32) / sum(lengths))
    assert found.short == pytest.approx(sum(n for n in lengths if n < 4) / sum(lengths))


def test_residuals_are_those_of_least_squares() -> None:
    disparity = np.random.default_rng(4).random((20, 30))
    disparity[3, 3] = np.nan
    found = noise.plane_residuals(disparity)
    assert found.shape == (2 * 3 - 1, 9, 9), "the window with the hole is left out"
    y, x = np.mgrid[:9, :9]
    basis = np.stack([x.ravel(), y.ravel(), np.ones(81)], 1)
    tile = disparity[:9, 9:18].ravel()
    slow = tile - basis @ np.linalg.lstsq(basis, tile, rcond=None)[0]
    np.testing.assert_allclose(found[0].ravel(), slow, atol=1e-12)


def test_the_border_that_no_sensor_sees_is_not_a_hole() -> None:
    raw = slanted(5, 0.05)
    raw[:, :40] = 0
    assert noise.measure([(raw, FOCAL_BASELINE)]).holes == 0


def test_shards_and_images_by_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "shards"
    folder.mkdir()
    with ShardWriter(folder / "s-000000.tar") as writer:
        for i, sensor in enumerate(["d435", "d435", "l515", "d405"]):
            facts = {"sensor": sensor, "sensor_model": "statistical", "seed": 1, "families": [], "scene": "table"}
            writer.write(i, made.sample(i, 64, 80), facts)
    image = tmp_path / "raw.png"
    pixels = np.rint(slanted(6, 0.05) * 1e4).astype(np.uint16)
    pixels[:, 5] = 65535
    made.write(image, pixels)
    assert noise.main([str(folder), "--image", str(image), "0.0001", str(FOCAL_BASELINE), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert {k: v["images"] for k, v in found.items()} == {
        "shards d435 statistical table": 2,
        "shards d405 statistical table": 1,
        str(image): 1,
    }
    assert found[str(image)]["holes"] == pytest.approx(1 / 360)
    assert noise.main([str(folder)]) == 0
    assert "d405 statistical table" in capsys.readouterr().out


def test_bad_input_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(LabError, match="no image has any depth"):
        noise.measure([(np.zeros((9, 9), np.float32), FOCAL_BASELINE)])
    image = tmp_path / "empty.png"
    made.write(image, np.zeros((20, 20), np.uint16))
    for arguments, expected in [
        ([str(tmp_path / "none")], "no such folder"),
        (["--image", str(image), "0.001", "23"], "no image has any depth"),
        (["--image", str(image), "mm", "23"], "write the unit"),
        (["--image", str(image), "0.001", "nan"], "the product above 0"),
    ]:
        assert noise.main(arguments) == 1
        assert expected in capsys.readouterr().err
