"""The covariance of a relative pose.

The information J^T J of a fit holds where it is evaluated, and that place is itself uncertain: near the epipole, or
with little parallax, a fit that happens to err claims to know more than one that does not. So the covariance of a
general pose is the mean over the poses around the fit that are as probable as the fit's own covariance says,

    C = 1/2n sum_k  information(x (+) +- sqrt(n) l_k)^-1,    sum_k l_k l_k^T = information(x)^-1,  n = 5

It is honest where the direction is known to about 0.2 rad; beyond, no Gaussian on a tangent plane tells the truth.

Source: Julier, Uhlmann (1997), A new extension of the Kalman filter to nonlinear systems (the symmetric points).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from smartnav_graph.vision.epipolar import sampson
from smartnav_graph.vision.refine import Fit, Matched, RotationPrior, shifted, tangent_basis

Floats = NDArray[np.float64]

UNKNOWNS = 5
LARGEST_CONDITION = 1e10  # of the scaled information: more is a direction the matches leave open


def covariance(kind: str, matched: Matched, fit: Fit, prior: RotationPrior | None) -> Floats | None:
    """Covariance (5, 5) of rotation and direction, infinite where there is no baseline; None where a combination of
    the unknowns is open."""
    found = inverse(fit.information)
    if found is not None and kind == "general":
        found = _around(found, matched, fit, prior)
    if found is None:
        return None
    known = found[:UNKNOWNS, :UNKNOWNS]
    out = np.diag(np.full(UNKNOWNS, np.inf))
    out[: len(known), : len(known)] = known
    return out


def inverse(information: Floats) -> Floats | None:
    """Inverse (..., p, p) of information; None where it is singular."""
    scale = np.sqrt(np.einsum("...pp->...p", information))
    if not (scale > 0).all():
        return None
    outer = scale[..., :, None] * scale[..., None, :]
    values, vectors = np.linalg.eigh(information / outer)
    if not (values[..., 0] * LARGEST_CONDITION > values[..., -1]).all():
        return None
    return np.asarray((vectors / values[..., None, :]) @ np.swapaxes(vectors, -1, -2) / outer)


def _around(found: Floats, matched: Matched, fit: Fit, prior: RotationPrior | None) -> Floats | None:
    """Mean covariance over the symmetric points of the covariance `found`."""
    R, t = fit.state
    spread, axes = np.linalg.eigh(found)
    points = (np.sqrt(UNKNOWNS * np.maximum(spread, 0.0)) * axes).T
    steps = np.concatenate([points, -points])
    turns = R @ Rotation.from_rotvec(steps[:, :3]).as_matrix()
    ways = np.stack([shifted(t, step[3:]) for step in steps])
    _, by_turn, by_t = sampson(turns, ways, matched.xy0, matched.xy1)
    across = np.stack([tangent_basis(way) for way in ways])
    J = np.concatenate([by_turn, by_t @ across], axis=2) / matched.sigma[:, None]
    information = J.transpose(0, 2, 1) @ J
    if prior is not None:
        information[:, :3, :3] += np.eye(3) / prior.sigma**2
    around = inverse(information)
    return None if around is None else np.asarray(around.mean(axis=0))
