"""Readings of single sensors on their own stamps -> streams: order, gaps, one sensor carried to another's stamps.

Logs with one file or one column group a sensor are put together here. Nothing is extrapolated or carried over a gap;
every row that is left out is counted.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from smartnav_graph.core.arrays import Floats, Mask, Table, Times
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.timebase import MISSING_PERIODS, NS, interpolate, nearest
from smartnav_graph.readers.source import inertial_columns, vector_columns
from smartnav_graph.session import repair
from smartnav_graph.session.streams import Imu, Magnetometer

GAP_S = 0.05  # no reading is interpolated across a longer step, unless the sensor is slower
SLOWER = 1.5  # times the rate of the accelerometer: a gyroscope so fast has forces that were not measured
SAME_STAMP_NS = 10_000  # stamps closer than this count as one: readings change less in between than they are resolved

Counts = Mapping[str, int]


@dataclass(frozen=True)
class Samples:
    """Readings `values` (n, k) of one sensor at stamps `t_ns` (n,), strictly increasing, of `file`.

    counts : what was left out or moved, by reason
    """

    file: Path
    t_ns: Times
    values: Floats
    counts: Counts = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.t_ns)

    @property
    def rate_hz(self) -> float:
        """Rows a second; zero for a single row."""
        return 0.0 if len(self) < 2 else (len(self) - 1) * NS / float(self.t_ns[-1] - self.t_ns[0])


def in_time_order(file: Path, t_ns: Times, values: Floats, repairs: Iterable[str] = ()) -> Samples:
    """Readings in order of time: rows with an unknown value (NaN) and repeated stamps are left out, and counted.

    Parameters
    ----------
    t_ns, values : (n,) and (n, k) or (n,), as they were logged
    repairs : names of `smartnav_graph.session.repair`; ``clock`` continues a clock that was set back

    Raises
    ------
    SessionError
        No row has a value, or the clock was set back.
    """
    rows = values.reshape(len(t_ns), -1)
    known = np.isfinite(rows).all(axis=1)
    if not known.any():
        raise SessionError(file, f"has no row with a value among {len(rows)}", "numbers", "switch the sensor on")
    table: Table = {"t_ns": t_ns[known]} | {f"_{i}": column[known] for i, column in enumerate(rows.T)}
    # `order` of a stream with unique stamps; the names of the columns mean nothing to it
    wanted = {"order", *(name for name in repairs if name == "clock")}
    try:
        table, counts = repair.repair(Magnetometer, table, wanted)
    except SessionError as error:
        raise error.located(file) from error
    left_out = {"without a value left out": int((~known).sum())} if not known.all() else {}
    sorted_rows = np.stack([np.asarray(table[f"_{i}"], dtype=np.float64) for i in range(rows.shape[1])], axis=-1)
    return Samples(file, np.asarray(table["t_ns"], dtype=np.int64), sorted_rows, left_out | counts)


def within(t_ns: Times, samples: Samples) -> Mask:
    """Mask (n,) of the stamps between two readings that lie no gap apart (`GAP_S`, and `MISSING_PERIODS` periods)."""
    at = samples.t_ns
    if len(at) < 2:
        return np.isin(t_ns, at)
    limit = max(GAP_S, MISSING_PERIODS * float(np.median(np.diff(at))) / NS) * NS
    after = np.clip(np.searchsorted(at, t_ns), 1, len(at) - 1)
    inside = (t_ns >= at[0]) & (t_ns <= at[-1])
    return np.asarray(inside & ((at[after] - at[after - 1] <= limit) | np.isin(t_ns, at)))


def carried(t_ns: Times, samples: Samples) -> tuple[Floats, Mask]:
    """Readings (n, k) interpolated linearly to the stamps (n,) of another sensor, and where they are known.

    Elsewhere the rows hold NaN.
    """
    known = within(t_ns, samples)
    rows = np.full((len(t_ns), samples.values.shape[1]), np.nan)
    if known.any():
        rows[known] = interpolate(t_ns[known], samples.t_ns, samples.values)
    return rows, known


def summed(one: Samples, other: Samples) -> Samples:
    """The sum of two vectors of one sensor, such as gravity and linear acceleration, at the stamps of `one`.

    Raises
    ------
    SessionError
        They have no time in common.
    """
    rows, known = carried(one.t_ns, other)
    if not known.any():
        raise SessionError(one.file, f"has no time in common with {other.file.name}", "stamps on one clock")
    counts = {f"outside {other.file.name} left out": int((~known).sum())} if not known.all() else {}
    return Samples(one.file, one.t_ns[known], one.values[known] + rows[known], {**one.counts, **counts})


def inertial_table(gyro: Samples, accel: Samples) -> tuple[Table, dict[str, int]]:
    """Columns of the stream ``imu`` on the gyro's stamps: angular rate rad/s and specific force m/s^2, and counts.

    Raises
    ------
    SessionError
        The two have no time in common.
    """
    force, known = carried(gyro.t_ns, accel)
    if not known.any():
        found = f"has no time in common with {accel.file.name}"
        raise SessionError(gyro.file, found, "gyro and accelerometer on one clock", stream=Imu.NAME)
    t_ns = gyro.t_ns[known]
    outside = (accel.t_ns < t_ns[0]) | (accel.t_ns > t_ns[-1])
    apart = np.abs(accel.t_ns[nearest(t_ns, accel.t_ns)] - t_ns) > SAME_STAMP_NS
    if SLOWER * accel.rate_hz > gyro.rate_hz:  # interpolation loses nothing
        apart[:] = False
    counts = {f"of the gyro {reason}": count for reason, count in gyro.counts.items()}
    counts |= {f"of the accelerometer {reason}": count for reason, count in accel.counts.items()}
    counts |= {
        "of the gyro outside the accelerometer's span dropped": int((~known).sum()),
        "of the accelerometer outside the gyro's span dropped": int(outside.sum()),
        "with the acceleration interpolated to the gyro's stamp": int(apart.sum()),
    }
    columns = inertial_columns(t_ns, gyro.values[known], force[known])
    return columns, {reason: count for reason, count in counts.items() if count}


def magnetic_table(field_ut: Samples) -> Table:
    """Columns of the stream ``magnetometer``, uT."""
    return {"t_ns": field_ut.t_ns} | vector_columns("mag_{}_ut", field_ut.values)


def clock_offset(from_ns: Times, to_ns: Times) -> int:
    """Nanoseconds to add to stamps of one clock to have them on another, of pairs of stamps (n,) taken together.

    The median of the differences: a reading that was written late does not count.
    """
    apart = to_ns - from_ns
    return int(apart[0]) + int(np.median(apart - apart[0]))  # no float holds the nanoseconds of an epoch
