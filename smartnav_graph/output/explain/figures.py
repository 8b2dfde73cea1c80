"""What determines the state of one keyframe: position, heading, tilt, velocity, biases."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.timebase import NS, seconds_since
from smartnav_graph.evaluation.influence import CALIBRATION, Influence, KeyframeInfluence
from smartnav_graph.graph.solution import ACCEL_BIAS, GYRO_BIAS, POS, VEL
from smartnav_graph.output.run_folder import StoredRun

# Rotation about the vertical, among the fifteen components.
YAW = 2
# A quantity depends on a source without which its sigma grows by more than this factor.
DEPENDS = 10.0
# The shifts of all sources add up to zero in a graph that was solved as a whole, to so many sigmas.
UNBALANCED = 0.05
STRONGEST = 5  # measurements listed one by one
# Sources without single rows of a sensor.
NO_ROWS = ("imu", "prior", CALIBRATION)


class Quantity(NamedTuple):
    """Components of the state that are reported together, and the factor to its unit."""

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
POSITION, HORIZONTAL = Quantity("position", POS, "m"), Quantity("position", slice(3, 5), "m")
UP, HEADING, TILT, VELOCITY = QUANTITIES[2:6]


@dataclass(frozen=True)
class Explanation:
    """What determines the state of one keyframe.

    asked_ns : the requested time, None for the largest horizontal sigma
    """

    run: StoredRun
    influence: Influence
    keyframe: KeyframeInfluence
    asked_ns: int | None

    @property
    def t_ns(self) -> int:
        """Stamp of the keyframe."""
        return int(self.influence.keyframes.t_ns[self.keyframe.place])

    def to_dict(self) -> dict[str, object]:
        """Every figure."""
        frames, place = self.influence.keyframes, self.keyframe.place
        return {
            "asked_s": None if self.asked_ns is None else self.seconds(self.asked_ns),
            "t_s": self.seconds(self.t_ns),
            "keyframe": {"number": place + 1, "of": len(frames), "window": str(frames.kind[place])},
            "components": [self._component(quantity) for quantity in QUANTITIES],
            "shift_sigmas": {
                name: shifts(shift) for name, shift in zip(self.keyframe.sources, self.keyframe.shift, strict=True)
            },
            "balanced": self.balanced,
            "touching": self._touching(),
            "measurements": [self._measurement(i) for i in self.strongest()],
            "half_within_s": {q.name: self.half_within_s(q) for q in (POSITION, HEADING)},
        }

    def seconds(self, t_ns: int) -> float:
        """Seconds since the session's time zero."""
        return round(float(seconds_since(t_ns, self.run.solution.t0_ns)), 6)

    @property
    def balanced(self) -> bool:
        """Whether the shifts add up to zero: the graph was solved as a whole."""
        return bool(np.abs(self.keyframe.shift.sum(axis=0)).max() < UNBALANCED)

    def share(self, quantity: Quantity) -> Floats:
        """Share (s,) of each source in the variance of a quantity."""
        return self._mean(self.keyframe.share, quantity)

    def measured_at_epoch(self, quantity: Quantity) -> float:
        """Share of the factors that touch this keyframe and no other."""
        return float(self._mean(self.keyframe.at_keyframe, quantity).sum())

    def _mean(self, by_component: Floats, quantity: Quantity) -> Floats:
        part, variance = quantity.components, self.keyframe.sigma[quantity.components] ** 2
        return np.asarray(by_component[:, part] @ variance / variance.sum())

    def without(self, quantity: Quantity) -> Floats:
        """Factor (s,) on the sigma of a quantity without each source, inf where it is not observable then."""
        part, variance = quantity.components, self.keyframe.sigma[quantity.components] ** 2
        return np.asarray(np.sqrt(self.keyframe.without[:, part] ** 2 @ variance / variance.sum()))

    def sigma(self, quantity: Quantity) -> float:
        """Sigma of a quantity in its unit: of several components the root of the sum of squares. Without the errors of
        sensors that are no states, which no measurement explains."""
        return float(np.linalg.norm(self.keyframe.sigma[quantity.components])) * quantity.factor

    def half_within_s(self, quantity: Quantity) -> float:
        """Seconds before and after the epoch from which half of the quantity's variance comes."""
        share = self._mean(self.keyframe.measurements.share, quantity)
        away = np.abs(self.keyframe.measurements.t_ns - self.t_ns)
        order = np.argsort(away, kind="stable")
        half = int(np.searchsorted(np.cumsum(share[order]), 0.5 * share.sum()))
        return round(float(away[order[min(half, len(order) - 1)]]) / NS, 3)

    def strongest(self) -> list[int]:
        """Measurements that shift the position or the heading most, without the inertial ones."""
        all_rows = self.keyframe.measurements
        shift = np.abs(all_rows.shift[:, [3, 4, 5, YAW]]).max(axis=1)
        shift[np.isin(all_rows.source, NO_ROWS) | all_rows.part] = 0.0
        order = np.argsort(-shift, kind="stable")[:STRONGEST]
        return [int(i) for i in order if shift[i] > 0.0]

    def _component(self, quantity: Quantity) -> dict[str, object]:
        names, without = self.keyframe.sources, self.without(quantity)
        return {
            "name": quantity.name,
            "unit": quantity.unit,
            "sigma": self.sigma(quantity),
            "share": dict(zip(names, self.share(quantity).tolist(), strict=True)),
            "share_at_epoch": self.measured_at_epoch(quantity),
            "sigma_factor_without": {n: finite(f) for n, f in zip(names, without, strict=True)},
            "depends_on": [n for n, f in zip(names, without, strict=True) if f > DEPENDS],
        }

    def _touching(self) -> list[dict[str, object]]:
        found: list[dict[str, object]] = []
        h = self.keyframe
        for i in np.flatnonzero(h.touching).tolist():
            own = {q.name: float(np.linalg.norm(h.own[i, q.components])) * q.factor for q in QUANTITIES}
            row = {
                "source": h.sources[i],
                "factors": int(h.touching[i]),
                "shift_sigmas": shifts(h.shift_at_keyframe[i]),
            }
            found.append(row | {"sigma_if_neighbours_were_known": {n: finite(s) for n, s in own.items()}})
        return found

    def _measurement(self, i: int) -> dict[str, object]:
        m = self.keyframe.measurements
        return {
            "source": str(m.source[i]),
            "t_s": self.seconds(int(m.t_ns[i])),
            "row": int(m.row[i]),
            "share_of_position": float(self._mean(m.share[i : i + 1], POSITION)[0]),
            "share_of_heading": float(m.share[i, YAW]),
            "shift_sigmas": shifts(m.shift[i]),
        }


def shifts(sigmas: Floats) -> dict[str, float]:
    """A shift (15,) in sigmas by direction."""
    named = {"east": sigmas[3], "north": sigmas[4], "up": sigmas[5], "heading_clockwise": -sigmas[YAW]}
    return {name: float(value) for name, value in named.items()}


def finite(value: float) -> float | None:
    """A number, None where it is infinite."""
    return float(value) if np.isfinite(value) else None
