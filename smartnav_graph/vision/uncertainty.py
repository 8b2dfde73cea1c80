"""The covariance of a relative pose.

The information J^T J of a fit depends on the pose where it is evaluated, which is uncertain itself: near the epipole,
or with little parallax, it is too large at a wrong pose. So the covariance of a general pose is the mean over poses
around the fit, the symmetric points of its own covariance,

    C = 1/2n sum_k  information(x (+) +- sqrt(n) l_k)^-1,    sum_k l_k l_k^T = information(x)^-1,  n = 5

It holds up to a sigma of the direction of about 0.2 rad; beyond, a Gaussian on the tangent plane is a poor model.

If other poses x_j = x (+) d_j of covariance C_j and probability p_j explain the matches about as well, the result is
the second moment of all of them about the one taken,

    (1 - sum_j p_j) C + sum_j p_j (C_j + d_j d_j^T)

Source: Julier, Uhlmann (1997), A new extension of the Kalman filter to nonlinear systems (the symmetric points).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.so3 import exp
from smartnav_graph.vision.epipolar import sampson
from smartnav_graph.vision.refine import (
    MatchedPoints,
    PoseFit,
    RotationPrior,
    State,
    retract_direction,
    rotation_vector,
    tangent_basis,
)

UNKNOWNS = 5
LARGEST_CONDITION = 1e10  # of the scaled information: beyond it the pose is not determined


class Alternative(NamedTuple):
    """Another pose that explains the matches: c0_R_c1, c0_t_c1, their covariance (5, 5), and its cost (half the sum of
    squared residuals) less that of the pose taken."""

    R: Floats
    t: Floats
    covariance: Floats
    cost_difference: float


def covariance(kind: str, matched: MatchedPoints, fit: PoseFit, prior: RotationPrior | None) -> Floats | None:
    """Covariance (5, 5) of rotation and direction, infinite without a baseline; None if a combination of the
    unknowns is not determined."""
    found = inverse(fit.information)
    if found is not None and kind == "general":
        found = _mean_covariance(found, matched, fit, prior)
    if found is None:
        return None
    known = found[:UNKNOWNS, :UNKNOWNS]
    out = np.diag(np.full(UNKNOWNS, np.inf))
    out[: len(known), : len(known)] = known
    return out


def mixture_covariance(found: Floats, state: State, others: Sequence[Alternative]) -> Floats:
    """The second moment (5, 5) about a pose of covariance `found` (5, 5), of it and of other poses."""
    probability = probabilities(others)
    total = (1.0 - sum(probability)) * found
    for other, part in zip(others, probability, strict=True):
        difference = np.concatenate([rotation_vector(state[0].T @ other.R), _tangent_vector(state[1], other.t)])
        to_tangent = np.zeros((UNKNOWNS, UNKNOWNS))
        to_tangent[:3, :3], to_tangent[3:, 3:] = state[0].T @ other.R, _transported(state[1], other.t)
        total += part * (to_tangent @ other.covariance @ to_tangent.T + np.outer(difference, difference))
    return total


def _transported(t: Floats, other: Floats) -> Floats:
    """(2, 2) from the tangent plane of one direction to that of t, along the great circle between them."""
    axis, cosine = np.cross(other, t), float(other @ t)
    if cosine < -1.0 + 1e-9:
        return np.eye(2)
    across = np.cross(np.eye(3), axis).T  # [axis]x
    turn = np.eye(3) + across + across @ across / (1.0 + cosine)
    return np.asarray(tangent_basis(t).T @ turn @ tangent_basis(other))


def probabilities(others: Sequence[Alternative]) -> list[float]:
    """Probability of each, the pose taken being one more."""
    weights = [math.exp(min(-other.cost_difference, 50.0)) for other in others]
    return [weight / (1.0 + sum(weights)) for weight in weights]


def _tangent_vector(t: Floats, other: Floats) -> Floats:
    """Logarithm (2,) on the sphere: from the unit vector t to another, on the tangent plane of t."""
    across = tangent_basis(t).T @ other
    length = math.hypot(*across)
    return np.asarray(across / length * math.atan2(length, float(t @ other)) if length > 0 else across)


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


def _mean_covariance(found: Floats, matched: MatchedPoints, fit: PoseFit, prior: RotationPrior | None) -> Floats | None:
    """Mean covariance over the symmetric points of the covariance `found`."""
    R, t = fit.state
    spread, axes = np.linalg.eigh(found)
    points = (np.sqrt(UNKNOWNS * np.maximum(spread, 0.0)) * axes).T
    steps = np.concatenate([points, -points])
    turns = R @ exp(steps[:, :3])
    ways = np.stack([retract_direction(t, step[3:]) for step in steps])
    _, by_rotation, by_t = sampson(turns, ways, matched.xy0, matched.xy1)
    across = np.stack([tangent_basis(way) for way in ways])
    J = np.concatenate([by_rotation, by_t @ across], axis=2) / matched.sigma[:, None]
    information = J.transpose(0, 2, 1) @ J
    if prior is not None:
        information[:, :3, :3] += np.eye(3) / prior.sigma**2
    around = inverse(information)
    return None if around is None else np.asarray(around.mean(axis=0))
