"""Matches tested by a turn that is known: outliers out, good ones in, and no pair that fits its own wrong motion."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smartnav_graph.vision.gating import INLIER_SIGMAS, gate
from smartnav_graph.vision.pairs import Pairs

SIGMA = 1.2e-3


def simulated(rng, pairs=60, count=40, outliers=0.3, baseline=0.4):
    R = Rotation.from_rotvec(rng.normal(0, 0.1, (pairs, 3))).as_matrix()
    t = rng.normal(0, 1, (pairs, 3))
    t *= baseline / np.linalg.norm(t, axis=1, keepdims=True)
    far = rng.uniform([-3, -2, 3], [3, 2, 9], (pairs, count, 3))
    near = (far - t[:, None]) @ R
    x0, x1 = (x[..., :2] / x[..., 2:] + rng.normal(0, SIGMA, (pairs, count, 2)) for x in (far, near))
    wrong = rng.random((pairs, count)) < outliers
    x1[wrong] = rng.uniform(-0.5, 0.5, (wrong.sum(), 2))
    images = np.stack([np.arange(pairs), np.arange(pairs) + 1], axis=1)
    stamps = np.arange(pairs + 1, dtype=np.int64) * 10**9
    flat = np.repeat(np.arange(pairs), count)
    return Pairs(stamps, images, x0.reshape(-1, 2), x1.reshape(-1, 2), flat), R, t, wrong


@pytest.fixture
def rng():
    return np.random.default_rng(5)


def test_outliers_leave_and_good_matches_stay(rng):
    pairs, R, t, wrong = simulated(rng)
    found = gate(pairs, R, np.full(len(pairs), SIGMA))
    assert found.inliers[~wrong].mean() > 0.98
    assert found.inliers[wrong].mean() < 0.10  # those that lie on their epipolar line by chance
    angle = np.degrees(np.arccos(np.abs((found.direction * t).sum(axis=1)) / 0.4))
    assert np.median(angle) < 1.0


def test_a_turn_that_is_wrong_leaves_few_matches(rng):
    pairs, R, _, _ = simulated(rng, outliers=0.0)
    off = R @ Rotation.from_rotvec([0.0, 0.0, 0.05]).as_matrix()
    found = gate(pairs, off, np.full(len(pairs), SIGMA))
    assert np.median(found.inliers.mean(axis=1)) < 0.5
    assert np.median(gate(pairs, R, np.full(len(pairs), SIGMA)).inliers.mean(axis=1)) > 0.98


def test_parallax_is_what_the_turn_does_not_explain(rng):
    still, R, _, _ = simulated(rng, outliers=0.0, baseline=1e-9)
    assert gate(still, R, np.full(len(still), SIGMA)).parallax.max() < 3 * SIGMA
    moved, R, _, _ = simulated(rng, outliers=0.0)
    assert np.median(gate(moved, R, np.full(len(moved), SIGMA)).parallax) > 0.03


def test_the_same_seed_gives_the_same_verdict(rng):
    pairs, R, _, _ = simulated(rng)
    one, other = (gate(pairs, R, np.full(len(pairs), SIGMA), seed=4).inliers for _ in range(2))
    np.testing.assert_array_equal(one, other)
    assert INLIER_SIGMAS > 2.0
