"""Native factors and blocks as one graph: linearised and summed together."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from smartnav_graph.graph import Block, RowModel, Step

Floats = NDArray[np.float64]


_jacobian_factor: Any = gtsam.JacobianFactor  # takes any number of (key, matrix) pairs; its stub knows three


class Stack:
    """All rows of one model."""

    def __init__(self, model: RowModel, blocks: Sequence[Block]) -> None:
        self.model = model
        self.keys = [keys for block in blocks for keys in block.keys]
        self.data = np.concatenate([block.data for block in blocks])

    def _states(self, values: Any) -> list[Floats]:
        columns = zip(*self.keys, strict=True)
        return [
            np.array([values.atPose3(k).matrix() if letter == "X" else values.atVector(k) for k in column])
            for letter, column in zip(self.model.letters, columns, strict=True)
        ]

    def residuals(self, values: Any) -> Floats:
        """Whitened residuals (m, d)."""
        return self.model.linearize(self._states(values), self.data)[0]

    def add_to(self, linear: Any, values: Any) -> None:
        """Append one JacobianFactor a row."""
        residual, jacobians = self.model.linearize(self._states(values), self.data)
        unit = gtsam.noiseModel.Unit.Create(residual.shape[1])
        for row, keys in enumerate(self.keys):
            terms: list[Any] = []
            for key, jacobian in zip(keys, jacobians, strict=True):
                terms += [key, jacobian[row]]
            linear.push_back(_jacobian_factor(*terms, -residual[row], unit))


class WholeGraph:
    """What `minimise` needs of a graph: `linearize` and `error`."""

    def __init__(self, steps: Iterable[Step]) -> None:
        self.native = gtsam.NonlinearFactorGraph()
        by_model: dict[int, list[Block]] = {}
        for step in steps:
            for _, factor in step.factors:
                self.native.push_back(factor)
            for block in step.blocks:
                by_model.setdefault(id(block.model), []).append(block)
        self.stacks = [Stack(blocks[0].model, blocks) for blocks in by_model.values()]

    def linearize(self, values: Any) -> Any:
        """The linear system (gtsam.GaussianFactorGraph) at `values`."""
        linear = self.native.linearize(values)
        for stack in self.stacks:
            stack.add_to(linear, values)
        return linear

    def error(self, values: Any) -> float:
        """Half the sum of weighted squares."""
        return float(self.native.error(values)) + sum(
            0.5 * float((s.residuals(values) ** 2).sum()) for s in self.stacks
        )


def custom_factor(block: Block, row: int) -> Any:
    """One row of a block as a gtsam.CustomFactor."""
    model, keys, data = block.model, block.keys[row], block.data[row : row + 1]

    def error(this: Any, values: Any, jacobians: list[Floats] | None) -> Floats:
        states = [
            (values.atPose3(k).matrix() if letter == "X" else values.atVector(k))[None]
            for letter, k in zip(model.letters, keys, strict=True)
        ]
        residual, found = model.linearize(states, data)
        if jacobians is not None:
            for i, jacobian in enumerate(found):
                jacobians[i] = np.asfortranarray(jacobian[0])
        return np.asarray(residual[0])

    dim = len(model.linearize([_zero(letter) for letter in model.letters], data)[0][0])
    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(dim), list(keys), error)


def _zero(letter: str) -> Floats:
    return np.eye(4)[None] if letter == "X" else np.zeros((1, 3))
