"""Native factors and blocks as one graph: linearised and summed together."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property

import gtsam
import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core.arrays import Floats, Indices
from smartnav_graph.graph.robust import loss_weights, robust
from smartnav_graph.graph.states import STATES, SessionState, letters_of
from smartnav_graph.graph.update import FactorBatch, GraphUpdate, Measured, RowModel

FixedStates = Mapping[int, Floats]


def value_of(values: gtsam.Values, letter: str, name: int) -> Floats:
    """A state as an array: pose (4, 4), anything else (n,)."""
    if letter == "X":
        return np.asarray(values.atPose3(name).matrix())
    if letter == "B":
        return np.asarray(values.atConstantBias(name).vector())
    return np.asarray(values.atVector(name))


class Snapshot:
    """States of gtsam.Values as arrays, all of a kind fetched at once; held states at their constants. What stacks are
    linearised to there is kept: a candidate whose cost was found is what the next step is taken from."""

    def __init__(self, values: gtsam.Values, held: FixedStates) -> None:
        self.values, self.held = values, held
        self._kinds: dict[str, tuple[NDArray[np.uint64], Floats]] = {}
        self._linear: dict[int, tuple[Floats, list[Floats]]] = {}

    def column(self, letter: str, names: NDArray[np.uint64]) -> Floats:
        """States (m, ...) of one kind, all free or all held."""
        if int(names[0]) in self.held:
            return np.array([self.held[name] for name in names.tolist()])
        if letter not in self._kinds:
            self._kinds[letter] = self._of_kind(letter)
        known, states = self._kinds[letter]
        return np.asarray(states[np.searchsorted(known, names)])

    @cached_property
    def _names(self) -> NDArray[np.uint64]:
        return np.array(self.values.keys(), dtype=np.uint64)

    def _of_kind(self, letter: str) -> tuple[NDArray[np.uint64], Floats]:
        """Keys and values of all states of a kind, sorted by key."""
        names = self._names[letters_of(self._names) == ord(letter)]
        if letter == "X":
            rows = gtsam.utilities.extractPose3(self.values)  # rotation by rows, position
            poses = np.tile(np.eye(4), (len(names), 1, 1))
            poses[:, :3, :3], poses[:, :3, 3] = rows[:, :9].reshape(-1, 3, 3), rows[:, 9:]
            return names, poses
        if letter == "B":
            return names, np.array([value_of(self.values, letter, name) for name in names.tolist()])
        return names, np.asarray(gtsam.utilities.extractVectors(self.values, letter))

    def linearized(self, stack: StackedFactors) -> tuple[Floats, list[Floats]]:
        """Residuals and Jacobians of a stack."""
        if id(stack) not in self._linear:
            self._linear[id(stack)] = stack.model.linearize(stack.states(self), stack.data)
        return self._linear[id(stack)]


class StackedFactors:
    """All rows of one model under one loss; `blocks` gives each row's origin."""

    def __init__(self, model: RowModel, blocks: Sequence[FactorBatch], held: FixedStates) -> None:
        self.model, self.blocks, self.held = model, blocks, held
        self.sensor = blocks[0].sensor
        self.loss = blocks[0].loss
        self.keys = [keys for block in blocks for keys in block.keys]
        self._names = np.array(self.keys, dtype=np.uint64)
        self.loss_scale = np.repeat([block.loss_scale for block in blocks], [len(block.keys) for block in blocks])
        self.used = np.array([used for block in blocks for used in block.used], dtype=bool)
        self.data = np.concatenate([block.data for block in blocks])

    @cached_property
    def t_ns(self) -> NDArray[np.int64]:
        """Time (m,) of each row."""
        return np.array([block.t_ns for block in self.blocks for _ in block.keys], dtype=np.int64)

    @cached_property
    def rows(self) -> NDArray[np.intp]:
        """Row (m,) of the stream behind each, -1 where there is none."""
        return np.array([row for block in self.blocks for row in block.rows], dtype=np.intp)

    def weight(self, residual: Floats) -> Floats:
        """Weight (m,) of the loss on whitened residuals (m, d)."""
        return loss_weights((residual**2).sum(axis=1), self.loss, self.loss_scale, residual.shape[1])[0]

    def linearize(self, values: gtsam.Values | Snapshot) -> tuple[Floats, list[Floats]]:
        """Whitened residuals (m, d) of all rows, used or not, and their Jacobians, without the loss.

        values : gtsam.Values, or a `Snapshot` that stacks share
        """
        return self._snapshot(values).linearized(self)

    def _snapshot(self, values: gtsam.Values | Snapshot) -> Snapshot:
        return values if isinstance(values, Snapshot) else Snapshot(values, self.held)

    def states(self, snapshot: Snapshot) -> list[Floats]:
        """The states (m, ...) of the rows, one array a letter of the model."""
        columns = zip(self.model.letters, self._names.T, strict=True)
        return [snapshot.column(letter, names) for letter, names in columns]

    def measured(self, values: gtsam.Values | Snapshot) -> Measured:
        """Every measurement by itself: the rows, or the measurements they combine."""
        if hasattr(self.model, "measured"):
            found: Measured = self.model.measured(self.states(self._snapshot(values)), self.data)
            return found._replace(used=found.used & self.used[found.row])
        white, _ = self.linearize(values)
        return Measured(np.arange(len(white)), white, self.weight(white), self.used)

    def sizes(self, values: gtsam.Values | Snapshot) -> Floats:
        """Norm (m,) of each whitened row; of one that combines many measurements, their median."""
        found = self.measured(values)
        norm = np.linalg.norm(found.white, axis=1)
        if len(norm) == len(self.keys):
            return np.asarray(norm)
        return np.array([np.median(norm[found.row == row]) for row in range(len(self.keys))])

    def cost(self, values: gtsam.Values | Snapshot) -> float:
        """Half the sum of squares of the used rows, under the loss."""
        residual = self.linearize(values)[0][self.used]
        square, dim = (residual**2).sum(axis=1), residual.shape[1]
        return float(loss_weights(square, self.loss, self.loss_scale[self.used], dim)[1].sum())

    def add_to(self, linear: gtsam.GaussianFactorGraph, values: gtsam.Values | Snapshot) -> None:
        """Append one linear factor a used row; held states and states that nothing depends on have no column."""
        residual, jacobians = self.linearize(values)
        root = np.sqrt(self.weight(residual))
        free = [i for i, jacobian in enumerate(jacobians) if self.keys[0][i] not in self.held and jacobian.any()]
        augmented = np.concatenate([*(jacobians[i] for i in free), -residual[:, :, None]], axis=2)
        augmented *= root[:, None, None]
        dims = [*(jacobians[i].shape[2] for i in free), 1]
        for row in np.flatnonzero(self.used):
            keys = self.keys[row]
            linear.push_back(linear_factor([keys[i] for i in free], dims, augmented[row]))


