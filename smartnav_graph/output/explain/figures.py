"""What determined the state of one keyframe, in the quantities that people speak of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.timebase import NS, seconds_since
from smartnav_graph.evaluation.influence import CALIBRATION, Influence, KeyframeInfluence
from smartnav_graph.graph.solution import ACCEL_BIAS, GYRO_BIAS, POS, VEL
from smartnav_graph.output.run_folder import StoredRun

# About the vertical, among the fifteen components.
HEADING = 2
# A sigma that grows by this factor without a source rests on it.
RESTS = 10.0
# Sigmas that the pulls of a graph solved as one may miss to balance.
UNBALANCED = 0.05
STRONGEST = 5  # measurements told one by one
# Sources that no single row of a sensor stands for.
NO_ROWS = ("imu", "prior", CALIBRATION)


class Quantity(NamedTuple):
    """Components of the state that people speak of as one, and the factor to its unit."""

    name: str
    components: slice
    unit: str
    factor: float = 1.0


DEG = float(np.degrees(1.0))
QUANTITIES = (
    Quantity("east", slice(3, 4), "m"),
    Quantity("north", slice(4, 5), "m"),
    Quantity("up", slice(5, 6), "m"),
    Quantity("heading", slice(2, 3), "deg", DEG),
    Quantity("tilt", slice(0, 2), "deg", DEG),
    Quantity("velocity", VEL, "m/s"),
    Quantity("accelerometer bias", ACCEL_BIAS, "m/s²"),
    Quantity("gyroscope bias", GYRO_BIAS, "deg/s", DEG),
)
PLACE, LEVEL_PLACE = Quantity("position", POS, "m"), Quantity("position", slice(3, 5), "m")
HEIGHT, DIRECTION, TILT, VELOCITY = QUANTITIES[2:6]


@dataclass(frozen=True)
class Explanation:
    """Why the state of one keyframe is what it is.

    asked_ns : the instant asked for, None where the least certain one was looked for
    """

    run: StoredRun
    influence: Influence
    held: KeyframeInfluence
    asked_ns: int | None

    @property
    def t_ns(self) -> int:
        return int(self.influence.keyframes.t_ns[self.held.place])

    def to_dict(self) -> dict[str, Any]:
        """Every figure."""
        frames, place = self.influence.keyframes, self.held.place
        return {
            "asked_s": None if self.asked_ns is None else self.seconds(self.asked_ns),
            "t_s": self.seconds(self.t_ns),
            "keyframe": {"number": place + 1, "of": len(frames), "window": str(frames.kind[place])},
            "components": [self._component(quantity) for quantity in QUANTITIES],
            "pull_sigmas": {name: pulls(pull) for name, pull in zip(self.held.sources, self.held.pull, strict=True)},
            "balanced": self.balanced,
            "touching": self._touching(),
            "measurements": [self._measurement(i) for i in self.strongest()],
            "reach_s": {q.name: self.reach_s(q) for q in (PLACE, DIRECTION)},
        }

    def seconds(self, t_ns: int) -> float:
        """Seconds since the session's time zero."""
        return round(float(seconds_since(t_ns, self.run.solution.t0_ns)), 6)

    @property
    def balanced(self) -> bool:
        """Whether the pulls balance: the graph was solved as one."""
        return bool(np.abs(self.held.pull.sum(axis=0)).max() < UNBALANCED)

    def share(self, quantity: Quantity) -> Floats:
        """Share (s,) of each source in the variance of a quantity."""
        return self._mean(self.held.share, quantity)

    def here(self, quantity: Quantity) -> float:
        """Share of what touches this keyframe and no other."""
        return float(self._mean(self.held.here, quantity).sum())

    def _mean(self, by_component: Floats, quantity: Quantity) -> Floats:
        part, variance = quantity.components, self.held.sigma[quantity.components] ** 2
        return np.asarray(by_component[:, part] @ variance / variance.sum())

    def without(self, quantity: Quantity) -> Floats:
        """Factor (s,) on the sigma of a quantity without each source, inf where nothing determines it then."""
        part, variance = quantity.components, self.held.sigma[quantity.components] ** 2
        return np.asarray(np.sqrt(self.held.without[:, part] ** 2 @ variance / variance.sum()))

    def sigma(self, quantity: Quantity) -> float:
        """Sigma of a quantity in its unit: of several components the root of the sum of squares."""
        return float(np.linalg.norm(self.held.sigma[quantity.components])) * quantity.factor

    def reach_s(self, quantity: Quantity) -> float:
        """Seconds around the instant within which lies half of what the quantity's variance is made of."""
        share = self._mean(self.held.measurements.share, quantity)
        away = np.abs(self.held.measurements.t_ns - self.t_ns)
        order = np.argsort(away, kind="stable")
        half = int(np.searchsorted(np.cumsum(share[order]), 0.5 * share.sum()))
        return round(float(away[order[min(half, len(order) - 1)]]) / NS, 3)

    def strongest(self) -> list[int]:
        """Measurements that pull the position or the heading most, none of the inertial ones."""
        told = self.held.measurements
        pull = np.abs(told.pull[:, [3, 4, 5, HEADING]]).max(axis=1)
        pull[np.isin(told.source, NO_ROWS)] = 0.0
        order = np.argsort(-pull, kind="stable")[:STRONGEST]
        return [int(i) for i in order if pull[i] > 0.0]

    def _component(self, quantity: Quantity) -> dict[str, Any]:
        names, without = self.held.sources, self.without(quantity)
        return {
            "name": quantity.name,
            "unit": quantity.unit,
            "sigma": self.sigma(quantity),
            "share": dict(zip(names, self.share(quantity).tolist(), strict=True)),
            "measured_here": self.here(quantity),
            "sigma_factor_without": {n: finite(f) for n, f in zip(names, without, strict=True)},
            "rests_on": [n for n, f in zip(names, without, strict=True) if f > RESTS],
        }

    def _touching(self) -> list[dict[str, Any]]:
        found, h = [], self.held
        for i in np.flatnonzero(h.touching).tolist():
            own = {q.name: float(np.linalg.norm(h.own[i, q.components])) * q.factor for q in QUANTITIES}
            told = {"source": h.sources[i], "factors": int(h.touching[i]), "pull_sigmas": pulls(h.pull_here[i])}
            found.append(told | {"sigma_if_neighbours_were_known": {n: finite(s) for n, s in own.items()}})
        return found

    def _measurement(self, i: int) -> dict[str, Any]:
        m = self.held.measurements
        return {
            "source": str(m.source[i]),
            "t_s": self.seconds(int(m.t_ns[i])),
            "row": int(m.row[i]),
            "share_of_position": float(self._mean(m.share[i : i + 1], PLACE)[0]),
            "share_of_heading": float(m.share[i, HEADING]),
            "pull_sigmas": pulls(m.pull[i]),
        }


def pulls(sigmas: Floats) -> dict[str, float]:
    """A pull (15,) in the directions that people speak of."""
    told = {"east": sigmas[3], "north": sigmas[4], "up": sigmas[5], "heading_clockwise": -sigmas[HEADING]}
    return {name: float(value) for name, value in told.items()}


def finite(value: float) -> float | None:
    """A number, None for what has no bound."""
    return float(value) if np.isfinite(value) else None
