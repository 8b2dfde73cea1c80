"""Which geometry two images show: none (static), a rotation, a plane, or depth and a baseline.

The geometric robust information criterion weighs the misses of a model against the freedom it takes:

    GRIC = sum min(e^2, 2 (r - d)) + ln(r) d n + ln(r n) k,    r = 4 coordinates a match

with e^2 the squared miss in units of the noise, d the dimension of the model (3 coplanarity, 2 point transfer) and k
its unknowns. It is counted over the matches that any of the models explains: the others say nothing of the choice.

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
from smartnav_graph.vision.refine import GATE_SQUARE, Matched

COORDINATES = 4
UNKNOWNS = {"static": 0, "rotation": 3, "planar": 8, "general": 5}
RESIDUALS = {"static": 2, "rotation": 2, "planar": 2, "general": 1}  # r - d
# Displacements of a camera at rest are Rayleigh distributed: median 1.67 sigma, known to 1.2 sigma / sqrt(n).
STILL_MEDIAN, STILL_SPREAD, STILL_LEAST = 1.67, 3.6, 2.0
STILL_SHARE = 0.9
MOVED = {"planar", "general"}
STATED = 20.0  # matches that the sigma stated counts for


class Explained(NamedTuple):
    """How a model does: squared misses (m,) in sigmas, and the squared deviation from what was known beforehand."""

    square: Floats
    prior: float = 0.0


def stands_still(square: Floats) -> bool:
    """Do the points stay where they were: nearly all of them, and not displaced together by what noise leaves unseen?

    square (m,) : squared displacement, in units of 2 sigma^2
    """
    near = square < GATE_SQUARE[2]
    if near.mean() < STILL_SHARE:
        return False
    median = float(np.sqrt(2.0 * np.median(square[near])))
    return median < max(STILL_LEAST, STILL_MEDIAN + STILL_SPREAD / math.sqrt(int(near.sum())))


def noise(square: Floats) -> float:
    """Variance of the matches in units of the one they were given, from their misses (m,) of the general pose.

    A sigma stated too large would let a plane pass for depth, and one too small depth for a plane. What was stated
    counts like so many matches.
    """
    inliers = square[square < GATE_SQUARE[1]]
    return (float(inliers.sum()) + STATED) / (max(len(inliers) - UNKNOWNS["general"], 0) + STATED)


def gric(kind: str, explained: Explained, rows: NDArray[np.bool_], variance: float) -> float:
    """The criterion of one model over some of the matches; less is better."""
    n, codimension = int(rows.sum()), RESIDUALS[kind]
    missed = float(np.minimum(explained.square[rows] / variance, 2.0 * codimension).sum())
    freedom = math.log(COORDINATES) * (COORDINATES - codimension) * n
    return missed + freedom + math.log(COORDINATES * n) * UNKNOWNS[kind] + explained.prior


def choose(models: Mapping[str, Explained]) -> str:
    """The kind of geometry that explains most with least.

    Whether there is a baseline at all is judged by the sigma stated, unless the matches show more noise; a plane is
    told from depth by the noise that the matches show.
    """
    rows = np.any([told.square < GATE_SQUARE[RESIDUALS[kind]] for kind, told in models.items()], axis=0)
    if not rows.any():
        return "general"  # of which too few matches agree
    variance = noise(models["general"].square)
    moved = min(models.keys() & MOVED, key=lambda kind: gric(kind, models[kind], rows, variance))
    kinds = [moved, *sorted(models.keys() - MOVED)]
    return min(kinds, key=lambda kind: gric(kind, models[kind], rows, max(variance, 1.0)))


def by_chance(matched: Matched, agree: int, kind: str, sample: int) -> float:
    """Expected number of sets of so many agreeing matches, were all matches wrong and spread over the picture.

    (n - s) C(n, k) C(k, s) p^(k - s), for k of n matches that agree with what s of them fix; p is the share of the
    picture in which a match agrees: a band along a line, or an ellipse round a point.
    """
    n, k, sigma = len(matched.sigma), agree, float(np.median(matched.sigma))
    if k <= sample or n <= sample:
        return math.inf
    width, height = np.maximum(np.ptp(matched.xy1, axis=0), sigma)
    reach = math.sqrt(2.0 * GATE_SQUARE[RESIDUALS[kind]]) * sigma
    share = math.pi * reach**2 if RESIDUALS[kind] == 2 else 2.0 * reach * math.hypot(width, height)
    logarithm = math.log(n - sample) + math.log(math.comb(n, k)) + math.log(math.comb(k, sample))
    return math.exp(min(logarithm + (k - sample) * math.log(min(share / (width * height), 1.0)), 700.0))


def hardly_moves(square: Floats) -> bool:
    """Is nearly every point where it was, as far as it can tell by itself? square (m,) : see `stands_still`."""
    return bool((square < GATE_SQUARE[2]).sum() >= STILL_SHARE * max(len(square), 1))
