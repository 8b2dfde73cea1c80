"""Errors that have no state: what the residuals of a solution say of them, and how far they move its states.

With whitened residuals r and Jacobian A of all factors at the solution, and the derivatives J of r by some errors x,

    information = J^T M J      score = -J^T M r      M = 1 - A (A^T A)^-1 A^T      change = -(A^T A)^-1 A^T J

so that information^-1 score is what one more iteration of least squares with x as states without priors finds, and
`change` x what it then moves the others by.

Source: Foerstner, Wrobel (2016), Photogrammetric Computer Vision, 4.6.4; Schmidt (1966), Advances in Control Systems 3.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import gtsam
import numpy as np
from scipy.sparse import csc_array
from scipy.sparse.linalg import SuperLU, splu

from smartnav_graph.core.arrays import Floats, Indices
from smartnav_graph.graph.states import KEYFRAME_LETTERS, dims_of, key, kind_of
from smartnav_graph.graph.update import FactorId
from smartnav_graph.smoothers.estimate import Estimate
from smartnav_graph.smoothers.redundancy import factor_ids
from smartnav_graph.smoothers.whole_graph import WholeGraph

# First row and derivatives (m,) of the residuals of some factors.
Derivatives = Sequence[tuple[int, Floats]]
# Errors that the states are solved for at once: a column of a long recording has megabytes.
BLOCK = 16


@dataclass(frozen=True)
class LinearPart:
    """A linear factor: its first row, and its derivatives (m, d) by state."""

    name: FactorId
    row: int
    by_state: Mapping[int, Floats]

    def pose(self) -> tuple[int, Floats] | None:
        """Index of its keyframe and derivatives (m, 3) by the position, body axes; None unless it has one pose."""
        found = [name for name in self.by_state if kind_of(name).letter == "X"]
        return (gtsam.symbolIndex(found[0]), self.by_state[found[0]][:, 3:6]) if len(found) == 1 else None


class Sensitivity(NamedTuple):
    """Of k errors: information (k, k), score (k,), power (k,), the information were all states known, and change (s, m)
    of all states by those asked for."""

    information: Floats
    score: Floats
    power: Floats
    change: Floats

    @property
    def left(self) -> Floats:
        """Share (k,) of the information on each error that the states leave."""
        return np.asarray(np.diag(self.information) / np.maximum(self.power, np.finfo(np.float64).tiny))


class LinearSystem:
    """Every factor in use of an estimate, linearised at it."""

    def __init__(self, estimate: Estimate) -> None:
        priors = [
            gtsam.PriorFactorVector(state.key, state.prior_mean, gtsam.noiseModel.Diagonal.Sigmas(state.prior_sigma))
            for state in estimate.session.values()
            if not state.held
        ]
        native = WholeGraph([*(factor for _, factor in estimate.factors), *priors], (), estimate.held)
        self._linear, self._estimate = native.linearize(estimate.values), estimate
        for stack in estimate.all_stacks:
            stack.add_to(self._linear, estimate.snapshot)

    def parts(self, sensors: Collection[str]) -> list[LinearPart]:
        """The factors of some sensors."""
        counts, found = self._estimate.marginals.counts, list[LinearPart]()
        first = (np.cumsum(counts) - counts).tolist()
        for i, name in enumerate(factor_ids(self._estimate)):
            factor = self._linear.at(i) if name.sensor in sensors else None
            if factor is None or factor.empty():
                continue
            states = list(factor.keys())
            ends = np.cumsum(dims_of(np.array(states, dtype=np.uint64)))[:-1]
            by_state = dict(zip(states, np.split(factor.jacobian()[0], ends, axis=1), strict=True))
            found.append(LinearPart(name, first[i], by_state))
        return found

    def at_poses(self, sensor: str) -> list[tuple[LinearPart, Floats, int]]:
        """Factors of a sensor on one pose: derivatives (m, 3) by its position, body axes, and row of its keyframe."""
        place = {index: k for k, index in enumerate(self._estimate.indices)}
        poses = [(part, part.pose()) for part in self.parts([sensor])]
        return [(part, pose[1], place[pose[0]]) for part, pose in poses if pose is not None]

    @cached_property
    def _matrices(self) -> tuple[csc_array, Floats]:
        i, j, value = self._linear.sparseJacobian_()
        whole = csc_array((value, (i.astype(np.intp) - 1, j.astype(np.intp) - 1)))
        return whole[:, :-1], whole[:, [-1]].toarray()[:, 0]

    @cached_property
    def _normal(self) -> SuperLU:
        """The normal equations, factorised."""
        A, _ = self._matrices
        return splu((A.T @ A).tocsc(), "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})

    def sensitivity(self, errors: Sequence[Derivatives], moving: Sequence[int] = ()) -> Sensitivity:
        """Of errors that these derivatives of the residuals have; the change of the states by those of `moving`."""
        (A, b), normal = self._matrices, self._normal
        rows = [np.arange(first, first + len(by)) for error in errors for first, by in error]
        columns = np.repeat(np.arange(len(errors)), [sum(len(by) for _, by in error) for error in errors])
        values = [by for error in errors for _, by in error]
        J = csc_array((np.concatenate(values), (np.concatenate(rows), columns)), shape=(len(b), len(errors)))
        cross, information = (A.T @ J).tocsc(), (J.T @ J).toarray()
        score = J.T @ b - cross.T @ normal.solve(A.T @ b)
        change, place = np.empty((A.shape[1], len(moving))), {k: i for i, k in enumerate(moving)}
        for first in range(0, len(errors), BLOCK):
            block = range(first, min(first + BLOCK, len(errors)))
            fitted = normal.solve(cross[:, [*block]].toarray())
            information[:, [*block]] -= cross.T @ fitted
            change[:, [place[k] for k in block if k in place]] = -fitted[:, [k - first for k in block if k in place]]
        return Sensitivity(information, score, np.asarray((J**2).sum(axis=0)), change)

    def keyframes(self, change: Floats) -> Floats:
        """Of the change (s, m) of all states that of the keyframes (n, 15, m), as `Estimate.covariance`."""
        names = np.sort(np.array(list(self._linear.keys()), dtype=np.uint64))
        ends = np.cumsum(dims_of(names))
        found = []
        for letter in KEYFRAME_LETTERS:
            keys = np.array([key(letter, index) for index in self._estimate.indices], dtype=np.uint64)
            first: Indices = np.append(0, ends)[np.searchsorted(names, keys)]
            found.append(change[first[:, None] + np.arange(kind_of(int(keys[0])).dim)])
        R = self._estimate.states()[0]
        rotation, position = R @ found[0][:, :3], R @ found[0][:, 3:]
        return np.concatenate([rotation, position, *found[1:]], axis=1)
