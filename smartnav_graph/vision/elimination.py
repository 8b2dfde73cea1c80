"""Unknowns of one image pair, such as its baseline, eliminated from its normal equations; all pairs at once.

Source: Golub, Pereyra (1973), The differentiation of pseudo-inverses and nonlinear least squares problems whose
variables separate, SIAM J. Numerical Analysis 10(2).
"""

from __future__ import annotations

import numpy as np

from smartnav_graph.core.arrays import Floats


def eliminated(J: Floats, own: Floats, residual: Floats, weight: Floats, prior: Floats) -> tuple[Floats, Floats]:
    """Information (n, p, p) and scores (n, p) of common unknowns.

    J (n, k, p), own (n, k, q) : derivatives of residuals (n, k) by common unknowns and by those of each pair
    weight (n, k) ; prior (q, q) or (n, q, q) : information on those of a pair
    """
    weighted, weighted_own = J * weight[..., None], own * weight[..., None]
    B = np.swapaxes(weighted, 1, 2) @ own
    inner = np.swapaxes(weighted_own, 1, 2) @ own + prior
    carried = np.swapaxes(np.linalg.solve(inner, np.swapaxes(B, 1, 2)), 1, 2)
    information = np.swapaxes(weighted, 1, 2) @ J - carried @ np.swapaxes(B, 1, 2)
    own_score = np.einsum("nka,nk->na", weighted_own, residual)
    scores = np.einsum("nkp,nk->np", weighted, residual) - np.einsum("npa,na->np", carried, own_score)
    return information, -scores
