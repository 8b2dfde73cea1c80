"""Coplanarity: zero where rays meet, the distance to the curve otherwise, derivatives by differences."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smartnav_graph.vision.epipolar import essential, rays, sampson


@pytest.fixture
def pair(rng):
    R = Rotation.from_rotvec([0.1, -0.2, 0.05]).as_matrix()
    t = np.array([0.4, 0.1, -0.2])
    far = rng.uniform([-2, -2, 3], [2, 2, 8], (40, 3))
    near = (far - t) @ R  # X1 = R^T (X0 - t)
    return R, t, far[:, :2] / far[:, 2:], near[:, :2] / near[:, 2:]


@pytest.fixture
def rng():
    return np.random.default_rng(7)


def test_rays_of_one_point_and_the_baseline_are_coplanar(pair):
    R, t, x0, x1 = pair
    assert np.abs(sampson(R, t, x0, x1).residual).max() < 1e-15
    np.testing.assert_allclose(np.einsum("mi,ij,mj->m", rays(x0), essential(R, t), rays(x1)), 0.0, atol=1e-15)
    wrong = [(R.T, t), (R, R.T @ t), (R, t * [1, 1, -1]), (R, t[[1, 0, 2]])]
    assert all(np.median(np.abs(sampson(*pose, x0, x1).residual)) > 0.001 for pose in wrong)


def test_residual_is_the_distance_to_matches_that_fit(pair, rng):
    """Nearest (x0, x1) on the epipolar constraint, found by Newton steps, is as far as the residual says."""
    R, t, x0, x1 = pair
    noisy = x0 + rng.normal(0, 1e-4, x0.shape), x1 + rng.normal(0, 1e-4, x1.shape)
    residual = sampson(R, t, *noisy).residual
    E = essential(R, t)
    fitted = np.column_stack(noisy)
    for _ in range(3):
        a, b = rays(fitted[:, :2]), rays(fitted[:, 2:])
        slope = np.column_stack([(b @ E.T)[:, :2], (a @ E)[:, :2]])
        miss = np.einsum("mi,ij,mj->m", a, E, b)
        fitted -= (miss / (slope**2).sum(axis=1))[:, None] * slope
    np.testing.assert_allclose(np.linalg.norm(fitted - np.column_stack(noisy), axis=1), np.abs(residual), atol=1e-8)


def test_length_of_the_baseline_does_not_matter_without_a_floor(pair, rng):
    R, t, x0, x1 = pair
    x1 = x1 + rng.normal(0, 0.01, x1.shape)
    np.testing.assert_allclose(sampson(R, 9.0 * t, x0, x1).residual, sampson(R, t, x0, x1).residual, atol=1e-15)


@pytest.mark.parametrize("floor", [0.0, 0.1])
def test_derivatives_are_exact(pair, rng, floor):
    R, t, x0, x1 = pair
    x1 = x1 + rng.normal(0, 0.02, x1.shape)
    found = sampson(R, t, x0, x1, floor)
    h = 1e-6
    for i, axis in enumerate(np.eye(3)):
        turned = [sampson(R @ Rotation.from_rotvec(s * h * axis).as_matrix(), t, x0, x1, floor)[0] for s in (1, -1)]
        moved = [sampson(R, t + s * h * axis, x0, x1, floor)[0] for s in (1, -1)]
        np.testing.assert_allclose(found.by_rotation[:, i], np.subtract(*turned) / (2 * h), atol=1e-8)
        np.testing.assert_allclose(found.by_translation[:, i], np.subtract(*moved) / (2 * h), atol=1e-8)


def test_no_baseline_says_nothing(pair):
    R, _, x0, x1 = pair
    for floor in (0.0, 0.01):
        found = sampson(R, np.zeros(3), x0, x1, floor)
        assert all(np.isfinite(part).all() for part in found) or floor == 0.0
        assert not found.residual.any()


def test_many_pairs_at_once(pair):
    R, t, x0, x1 = pair
    x1 = x1 + 0.01
    poses = np.array([R, R @ R]), np.array([t, -2.0 * t + 0.1])
    many = sampson(*poses, np.array([x0, x0]), np.array([x1, x1]))
    for i, one in enumerate(zip(*poses, strict=True)):
        for a, b in zip(many, sampson(*one, x0, x1), strict=True):
            np.testing.assert_allclose(a[i], b, atol=1e-14)
