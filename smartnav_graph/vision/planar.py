"""The pose of two cameras that see a plane: from a homography, as coplanarity does not determine it well.

    x0 ~ H x1,  H = R + t m^T,  m . X1 = 1 on the plane (unit t: lengths in units of the baseline)

Source: Faugeras, Lustman (1988), Motion and structure from motion in a piecewise planar environment (through OpenCV's
decomposition); Malis, Vargas (2007), INRIA RR-6303, for the two poses that remain.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core.arrays import Floats
from smartnav_graph.vision.epipolar import rays
from smartnav_graph.vision.ransac import pixels_a_unit, usac
from smartnav_graph.vision.refine import (
    GATE_SQUARE,
    EpipolarModel,
    MatchedPoints,
    PlaneModel,
    PoseFit,
    RotationPrior,
    angle,
    refine,
    transfer,
)
from smartnav_graph.vision.uncertainty import UNKNOWNS, Alternative, inverse

LEAST_PLANAR = 6  # matches: eight unknowns and four residuals to test them
LEAST_SHARE_OF_PLANE = 0.8  # of the coplanar matches: with fewer on the plane GRIC prefers the general pose
DIFFERENT_ROTATION = 1e-3  # rad between two different poses
CLEARLY_BETTER = 9.0  # difference of squared residuals, 3 sigmas


class PlanarFit(NamedTuple):
    """Pose with its plane; `others` explain the matches as well."""

    fit: PoseFit
    others: list[Alternative]


def fit_plane(
    matched: MatchedPoints, coplanar: NDArray[np.bool_], prior: RotationPrior | None, seed: int
) -> PlanarFit | None:
    """The pose (R, t, m) from a plane on which most of the `coplanar` (m,) matches lie; None without such a plane."""
    H = _homography(matched, seed)
    if H is None:
        return None
    residual, _ = transfer(H, matched)
    near = np.einsum("mk,mk->m", residual, residual) < GATE_SQUARE[2]
    if near[coplanar].sum() < LEAST_SHARE_OF_PLANE * coplanar.sum():
        return None
    fits = [refine(PlaneModel(matched), start, prior=prior) for start in _poses(H, matched)]
    return _best(fits, matched) if fits else None


def _homography(matched: MatchedPoints, seed: int) -> Floats | None:
    """H (3, 3) from the second image to the first, by OpenCV's MAGSAC++."""
    import cv2

    if len(matched.sigma) < LEAST_PLANAR:
        return None
    focal = pixels_a_unit(matched)
    H, _ = cv2.findHomography(focal * matched.xy1, focal * matched.xy0, usac(seed))
    if H is None or not np.isfinite(H).all():
        return None
    K = np.array([focal, focal, 1.0])
    return np.asarray(H * K / K[:, None])


def _poses(H: Floats, matched: MatchedPoints) -> list[tuple[Floats, Floats, Floats]]:
    """States (R, t, m) of H whose plane lies in front of the second camera for most of the matches on it."""
    import cv2

    residual, _ = transfer(H, matched)
    on_it = matched.only((residual**2).sum(axis=1) < GATE_SQUARE[2])
    found = []
    _, turns, shifts, normals = cv2.decomposeHomographyMat(H, np.eye(3))
    for R, shift, normal in zip(turns, shifts, normals, strict=True):
        length = float(np.linalg.norm(shift))
        if length > 0 and np.mean(rays(on_it.xy1) @ normal.ravel() > 0) > 0.5:
            found.append((np.asarray(R), shift.ravel() / length, length * normal.ravel()))
    return found


def _best(fits: list[PoseFit], matched: MatchedPoints) -> PlanarFit:
    """The pose of least cost, with the matches off the plane; of several about alike that of the smallest rotation."""
    costs = [2.0 * fit.cost + _off_plane(fit, matched) for fit in fits]
    alike = [(fit, cost) for fit, cost in zip(fits, costs, strict=True) if cost < min(costs) + CLEARLY_BETTER]
    best, least = min(alike, key=lambda one: angle(one[0].state[0]))
    others = []
    for fit, cost in alike:
        known = inverse(fit.information)
        if known is not None and angle(best.state[0].T @ fit.state[0]) > DIFFERENT_ROTATION:
            R, t, _ = fit.state
            others.append(Alternative(R, t, known[:UNKNOWNS, :UNKNOWNS], 0.5 * (cost - least)))
    return PlanarFit(best, others)


def _off_plane(fit: PoseFit, matched: MatchedPoints) -> float:
    """Truncated squared coplanarity residual of the matches off the plane."""
    r, _ = EpipolarModel(matched).rows(fit.state[:2])
    return float(np.minimum(r[:, 0] ** 2, GATE_SQUARE[1])[fit.square > GATE_SQUARE[2]].sum())
