"""Covariance of a linear system, and what its solution fits of every residual.

Forward in time the states of each keyframe are eliminated by an orthogonal transformation: R x_k + S y = d, with y the
later states that share factors with x_k or with an earlier one. Backwards, with K = R^-1 S and a root L of P_y = L L^T,

    P of (x_k, y) = F F^T,    F = [R^-1  -K L; 0  L]

and a QR factorisation brings the rows of F that the keyframe before needs back to a square root. QR is exact where
states are weakly held, and this is stable where nothing holds the trajectory (a dead reckoning of minutes), where
GTSAM's shortcuts of the Bayes tree give up. Covariances themselves lose all digits on the way back where neighbouring
states are tied to each other 10^8 times better than to the world, as by images; their roots do not. The states of a
whitened row J of the system are among those of its first keyframe and their y, so that J P J^T is at hand there.

Source: Rauch, Tung, Striebel (1965), in square-root form (Bierman 1977, Factorization methods, ch. X).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from itertools import chain
from typing import NamedTuple

import gtsam
import numpy as np

from smartnav_graph.core.arrays import Floats, Indices, Mask
from smartnav_graph.graph.states import dims_of

# Rotation, position, velocity and biases of a keyframe.
_OWN = 15


class Marginals(NamedTuple):
    """Covariances on GTSAM's tangents: joint (n, 15, 15) of each keyframe, following (n - 1, 15, 15) of each with the
    next, session (s, s). Of the rows of the system: whitened residual (r,), and fitted (r,), the diagonal of J P J^T.
    """

    joint: Floats
    following: Floats
    session: Floats
    residual: Floats
    fitted: Floats


class _Columns:
    """The states in the order of their elimination, by groups: of each keyframe, then of the session.

    names : keys; starts : first column of each state; first, own : of each group, its first column and their number;
    group : of each column
    """

    def __init__(self, groups: Sequence[Sequence[int]]) -> None:
        self.names = np.fromiter(chain.from_iterable(groups), dtype=np.uint64)
        self.dims = dims_of(self.names)
        ends = np.concatenate([[0], np.cumsum(self.dims)])
        self.starts, bounds = ends[:-1], ends[np.cumsum([0, *map(len, groups)])]
        self.first, self.own = bounds[:-1], np.diff(bounds)
        self.group = np.repeat(np.arange(len(groups)), self.own)

    def of_keys(self) -> Indices:
        """Column here of each column in the order of the keys."""
        order = np.argsort(self.names)
        dims, start = self.dims[order], self.starts[order]
        return np.asarray(np.repeat(start - np.cumsum(dims) + dims, dims) + np.arange(len(self.group)))

    def fault(self, column: int) -> RuntimeError:
        """The complaint, in GTSAM's words, that the state of a column is not determined."""
        name = int(self.names[np.searchsorted(self.starts, column, side="right") - 1])
        return RuntimeError(f"(Symbol: {gtsam.Symbol(name).string()})")


class _Fronts:
    """Rows of a linear system by the first group of states that they touch, each as a matrix over the columns of that
    group, of the next group, and of `far` ones after it that something up to this group touches.

    width : number of the columns of each group's matrix; rows : numbers of the rows, sorted by group
    kept : of each group, the places in the next group's matrix of the columns behind its own
    """

    def __init__(self, linear: gtsam.GaussianFactorGraph, rows: int, columns: _Columns) -> None:
        names = linear.keys()
        if names.size() < len(columns.names):
            raise columns.fault(int(columns.starts[~np.isin(columns.names, list(names))][0]))
        i, j, value = linear.sparseJacobian_()  # numbered from 1, columns in the order of the keys, right side last
        row, column = i.astype(np.intp) - 1, j.astype(np.intp) - 1
        del i, j  # hundreds of megabytes of a long recording
        right = column == len(columns.group)
        self.residual = np.zeros(rows)
        self.residual[row[right]] = value[right]
        row, column, value = row[~right], columns.of_keys()[column[~right]], value[~right]
        touched = np.full(rows, len(columns.own) - 1)
        np.minimum.at(touched, row, columns.group[column])
        self.rows = np.argsort(touched, kind="stable")
        self._row_bounds = np.searchsorted(touched[self.rows], np.arange(len(columns.own) + 1))
        line = np.empty(rows, dtype=np.intp)
        line[self.rows] = np.arange(rows) - self._row_bounds[touched[self.rows]]
        group = touched[row]
        order = np.argsort(group, kind="stable")
        self._line, group, column, self._value = line[row[order]], group[order], column[order], value[order]
        self._entry_bounds = np.searchsorted(group, np.arange(len(columns.own) + 1))
        self._separate(columns, group, column)
        self._place = self._places(columns, group, column)

    def _separate(self, columns: _Columns, group: Indices, column: Indices) -> None:
        first_use = np.full(len(columns.group), len(columns.own))
        np.minimum.at(first_use, column, group)
        late = np.flatnonzero(first_use < columns.group - 1)
        use, after = first_use[late], np.append(columns.first[2:], [len(columns.group)] * 2)
        far = [late[(use <= k) & (late >= first)] for k, first in enumerate(after[: len(columns.own)])]
        sizes = np.array([len(part) for part in far])
        self._next = np.append(columns.own[1:], 0)
        self._far_start = np.cumsum(sizes) - sizes
        self.width = columns.own + self._next + sizes
        self._far = np.concatenate([k * len(columns.group) + part for k, part in enumerate(far)])
        at = self._places(columns, np.repeat(np.arange(1, len(far) + 1), sizes), np.concatenate(far))
        self.kept = [
            np.append(np.arange(size), part)
            for size, part in zip(self._next, np.split(at, self._far_start[1:]), strict=True)
        ]

    def _places(self, columns: _Columns, group: Indices, column: Indices) -> Indices:
        """Places of columns in the matrices of their groups."""
        place, near = column - columns.first[group], (columns.own + self._next)[group]
        far = np.flatnonzero(place >= near)
        at = np.searchsorted(self._far, group[far] * len(columns.group) + column[far])
        place[far] = near[far] + at - self._far_start[group[far]]
        return np.asarray(place)

    def matrix(self, group: int) -> Floats:
        """Rows of a group (q, width)."""
        entries = slice(*self._entry_bounds[group : group + 2])
        found = np.zeros((self._row_bounds[group + 1] - self._row_bounds[group], self.width[group]))
        found[self._line[entries], self._place[entries]] = self._value[entries]
        return found

    def numbers(self, group: int) -> Indices:
        """Numbers (q,) of the rows of a group."""
        return np.asarray(self.rows[self._row_bounds[group] : self._row_bounds[group + 1]])


