"""Model selection for two images: static, rotation, plane, or general (depth and a baseline).

The geometric robust information criterion (GRIC) adds the residuals of a model and a penalty for its freedom:

    GRIC = sum min(e^2, 2 (r - d)) + ln(r) d n + ln(r n) k,    r = 4 coordinates a match

with e^2 the squared residual in units of the noise, d the dimension of the model (3 coplanarity, 2 point transfer) and
k its unknowns. The sum is over the matches that any of the models explains.

Source: Torr (1998), Geometric motion segmentation and model selection, Phil. Trans. R. Soc. A 356; Moisan, Stival
(2004), A probabilistic criterion to detect rigid point matches between two images, IJCV 57(3), for `by_chance`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core.arrays import Floats
from smartnav_graph.vision.refine import GATE_SQUARE, MatchedPoints

COORDINATES = 4
UNKNOWNS = {"static": 0, "rotation": 3, "planar": 8, "general": 5}
RESIDUALS = {"static": 2, "rotation": 2, "planar": 2, "general": 1}  # r - d
# Displacements of a camera at rest are Rayleigh distributed: median 1.67 sigma, known to 1.2 sigma / sqrt(n).
STATIC_MEDIAN, STATIC_SPREAD, STATIC_LEAST = 1.67, 3.6, 2.0
STATIC_SHARE = 0.9
MOVING = {"planar", "general"}
PRIOR_MATCHES = 20.0  # weight of the given sigma, in matches


class ModelFit(NamedTuple):
    """Fit of one model: squared residuals (m,) in sigmas, and the squared deviation from the prior in sigmas."""

    square: Floats
    prior: float = 0.0


def is_static(square: Floats) -> bool:
    """Whether nearly all points do not move, and their median displacement is that of noise.

    square (m,) : squared displacement, in units of 2 sigma^2
    """
    near = square < GATE_SQUARE[2]
    if near.mean() < STATIC_SHARE:
        return False
    median = float(np.sqrt(2.0 * np.median(square[near])))
    return median < max(STATIC_LEAST, STATIC_MEDIAN + STATIC_SPREAD / math.sqrt(int(near.sum())))


def noise_variance(square: Floats) -> float:
    """Variance of the matches in units of the one they were given, from their residuals (m,) of the general pose.

    With too large a sigma a general scene is taken for a plane, with too small a sigma a plane for a general scene. The
    given sigma has the weight of `PRIOR_MATCHES` matches.
    """
    inliers = square[square < GATE_SQUARE[1]]
    return (float(inliers.sum()) + PRIOR_MATCHES) / (max(len(inliers) - UNKNOWNS["general"], 0) + PRIOR_MATCHES)


def gric(kind: str, explained: ModelFit, rows: NDArray[np.bool_], variance: float) -> float:
    """The criterion of one model over some of the matches; less is better."""
    n, codimension = int(rows.sum()), RESIDUALS[kind]
    residuals = float(np.minimum(explained.square[rows] / variance, 2.0 * codimension).sum())
    freedom = math.log(COORDINATES) * (COORDINATES - codimension) * n
    return residuals + freedom + math.log(COORDINATES * n) * UNKNOWNS[kind] + explained.prior


def select_model(models: Mapping[str, ModelFit]) -> str:
    """The kind of geometry of the smallest criterion.

    Plane and general pose are compared with the noise that the matches show; then with static and rotation, with the
    given sigma or that noise, whichever is larger.
    """
    rows = np.any([fit.square < GATE_SQUARE[RESIDUALS[kind]] for kind, fit in models.items()], axis=0)
    if not rows.any():
        return "general"  # of which too few matches agree
    variance = noise_variance(models["general"].square)
    moving = min(models.keys() & MOVING, key=lambda kind: gric(kind, models[kind], rows, variance))
    kinds = [moving, *sorted(models.keys() - MOVING)]
    return min(kinds, key=lambda kind: gric(kind, models[kind], rows, max(variance, 1.0)))


def by_chance(matched: MatchedPoints, agree: int, kind: str, sample: int) -> float:
    """Expected number of sets of so many agreeing matches, were all matches wrong and spread over the picture.

    (n - s) C(n, k) C(k, s) p^(k - s), for k of n matches that agree with a model determined by s of them; p is the
    share of the picture in which a match agrees: a band along a line, or an ellipse around a point.
    """
    n, k, sigma = len(matched.sigma), agree, float(np.median(matched.sigma))
    if k <= sample or n <= sample:
        return math.inf
    width, height = np.maximum(np.ptp(matched.xy1, axis=0), sigma)
    reach = math.sqrt(2.0 * GATE_SQUARE[RESIDUALS[kind]]) * sigma
    share = math.pi * reach**2 if RESIDUALS[kind] == 2 else 2.0 * reach * math.hypot(width, height)
    logarithm = math.log(n - sample) + math.log(math.comb(n, k)) + math.log(math.comb(k, sample))
    return math.exp(min(logarithm + (k - sample) * math.log(min(share / (width * height), 1.0)), 700.0))


def is_nearly_static(square: Floats) -> bool:
    """Whether nearly all points do not move beyond their noise; square (m,) : see `is_static`."""
    return bool((square < GATE_SQUARE[2]).sum() >= STATIC_SHARE * max(len(square), 1))
