"""Consistency of the covariance: normalised estimation error squared (NEES).

Source: Bar-Shalom, Li, Kirubarajan (2001), Estimation with Applications to Tracking and Navigation, section 5.4.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from smartnav_graph.core.arrays import Floats, Mask


def nees(errors: ArrayLike, covariances: ArrayLike) -> Floats:
    """Normalised estimation error squared, e^T P^-1 e, of every row.

    Expected value k (the dimension) where the covariance is right; a larger mean means that it is too small.

    Parameters
    ----------
    errors : (n, k)
    covariances : (n, k, k), same units squared

    Returns
    -------
    (n,) dimensionless; NaN where the covariance is not finite or not positive definite.
    """
    e = np.asarray(errors, dtype=np.float64)
    P = np.asarray(covariances, dtype=np.float64)
    out = np.full(len(e), np.nan)
    good: Mask = np.asarray(np.isfinite(P).all(axis=(1, 2)))
    # eigvalsh finds indefinite matrices without raising for the whole stack, as a Cholesky would
    good[good] = np.linalg.eigvalsh(P[good])[:, 0] > 0.0
    out[good] = np.einsum("ni,ni->n", e[good], np.linalg.solve(P[good], e[good][:, :, None])[:, :, 0])
    return out