def linear_factor(keys: Sequence[int], dims: Sequence[int], augmented: Floats) -> gtsam.GaussianConditional:
    """sum A_i x_i = b from [A_1 ... A_n b] (d, sum of dims): a JacobianFactor of any number of terms.

    JacobianFactor's own constructor takes three terms at most. A GaussianConditional is a JacobianFactor, and GTSAM
    treats it as one where it is part of a graph: what it calls frontal does not matter there.
    """
    return gtsam.GaussianConditional(keys, 1, gtsam.VerticalBlockMatrix(dims, augmented))


def stacks_of(blocks: Iterable[FactorBatch], held: FixedStates) -> list[StackedFactors]:
    """Blocks joined by sensor, model, loss and which of their states are held."""
    groups: dict[tuple[str, int, str, tuple[bool, ...]], list[FactorBatch]] = {}
    for block in blocks:
        if block.keys:
            constant = tuple(name in held for name in block.keys[0])
            groups.setdefault((block.sensor, id(block.model), block.loss, constant), []).append(block)
    return [StackedFactors(group[0].model, group, held) for group in groups.values()]


class WholeGraph:
    """What `minimise` needs of a graph: `linearize` and `error`."""

    def __init__(
        self, factors: Iterable[gtsam.NonlinearFactor], blocks: Iterable[FactorBatch], held: FixedStates
    ) -> None:
        self.native = gtsam.NonlinearFactorGraph()
        for factor in factors:
            self.native.push_back(factor)
        self.held = held
        self.stacks = stacks_of(blocks, held)
        self._last: Snapshot | None = None

    @classmethod
    def of(cls, updates: Sequence[GraphUpdate]) -> WholeGraph:
        """Everything that updates add, with the priors of the session states they touch."""
        session = {name: state for update in updates for name, state in update.session.items()}
        held = {name: value for update in updates for name, value in update.held.items()}
        factors = [factor for update in updates for _, factor in update.factors]
        blocks = (block for update in updates for block in update.blocks)
        return cls([*factors, *map(session_prior, session.values())], blocks, held)

    def linearize(self, values: gtsam.Values) -> gtsam.GaussianFactorGraph:
        """The linear system (gtsam.GaussianFactorGraph) at `values`."""
        linear, snapshot = self.native.linearize(values), self._snapshot(values)
        for stack in self.stacks:
            stack.add_to(linear, snapshot)
        return linear

    def row_counts(self, linear: gtsam.GaussianFactorGraph) -> Indices:
        """Rows of each factor of `linear`, the linear system at some values."""
        counts = [self._native_rows(i, linear) for i in range(self.native.size())]
        for stack in self.stacks:
            width = linear.at(len(counts)).jacobian()[1].size if stack.used.any() else 0
            counts += [width] * int(stack.used.sum())
        return np.array(counts, dtype=np.intp)

    def _native_rows(self, place: int, linear: gtsam.GaussianFactorGraph) -> int:
        """Those of smart factors depend on what was eliminated from them."""
        factor = self.native.at(place)
        if isinstance(factor, gtsam.NoiseModelFactor):
            return int(factor.dim())
        system = linear.at(place)
        return 0 if system is None or system.empty() else int(system.jacobian()[1].size)

    def error(self, values: gtsam.Values) -> float:
        """Half the sum of weighted squares."""
        snapshot = self._snapshot(values)
        return float(self.native.error(values) + sum(stack.cost(snapshot) for stack in self.stacks))

    def _snapshot(self, values: gtsam.Values) -> Snapshot:
        """The snapshot of the same values used last, or a new one; values do not change in between."""
        if self._last is None or self._last.values is not values:
            self._last = Snapshot(values, self.held)
        return self._last