@cache
def _upper(rows: int, columns: int) -> Mask:
    return np.triu(np.ones((rows, columns), dtype=bool))


def _eliminated(fronts: _Fronts, columns: _Columns) -> list[Floats]:
    """[R S] of each group of states, forward in time."""
    from scipy.linalg import lapack

    found, rest, kept = [], np.zeros((0, 0)), np.zeros(0, dtype=np.intp)
    for group, own in enumerate(columns.own):
        rows, front = len(rest), fronts.matrix(group)
        stacked = np.zeros((rows + len(front), fronts.width[group]), order="F")
        stacked[:rows, kept], stacked[rows:] = rest, front
        triangle = lapack.dgeqrf(stacked, overwrite_a=True)[0][: stacked.shape[1]]
        triangle = np.where(_upper(*triangle.shape), triangle, 0.0)
        found.append(triangle[:own])
        rest, kept = triangle[own:, own:], fronts.kept[group]
    return found


def _earlier(conditional: Floats, own: int, later: Floats, first: int, columns: _Columns) -> Floats:
    """Root F (own + k, own + k) of the covariance F F^T of a group of `own` states and of the k later ones that
    `conditional` [R S] ties it to; `later` (k, m) is a root of theirs.

    first : column of the group's first state, for the error where R is singular
    """
    from scipy.linalg import lapack

    if len(conditional) < own:
        raise columns.fault(first + len(conditional))
    inverse, fault = lapack.dtrtri(conditional[:, :own])
    if fault or not np.isfinite(inverse).all():
        raise columns.fault(first + max(fault - 1, 0))
    size = len(later)
    if size < later.shape[1]:
        triangle = lapack.dgeqrf(later.T)[0][:size]
        later = np.where(_upper(*triangle.shape), triangle, 0.0).T
    root = np.zeros((own + size, own + later.shape[1]))
    root[:own, :own], root[:own, own:] = inverse, -(inverse @ conditional[:, own:]) @ later
    root[own:, own:] = later
    return root


def marginals(
    linear: gtsam.GaussianFactorGraph, groups: Sequence[Sequence[int]], session: Sequence[int], rows: int
) -> Marginals:
    """Covariances and fits of a linear system (gtsam.GaussianFactorGraph) of so many rows.

    Parameters
    ----------
    groups : keys of the states of each keyframe, those of `KEYFRAME_LETTERS` first; session : of all others

    Raises
    ------
    RuntimeError
        A state is not determined.
    """
    columns, count = _Columns([*groups, session] if session else groups), len(groups)
    fronts = _Fronts(linear, rows, columns)
    conditionals = _eliminated(fronts, columns)
    joint, following = np.empty((count, _OWN, _OWN)), np.empty((max(count - 1, 0), _OWN, _OWN))
    fitted, root = np.zeros(rows), np.zeros((0, 0))
    session_covariance = root
    for group in reversed(range(len(conditionals))):
        own = int(columns.own[group])
        root = _earlier(conditionals[group], own, root[fronts.kept[group]], int(columns.first[group]), columns)
        if group < count:
            joint[group] = root[:_OWN] @ root[:_OWN].T
        else:
            session_covariance = root @ root.T
        if group < count - 1:
            following[group] = root[:_OWN] @ root[own : own + _OWN].T
        fitted[fronts.numbers(group)] = ((fronts.matrix(group) @ root) ** 2).sum(axis=1)
    return Marginals(joint, following, session_covariance, fronts.residual, fitted)
