"""The covariance of a relative pose.

The information J^T J of a fit holds where it is evaluated, and that place is itself uncertain: near the epipole, or
with little parallax, a fit that happens to err claims to know more than one that does not. So the covariance of a
general pose is the mean over the poses around the fit that are as probable as the fit's own covariance says,

    C = 1/2n sum_k  information(x (+) +- sqrt(n) l_k)^-1,    sum_k l_k l_k^T = information(x)^-1,  n = 5

It is honest where the direction is known to about 0.2 rad; beyond, no Gaussian on a tangent plane tells the truth.

Where other poses x_j = x (+) d_j of covariance C_j explain the matches about as well, with a share p_j of the
probability, what is told is the second moment of them all about the one that was taken,

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
from smartnav_graph.vision.refine import Fit, Matched, RotationPrior, State, rotation_vector, shifted, tangent_basis

UNKNOWNS = 5
LARGEST_CONDITION = 1e10  # of the scaled information: more is a direction the matches leave open


class Other(NamedTuple):
    """Another pose that explains the matches: c0_R_c1, c0_t_c1, their covariance (5, 5), and by how much of the cost
    (half the squared misses) it is behind the one taken; negative where it is ahead."""

    R: Floats
    t: Floats
    covariance: Floats
    behind: float


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


def shared(found: Floats, state: State, others: Sequence[Other]) -> Floats:
    """The second moment (5, 5) about a pose of covariance `found` (5, 5), of it and of other poses."""
    share = shares(others)
    total = (1.0 - sum(share)) * found
    for other, part in zip(others, share, strict=True):
        apart = np.concatenate([rotation_vector(state[0].T @ other.R), _away(state[1], other.t)])
        here = np.zeros((UNKNOWNS, UNKNOWNS))
        here[:3, :3], here[3:, 3:] = state[0].T @ other.R, _carried(state[1], other.t)
        total += part * (here @ other.covariance @ here.T + np.outer(apart, apart))
    return total


def _carried(t: Floats, other: Floats) -> Floats:
    """(2, 2) from the tangent plane of one direction to that of t, along the great circle between them."""
    axis, cosine = np.cross(other, t), float(other @ t)
    if cosine < -1.0 + 1e-9:
        return np.eye(2)
    across = np.cross(np.eye(3), axis).T  # [axis]x
    turn = np.eye(3) + across + across @ across / (1.0 + cosine)
    return np.asarray(tangent_basis(t).T @ turn @ tangent_basis(other))


def shares(others: Sequence[Other]) -> list[float]:
    """Probability of each, next to the one taken."""
    weights = [math.exp(min(-other.behind, 50.0)) for other in others]
    return [weight / (1.0 + sum(weights)) for weight in weights]


def _away(t: Floats, other: Floats) -> Floats:
    """Direction from the unit vector t to another, as long (2,) as the angle between them, on the tangent plane."""
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


def _around(found: Floats, matched: Matched, fit: Fit, prior: RotationPrior | None) -> Floats | None:
    """Mean covariance over the symmetric points of the covariance `found`."""
    R, t = fit.state
    spread, axes = np.linalg.eigh(found)
    points = (np.sqrt(UNKNOWNS * np.maximum(spread, 0.0)) * axes).T
    steps = np.concatenate([points, -points])
    turns = R @ exp(steps[:, :3])
    ways = np.stack([shifted(t, step[3:]) for step in steps])
    _, by_turn, by_t = sampson(turns, ways, matched.xy0, matched.xy1)
    across = np.stack([tangent_basis(way) for way in ways])
    J = np.concatenate([by_turn, by_t @ across], axis=2) / matched.sigma[:, None]
    information = J.transpose(0, 2, 1) @ J
    if prior is not None:
        information[:, :3, :3] += np.eye(3) / prior.sigma**2
    around = inverse(information)
    return None if around is None else np.asarray(around.mean(axis=0))
