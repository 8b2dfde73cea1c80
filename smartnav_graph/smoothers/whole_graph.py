"""Native factors and blocks as one graph: linearised and summed together."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from smartnav_graph.graph import STATES, Block, RowModel, SessionState, Step

Floats = NDArray[np.float64]
Held = Mapping[int, Floats]


HUBER = 1.345  # keeps 95 % efficiency on Gaussian residuals (Holland, Welsch 1977)


def value_of(values: Any, letter: str, name: int) -> Floats:
    """A state as an array: pose (4, 4), anything else (n,)."""
    if letter == "X":
        return np.asarray(values.atPose3(name).matrix())
    if letter == "B":
        return np.asarray(values.atConstantBias(name).vector())
    return np.asarray(values.atVector(name))


def loss_weights(square: Floats, loss: str) -> tuple[Floats, Floats]:
    """Weight (m,) and cost (m,) of rows with squared norm `square` (m,) under a loss: none, huber or cauchy(1)."""
    if loss == "none":
        return np.ones_like(square), 0.5 * square
    if loss == "cauchy":
        return 1.0 / (1.0 + square), 0.5 * np.log1p(square)
    norm = np.sqrt(np.maximum(square, 1e-300))
    outside = norm > HUBER
    return np.where(outside, HUBER / norm, 1.0), np.where(outside, HUBER * norm - 0.5 * HUBER**2, 0.5 * square)


class Stack:
    """All rows of one model under one loss; `blocks` gives each row's origin."""

    def __init__(self, model: RowModel, blocks: Sequence[Block], held: Held) -> None:
        self.model, self.blocks, self.held = model, blocks, held
        self.loss = blocks[0].loss
        self.keys = [keys for block in blocks for keys in block.keys]
        self.used = np.array([used for block in blocks for used in block.used], dtype=bool)
        self.data = np.concatenate([block.data for block in blocks])

    def _states(self, values: Any) -> list[Floats]:
        columns = zip(*self.keys, strict=True)
        return [
            np.array([self.held[k] if k in self.held else value_of(values, letter, k) for k in column])
            for letter, column in zip(self.model.letters, columns, strict=True)
        ]

    def linearize(self, values: Any) -> tuple[Floats, list[Floats]]:
        """Whitened residuals (m, d) of all rows, used or not, and their Jacobians, without the loss."""
        return self.model.linearize(self._states(values), self.data)

    def cost(self, values: Any) -> float:
        """Half the sum of squares of the used rows, under the loss."""
        residual = self.linearize(values)[0][self.used]
        return float(loss_weights((residual**2).sum(axis=1), self.loss)[1].sum())

    def add_to(self, linear: Any, values: Any) -> None:
        """Append one JacobianFactor a used row; held states and states that nothing depends on have no column."""
        residual, jacobians = self.linearize(values)
        root = np.sqrt(loss_weights((residual**2).sum(axis=1), self.loss)[0])
        residual = residual * root[:, None]
        columns = [(i, jacobian * root[:, None, None]) for i, jacobian in enumerate(jacobians) if jacobian.any()]
        unit = gtsam.noiseModel.Unit.Create(residual.shape[1])
        for row in np.flatnonzero(self.used):
            keys = self.keys[row]
            terms = [(keys[i], jacobian[row]) for i, jacobian in columns if keys[i] not in self.held]
            linear.push_back(jacobian_factor(terms, -residual[row], unit, values))


def jacobian_factor(terms: Sequence[tuple[int, Floats]], b: Floats, unit: Any, values: Any) -> Any:
    """sum A_i x_i = b as a gtsam.JacobianFactor. Its own constructor takes three terms at most; any number come out of
    a CustomFactor that is linearised (`values` must hold the keys, and are not looked at)."""
    if len(terms) <= 3:
        return gtsam.JacobianFactor(*(part for term in terms for part in term), b, unit)

    def known(this: Any, values: Any, jacobians: list[Floats] | None) -> Floats:
        if jacobians is not None:
            for i, (_, A) in enumerate(terms):
                jacobians[i] = np.asfortranarray(A)
        return -b

    return gtsam.CustomFactor(unit, [name for name, _ in terms], known).linearize(values)


def stacks_of(blocks: Iterable[Block], held: Held) -> list[Stack]:
    """Blocks joined by sensor, model and loss."""
    groups: dict[tuple[str, int, str], list[Block]] = {}
    for block in blocks:
        if block.keys:
            groups.setdefault((block.sensor, id(block.model), block.loss), []).append(block)
    return [Stack(group[0].model, group, held) for group in groups.values()]


class WholeGraph:
    """What `minimise` needs of a graph: `linearize` and `error`. Priors of its session states are part of it."""

    def __init__(self, steps: Iterable[Step]) -> None:
        self.native = gtsam.NonlinearFactorGraph()
        blocks: list[Block] = []
        held: dict[int, Floats] = {}
        self.session: dict[int, SessionState] = {}
        for step in steps:
            for _, factor in step.factors:
                self.native.push_back(factor)
            blocks += step.blocks
            held |= step.held
            self.session |= step.session
        for state in self.session.values():
            self.native.push_back(session_prior(state))
        self.stacks = stacks_of(blocks, held)

    def linearize(self, values: Any) -> Any:
        """The linear system (gtsam.GaussianFactorGraph) at `values`."""
        linear = self.native.linearize(values)
        for stack in self.stacks:
            stack.add_to(linear, values)
        return linear

    def error(self, values: Any) -> float:
        """Half the sum of weighted squares."""
        return float(self.native.error(values)) + sum(stack.cost(values) for stack in self.stacks)


def session_prior(state: SessionState) -> Any:
    """Prior factor of a session state."""
    return gtsam.PriorFactorVector(state.key, state.initial, gtsam.noiseModel.Diagonal.Sigmas(state.sigma))


def custom_factor(block: Block, row: int, held: Held) -> Any:
    """One row of a block as a gtsam.CustomFactor on the states that are not held."""
    model, keys, data = block.model, block.keys[row], block.data[row : row + 1]
    free = [i for i, k in enumerate(keys) if k not in held]

    def error(this: Any, values: Any, jacobians: list[Floats] | None) -> Floats:
        states = [
            (held[k] if k in held else value_of(values, letter, k))[None]
            for letter, k in zip(model.letters, keys, strict=True)
        ]
        residual, found = model.linearize(states, data)
        if jacobians is not None:
            for slot, i in enumerate(free):
                jacobians[slot] = np.asfortranarray(found[i][0])
        return np.asarray(residual[0])

    dim = len(model.linearize([_zero(letter) for letter in model.letters], data)[0][0])
    return gtsam.CustomFactor(_noise(dim, block.loss), [keys[i] for i in free], error)


def _noise(dim: int, loss: str) -> Any:
    unit, estimators = gtsam.noiseModel.Unit.Create(dim), gtsam.noiseModel.mEstimator
    if loss == "none":
        return unit
    estimator = estimators.Huber.Create(HUBER) if loss == "huber" else estimators.Cauchy.Create(1.0)
    return gtsam.noiseModel.Robust.Create(estimator, unit)


def _zero(letter: str) -> Floats:
    return np.eye(4)[None] if letter == "X" else np.zeros((1, STATES[letter].dim))
