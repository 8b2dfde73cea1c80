"""Influence of all measurements on one keyframe: shares of its variance, shifts, and its sigma without a source."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix, diags_array, eye_array
from scipy.sparse.linalg import splu

from smartnav_graph.core.arrays import Floats, Mask, Times
from smartnav_graph.core.errors import SolverError
from smartnav_graph.evaluation.influence.factors import Influence
from smartnav_graph.factors import builder_of
from smartnav_graph.graph.states import KEYFRAME_LETTERS, STATES, indices_of, letters_of

# Without a source a component is not observable if its sigma grows by more than this factor.
LOST = 100.0
# Added to the scaled diagonal so that the factorisation of a system without one source does not stop.
RIDGE = 1e-13


@dataclass(frozen=True)
class Measurements:
    """Every factor of the graph: source (f,), t_ns (f,), row (f,), share (f, 15) of the variance of the keyframe and
    shift (f, 15) in sigmas; part (f,): ties beside the measurements of a source, such as of a correlated error."""

    source: NDArray[np.object_]
    t_ns: Times
    row: NDArray[np.int64]
    share: Floats
    shift: Floats
    part: Mask


@dataclass(frozen=True)
class KeyframeInfluence:
    """Influence on one keyframe. Fifteen components: rotation, position, velocity (nav axes), biases (body axes).

    place : row among the keyframes; covariance (15, 15) given all data
    sources : names of the s builders of the whole graph, and `CALIBRATION`
    share (s, 15) : of each component's variance, by source; at_keyframe (s, 15) : its part from factors that touch this
    keyframe and no other
    shift (s, 15) : how far each source moves the state against the others, in sigmas; touching (s,) : number of factors
    that touch the keyframe; shift_at_keyframe (s, 15) : their part of the shift; own (s, 15) : sigma of a component
    from these factors alone if all else were known, inf without information
    without (s, 15) : sigma without the source over sigma, inf beyond `LOST`
    """

    place: int
    covariance: Floats
    sources: Sequence[str]
    share: Floats
    at_keyframe: Floats
    shift: Floats
    touching: NDArray[np.int64]
    shift_at_keyframe: Floats
    own: Floats
    without: Floats
    measurements: Measurements

    @property
    def sigma(self) -> Floats:
        """One sigma (15,) of each component."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def influence_of_keyframe(influence: Influence, place: int) -> KeyframeInfluence:
    """Shares, shifts and sigmas without a source of the keyframe in row `place`.

    Raises
    ------
    SolverError
        The system does not determine that keyframe.
    """
    system = _LinearSystem(influence)
    index = int(influence.keyframes.index[place])
    columns, turn = system.columns(index), np.eye(15)
    turn[:3, :3] = turn[3:6, 3:6] = influence.keyframes.nav_R_body[place]  # from body to nav axes
    covariances = _determined(system, columns, index)
    covariance = turn @ covariances[columns] @ turn.T
    variance = np.diag(covariance)
    sigma, by_source, own = np.sqrt(variance), system.by_source, system.J[:, columns] @ turn.T
    without = np.array([system.sigma_without(s, columns, turn) for s in range(len(influence.sources))]) / sigma
    K = np.asarray(system.J @ covariances @ turn.T)
    shift = K * system.b[:, None] / sigma
    touching, alone = (mask[system.factor][:, None] for mask in system.touching(index))
    with np.errstate(divide="ignore"):
        own_sigma = 1.0 / np.sqrt(by_source @ own**2)
    return KeyframeInfluence(
        place=place,
        covariance=covariance,
        sources=influence.sources,
        share=by_source @ K**2 / variance,
        at_keyframe=by_source @ (K**2 * alone) / variance,
        shift=by_source @ shift,
        touching=np.bincount(system.source[system.touching(index)[0]], minlength=len(influence.sources)),
        shift_at_keyframe=by_source @ (shift * touching),
        own=own_sigma,
        without=np.where(without > LOST, np.inf, without),
        measurements=Measurements(
            source=np.array(influence.sources, dtype=object)[system.source],
            t_ns=np.concatenate([group.t_ns for group in influence.groups]),
            row=np.concatenate([group.row for group in influence.groups]),
            share=system.by_factor @ K**2 / variance,
            shift=system.by_factor @ shift,
            part=np.concatenate([np.full(len(g.t_ns), builder_of(g.sensor) != g.sensor) for g in influence.groups]),
        ),
    )


def _determined(system: _LinearSystem, columns: NDArray[np.int64], index: int) -> Floats:
    """Columns (n, 15) of the covariance, checked."""
    try:
        found = _covariances(system.J, columns, 0.0)
    except RuntimeError:  # exactly singular
        found = np.full((system.J.shape[1], 15), np.nan)
    variance = np.diag(found[columns])
    if not (np.isfinite(variance).all() and (variance > 0).all()):
        where = f"keyframe {index}"
        raise SolverError(where, "is not determined by the factors stored with the run", "a solvable graph")
    return found


