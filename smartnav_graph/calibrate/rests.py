"""Rests in a recording: stretches in which the means of short blocks of readings do not change.

The level of noise is that of the quiet blocks, whatever the sensor, up to what no sensor at rest exceeds; a block
belongs to a rest where force and rate scatter by less than `FACTOR` times that level, and their means stay as they are.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from smartnav_graph.core.arrays import Floats, Mask, Times, runs
from smartnav_graph.core.errors import CalibrationError
from smartnav_graph.core.timebase import NS
from smartnav_graph.session.session import Session
from smartnav_graph.session.streams import Imu

BLOCK_S, LEAST_ROWS = 0.25, 10  # length of a block, at least so many readings
FACTOR = 5.0  # of the level of noise
MOST_FORCE, MOST_RATE = 0.15, 0.03  # m/s^2, rad/s: scatter (three axes) of the noisiest phone at rest
FAR = 0.25  # share of gravity by which the median reading at rest may differ from it
TURNED = 0.02  # rad between the directions of specific force of neighbouring blocks; a rest shows less


@dataclass(frozen=True)
class RestRows:
    """Rows first .. last (not included) of the inertial stream."""

    first: int
    last: int

    @property
    def rows(self) -> slice:
        """Of the stream."""
        return slice(self.first, self.last)

    def __len__(self) -> int:
        return self.last - self.first


def interval_s(t_ns: Times) -> float:
    """Mean interval of stamps without their gaps, s."""
    steps = np.diff(t_ns)
    return float(steps[steps <= 3 * np.median(steps)].mean()) / NS


def find_rests(imu: Imu, least_s: float, quiet: float = 0.2) -> list[RestRows]:
    """Rests of at least `least_s`; a gap in the recording ends a rest.

    quiet : quantile of the scatter of the blocks that is taken for the level of noise: one half for a device that is at
    rest most of the time
    """
    dt = interval_s(imu.t_ns)
    size = max(round(BLOCK_S / dt), LEAST_ROWS)
    count = len(imu) // size
    if count < 3:
        return []
    readings = np.concatenate([imu.accel, imu.gyro], axis=1)[: count * size].reshape(count, size, 6)
    mean, scatter = readings.mean(axis=1), readings.std(axis=1, ddof=1)
    still = np.ones(count, dtype=bool)
    for part, most in ((slice(0, 3), MOST_FORCE), (slice(3, 6), MOST_RATE)):
        size_of = np.linalg.norm(scatter[:, part], axis=1)
        still &= size_of <= FACTOR * min(float(np.quantile(size_of, quiet)), most)
    still &= ~_turned(mean[:, :3])
    still &= ~_spans_gap(imu.t_ns[: count * size].reshape(count, size))
    between = imu.t_ns[size : count * size : size] - imu.t_ns[size - 1 : (count - 1) * size : size]
    gap = np.concatenate([[False], between > NS * max(0.5, 10 * dt)])
    rests = []
    for first, last in runs(still):
        for a, b in _split(int(first), int(last), gap):
            if (b - a) * size * dt >= least_s:
                rests.append(RestRows(a * size, b * size))
    return rests


def _split(first: int, last: int, gap: Mask) -> list[tuple[int, int]]:
    edges = [first, *(i for i in range(first + 1, last) if gap[i]), last]
    return list(pairwise(edges))


def _turned(force: Floats) -> Mask:
    """Blocks whose mean direction differs from that of both neighbours."""
    unit = force / np.maximum(np.linalg.norm(force, axis=1, keepdims=True), 1e-12)
    steps = np.linalg.norm(np.diff(unit, axis=0), axis=1) > TURNED
    return np.asarray(np.concatenate([[True], steps]) & np.concatenate([steps, [True]]))


def _spans_gap(t_ns: Times) -> Mask:
    steps = np.diff(t_ns, axis=1)
    return np.asarray(steps.max(axis=1) > np.maximum(10 * np.median(steps), NS / 2))


def check_readings(session: Session, sensors: tuple[str, ...] = ("accel", "gyro")) -> list[str]:
    """Warnings about clipped and coarsely quantised axes.

    Raises
    ------
    CalibrationError
        An axis is constant, or most readings are at its limits.
    """
    imu, warnings = session.require_imu(), []
    for sensor in sensors:
        for axis, readings in zip("xyz", getattr(imu, sensor).T, strict=True):
            name, (low, high) = f"{sensor}_{axis}", (readings.min(), readings.max())
            if low == high:
                remedy = "check the sensor and the columns of the import"
                raise CalibrationError(session.path or name, f"{name} is constant ({low:.6g})", "noise", remedy)
            at_limit = max((_longest(readings == limit), limit) for limit in (low, high))
            step = _step(readings)
            if at_limit[0] >= 5 and at_limit[0] * step < np.ptp(readings) and step < 0.2 * np.ptp(readings):
                found = f"{name} is clipped at {at_limit[1]:.6g} ({at_limit[0]} readings in a row)"
                raise CalibrationError(
                    session.path or name, found, "readings within range", "move slower, or set a larger range"
                )
            if step > 0.5 * readings.std():
                warnings.append(
                    f"{name} is quantised in steps of {step:.3g}, more than half its noise, which is not reliable; "
                    "record with a smaller range, or unfiltered"
                )
    return warnings


def check_unit(session: Session, means: Floats) -> None:
    """Refuse means (m, 3) of specific force at rest that are far from gravity."""
    length = float(np.median(np.linalg.norm(means, axis=1)))
    if abs(length / session.gravity - 1) > FAR:
        found, remedy = f"specific force at rest is {length:.4g}", "import it in m/s^2 (--columns, --repair units)"
        raise CalibrationError(session.path or "session", found, f"{session.gravity:.4g} m/s^2", remedy)


def _longest(mask: Mask) -> int:
    found = runs(mask)
    return int((found[:, 1] - found[:, 0]).max()) if len(found) else 0


def _step(readings: Floats) -> float:
    """Smallest difference between two readings that differ: the resolution."""
    values = np.unique(readings[:: max(len(readings) // 20000, 1)])
    steps = np.diff(values)
    return float(np.quantile(steps, 0.1)) if len(steps) else 0.0
