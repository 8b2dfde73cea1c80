"""Graduated non-convexity: the weights of a surrogate that turns from convex to truncated."""

from __future__ import annotations

import numpy as np
import pytest

from smartnav_graph.graph import gnc

SQUARES = np.array([0.0, 0.5, 3.0, 8.0, 20.0, 400.0, 1e4])
LIMIT = 9.0


def test_weights_are_the_derivative_of_the_surrogate():
    """Yang et al. (2020), eq. 12: rho = r^2 below, 2 c |r| sqrt(mu (mu + 1)) - mu (c^2 + r^2) between, c^2 above;
    the weight of r is rho' / (2 r)."""
    mu, r = 0.7, np.linspace(0.05, 8.0, 400)

    def rho(r: np.ndarray) -> np.ndarray:
        low, high = mu / (mu + 1) * LIMIT, (mu + 1) / mu * LIMIT
        middle = 2 * np.sqrt(LIMIT * mu * (mu + 1)) * r - mu * (LIMIT + r**2)
        return np.where(r**2 <= low, r**2, np.where(r**2 >= high, LIMIT, middle))

    slope = (rho(r + 1e-6) - rho(r - 1e-6)) / 2e-6 / (2 * r)
    np.testing.assert_allclose(gnc.weights(r**2, LIMIT, mu), slope, atol=1e-4)


def test_it_begins_with_hardly_any_difference_and_ends_truncated():
    begin = gnc.weights(SQUARES, LIMIT, gnc.first_mu(SQUARES, LIMIT))
    assert (np.diff(begin) <= 0).all() and begin[-1] > 0  # every row still pulls
    end = gnc.weights(SQUARES, LIMIT, 1e6)
    assert gnc.converged(end) and end.round().tolist() == [1, 1, 1, 1, 0, 0, 0]
    assert gnc.weights(SQUARES, LIMIT, np.inf).tolist() == [1, 1, 1, 1, 0, 0, 0]


def test_where_no_row_is_near_the_limit_it_is_least_squares_at_once():
    small = np.array([0.1, 4.0])
    assert gnc.first_mu(small, LIMIT) == np.inf and gnc.first_mu(np.zeros(0), LIMIT) == np.inf
    assert gnc.weights(small, LIMIT, np.inf).tolist() == [1.0, 1.0]


def test_the_cost_is_truncated():
    assert gnc.truncated(SQUARES, LIMIT) == pytest.approx(0.5 * (0.5 + 3 + 8 + 9 + 9 + 9))


@pytest.mark.parametrize("seed", range(20))
def test_a_line_through_half_outliers_is_found(seed):
    rng = np.random.default_rng(seed)
    x = np.linspace(-1, 1, 40)
    y = 3.0 * x + 1.0 + 0.1 * rng.standard_normal(40)
    bad = rng.permutation(40)[:18]
    y[bad] += rng.uniform(5, 40, 18) * rng.choice([-1, 1], 18)
    A, limit, weight, mu = np.stack([x, np.ones(40)], axis=-1), 9.0, np.ones(40), None
    for _ in range(60):
        root = np.sqrt(weight)
        fit = np.linalg.lstsq(A * root[:, None], y * root, rcond=None)[0]
        square = ((y - A @ fit) / 0.1) ** 2
        mu = gnc.first_mu(square, limit) if mu is None else 1.4 * mu
        weight = gnc.weights(square, limit, mu)
    np.testing.assert_allclose(fit, [3.0, 1.0], atol=0.15)
    assert set(np.flatnonzero(weight < 0.5)) >= set(bad)
