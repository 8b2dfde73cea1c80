"""Redundancy of groups of factors: residuals of a group less what the solution fits of them.

    redundancy = sum over the factors of (m - tr(J P J^T))

J is the whitened Jacobian of m residuals, under the weight of its loss, and P the covariance of the solution: that of
the states of one factor is part of the joint covariance at its first keyframe, so that the sum is exact. Over all
factors, priors too, the redundancies add up to the number of residuals less that of unknowns.

Source: Foerstner, Wrobel (2016), Photogrammetric Computer Vision, 4.6.2 (redundancy numbers).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import gtsam
import numpy as np

from smartnav_graph.core.arrays import Floats
from smartnav_graph.graph.states import KEYFRAME_LETTERS, indices_of, key, kind_of
from smartnav_graph.graph.update import FactorId
from smartnav_graph.smoothers.estimate import Estimate, JointCovariance, joint_covariances
from smartnav_graph.smoothers.whole_graph import WholeGraph

# Source of the priors of the session's states (clock offsets, lever arms, mounts).
CALIBRATION = "calibration"


class Redundancy(NamedTuple):
    """Of the factors of one name: residuals (their number), fitted, the sum of tr(J P J^T) over them, and square, that
    of their whitened residuals, under the weight of their loss."""

    residuals: int
    fitted: float
    square: float


class FactorFit(NamedTuple):
    """Of one factor: whitened residual (m,), and fitted (m,), the diagonal of J P J^T."""

    factor: FactorId
    residual: Floats
    fitted: Floats


def redundancies(estimate: Estimate) -> Mapping[str, Redundancy]:
    """Redundancy by name of the factors' `FactorId`, and of the priors of the session states (`CALIBRATION`).

    Raises
    ------
    RuntimeError
        A keyframe is not determined.
    """
    total: dict[str, Floats] = {}
    for factor, residual, fitted in factor_fits(estimate):
        sums = np.array([len(residual), fitted.sum(), residual @ residual])
        total[factor.sensor] = total.get(factor.sensor, 0.0) + sums
    return {name: Redundancy(int(count), *rest) for name, (count, *rest) in total.items()}


# Fits of the estimates that are still in use: the last pass and the summary ask for the same ones.
_FITS: WeakKeyDictionary[Estimate, Sequence[FactorFit]] = WeakKeyDictionary()


def factor_fits(estimate: Estimate) -> Sequence[FactorFit]:
    """The fit of every factor in use, in no particular order; found once for an estimate.

    Raises
    ------
    RuntimeError
        A keyframe is not determined.
    """
    if estimate not in _FITS:
        _FITS[estimate] = tuple(_factor_fits(estimate))
    return _FITS[estimate]


def _factor_fits(estimate: Estimate) -> Iterator[FactorFit]:
    names, linear = _linearized(estimate)
    session, groups = _states(linear, estimate)
    place = {name: row for row, group in enumerate(groups) for name in group}
    factors: dict[int, list[tuple[FactorId, Any]]] = {}
    for i, name in enumerate(names):
        factor = linear.at(i)
        if factor is not None and not factor.empty():
            first = min(place.get(state, len(groups)) for state in factor.keys())  # noqa: SIM118
            factors.setdefault(first, []).append((name, factor))
    order = gtsam.Ordering([*itertools.chain(*groups), *session])
    for row, joint in joint_covariances(linear.eliminateSequential(order, gtsam.EliminateQR), groups, session):
        if row in factors:
            yield from _fits(factors[row], joint)


def _fits(factors: Sequence[tuple[FactorId, Any]], joint: JointCovariance) -> Iterator[FactorFit]:
    """The fit of some factors; joint : of all their states."""
    parts = [factor.jacobian() for _, factor in factors]
    ends = list(itertools.accumulate(len(residual) for _, residual in parts))
    J = np.zeros((ends[-1], len(joint.covariance)))
    for (_, factor), (part, residual), end in zip(factors, parts, ends, strict=True):
        column = 0
        for state in factor.keys():  # noqa: SIM118
            at = joint.at[state]
            J[end - len(residual) : end, at] = part[:, column : column + at.stop - at.start]
            column += at.stop - at.start
    fitted = ((J @ joint.covariance) * J).sum(axis=1)
    for (name, _), (_, residual), end in zip(factors, parts, ends, strict=True):
        yield FactorFit(name, residual, fitted[end - len(residual) : end])


def _linearized(estimate: Estimate) -> tuple[list[FactorId], Any]:
    """Every factor in use, and the linear system (gtsam.GaussianFactorGraph) of them in that order."""
    priors = [
        gtsam.PriorFactorVector(state.key, state.prior_mean, gtsam.noiseModel.Diagonal.Sigmas(state.prior_sigma))
        for state in estimate.session.values()
        if not state.held
    ]
    graph = WholeGraph([*(factor for _, factor in estimate.factors), *priors], estimate.blocks, estimate.held)
    names = [factor for factor, _ in estimate.factors] + [FactorId(CALIBRATION, 0)] * len(priors)
    for stack in graph.stacks:
        sensor, used = stack.blocks[0].sensor, stack.used
        pairs = zip(stack.t_ns[used].tolist(), stack.rows[used].tolist(), strict=True)
        names += [FactorId(sensor, t_ns, row) for t_ns, row in pairs]
    return names, graph.linearize(estimate.values)


def _states(linear: Any, estimate: Estimate) -> tuple[list[int], list[list[int]]]:
    """Keys of the session states of a linear system, and of the states of each keyframe."""
    groups = {index: [key(letter, index) for letter in KEYFRAME_LETTERS] for index in estimate.indices}
    names = np.array(sorted(linear.keys()), dtype=np.uint64)
    session = []
    for name, index in zip(names.tolist(), indices_of(names).tolist(), strict=True):
        kind = kind_of(name)
        if kind.scope == "session":
            session.append(name)
        elif kind.scope == "chain":
            groups[index].append(name)
    return session, list(groups.values())
