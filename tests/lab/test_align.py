"""Alignment against brute force, the guided filter against loops, synthesis by what it must keep."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from depthrig.lab import LabError, synthesis
from depthrig.lab.align import align, masked_nearest, normalise, objective, unscale
from depthrig.lab.config import SynthesisConfig
from depthrig.lab.guided import box_sum, guided_filter


def by_brute_force(p: np.ndarray, g: np.ndarray, w: np.ndarray) -> float:
    """The least cost over the line through each pair of points."""
    best = np.inf
    for i, j in itertools.combinations(range(p.size), 2):
        if p[i] != p[j]:
            s = (g[i] - g[j]) / (p[i] - p[j])
            if s > 0:
                best = min(best, objective(p, g, w, s, g[i] - s * p[i]))
    return best


def cloud(seed: int, n: int = 64, outliers: float = 0.3) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    g = rng.uniform(0.4, 4, n)
    p = (g - 0.7) / 2.5 * (1 + 0.01 * rng.standard_normal(n))
    wrong = rng.random(n) < outliers
    return np.where(wrong, rng.uniform(-1, 2, n), p), g


@pytest.mark.parametrize("seed", range(6))
def test_alignment_is_exact(seed: int) -> None:
    p, g = cloud(seed)
    if seed == 3:  # ties
        p, g = np.round(p, 1), np.round(g, 1)
    if seed == 4:  # far from 0
        p = 1e4 + p
    want = by_brute_force(p, g, 1 / g)
    got = align(p, g)
    assert got.cost == pytest.approx(want, abs=1e-9)
    assert objective(p, g, 1 / g, got.scale, got.shift) == pytest.approx(want, abs=1e-9)


def test_alignment_stands_outliers() -> None:
    p, g = cloud(9, 300, 0.4)
    got = align(p, g)
    assert got.scale == pytest.approx(2.5, rel=3e-2)
    assert got.shift == pytest.approx(0.7, abs=0.03)
    exact = align((g - 0.7) / 2.5, g)
    assert (exact.scale, exact.shift) == pytest.approx((2.5, 0.7), abs=1e-9)


def test_alignment_refuses_what_has_no_answer() -> None:
    for p, g, words in (
        ([1.0], [1.0], "two points"),
        ([1.0, np.nan], [1.0, 2.0], "two points"),
        ([1.0, 1.0], [1.0, 2.0], "unobservable"),
        ([1.0, 2.0], [2.0, 1.0], "rising"),
        ([1.0, 2.0], [2.0], "2 points with 1"),
    ):
        with pytest.raises(LabError, match=words):
            align(np.array(p), np.array(g))


def test_the_grid_takes_the_valid_pixel_nearest_to_each_centre() -> None:
    rng = np.random.default_rng(2)
    depth = np.where(rng.random((17, 29)) < 0.5, 0, 1.0)
    depth[:5] = 0
    depth[6, 6] = np.nan
    got = set(masked_nearest(depth, 5).tolist())
    want = set()
    for a, b in itertools.product(range(5), range(5)):
        inside = [
            (y, x) for y in range(17) for x in range(29) if y * 5 // 17 == a and x * 5 // 29 == b and depth[y, x] > 0
        ]
        if inside:
            centre = ((a + 0.5) * 17 / 5 - 0.5, (b + 0.5) * 29 / 5 - 0.5)
            y, x = min(inside, key=lambda q: ((q[0] - centre[0]) ** 2 + (q[1] - centre[1]) ** 2, q))
            want.add(y * 29 + x)
    assert got == want
    assert masked_nearest(np.zeros((4, 4))).size == 0


def test_normalisation_is_affine_invariant() -> None:
    g = np.random.default_rng(0).uniform(0.5, 3, (9, 11))
    valid = g > 1
    got = normalise(g, valid)
    np.testing.assert_allclose(normalise(3 * g + 5, valid), got, atol=1e-12)
    assert np.median(got[valid]) == pytest.approx(0, abs=1e-12)
    assert np.abs(got[valid]).mean() == pytest.approx(1)
    assert not got[~valid].any()
    for bad, mask in ((g, np.zeros_like(valid)), (np.ones_like(g), valid)):
        with pytest.raises(LabError, match="normalisation"):
            normalise(bad, mask)


@pytest.mark.parametrize("inverse", [False, True])
def test_unscaling_undoes_any_scale_and_shift(inverse: bool) -> None:
    rng = np.random.default_rng(1)
    truth = rng.uniform(0.5, 3, (40, 50)).astype(np.float32)
    relative = ((1 / truth if inverse else truth) - 0.9) * 0.37
    holed = np.where(rng.random(truth.shape) < 0.3, 0, truth).astype(np.float32)
    np.testing.assert_allclose(unscale(relative, holed, inverse), truth, rtol=1e-5)
    with pytest.raises(LabError, match="empty"):
        unscale(relative, np.zeros_like(truth), inverse)


def slow_guided(i: np.ndarray, p: np.ndarray, valid: np.ndarray, r: int, eps: float) -> tuple[np.ndarray, np.ndarray]:
    """By the definition: a line per window, the mean of the lines around each pixel."""
    h, w = i.shape
    lines: dict[tuple[int, int], tuple[float, float]] = {}
    for y, x in itertools.product(range(h), range(w)):
        window = np.s_[max(0, y - r) : y + r + 1, max(0, x - r) : x + r + 1]
        m = valid[window]
        if m.any():
            ii, pp = i[window][m], p[window][m]
            a = ((ii - ii.mean()) * (pp - pp.mean())).mean() / (ii.var() + eps)
            lines[y, x] = (a, pp.mean() - a * ii.mean())
    out, reached = np.zeros((h, w)), np.zeros((h, w), bool)
    for y, x in itertools.product(range(h), range(w)):
        near = [v for (a, b), v in lines.items() if abs(a - y) <= r and abs(b - x) <= r]
        if near:
            a, b = np.mean(near, 0)
            out[y, x], reached[y, x] = a * i[y, x] + b, True
    return out, reached


@pytest.mark.parametrize(
    ("r", "holes", "offset"), [(1, 0.0, 0), (2, 0.5, 0), (3, 0.97, 0), (2, 0.4, 1000), (30, 0.2, 0)]
)
def test_the_guided_filter_is_its_definition(r: int, holes: float, offset: float) -> None:
    rng = np.random.default_rng(r)
    i = rng.random((15, 18)) + offset
    p = 2 * i + rng.random((15, 18))
    valid = rng.random(i.shape) >= holes
    garbage = np.where(valid, p, np.nan)
    got, reached = guided_filter(i, garbage, valid, r, 1e-3)
    want, want_reached = slow_guided(i, p, valid, r, 1e-3)
    np.testing.assert_array_equal(reached, want_reached)
    np.testing.assert_allclose(got, want, atol=1e-8 if offset else 1e-10)


def test_the_guided_filter_at_its_limits() -> None:
    i = np.random.default_rng(0).random((8, 9))
    none = np.zeros(i.shape, bool)
    assert not guided_filter(i, i, none, 2, 1e-3)[1].any()
    flat, _ = guided_filter(np.ones_like(i), i, ~none, 20, 0.0)
    np.testing.assert_allclose(flat, i.mean())
    for radius, epsilon in ((0, 1.0), (1, -1.0), (1, np.nan)):
        with pytest.raises(LabError, match="radius"):
            guided_filter(i, i, ~none, radius, epsilon)
    with pytest.raises(LabError, match="differ"):
        guided_filter(i, i[1:], ~none, 1, 1)


def test_box_sums() -> None:
    image = np.random.default_rng(3).random((7, 5))
    got = box_sum(image, 2)
    for y, x in itertools.product(range(7), range(5)):
        assert got[y, x] == pytest.approx(image[max(0, y - 2) : y + 3, max(0, x - 2) : x + 3].sum())


def scene(height: int = 120, width: int = 160) -> np.ndarray:
    truth = np.tile(np.linspace(2.5, 1.2, height)[:, None], (1, width)).astype(np.float32)
    truth[30:80, 50:90] = 0.7
    truth[10:100, 120] = 0.6  # thin
    truth[:, :5] = 0
    return truth


STEREO = SynthesisConfig(sensor="stereo", focal_baseline=8.0)
TOF = SynthesisConfig(sensor="tof")
NOTHING = synthesis.Noise(0, 0, 0, 0, 0, 0, 0, 0, 0)


def test_no_noise_changes_nothing() -> None:
    truth = scene()
    for config in (STEREO, TOF):
        got = synthesis.with_noise(truth, NOTHING, config, np.random.default_rng(0))
        np.testing.assert_allclose(got, truth, rtol=1e-6)
        drawn = synthesis.draw_noise(np.random.default_rng(1), 0.0)
        assert drawn == NOTHING


def test_each_kind_of_noise_does_its_own() -> None:
    truth = scene()

    def made(config: SynthesisConfig = STEREO, **kinds: float) -> np.ndarray:
        return synthesis.with_noise(
            truth, synthesis.Noise(**{**vars(NOTHING), **kinds}), config, np.random.default_rng(4)
        )

    known = truth > 0
    flat = np.zeros_like(known)
    flat[40:70, 60:80] = True
    for name in ("white_px", "blocky_px"):
        # Of disparity, so depth errs with z squared over focal length times baseline.
        got = made(**{name: 0.1})
        assert got[flat].std() == pytest.approx(0.1 * 0.7**2 / 8, rel=0.25)
        assert made(TOF, **{name: 0.1})[flat].std() == pytest.approx(0.001, rel=0.25)
    steps = 8 / made(step_px=1 / 4)[known] * 4
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-4)
    got = made(shift_px=0.5)
    assert np.isin(got[known & (got > 0)], truth).all()
    assert (got != truth).any()
    got = made(blotches=0.05)
    assert 0.02 < (got[known] == 0).mean() < 0.08
    got = made(speckle=0.02)
    assert 0.005 < (np.abs(got - truth) > 0.01)[known].mean() < 0.04
    got = made(widen_px=8)
    changed = got < truth - 0.01
    assert 50 < changed.sum() < 2000
    assert not changed[:, 0:40].any()
    got = made(thin_px=6)
    assert (got[20:25, 120] > 1).all()
    assert (got[flat] == truth[flat]).all()
    got = made(flying=0.5)
    between = (got > 0.75) & (got < 1.1)
    assert 5 < between.sum() < 200


def test_synthesis_is_seeded_and_keeps_what_is_unknown(monkeypatch: pytest.MonkeyPatch) -> None:
    truth = scene()
    relative = 3 / np.maximum(truth, 0.5) + 0.05 * np.random.default_rng(1).standard_normal(truth.shape)
    holes = np.zeros(truth.shape)
    holes[30:80, 50:90] = 0.9
    monkeypatch.setattr(synthesis, "ANCHORS_SIDE", 12)
    of_depth = 0.3 * truth + 0.02 * np.random.default_rng(2).standard_normal(truth.shape)
    for config, rel in ((STEREO, relative), (TOF, of_depth)):
        kinds = set()
        for seed in range(6):
            one, two = (synthesis.synthesise(truth, config, np.random.default_rng(seed), rel, holes) for _ in range(2))
            np.testing.assert_array_equal(one, two)
            assert one.dtype == np.float32
            assert np.isfinite(one).all()
            assert one.min() >= 0
            assert (one[30:80, 50:90] == 0).mean() > 0.5
            both = (one > 0) & (truth > 0)
            assert both.mean() > 0.3
            assert np.median(np.abs(one[both] - truth[both])) < 0.15
            kinds.add(float(one.sum()))
        assert len(kinds) == 6
    with pytest.raises(LabError, match="sensor"):
        synthesis.synthesise(truth, SynthesisConfig(), np.random.default_rng(0))
    with pytest.raises(LabError, match="within 0"):
        synthesis.hole_mask(holes + 0.2, np.random.default_rng(0))
    with pytest.raises(LabError, match="for a truth of"):
        for seed in range(9):
            synthesis.value_noise(truth, relative[1:], True, np.random.default_rng(seed))


def test_value_noise_is_true_unfiltered_or_filtered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(synthesis, "ANCHORS_SIDE", 10)
    truth = np.maximum(scene(), 0.5)
    relative = 1 / truth + 0.02 * np.random.default_rng(1).standard_normal(truth.shape)
    noisy = unscale(relative, truth, True, 10)
    found = [synthesis.value_noise(truth, relative, True, np.random.default_rng(seed)) for seed in range(60)]
    true = sum(np.array_equal(f, truth) for f in found)
    unfiltered = sum(np.array_equal(f, noisy) for f in found)
    assert 1 <= true <= 14
    assert 1 <= unfiltered <= 14
    # A filtered image lies nearer to the truth than what it was filtered along.
    errors = [np.abs(f - truth).mean() for f in found if not np.array_equal(f, truth) and not np.array_equal(f, noisy)]
    assert max(errors) <= np.abs(noisy - truth).mean() * 1.01
    assert synthesis.value_noise(truth, None, True, np.random.default_rng(0)) is truth