def session_prior(state: SessionState) -> gtsam.PriorFactorVector:
    """Prior factor of a session state."""
    return gtsam.PriorFactorVector(state.key, state.initial, gtsam.noiseModel.Diagonal.Sigmas(state.sigma))


# Components of a row of each model.
_SIZES: dict[RowModel, int] = {}


def custom_factor(block: FactorBatch, row: int, held: FixedStates) -> gtsam.CustomFactor:
    """One row of a block as a gtsam.CustomFactor on the states that are not held."""
    model, keys, data = block.model, block.keys[row], block.data[row : row + 1]
    free = [i for i, k in enumerate(keys) if k not in held]

    def error(this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Floats] | None) -> Floats:
        states = [
            (held[k] if k in held else value_of(values, letter, k))[None]
            for letter, k in zip(model.letters, keys, strict=True)
        ]
        residual, found = model.linearize(states, data)
        if jacobians is not None:
            for slot, i in enumerate(free):
                jacobians[slot] = np.asfortranarray(found[i][0])
        return np.asarray(residual[0])

    if model not in _SIZES:
        _SIZES[model] = len(model.linearize([_zero(letter) for letter in model.letters], data)[0][0])
    noise = robust(gtsam.noiseModel.Unit.Create(_SIZES[model]), block.loss, block.loss_scale)
    return gtsam.CustomFactor(noise, [keys[i] for i in free], error)


def _zero(letter: str) -> Floats:
    return np.eye(4)[None] if letter == "X" else np.zeros((1, STATES[letter].dim))
