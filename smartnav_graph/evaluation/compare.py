"""Differences between two solutions of one session, and between the summaries of two runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from smartnav_graph.core.arrays import Floats, Times
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.so3 import log
from smartnav_graph.core.timebase import interpolate, seconds_since
from smartnav_graph.evaluation.align import StateSeries, states_of_solution
from smartnav_graph.evaluation.metrics import Statistics
from smartnav_graph.graph.solution import ACCEL_BIAS, GYRO_BIAS, POS, ROT, VEL, Solution

DEG = float(np.degrees(1.0))
# What two solutions of one problem differ by for rounding alone: beside 1 (rad, m, m/s ...) or the size of the state.
ROUNDING = 1e-9
# Figures that agree to this share are the same: they are shown with six digits.
SHOWN = 1e-6


class Measure(NamedTuple):
    """Components of the state whose difference has one magnitude, in a unit `factor` times smaller than SI."""

    name: str
    components: slice
    unit: str
    factor: float = 1.0


MEASURES = (
    Measure("position_m", POS, "m"),
    Measure("horizontal_m", slice(3, 5), "m"),
    Measure("height_m", slice(5, 6), "m"),
    Measure("rotation_deg", ROT, "deg", DEG),
    Measure("heading_deg", slice(2, 3), "deg", DEG),
    Measure("velocity_m_s", VEL, "m/s"),
    Measure("accel_bias_m_s2", ACCEL_BIAS, "m/s²"),
    Measure("gyro_bias_deg_s", GYRO_BIAS, "deg/s", DEG),
)


@dataclass(frozen=True)
class DifferenceStatistics:
    """Magnitudes of one difference: statistics, when it is largest, that largest one in sigmas (the larger of the two
    runs'), and the median ratio of the sigmas, second over first."""

    statistics: Statistics
    largest_at_s: float
    largest_sigmas: float
    sigma_ratio: float


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Two solutions at n common epochs.

    t_ns (n,); difference (n, 15) second less first: rotation (the vector theta of R_2 = Exp(theta) R_1), position,
    velocity in nav axes, biases in body axes; position (n, 3) of the first, m; sigma_first, sigma_second (n, 15)
    """

    t_ns: Times
    t0_ns: int
    position: Floats
    difference: Floats
    sigma_first: Floats
    sigma_second: Floats

    def __len__(self) -> int:
        return len(self.t_ns)

    @cached_property
    def seconds(self) -> Floats:
        """Seconds (n,) since the session's time zero."""
        return seconds_since(self.t_ns, self.t0_ns)

    def magnitude(self, measure: Measure) -> Floats:
        """Magnitudes (n,) of the difference in the measure's unit."""
        return np.asarray(np.linalg.norm(self.difference[:, measure.components], axis=1) * measure.factor)

    def statistics(self, measure: Measure) -> DifferenceStatistics:
        """The figures of one measure."""
        magnitude = self.magnitude(measure)
        first, second = (
            np.linalg.norm(sigma[:, measure.components], axis=1) * measure.factor
            for sigma in (self.sigma_first, self.sigma_second)
        )
        at = int(magnitude.argmax())
        return DifferenceStatistics(
            statistics=Statistics.of(magnitude),
            largest_at_s=float(self.seconds[at]),
            largest_sigmas=float(magnitude[at] / max(first[at], second[at])),
            sigma_ratio=float(np.median(second / first)),
        )

    def to_dict(self) -> dict[str, object]:
        """The figures of every measure."""
        figures: dict[str, object] = {"epochs": len(self)}
        for measure in MEASURES:
            found = asdict(self.statistics(measure))
            figures[measure.name] = found.pop("statistics") | found
        return figures

    def largest(self, count: int, apart_s: float) -> list[int]:
        """Rows of the largest differences of position, each `apart_s` from those before it."""
        magnitude = self.magnitude(MEASURES[0])
        found: list[int] = []
        left = np.ones(len(self), dtype=bool)
        while left.any() and len(found) < count:
            row = int(np.flatnonzero(left)[magnitude[left].argmax()])
            found.append(row)
            left &= np.abs(self.seconds - self.seconds[row]) >= apart_s
        return found


def compare(first: Solution, second: Solution) -> Comparison:
    """Two solutions at their common stamps; without at least two of them, at the stamps of the first inside the second.

    Raises
    ------
    SessionError
        They have no time in common.
    """
    one, other = states_of_solution(first), states_of_solution(second)
    common = np.isin(one.t_ns, other.t_ns)
    rows = common if common.sum() >= 2 else one.inside(other)
    inside = one.take(rows)
    if not len(inside):
        raise SessionError("compare", "the two runs have no time in common", "two runs of one session")
    at = other.at(inside.t_ns)
    bias, sigma = (interpolate(inside.t_ns, second.t_ns, values) for values in (_biases(second), second.sigmas))
    difference = np.concatenate([_differences(inside, at), bias - _biases(first)[rows]], axis=1)
    return Comparison(
        t_ns=inside.t_ns,
        t0_ns=first.t0_ns,
        position=inside.position,
        difference=_beyond_rounding(difference, inside.position),
        sigma_first=first.sigmas[rows],
        sigma_second=sigma,
    )


def _beyond_rounding(difference: Floats, position: Floats) -> Floats:
    """Differences (n, 15) with zero where they are rounding of the states."""
    size = np.ones(15)
    size[POS] += np.abs(position).max()
    return np.where(np.abs(difference) > ROUNDING * size, difference, 0.0)


def _biases(solution: Solution) -> Floats:
    return np.concatenate([solution.accel_bias, solution.gyro_bias], axis=1)


def _differences(one: StateSeries, other: StateSeries) -> Floats:
    """Rotation, position and velocity (n, 9) from one series to the other."""
    assert one.rotation is not None and other.rotation is not None  # of solutions
    assert one.velocity is not None and other.velocity is not None
    turn = log(other.rotation @ one.rotation.transpose(0, 2, 1))
    return np.concatenate([turn, other.position - one.position, other.velocity - one.velocity], axis=1)


def rejected_sets(first: Mapping[str, object], second: Mapping[str, object]) -> dict[str, dict[str, object]]:
    """By sensor, rows that both runs rejected and that only one of them did, of two tables of summary.json."""

    def rows(summary: Mapping[str, object]) -> dict[str, set[int]]:
        found: dict[str, set[int]] = {}
        rejections = summary.get("rejections")
        for one in rejections if isinstance(rejections, Sequence) else ():
            found.setdefault(str(one["sensor"]), set()).add(int(one["row"]))
        return found

    one, other = rows(first), rows(second)
    sets: dict[str, dict[str, object]] = {}
    for name in sorted({*one, *other}):
        a, b = one.get(name, set()), other.get(name, set())
        sets[name] = {"both": len(a & b), "only_first": sorted(a - b), "only_second": sorted(b - a)}
    return sets


# Figures of summary.json that are compared, beside those of sensors and states; "a.b" is b of table a.
FIGURES = (
    *("mode", "vehicle", "duration_s", "path_m", "keyframes", "chi2_per_dof.overall", "iterations", "passes"),
    *("converged", "position_sigma_m.median", "position_sigma_m.p95", "position_sigma_m.max", "timings_s.total"),
)


def figure_differences(first: Mapping[str, object], second: Mapping[str, object]) -> dict[str, tuple[object, object]]:
    """Figures that differ between two tables of summary.json by more than rounding: path -> the value of each, None
    where it has none."""
    one, other = _figures(first), _figures(second)
    names = [*one, *(name for name in other if name not in one)]
    pairs = {name: (one.get(name), other.get(name)) for name in names}
    return {name: pair for name, pair in pairs.items() if not _alike(*pair)}


def _alike(one: object, other: object) -> bool:
    """Whether two figures are the same, numbers but for rounding."""
    if isinstance(one, float) and isinstance(other, float):
        return abs(one - other) <= SHOWN * max(abs(one), abs(other))
    return one == other


def _figures(summary: Mapping[str, object]) -> dict[str, object]:
    found = {name: value for name in FIGURES if (value := _at(summary, name)) is not None}
    for group, field in (("used", ""), ("rejected", ""), ("withheld", "rms_horizontal_m"), ("states", "value")):
        table = summary.get(group)
        for name, value in table.items() if isinstance(table, Mapping) else ():
            found[f"{group}.{name}"] = value.get(field) if field else value
    return found


def _at(summary: Mapping[str, object], path: str) -> object:
    value: object = summary
    for name in path.split("."):
        value = value.get(name) if isinstance(value, Mapping) else None
    return value
