"""What one pass of the estimator leaves to the next."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core.arrays import Floats, Mask


class Phase(Enum):
    """How a pass treats outliers among the fixes.

    PLAIN : least squares; ROBUST : a redescending loss finds outliers; GRADUATED : graduated non-convexity (GNC), where
    configured; GATED : least squares without the outliers; CAUSAL : replay, least squares, with a redescending loss
    where a fix is inconsistent with its prediction
    """

    PLAIN = "plain"
    ROBUST = "robust"
    GRADUATED = "graduated"
    GATED = "gated"
    CAUSAL = "causal"


# Stage 0 has what finds the trajectory (fixes, standstills), stage 1 also what needs it found first (vehicle
# constraints, time offsets, magnetometer, steps).
LAST_STAGE = 1
# What a replay may look at before its first output, s.
INITIALISATION_S = 30.0


@dataclass(frozen=True)
class PassState:
    """What one pass leaves to the next.

    noise_scales : factor on the default sigma by group name
    rejected : rows not used, by sensor
    correlated : sensors with a Gauss-Markov state for their correlated errors
    fixed_states : session states fixed at a value (d,), by name
    aligned_states : value (d,) and sigma of session states that the alignment found, by name
    stage : a builder takes part from its own `stage` on
    phase : treatment of outliers
    selections : what a builder of images selected of its measurements, by its name
    outlier_tests : how often image pairs and tracks were tested against a solution, by builder
    weights, gnc_mu : weights of rows between 0 and 1 by sensor, and the control parameter mu of GNC
    trusted : rows of fixes that outlier tests may no longer reject, by sensor
    robust_floor_m : least sigma (m) of a fix under the redescending loss
    refuted : first stamp of the standstills in which the solution moves
    """

    noise_scales: Mapping[str, float] = field(default_factory=dict)
    rejected: Mapping[str, frozenset[int]] = field(default_factory=dict)
    correlated: frozenset[str] = frozenset()
    fixed_states: Mapping[str, Floats] = field(default_factory=dict)
    aligned_states: Mapping[str, tuple[Floats, float]] = field(default_factory=dict)
    stage: int = 0
    phase: Phase = Phase.PLAIN
    selections: Mapping[str, object] = field(default_factory=dict)
    outlier_tests: Mapping[str, int] = field(default_factory=dict)
    weights: Mapping[str, Mapping[int, float]] = field(default_factory=dict)
    gnc_mu: float = 0.0
    robust_floor_m: float = 0.0
    trusted: Mapping[str, frozenset[int]] = field(default_factory=dict)
    refuted: frozenset[int] = frozenset()

    def weight(self, sensor: str, row: int) -> float:
        """Weight of a row under GNC, 1 otherwise."""
        return self.weights.get(sensor, {}).get(row, 1.0)

    @property
    def narrowing(self) -> bool:
        """Whether the redescending loss is still wider than the noise."""
        return self.phase is Phase.ROBUST and self.robust_floor_m > 0.0

    @property
    def causal(self) -> bool:
        """Whether this is a replay."""
        return self.phase is Phase.CAUSAL

    def scale(self, group: str) -> float:
        """Factor on the default sigma of a group."""
        return self.noise_scales.get(group, 1.0)

    def tests(self, builder: str) -> int:
        """How often the image pairs or tracks of a builder were tested against a solution."""
        return self.outlier_tests.get(builder, 0)

    def used(self, sensor: str, rows: NDArray[np.intp]) -> Mask:
        """Mask of the rows (m,) of a sensor that are not rejected."""
        return ~np.isin(rows, list(self.rejected.get(sensor, frozenset())))

    def is_rejected(self, sensor: str, row: int) -> bool:
        """Whether a row of a sensor is rejected."""
        return row in self.rejected.get(sensor, frozenset())


Value = TypeVar("Value")


class PerPass(Generic[Value]):
    """What a builder computed of a pass state alone, kept as long as it is asked for the same one."""

    def __init__(self) -> None:
        self._kept: tuple[PassState, Value] | None = None

    def of(self, pass_state: PassState, compute: Callable[[PassState], Value]) -> Value:
        """The value of a pass state, computed the first time."""
        if self._kept is None or self._kept[0] is not pass_state:
            self._kept = pass_state, compute(pass_state)
        return self._kept[1]
