"""Derivatives of observations by central differences."""

from __future__ import annotations

import numpy as np

from smartnav_graph.core.so3 import exp
from smartnav_graph.factors.observation import Observation


def random_rotations(rng: np.random.Generator, m: int) -> np.ndarray:
    """Attitudes (m, 3, 3) all round."""
    return exp(rng.uniform(-3.0, 3.0, (m, 3)))


def assert_observation(observation: Observation, R, p, v, extra, data, *, step: float = 1e-6) -> None:
    """by_state and by_extra are the numerical derivatives, to a millionth of the largest element."""
    _, by_state, by_extra = observation.observe(R, p, v, extra, data)

    def moved(slot: int, axis: int, size: float):
        shift = size * np.eye(30)[axis]
        R1 = R @ exp(np.tile(shift[:3], (len(R), 1))) if slot == 0 else R
        p1, v1 = p + shift[:3] * (slot == 1), v + shift[:3] * (slot == 2)
        extra1 = [x + shift[: x.shape[1]] * (slot == 3 + i) for i, x in enumerate(extra)]
        return observation.observe(R1, p1, v1, extra1, data)[0]

    def derivative(slot: int, width: int) -> np.ndarray:
        return np.stack([(moved(slot, i, step) - moved(slot, i, -step)) / (2 * step) for i in range(width)], axis=-1)

    state = np.concatenate([derivative(slot, 3) for slot in range(3)], axis=2)
    np.testing.assert_allclose(by_state, state, atol=1e-6 * np.abs(state).max())
    assert len(by_extra) == len(extra)
    for i, (x, by) in enumerate(zip(extra, by_extra, strict=True)):
        found = derivative(3 + i, x.shape[1])
        np.testing.assert_allclose(by, found, atol=1e-6 * np.abs(found).max())


def assert_jacobians(model, states, data, *, step: float = 1e-6, rtol: float = 1e-6) -> None:
    """The Jacobians of a row model are the numerical ones on GTSAM's tangents, to `rtol` of the largest element."""
    _, jacobians = model.linearize(states, data)
    assert len(jacobians) == len(states) == len(model.letters)
    for slot, (letter, jacobian) in enumerate(zip(model.letters, jacobians, strict=True)):
        columns = []
        for axis in range(jacobian.shape[2]):
            ends = []
            for size in (step, -step):
                moved = list(states)
                moved[slot] = _retracted(letter, states[slot], size * np.eye(jacobian.shape[2])[axis])
                ends.append(model.linearize(moved, data)[0])
            columns.append((ends[0] - ends[1]) / (2 * step))
        numeric = np.stack(columns, axis=-1)
        np.testing.assert_allclose(jacobian, numeric, atol=rtol * np.abs(numeric).max(), err_msg=letter)


def _retracted(letter: str, states: np.ndarray, by: np.ndarray) -> np.ndarray:
    """Poses (m, 4, 4) or vectors (m, n) moved on their tangent: R <- R Exp(w), p <- p + R u."""
    if letter != "X":
        return states + by
    moved = states.copy()
    moved[:, :3, :3] = states[:, :3, :3] @ exp(np.tile(by[:3], (len(states), 1)))
    moved[:, :3, 3] += states[:, :3, :3] @ by[3:]
    return moved
