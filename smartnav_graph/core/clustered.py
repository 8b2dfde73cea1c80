"""Covariance of least squares where the errors of a group (a view, a block of time) are not independent.

    cov = s^2 S^-1,  S = sum_v S_v,  scores g_v = A_v' r_v

is raised to what the scatter of the scores between groups shows, each corrected for its leverage. With few groups that
is known on average only: f, its mean over all directions, is blended with the scatter of each.

Source: Bell, McCaffrey (2002), Bias reduction in standard errors for linear regression with multi-stage samples.
"""

from __future__ import annotations

import numpy as np

from smartnav_graph.core.arrays import Floats

_LEAST_REST = 0.05  # least share of the information that the other groups have


def clustered_covariance(information: Floats, scores: Floats, variance: float, prior: Floats | None = None) -> Floats:
    """Covariance (p, p), at least that of independent errors.

    information : S_v (v, p, p); scores : g_v (v, p), which sum to zero at the solution; variance : s^2 of independent
    errors; prior (p, p) : information beside the groups, over the variance
    """
    S = information.sum(axis=0) + (0.0 if prior is None else prior)
    inverse = np.linalg.inv(S)
    L = np.linalg.cholesky(0.5 * (inverse + inverse.T))
    M, (count, p) = np.zeros_like(L), scores.shape
    for S_v, g_v in zip(information, scores, strict=True):
        share, axes = np.linalg.eigh(L.T @ S_v @ L)
        u = axes @ ((axes.T @ (L.T @ g_v)) / np.sqrt(np.maximum(1.0 - share, _LEAST_REST)))
        M += np.outer(u, u) / variance
    known = L.T @ information.sum(axis=0) @ L
    f = max(1.0, float(np.trace(M) / max(np.trace(known), 1e-9)))
    own = (1.0 - 1.0 / f) * count / (count + p)
    values, axes = np.linalg.eigh((1.0 - own) * f * known + own * M + np.eye(p) - known)
    return np.asarray(variance * L @ (axes * np.maximum(values, 1.0)) @ axes.T @ L.T)
