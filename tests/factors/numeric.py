"""Derivatives of observations by central differences."""

from __future__ import annotations

import numpy as np

from smartnav_graph.factors.observation import Observation, exp


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
