"""One clock per session: int64 nanoseconds. Decimal text -> t_ns, association, interpolation, gaps.

Nothing here knows sensors; arrays go in, arrays come out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from decimal import ROUND_HALF_EVEN, Decimal

import numpy as np
from numpy.typing import ArrayLike

from smartnav_graph.core.arrays import Floats, Indices, Times, runs
from smartnav_graph.core.errors import SessionError

NS = 1_000_000_000
# Days on which TAI - UTC grew by one second since GPS time began (IERS Bulletin C).
_LEAP_DAYS = (
    *("1981-07-01", "1982-07-01", "1983-07-01", "1985-07-01", "1988-01-01", "1990-01-01", "1991-01-01"),
    *("1992-07-01", "1993-07-01", "1994-07-01", "1996-01-01", "1997-07-01", "1999-01-01", "2006-01-01"),
    *("2009-01-01", "2012-07-01", "2015-07-01", "2017-01-01"),
)
LEAP_SECONDS = len(_LEAP_DAYS)  # GPS time minus UTC since 2017
_GPS_EPOCH_NS = int(np.datetime64("1980-01-06", "ns").astype(np.int64))


def ns_from_text(text: str, unit_ns: int = NS) -> int:
    """Nanoseconds of a decimal clock reading, rounded half to even.

    Binary floats cannot hold nanoseconds of a Unix epoch; decimal text can.

    Parameters
    ----------
    text : str
        Decimal number in units of `unit_ns`.
    unit_ns : int
        Nanoseconds in one unit of `text` (1e9 for seconds, 1 for nanoseconds).

    Raises
    ------
    SessionError
        The text is no finite number.
    """
    try:
        value = Decimal(text.strip()) * unit_ns
        ns = int(value.quantize(Decimal(1), rounding=ROUND_HALF_EVEN))
    except (ArithmeticError, ValueError) as error:  # ValueError: nan
        raise SessionError("time stamp", f"{text!r} is no number", "a decimal number of seconds") from error
    if abs(ns) >= 2**63:
        raise SessionError("time stamp", f"{text!r} does not fit int64 nanoseconds", "within 292 years of the epoch")
    return ns


def ns_from_texts(texts: Sequence[str], unit_ns: int = NS) -> Times:
    """`ns_from_text` of every element; shape (n,)."""
    return np.array([ns_from_text(text, unit_ns) for text in texts], dtype=np.int64)


def ns_from_seconds(seconds: ArrayLike) -> Times:
    """Nanoseconds of float seconds (for spans and simulated clocks, not for epochs)."""
    return np.asarray(np.rint(np.asarray(seconds, dtype=np.float64) * NS), dtype=np.int64)


def seconds_since(t_ns: ArrayLike, t0_ns: int) -> Floats:
    """Float seconds since `t0_ns`; exact to a nanosecond within 100 days."""
    return np.asarray(np.asarray(t_ns, dtype=np.int64) - t0_ns, dtype=np.float64) / NS


def interpolate(t_ns: ArrayLike, at_ns: ArrayLike, values: ArrayLike) -> Floats:
    """Linear interpolation of rows `values` (n, k) or (n,) given at `at_ns` to the times `t_ns`.

    Outside the span the end values hold.
    """
    at = np.asarray(at_ns, dtype=np.int64)
    t0 = int(at[0])
    x, xp = seconds_since(t_ns, t0), seconds_since(at, t0)
    rows = np.asarray(values, dtype=np.float64)
    if rows.ndim == 1:
        return np.asarray(np.interp(x, xp, rows), dtype=np.float64)
    return np.stack([np.interp(x, xp, column) for column in rows.T], axis=-1)


def nearest(t_ns: ArrayLike, at_ns: ArrayLike) -> Indices:
    """Index into the sorted `at_ns` of the time nearest to each of `t_ns`."""
    t, at = np.asarray(t_ns, dtype=np.int64), np.asarray(at_ns, dtype=np.int64)
    right = np.clip(np.searchsorted(at, t), 1, max(len(at) - 1, 1))
    if len(at) < 2:
        return np.zeros(t.shape, dtype=np.intp)
    return np.where(t - at[right - 1] <= at[right] - t, right - 1, right)


# Stretches separated by at most so many rows are joined.
JOINED_ROWS = 4
MISSING_PERIODS = 3.0  # a step longer than so many median periods lacks samples
STRAIGHT = 1e-3  # rad between successive differences on a straight line


@dataclass(frozen=True)
class Gap:
    """A stretch without real inertial data: an IMU data gap.

    kind is ``missing`` (no samples) or ``bridged`` (samples lie on an exact straight line: linearly interpolated).
    """

    start_ns: int
    end_ns: int
    kind: str

    @property
    def length_s(self) -> float:
        """Length, s."""
        return (self.end_ns - self.start_ns) / NS


def unix_ns(t_ns: ArrayLike, epoch: str) -> Times | None:
    """Unix nanoseconds (UTC) of stamps on a clock ``unix`` or ``gps``; None on a clock that gives no date."""
    stamps = np.asarray(t_ns, dtype=np.int64)
    return stamps if epoch == "unix" else utc_from_gps(stamps) if epoch == "gps" else None


def span_text(t_ns: Times) -> str:
    """Length and rate of stamps (n,): ``471.5 s, 100 Hz``; empty without two of them."""
    length = (int(t_ns[-1]) - int(t_ns[0])) / NS if len(t_ns) > 1 else 0.0
    return f"{length:.1f} s, {1e9 / max(float(np.median(np.diff(t_ns))), 1.0):.3g} Hz" if length > 0 else ""


def find_gaps(
    t_ns: Times,
    values: Floats,
    *,
    missing_s: float = 0.05,
    bridged_rows: int = 5,
) -> list[Gap]:
    """Find missing and linearly interpolated stretches of a sampled signal.

    Missing: a step longer than both `missing_s` and `MISSING_PERIODS` median periods.
    Bridged: at least `bridged_rows` successive rows that lie on one straight line of the k-dimensional signal space:
    successive differences, each axis in units of its median step, are parallel within `STRAIGHT` rad, and every
    axis moves from row to row (constant and quantised stretches do not count). No real inertial sensor does that,
    and the rule does not depend on the stamps, which may be jittered. Stretches separated by a few rows (two swapped
    rows, for example) are joined.

    Parameters
    ----------
    t_ns : (n,) int64, strictly increasing
    values : (n, k) samples; for an IMU the six axes in SI units
    """
    if len(t_ns) < 2:
        return []
    dt = np.diff(t_ns) / NS
    limit = max(missing_s, MISSING_PERIODS * float(np.median(dt)))
    gaps = [Gap(int(t_ns[i]), int(t_ns[i + 1]), "missing") for i in np.flatnonzero(dt > limit)]

    step = np.diff(values, axis=0)
    unit = np.median(np.abs(step[:: max(1, len(step) // 20_000)]), axis=0)
    step /= np.where(unit > 0, unit, 1.0)
    length = np.sqrt(np.einsum("ij,ij->i", step, step))
    cosine = np.einsum("ij,ij->i", step[:-1], step[1:]) / np.maximum(length[:-1] * length[1:], 1e-300)
    straight = cosine > np.cos(STRAIGHT)
    moving = (step[1:] != 0.0).all(axis=1)
    lines = runs(straight & moving) + np.array([0, 1])  # k parallel pairs span k + 2 rows
    long = lines[np.diff(lines)[:, 0] + 1 >= bridged_rows]
    gaps += [Gap(int(t_ns[i]), int(t_ns[j]), "bridged") for i, j in _joined(long)]
    return sorted(gaps, key=lambda gap: gap.start_ns)


def _joined(lines: Indices) -> list[tuple[int, int]]:
    """First and last rows of the stretches, joined where few rows lie between them: swapped rows break a line."""
    joined: list[tuple[int, int]] = []
    for i, j in lines.tolist():
        if joined and i - joined[-1][1] <= JOINED_ROWS:
            joined[-1] = (joined[-1][0], j)
        else:
            joined.append((i, j))
    return joined


def gps_from_utc(t_ns: Times) -> Times:
    """Nanoseconds since 1980-01-06 in GPS time of Unix nanoseconds (UTC); the inverse of `utc_from_gps`."""
    leaps = np.searchsorted(np.array(_LEAP_DAYS, dtype="datetime64[ns]").astype(np.int64), t_ns, side="right")
    return np.asarray(np.asarray(t_ns, dtype=np.int64) - _GPS_EPOCH_NS + leaps * NS)


def utc_from_gps(t_ns: Times) -> Times:
    """Unix nanoseconds (UTC) of nanoseconds since 1980-01-06 in GPS time, leap seconds subtracted."""
    steps = np.array(_LEAP_DAYS, dtype="datetime64[ns]").astype(np.int64) + np.arange(1, len(_LEAP_DAYS) + 1) * 10**9
    continuous = np.asarray(t_ns, dtype=np.int64) + _GPS_EPOCH_NS
    return np.asarray(continuous - np.searchsorted(steps, continuous, side="right") * 10**9)
