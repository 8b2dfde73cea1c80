from __future__ import annotations

import numpy as np
import pytest
from differences import average_nees_bounds, chi2_bounds

from smartnav_graph.evaluation.metrics import nees


def test_nees_is_the_squared_error_over_the_variance():
    values = nees([[2.0, 0.0, 0.0], [0.0, 3.0, 4.0]], np.stack([np.eye(3), np.diag([1.0, 9.0, 4.0])]))
    assert values == pytest.approx([4.0, 1.0 + 4.0])


def test_nees_uses_correlations():
    P = np.array([[[2.0, 1.0], [1.0, 2.0]]])
    assert nees([[1.0, 1.0]], P)[0] == pytest.approx(2.0 / 3.0)  # direction of the larger eigenvalue, 3


def test_bad_covariances_are_reported_as_nan():
    P = np.stack([np.eye(2), np.zeros((2, 2)), np.diag([1.0, -1.0]), np.full((2, 2), np.nan)])
    assert np.isnan(nees(np.ones((4, 2)), P)).tolist() == [False, True, True, True]


def test_published_chi_square_values():
    # Bar-Shalom, Li, Kirubarajan (2001), table 1.5.4-1: chi2_2 (0.025, 0.975) and chi2_3
    assert chi2_bounds(2) == pytest.approx((0.0506, 7.38), rel=2e-3)
    assert chi2_bounds(3) == pytest.approx((0.216, 9.35), rel=2e-3)
    # thirty runs of a three-dimensional block, 99.8 %
    assert average_nees_bounds(3, 30, 0.998) == pytest.approx((0.60 * 3, 1.52 * 3), rel=0.01)


@pytest.mark.parametrize(("scale", "inside"), [(1.0, True), (2.0, False), (0.5, False)])
def test_average_nees_separates_consistent_from_wrong_covariance(scale, inside):
    rng = np.random.default_rng(3)
    A = rng.normal(size=(3, 3))
    P = A @ A.T + 0.1 * np.eye(3)
    errors = rng.multivariate_normal(np.zeros(3), P, size=500)
    low, high = average_nees_bounds(3, 500, 0.998)
    average = nees(errors, np.broadcast_to(scale * P, (500, 3, 3))).mean()
    assert bool(low < average < high) is inside