class _LinearSystem:
    """The sparse rows J dx = b; `factor` (m,) is the factor of each row, `source` (f,) the source of each factor."""

    def __init__(self, influence: Influence) -> None:
        groups = influence.groups
        self.groups = groups
        self._first = _first_columns(np.unique(np.concatenate([group.keys.ravel() for group in groups])))
        parts, rows = [], 0
        for group in groups:
            g, m, width = group.augmented.shape
            row = np.broadcast_to(rows + np.arange(g * m).reshape(g, m, 1), (g, m, width - 1))
            column = np.broadcast_to(self._columns_of(group.keys)[:, None, :], row.shape)
            parts.append((group.augmented[:, :, :-1].ravel(), row.ravel(), column.ravel()))
            rows += g * m
        values, row, column = (np.concatenate(part) for part in zip(*parts, strict=True))
        self.J = csr_matrix((values, (row, column)), (rows, self._first[-1]))
        self.J.eliminate_zeros()
        self.b = np.concatenate([group.augmented[:, :, -1].ravel() for group in groups])
        counts = np.array([len(group.t_ns) for group in groups])
        heights = np.repeat([group.augmented.shape[1] for group in groups], counts)
        self.factor = np.repeat(np.arange(len(heights)), heights)
        self.source = np.repeat([influence.sources.index(builder_of(group.sensor)) for group in groups], counts)

    @cached_property
    def by_source(self) -> csr_matrix:
        """Sums rows (m, ...) by source."""
        return _summing(self.source[self.factor])

    @cached_property
    def by_factor(self) -> csr_matrix:
        """Sums rows (m, ...) by factor."""
        return _summing(self.factor)

    def _columns_of(self, names: NDArray[np.uint64]) -> NDArray[np.int64]:
        """Columns (g, width) of the states of factors of one shape, keys (g, k)."""
        sizes = [STATES[chr(letter)].dim for letter in letters_of(names[0])]
        first = np.array([self._first[name] for name in names.ravel().tolist()]).reshape(names.shape)
        return np.concatenate([first[:, [i]] + np.arange(size) for i, size in enumerate(sizes)], axis=1)

    def columns(self, index: int) -> NDArray[np.int64]:
        """The fifteen columns of a keyframe."""
        names = [(ord(letter) << 56) + index for letter in KEYFRAME_LETTERS]
        return np.asarray(self._columns_of(np.array([names], dtype=np.uint64))[0])

    def touching(self, index: int) -> tuple[Mask, Mask]:
        """Which factors (f,) touch a keyframe, and which of them no other."""
        touches, alone = [], []
        for group in self.groups:
            kind = letters_of(group.keys)
            shared = np.isin(kind, [ord(letter) for letter, state in STATES.items() if state.scope == "session"])
            at_keyframe = ~shared & (indices_of(group.keys) == index)
            touches.append((at_keyframe & np.isin(kind, [ord(letter) for letter in KEYFRAME_LETTERS])).any(axis=1))
            alone.append((at_keyframe | shared).all(axis=1))
        touched = np.concatenate(touches)
        return touched, touched & np.concatenate(alone)

    def sigma_without(self, source: int, columns: NDArray[np.int64], turn: Floats) -> Floats:
        """Sigma (15,) in nav axes without one source, inf where it is then not determined."""
        others = self.J[self.source[self.factor] != source]
        variance = np.diag(turn @ _covariances(others, columns, RIDGE)[columns] @ turn.T)
        return np.asarray(np.sqrt(np.where(np.isfinite(variance) & (variance > 0), variance, np.inf)))


def _first_columns(names: NDArray[np.uint64]) -> dict[int, int]:
    """First column of each state, keyframes in time order, then the session states; the number of columns at -1."""
    kind, index = letters_of(names), indices_of(names)
    shared = np.array([STATES[chr(letter)].scope == "session" for letter in kind])
    order = np.lexsort((kind, index, shared))
    starts = np.concatenate([[0], np.cumsum([STATES[chr(letter)].dim for letter in kind[order]])])
    return dict(zip([*names[order].tolist(), -1], starts.tolist(), strict=True))


def _summing(label: NDArray[np.intp]) -> csr_matrix:
    return csr_matrix((np.ones(len(label)), (label, np.arange(len(label)))))


def _covariances(J: csr_matrix, columns: NDArray[np.int64], ridge: float) -> Floats:
    """Columns of (J^T J)^-1 by Cholesky's LU of the normal equations with a diagonal of one, refined once.

    The time order of the states is a good elimination order of the chain.
    """
    square = np.asarray(J.multiply(J).sum(axis=0)).ravel()
    scale = 1.0 / np.sqrt(np.where(square > 0, square, 1.0))
    scaled = J @ diags_array(scale)
    normal = (scaled.T @ scaled + ridge * eye_array(J.shape[1])).tocsc()
    factor = splu(normal, permc_spec="NATURAL", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    wanted = np.zeros((J.shape[1], len(columns)))
    wanted[columns, np.arange(len(columns))] = scale[columns]
    found = factor.solve(wanted)
    found += factor.solve(wanted - scaled.T @ (scaled @ found))
    return np.asarray(found * scale[:, None])
