"""Fixes left out one by one: how well the solution predicts each, and how well its neighbours alone do.

What the solution without a fix is off by follows from the redundancy of its residual r, r / redundancy, with nothing
solved again. Beside it are polynomials through the fixes around. Where these predict better, the other sensors spoil
what the fixes know. That holds where the errors of the fixes are white: lasting ones are predicted by neighbours, too.

Source: Foerstner, Wrobel (2016), Photogrammetric Computer Vision, 4.6.2.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.timebase import NS
from smartnav_graph.estimate.result.assemble import SolvedProblem
from smartnav_graph.estimate.reweight.outliers import position_builders
from smartnav_graph.session.detect.scatter import apart_from_before
from smartnav_graph.smoothers.redundancy import factor_fits

# Neighbours on each side and degree of the polynomials.
CURVES = ((1, 1), (2, 1), (2, 3), (5, 1), (5, 3))
# Redundancies below this are rounding.
LEAST_REDUNDANCY = 1e-4


class LeftOut(NamedTuple):
    """Horizontal errors (n,) m of predicting each fix of a sensor: by the solution, and by the better curve."""

    sensor: str
    solution: Floats
    curve: Floats

    @property
    def rms(self) -> tuple[float, float]:
        """Of the solution and of the curve, m."""
        return float(np.sqrt(np.mean(self.solution**2))), float(np.sqrt(np.mean(self.curve**2)))

    @property
    def sigmas(self) -> float:
        """How many standard deviations of their mean the squares of the solution are larger by."""
        larger = self.solution**2 - self.curve**2
        return float(larger.mean() / max(larger.std() / np.sqrt(len(larger)), 1e-12))


def left_out(solved: SolvedProblem, least: int) -> Iterator[LeftOut]:
    """Every sensor of positions whose scatter is white noise, with at least so many fixes in use that have neighbours
    on both sides."""
    fits = factor_fits(solved.estimate)
    for builder in position_builders(solved.problem.builders):
        found, scatter = solved.fixes[builder.name], builder.scatter[0]
        if scatter is None or not scatter.is_noise:
            continue
        order = np.flatnonzero(solved.pass_state.used(builder.name, found.rows))
        order = order[np.argsort(solved.estimate.t_ns[found.keyframe[order]], kind="stable")]
        position = builder.position[found.rows[order], :2]
        t = (solved.estimate.t_ns[found.keyframe[order]] - solved.estimate.t_ns[0]) / NS
        new = apart_from_before(t, position)
        order, position, t = order[new], position[new], t[new]
        redundancy = 1.0 - fits.of(builder.name, found.rows[order], 3)[:, :2]
        error = found.residual[order, :2] / np.maximum(redundancy, LEAST_REDUNDANCY)
        known = [curve_error(t, position, *curve) for curve in CURVES if len(t) >= least + 2 * curve[0]]
        compared = np.isfinite(error).all(axis=1) & np.isfinite([curve.sum(axis=1) for curve in known]).all(axis=0)
        if compared.sum() < least or not known:
            continue
        best = min(known, key=lambda curve: float((curve[compared] ** 2).sum()))
        yield LeftOut(builder.name, *(np.linalg.norm(one[compared], axis=1) for one in (error, best)))


def curve_error(t: Floats, position: Floats, neighbours: int, degree: int) -> Floats:
    """Each position (n, d) less the polynomial of this degree through so many before and after; NaN at the ends."""
    out = np.full(position.shape, np.nan)
    middle = np.arange(neighbours, len(t) - neighbours)
    around = middle[:, None] + np.array([k for k in range(-neighbours, neighbours + 1) if k])
    since = t[around] - t[middle, None]
    powers = (since / np.abs(since).max(axis=1, keepdims=True))[:, :, None] ** np.arange(degree + 1)
    weight = np.linalg.pinv(powers)[:, 0]
    out[middle] = position[middle] - np.einsum("nj,njd->nd", weight, position[around])
    return out
