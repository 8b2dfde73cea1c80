"""Truncated least squares by graduated non-convexity: sum min(r^2, c^2), reached through surrogates that start convex.

Of the squares r^2 of all rows and a control mu, the weights are

    w = 1 below mu / (mu + 1) c^2,   0 above (mu + 1) / mu c^2,   c sqrt(mu (mu + 1)) / r - mu between.

mu starts so small that the surrogate is convex, and grows until every weight is 0 or 1.

Source: Yang, Antonante, Tzoumas, Carlone (2020), Graduated non-convexity for robust spatial perception, IEEE RA-L 5(2),
eq. 12 to 15; Black, Rangarajan (1996), On the unification of line processes, outlier rejection and robust statistics.
"""

from __future__ import annotations

import numpy as np

from smartnav_graph.core.arrays import Floats


def first_mu(square: Floats, limit: float) -> float:
    """mu at which the surrogate is convex for squares (m,) and c^2 = `limit`; infinite where no row is near it."""
    largest = float(square.max(initial=0.0))
    return limit / (2.0 * largest - limit) if 2.0 * largest > limit else np.inf


def weights(square: Floats, limit: float, mu: float) -> Floats:
    """Weights (m,) of rows with squares (m,) for c^2 = `limit`; of an infinite mu they are 0 or 1."""
    if np.isinf(mu):
        return np.asarray((square <= limit).astype(np.float64))
    middle = np.sqrt(limit * mu * (mu + 1.0) / np.maximum(square, 1e-12 * limit)) - mu
    return np.asarray(np.clip(middle, 0.0, 1.0))


def converged(weight: Floats) -> bool:
    """Whether every weight is as good as 0 or 1."""
    return bool((np.minimum(weight, 1.0 - weight) < 0.01).all())


def truncated(square: Floats, limit: float) -> float:
    """The cost: half the sum of min(r^2, c^2)."""
    return 0.5 * float(np.minimum(square, limit).sum())
