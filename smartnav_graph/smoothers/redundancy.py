"""Redundancy of groups of factors: residuals of a group less what the solution fits of them.

    redundancy = sum over the factors of (m - tr(J P J^T))

J is the whitened Jacobian of m residuals, under the weight of its loss, and P the covariance of the solution: that of
the states of one factor is part of the joint covariance at its first keyframe, so that the sum is exact. Over all
factors, priors too, the redundancies add up to the number of residuals less that of unknowns.

Source: Foerstner, Wrobel (2016), Photogrammetric Computer Vision, 4.6.2 (redundancy numbers).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from smartnav_graph.core.arrays import Floats, Indices
from smartnav_graph.graph.update import FactorId
from smartnav_graph.smoothers.estimate import Estimate

# Source of the priors of the session's states (clock offsets, lever arms, mounts).
CALIBRATION = "calibration"


class Redundancy(NamedTuple):
    """Of the factors of one name: residuals (their number), fitted, the sum of tr(J P J^T) over them, and square, that
    of their whitened residuals, under the weight of their loss."""

    residuals: int
    fitted: float
    square: float


class FactorFits(NamedTuple):
    """Of the factors in use: sensor and row of their stream (f,), and their first residual (f,); of all residuals (r,),
    whitened, and fitted (r,), the diagonal of J P J^T."""

    sensor: Sequence[str]
    row: Indices
    first: Indices
    residual: Floats
    fitted: Floats

    def of(self, sensor: str, rows: Indices, width: int) -> Floats:
        """The fitted (m, width) of some rows of a sensor's stream, NaN where one is not in use."""
        at = {int(self.row[i]): i for i, name in enumerate(self.sensor) if name == sensor}
        found = np.full((len(rows), width), np.nan)
        used = [i for i, row in enumerate(rows.tolist()) if row in at]
        first = self.first[[at[int(rows[i])] for i in used]]
        found[used] = self.fitted[first[:, None] + np.arange(width)]
        return found


def redundancies(estimate: Estimate) -> Mapping[str, Redundancy]:
    """Redundancy by name of the factors' `FactorId`, and of the priors of the session states (`CALIBRATION`)."""
    fits, names = factor_fits(estimate), dict[str, int]()
    kinds = np.array([names.setdefault(name, len(names)) for name in fits.sensor], dtype=np.intp)
    of_row = np.repeat(kinds, np.diff(np.append(fits.first, len(fits.residual))))
    sums = [np.bincount(of_row, weights, len(names)) for weights in (None, fits.fitted, fits.residual**2)]
    return {name: Redundancy(*(part[kind] for part in sums)) for name, kind in names.items()}


def factor_fits(estimate: Estimate) -> FactorFits:
    """The fit of every factor in use, in the order of the graph."""
    names, marginals = factor_ids(estimate), estimate.marginals
    rows = np.array([name.row for name in names], dtype=np.intp)
    first = np.cumsum(marginals.counts) - marginals.counts
    return FactorFits([name.sensor for name in names], rows, first, marginals.residual, marginals.fitted)


def factor_ids(estimate: Estimate) -> list[FactorId]:
    """Every factor in use, in the order of the graph."""
    names = [name for name, _ in estimate.factors]
    names += [FactorId(CALIBRATION, 0)] * sum(not state.held for state in estimate.session.values())
    for stack in estimate.all_stacks:
        pairs = zip(stack.t_ns[stack.used].tolist(), stack.rows[stack.used].tolist(), strict=True)
        names += [FactorId(stack.sensor, t_ns, row) for t_ns, row in pairs]
    return names
