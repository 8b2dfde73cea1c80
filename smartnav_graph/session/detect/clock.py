"""The clock of position fixes against the inertial data: stamp = IMU time + lag, found before any graph.

Two scores of a lag, as log likelihoods, of things that both sensors see:

course  chords d of the fixes lie along one axis of the body, whose heading is h: in every minute,
        J = (sum |d|^2 - max_b |sum d^2 conj(m) exp(-2i b t)|) / 2, m = mean exp(2i h) over a chord, b a rate left of
        the gyro bias
shape   fixes P and inertial displacement Q over some seconds, a polynomial removed from each (start, velocity, tilt,
        biases), agree but for yaw: J = |P|^2 + |Q|^2 - 2 |<P, Q>|

each with log likelihood -n/4 log(J/n + s^2): half that of n independent residuals, as errors of fixes are correlated.
Course needs no forward axis, but a body that turns with the motion; shape needs accelerations in m/s^2. They err for
different reasons: the lag is known where both have one peak, and it is the same one.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from smartnav_graph.core.arrays import Floats, Indices, Times
from smartnav_graph.core.timebase import NS
from smartnav_graph.session.detect.motion import STEP_S, Complexes, InertialMotion

# Where the lag is known: log likelihood of the peak over any lag `_PEAK_S` away, of both scores and their sum.
_SHARP, _SHARP_EACH, _PEAK_S = 8.0, 3.0, 3.0
_AGREE_S = 2.5  # between the peaks of both
_FLOOR = 0.1  # m; smaller residuals count the same
_OVERLAP_S = 10.0  # of both sensors, at least
_WINDOWS = ((20.0, 3), (40.0, 5))  # length, s, and degree of the polynomial
SPACING_S = 0.95  # between fixes that are used
_COARSE_S, _FINE_S = 0.25, 0.02
_MOST_LAGS = 1_000_000  # two days; fixes of longer are not compared
_LONG_SEARCH_S = 3600.0  # more lags than that in steps twice as long
_MOST_FIXES = 600  # of the search; the refinement takes all
_LONG_CHORD_S, _BLOCK_S = 4.0, 60.0
_MOST_RATE = 0.02  # rad/s
LEAST_SIGMA_S = 0.05
LEAST_FIXES = 10


def spaced_rows(t_ns: Times, position: Floats) -> Indices:
    """Rows of positions (n, 2) m at least `SPACING_S` apart, as closer ones share their errors, without those that
    repeat the position before or are not known."""
    new = np.concatenate([[True], np.diff(position, axis=0).any(axis=1)])[: len(t_ns)]
    rows, last = list[int](), -(2**62)
    for row in np.flatnonzero(new & np.isfinite(position).all(axis=1)).tolist():
        if t_ns[row] - last >= SPACING_S * NS:
            rows.append(row)
            last = int(t_ns[row])
    return np.array(rows, dtype=np.intp)


@dataclass(frozen=True)
class ClockOffset:
    """Offset of the stamps of a sensor: stamp = IMU time + `lag_s`, +- `sigma_s` where `known`.

    sharpness : log likelihood over that of any lag some seconds away; course_s, shape_s : the lags of both scores
    applied : whether the stamps were corrected
    """

    sensor: str
    lag_s: float
    sigma_s: float
    sharpness: float
    known: bool
    course_s: float
    shape_s: float
    applied: bool = False


@dataclass(frozen=True)
class FixTrack:
    """Fixes t (n,) s since the start of the inertial motion, position (n,) m, complex: east + i north."""

    t: Floats
    position: Complexes

    @classmethod
    def of(cls, t_ns: Times, position: Floats, start_ns: int) -> FixTrack:
        """Of fixes (n, >= 2) m, some second apart, without those that repeat the position before."""
        rows = spaced_rows(t_ns, position[:, :2])
        return cls((t_ns[rows] - start_ns) / NS, position[rows, 0] + 1j * position[rows, 1])

    def __len__(self) -> int:
        return len(self.t)

    @cached_property
    def spacing_s(self) -> float:
        """Median time between fixes, s."""
        return float(np.median(np.diff(self.t)))

    def chords(self, every: int) -> tuple[Floats, Floats, Complexes]:
        """Begin and end (m,) s, and displacement (m,), over so many fixes none of which is missing; the longest cut to
        the size of the others."""
        first = np.arange(0, len(self) - every, every)
        begin, end = self.t[first], self.t[first + every]
        d = self.position[first + every] - self.position[first]
        whole = end - begin < 2.0 * every * self.spacing_s
        size = np.abs(d)
        most = 1.5 * np.quantile(size, 0.95) + 1e-9
        return begin[whole], end[whole], np.asarray(d * np.minimum(1.0, most / np.maximum(size, 1e-9)))[whole]

    def windows(self, length_s: float, degree: int) -> list[slice]:
        """Rows of stretches of this length without a missing fix, one after the other."""
        length_s *= max(1.0, self.spacing_s / 1.5)
        after_gap = np.flatnonzero(np.diff(self.t) > 3.0 * self.spacing_s) + 1
        found = []
        for part in np.split(np.arange(len(self.t)), after_gap):
            while len(part):
                count = int(np.searchsorted(self.t[part], self.t[part[0]] + length_s - 0.5 * self.spacing_s))
                if count >= degree + 4 and self.t[part[count - 1]] - self.t[part[0]] > 0.7 * length_s:
                    found.append(slice(int(part[0]), int(part[0]) + count))
                part = part[count:]
        return found

    def busiest(self, count: int) -> FixTrack:
        """The `count` fixes in a row with most acceleration and turns."""
        if len(self) <= count:
            return self
        p = self.position
        bent = np.abs(p[8:] - 2.0 * p[4:-4] + p[:-8])
        way = np.concatenate([np.zeros(5), np.cumsum(np.minimum(bent, 5.0 * np.median(bent) + 1e-9)), np.zeros(4)])
        way[-4:] = way[-5]
        first = int(np.argmax(way[count - 1 :] - way[: len(way) - count + 1]))
        return FixTrack(self.t[first : first + count], self.position[first : first + count])


class _Curve:
    """Linear interpolation of values (n,) at fractional indices; NaN outside."""

    def __init__(self, values: Complexes) -> None:
        self.values, self.slope = values, np.diff(values)

    def at(self, step: Floats) -> Complexes:
        index = np.clip(step.astype(np.intp), 0, len(self.slope) - 1)
        found = np.take(self.values, index) + (step - index) * np.take(self.slope, index)
        found[(step < 0.0) | (step > len(self.slope))] = np.nan
        return np.asarray(found)


def course_score(motion: InertialMotion, fixes: FixTrack, lags: Floats) -> Floats:
    """Log likelihood (k,) of lags (k,) s by the course: of chords between fixes, and of longer ones of less noise."""
    axis = _Curve(np.concatenate([[0j], np.cumsum(np.exp(2j * motion.heading)) * STEP_S]))
    score = np.zeros(len(lags))
    for begin, end, d in (fixes.chords(1), fixes.chords(max(1, round(_LONG_CHORD_S / fixes.spacing_s)))):
        square, middle = d**2, 0.5 * (begin + end)
        blocks = np.array_split(np.arange(len(d)), np.clip(round((middle[-1] - middle[0]) / _BLOCK_S), 1, len(d)))
        edges, place = np.unique(np.concatenate([begin, end]), return_inverse=True)
        first, last = np.split(place, 2)
        for part in np.array_split(np.arange(len(lags)), -(-len(lags) // 500)):
            reached = axis.at((edges - lags[part, None]) / STEP_S)
            along = np.conj(reached[:, last] - reached[:, first]) * (square / (end - begin))
            along[np.isnan(along)] = 0.0
            for rows in blocks:
                t = middle[rows] - middle[rows].mean()
                count = int(np.ceil(_MOST_RATE * np.ptp(t) / 0.7))
                rates = np.linspace(-_MOST_RATE, _MOST_RATE, 2 * count + 1)
                best = np.abs(along[:, rows] @ np.exp(-2j * np.outer(t, rates))).max(axis=1)
                J = 0.5 * (np.abs(square[rows]).sum() - best)
                score[part] -= 0.25 * len(rows) * np.log(J / len(rows) + _FLOOR**2)
    return score


def shape_scores(motion: InertialMotion, fixes: FixTrack, lags: Floats, length_s: float, degree: int) -> Floats:
    """Log likelihood (w, k) of lags (k,) s by the shape of the way in every window of `FixTrack.windows`."""
    found, displacement = [], _Curve(motion.displacement)
    for window in fixes.windows(length_s, degree):
        t, n = fixes.t[window], window.stop - window.start
        basis = np.linalg.qr(np.vander(2.0 * (t - t[0]) / (t[-1] - t[0]) - 1.0, degree + 1))[0]
        p = fixes.position[window] - fixes.position[window][0]
        p = p - basis @ (basis.T @ p)
        power = float((np.abs(p) ** 2).sum())
        onto = np.column_stack([basis, np.conj(p)])  # p has nothing along the basis
        J = np.empty(len(lags))
        for part in np.array_split(np.arange(len(lags)), -(-len(lags) // 5000)):
            q = displacement.at((t - lags[part, None]) / STEP_S - 0.5)
            q -= q[:, :1].copy()
            along = q @ onto
            square = np.einsum("kn,kn->k", q.real, q.real) + np.einsum("kn,kn->k", q.imag, q.imag)
            removed = (np.abs(along[:, :-1]) ** 2).sum(axis=1)
            J[part] = power + np.maximum(square - removed, 0.0) - 2.0 * np.abs(along[:, -1])
        # outside the inertial data nothing moves
        found.append(-0.25 * n * np.log(np.where(np.isfinite(J), J, power) / n + _FLOOR**2))
    return np.array(found).reshape(-1, len(lags))


def shape_score(motion: InertialMotion, fixes: FixTrack, lags: Floats) -> Floats | None:
    """Log likelihood (k,) by the shape, the mean of both lengths of window; None where the fixes are too few."""
    scores = [shape_scores(motion, fixes, lags, *window) for window in _WINDOWS]
    sums = [score.sum(axis=0) for score in scores if len(score)]
    return np.asarray(np.mean(sums, axis=0)) if sums else None


def still_score(fixes: FixTrack) -> float:
    """`shape_score` of inertial data that see no motion."""
    steps = np.zeros(2)
    score = shape_score(InertialMotion(0, steps, steps.astype(np.complex128), steps), fixes, np.zeros(1))
    return -np.inf if score is None else float(score[0])


def _peak(score: Floats, lags: Floats) -> tuple[int, float]:
    """Index of the best lag, and how far its score exceeds that of any lag `_PEAK_S` away."""
    best = int(np.argmax(score))
    far = np.abs(lags - lags[best]) > _PEAK_S
    return best, float(score[best] - score[far].max()) if far.any() else 0.0


def find_clock_offset(sensor: str, motion: InertialMotion, fixes: FixTrack) -> ClockOffset | None:
    """The offset of fixes to the inertial data, at whatever lag both overlap; None where there are too few fixes.

    A search over all lags in steps of `_COARSE_S`, then around the peak of the shape in steps of `_FINE_S`.
    """
    if len(fixes) < LEAST_FIXES or len(fixes.chords(1)[0]) < LEAST_FIXES:
        return None
    part = fixes.busiest(_MOST_FIXES)
    first, last = part.t[0] - motion.length_s + _OVERLAP_S, part.t[-1] - _OVERLAP_S
    if first >= last:
        return None
    step = _COARSE_S if last - first < _LONG_SEARCH_S else 2.0 * _COARSE_S
    if last - first > step * _MOST_LAGS:
        return None
    lags = np.arange(np.ceil(first / step), np.floor(last / step) + 1) * step
    course = course_score(motion, part, lags)
    shape = shape_score(motion, part, lags)
    if shape is None:
        return None
    (a, sharp_a), (b, sharp_b), (_, sharp) = (_peak(score, lags) for score in (course, shape, course + shape))
    known = bool(min(sharp_a, sharp_b) > _SHARP_EACH and sharp > _SHARP and abs(lags[a] - lags[b]) < _AGREE_S)
    fine = lags[b] + np.arange(-2.0 * _COARSE_S, 2.0 * _COARSE_S + 1e-9, _FINE_S)
    score = shape_score(motion, fixes, fine)
    assert score is not None  # of more fixes than above
    best = int(np.argmax(score))
    curvature = -2.0 * np.polyfit(fine - fine[best], score, 2)[0]
    sigma = max(LEAST_SIGMA_S, 1.0 / np.sqrt(max(curvature, 1.0)))
    return ClockOffset(
        sensor,
        lag_s=round(float(fine[best]), 3),
        sigma_s=round(float(sigma), 3),
        sharpness=round(sharp, 1),
        known=known,
        course_s=float(lags[a]),
        shape_s=float(lags[b]),
    )
