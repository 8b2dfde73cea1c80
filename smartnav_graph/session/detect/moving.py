"""Motion that other sensors see where the inertial data look like a standstill: steady travel does.

Positions: in a window of the standstill a straight line at constant speed explains them, and no standstill does. The
slope is the median of those of all pairs, so that single outliers do not bend it. Its sigma counts the scatter beside
the line and the correlated error of code receivers, which drift while the device rests; a jump by multipath is
explained better by two places than by a line. Repeated positions count once: a receiver that holds its output
measures nothing. Speeds (wheels, Doppler, velocity of the body): the median of some readings. Images: their points
move. What these sensors neither confirm nor refute stays as the inertial data have it.

Source: Sen (1968), Estimates of the regression coefficient based on Kendall's tau, JASA 63(324).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core import chi_square
from smartnav_graph.core.arrays import Floats, Times, runs
from smartnav_graph.core.timebase import NS
from smartnav_graph.session.calibration.model import CARRIER_PHASE_SIGMA, GnssNoise
from smartnav_graph.session.detect.clock import spaced_rows
from smartnav_graph.session.detect.standstills import Standstills
from smartnav_graph.session.session import Session
from smartnav_graph.session.stream import Positioned
from smartnav_graph.session.streams import Imu

# Speed (m/s) and its ratio to its sigma above which the device moves.
LEAST_SPEED, SIGNIFICANT = 0.3, 5.0
# Lengths (s) of the windows that positions are tested in, the share of one that they span, and how many it takes.
WINDOWS_S, SPANNED, LEAST_FIXES = (5.0, 10.0, 20.0, 40.0, 80.0), 0.8, 5
# In a batch run windows of a length L are tested every L / `HOPS`, and rests shorter than this (s) beside motion
# without a border between them are none.
HOPS, SHORT_S = 4, 10.0
# Longest step (s) of the inertial data between two standstills that are tested as one, and how many sigmas of their
# noise the speed may seem to change by.
LONGEST_STEP_S, NOISE_SIGMAS = 0.5, 4.0
# Variance of a median of slopes over that of the least squares slope, about; sigma over a median absolute deviation.
THEIL_SEN, MAD = 1.1, 1.4826
# What a jump may explain better by chance, as a logarithm.
BY_CHANCE = 1.0
# Readings of a speed that are taken together, at least and for this time (s), all within the longest; the sigma (m/s)
# of those without one.
LEAST_READINGS, READINGS_S, LONGEST_S, SPEED_SIGMA = 3, 1.0, 5.0, 0.05
# Of these, at least so many are in the standstill itself, where it has so many.
LEAST_INSIDE = 2


@dataclass(frozen=True)
class Moving:
    """A span of stamps, from `start_ns` to `end_ns`, in which `sensor` sees the device move, at `speed` m/s (NaN where
    that is not measured)."""

    sensor: str
    start_ns: int
    end_ns: int
    speed: float = np.nan


def find_moving(
    session: Session, rests: Standstills, noise: GnssNoise, images: Sequence[Moving] = (), from_ns: int | None = None
) -> list[Moving]:
    """Where other sensors see that the device moves in what was taken for a standstill.

    Parameters
    ----------
    noise : of the GNSS fixes; images : spans in which images show motion
    from_ns : in a replay, end of the data that the first state is found with; later, a window is decided by what is
    known at its end, and holds from then on
    """
    at_rest, found = rests.rests(), list[Moving]()
    positions = {name: _positions(session, stream, noise) for name, stream in session.positions().items()}
    stretches = list(_stretches(rests, session.require_imu()))
    for begin, end in stretches:
        for name, fixes in positions.items():
            found += (replace(one, sensor=name) for one in fixes.moving(begin, end, from_ns))
    for name, readings in _speeds(session, noise).items():
        for begin, end in stretches:
            found += (replace(one, sensor=name) for one in readings.moving(begin, end))
    # only where the gyroscope shows no turn: turns move the points too
    found += [one for one in images if any(one.start_ns < b and one.end_ns > a for a, b in at_rest)]
    return found if from_ns is not None else [*found, *_remains(rests, stretches, found)]


def without_moving(rests: Standstills, moving: Sequence[Moving]) -> Standstills:
    """The standstills without these spans."""
    speed, turn = rests.speed_sigma.copy(), rests.turn_sigma.copy()
    for one in moving:
        inside = slice(*np.searchsorted(rests.t_ns, [one.start_ns, one.end_ns + 1]))
        speed[inside] = turn[inside] = np.nan
    kept = [(a, b) for a, b in rests.confirmed if not any(one.start_ns < b and one.end_ns > a for one in moving)]
    return replace(rests, speed_sigma=speed, turn_sigma=turn, confirmed=tuple(kept))


def _stretches(rests: Standstills, imu: Imu) -> Iterator[tuple[int, int]]:
    """Spans of constant velocity by the inertial data: standstills, those without acceleration in between as one. The
    stances of a foot are not tested, its rests are."""
    spans = rests.rests() if rests.on_foot else rests.spans()
    ends = [(int(a), int(b)) for a, b in np.searchsorted(rests.t_ns, np.array(spans, dtype=np.int64).reshape(-1, 2))]
    begin: int | None = None
    for k, (start, end) in enumerate(ends):
        begin = start if begin is None else begin
        if k + 1 == len(ends) or not _is_steady(imu, begin, end, ends[k + 1][0]):
            yield int(rests.t_ns[begin]), int(rests.t_ns[end])
            begin = None


def _is_steady(imu: Imu, begin: int, end: int, then: int) -> bool:
    """Whether the speed changes little from row `end` to `then`, with the mean specific force from `begin` to `end`."""
    dt = np.diff(imu.t_ns[end : then + 1]) / NS
    if dt.max(initial=0.0) > LONGEST_STEP_S:
        return False
    before, count = imu.accel[begin : end + 1], then - end
    change = np.cumsum((imu.accel[end:then] - before.mean(axis=0)) * dt[:, None], axis=0)
    noise = float(before.std(axis=0).max() * dt.mean()) * np.sqrt(count * (1.0 + count / len(before)))
    return bool(np.linalg.norm(change, axis=1).max() < LEAST_SPEED + NOISE_SIGMAS * noise)


def _remains(rests: Standstills, stretches: Sequence[tuple[int, int]], moving: Sequence[Moving]) -> Iterator[Moving]:
    """What is left of a stretch beside motion where it is short: no acceleration lies between the two."""
    left = without_moving(rests, moving).still
    for start, end in stretches:
        beside = [one for one in moving if one.start_ns <= end and one.end_ns >= start]
        first, last = np.searchsorted(rests.t_ns, [start, end + 1])
        for a, b in runs(left[first:last]) + first if beside else ():
            if rests.t_ns[b - 1] - rests.t_ns[a] < SHORT_S * NS:
                yield replace(beside[0], start_ns=int(rests.t_ns[a]), end_ns=int(rests.t_ns[b - 1]))


# --- positions ---


@dataclass(frozen=True)
class _Positions:
    """Distinct positions p (m, 2) m at t_ns (m,), with their sigma (m,) m or NaN, and when they are known; correlated
    sigma m and time s of their error."""

    t_ns: Times
    available_ns: Times
    p: Floats
    sigma: Floats
    correlated: float
    correlated_s: float

    def moving(self, begin: int, end: int, from_ns: int | None) -> Iterator[Moving]:
        """Spans of a standstill in which these positions move."""
        inside = np.flatnonzero((self.t_ns >= begin) & (self.t_ns <= end))
        t = self.t_ns[inside]
        for length in WINDOWS_S:
            last_end = -(2**62)
            for k in range(LEAST_FIXES - 1, len(t)):
                first, causal = int(np.searchsorted(t, t[k] - length * NS)), from_ns is not None
                known = int(self.available_ns[inside[k]])
                if k - first + 1 < LEAST_FIXES or t[k] - t[first] < SPANNED * length * NS:
                    continue
                if not causal and t[k] - last_end < length / HOPS * NS and k + 1 < len(t):
                    continue
                last_end = t[k]
                speed = self.speed(inside[first : k + 1])
                if speed > 0.0 and (from_ns is None or known <= from_ns):
                    yield Moving("", int(t[first]), int(t[k]), speed)
                if speed > 0.0 and causal:
                    until = self.available_ns[inside[k + 1]] if k + 1 < len(t) else end
                    yield Moving("", known, int(until), speed)

    def speed(self, rows: NDArray[np.intp]) -> float:
        """Speed m/s where some of these positions show that the device moves, zero elsewhere."""
        t, p, stated = (self.t_ns[rows] - self.t_ns[rows[0]]) / NS, self.p[rows], float(np.median(self.sigma[rows]))
        third = len(t) // 3
        rough = np.median(p[-third:], axis=0) - np.median(p[:third], axis=0)
        if np.linalg.norm(rough) < 0.5 * LEAST_SPEED * float(t[-third:].mean() - t[:third].mean()):
            return 0.0
        i, j = np.triu_indices(len(t), 1)
        slope = np.median((p[j] - p[i]) / (t[j] - t[i])[:, None], axis=0)
        speed, off = float(np.linalg.norm(slope)), p - slope * t[:, None]
        off -= np.median(off, axis=0)
        scatter = MAD * float(np.median(np.abs(off))) * np.sqrt(len(t) / (len(t) - 2.0))
        white = max(scatter, 0.5 * stated if np.isfinite(stated) else 0.0, 1e-3)
        correlated = min(self.correlated, stated) if stated < CARRIER_PHASE_SIGMA else self.correlated
        weight = t - t.mean()
        weight /= weight @ weight
        drift = correlated**2 * np.exp(-np.abs(t[:, None] - t) / self.correlated_s)
        rare = chi_square.student_limit(SIGNIFICANT, len(t) - 2)
        square = (rare * white) ** 2 * (weight @ weight) + SIGNIFICANT**2 * (weight @ drift @ weight)
        if speed < LEAST_SPEED or speed**2 < THEIL_SEN * square:
            return 0.0
        return speed if _misfit(off, white) < _misfit_of_jumps(p, white) else 0.0


def _positions(session: Session, stream: Positioned, noise: GnssNoise) -> _Positions:
    p = session.nav_position(stream)[:, :2]
    rows = spaced_rows(stream.t_ns, p)
    sigma = np.full(len(p), np.nan) if stream.sigma is None else stream.sigma[:, :2].max(axis=1)
    correlated = noise.correlated_horizontal_sigma if stream.NAME == "gnss" else 0.0
    known = np.maximum.accumulate(np.maximum(stream.available_ns, stream.t_ns)[rows])
    return _Positions(stream.t_ns[rows], known, p[rows], sigma[rows], correlated, noise.correlated_time)


def _misfit(off: Floats, sigma: float) -> float:
    """Of residuals (m, 2), little more for an outlier far off."""
    return float(np.log1p(0.5 * (off**2).sum(axis=1) / sigma**2).sum())


def _misfit_of_jumps(p: Floats, sigma: float) -> float:
    """Of the two or three places that positions (m, 2) were best at one after the other, with what they explain by
    chance: found one jump after the other."""
    k, one = _jump(p, sigma)
    more = [_jump(part, sigma)[1] + _misfit_of_place(rest, sigma) for part, rest in ((p[:k], p[k:]), (p[k:], p[:k]))]
    return min(one + BY_CHANCE, min(more) + 3.0 * BY_CHANCE)


def _jump(p: Floats, sigma: float) -> tuple[int, float]:
    """Where positions (m, 2) jump best, and the misfit."""
    if len(p) < 4:
        return len(p), _misfit_of_place(p, sigma)
    misfit = [_misfit_of_place(p[:k], sigma) + _misfit_of_place(p[k:], sigma) for k in range(2, len(p) - 1)]
    return int(np.argmin(misfit)) + 2, min(misfit)


def _misfit_of_place(p: Floats, sigma: float) -> float:
    return _misfit(p - np.median(p, axis=0), sigma)


# --- speeds ---


@dataclass(frozen=True)
class _Speeds:
    """Velocities v (m, d) m/s at t_ns (m,) with sigma (m,), and when they are known."""

    t_ns: Times
    available_ns: Times
    v: Floats
    sigma: Floats

    def moving(self, begin: int, end: int) -> Iterator[Moving]:
        """Where the median of some readings is a significant speed, from a second before it is known, and those of them
        in the standstill from `begin` to `end` agree: a device may stop between two readings."""
        inside = (self.t_ns >= begin) & (self.t_ns <= end)
        later = np.append(self.t_ns[1:], self.t_ns[-1] + round(READINGS_S * NS))
        after = int(np.searchsorted(self.t_ns, end + LONGEST_S * NS, side="right"))
        for k in range(max(LEAST_READINGS - 1, int(np.searchsorted(self.t_ns, begin)) - 1), after):
            first = min(k + 1 - LEAST_READINGS, int(np.searchsorted(self.t_ns, self.t_ns[k] - READINGS_S * NS)))
            own = np.flatnonzero(inside[first : k + 1]) + first
            needed = LEAST_INSIDE if self.t_ns[k] <= end else min(LEAST_INSIDE, int(inside.sum()))
            if self.t_ns[k] - self.t_ns[first] > LONGEST_S * NS or len(own) < needed:
                continue
            if len(own) and np.linalg.norm(np.median(self.v[own], axis=0)) < LEAST_SPEED:
                continue
            speed = float(np.linalg.norm(np.median(self.v[first : k + 1], axis=0)))
            if speed > max(LEAST_SPEED, SIGNIFICANT * float(np.median(self.sigma[first : k + 1]))):
                until = min(int(later[k]), int(self.t_ns[k] + READINGS_S * NS))
                start = int(self.available_ns[k] - READINGS_S * NS)
                if start < end and until > begin:
                    yield Moving("", start, until, speed)


def _speeds(session: Session, noise: GnssNoise) -> dict[str, _Speeds]:
    """What measures a speed, without the rows that have none."""
    found: dict[str, _Speeds] = {}
    wheel, velocity, gnss = session.wheel, session.velocity, session.gnss
    if wheel is not None:
        sigma = np.full(len(wheel), SPEED_SIGMA) if wheel.sigma is None else wheel.sigma
        found["wheel"] = _Speeds(wheel.t_ns, wheel.available_ns, wheel.speed[:, None], sigma)
    if velocity is not None:
        sigma = np.full(len(velocity), SPEED_SIGMA) if velocity.sigma is None else velocity.sigma.max(axis=1)
        found["velocity"] = _Speeds(velocity.t_ns, velocity.available_ns, velocity.velocity, sigma)
    if gnss is not None and gnss.velocity is not None:
        v = gnss.velocity[:, :2]
        rows = np.isfinite(v).all(axis=1)
        stated = np.full(len(v), np.nan) if gnss.sigma_velocity is None else gnss.sigma_velocity[:, :2].max(axis=1)
        sigma = np.where(np.isfinite(stated), stated, noise.velocity_horizontal_sigma)
        found["gnss"] = _Speeds(gnss.t_ns[rows], gnss.available_ns[rows], v[rows], sigma[rows])
    return {name: readings for name, readings in found.items() if len(readings.t_ns)}
