"""What one pass of the estimator leaves to the next."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core.arrays import Floats


@dataclass(frozen=True)
class PassState:
    """What one pass teaches the next.

    noise_scales : factor on the class-default sigma by group name
    rejected : rows not used, by sensor
    correlated : sensors whose errors are known to wander, and get a Gauss-Markov state
    held : session states that stay at a value (d,), by name
    stage : 0 has what finds the trajectory (fixes, standstills), 1 also what needs it found first (vehicle
    constraints, time offsets, magnetometer, steps)
    settled : passes that a builder has spent on judging what it is made of
    weights : of rows between 0 and 1 while the loss is graduated, by sensor; control : how far from convex it is, or in
    the robust phase the least sigma (m) that a fix has under the loss
    phase : ``plain`` (least squares), ``robust`` (a redescending loss finds outliers), ``graduated`` (truncated least
    squares by and by, where asked for), ``gated`` (least squares without outliers), ``causal`` (replay: least squares,
    a redescending loss where a fix contradicts the prediction)
    """

    noise_scales: Mapping[str, float] = field(default_factory=dict)
    rejected: Mapping[str, frozenset[int]] = field(default_factory=dict)
    correlated: frozenset[str] = frozenset()
    held: Mapping[str, Floats] = field(default_factory=dict)
    stage: int = 0
    phase: str = "plain"
    settled: Mapping[str, int] = field(default_factory=dict)
    weights: Mapping[str, Mapping[int, float]] = field(default_factory=dict)
    control: float = 0.0

    def weight(self, sensor: str, row: int) -> float:
        """Weight of a row while the loss is graduated, 1 otherwise."""
        return self.weights.get(sensor, {}).get(row, 1.0)

    @property
    def narrowing(self) -> bool:
        """Whether a loss is still wider than the noise."""
        return self.phase == "robust" and self.control > 0.0

    def scale(self, group: str) -> float:
        return self.noise_scales.get(group, 1.0)

    def used(self, sensor: str, rows: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Mask of the rows (m,) of a sensor that are not rejected."""
        return ~np.isin(rows, list(self.rejected.get(sensor, frozenset())))

    def is_rejected(self, sensor: str, row: int) -> bool:
        return row in self.rejected.get(sensor, frozenset())


LAST_STAGE = 1
