"""Interpolation across a gap in the inertial data, with weights and noise fitted to the recording itself.

Mean and slant (first moment, for the double integral) of force and rate over a gap are predicted from features before
and after it,

    sum_j w_j x_j,    x = the samples at the borders, means over 0 - 0.1, 0.1 - 0.3, 0.3 - 0.6 s before and after,

axis by axis, with the weights that fit best on the valid stretches of the same recording, each of which is bridged as
if it were a gap (ridge regression towards the mean of all features or the straight line between the borders). Vibration
needs long means, a turn needs a slope.

The residuals of cross-validation, on stretches with similar features, give the noise of the bridge: a Brownian bridge
beside white noise. Over a gap of length T the amplitude of the n-th sine has the variance

    E a_n^2 = q (T / n pi)^2 + D^2,    a_n = sqrt(2 / T) int e sin(n pi t / T) dt

A vehicle's speed and course change slowly (q), its vertical force and its rolling shake (D). The correlation of
axes, such as lateral force and yaw rate in a bend, comes from the products of their amplitudes.

Source: Priestley (1981), Spectral Analysis and Time Series, 10.3, on linear interpolation; Hastie, Tibshirani, Friedman
(2009), The Elements of Statistical Learning, 3.4 and 7.10, on ridge regression and cross-validation; Karatzas, Shreve
(1991), Brownian Motion and Stochastic Calculus, 5.6, on the bridge.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.timebase import NS, Gap, seconds_since
from smartnav_graph.graph.pass_state import INITIALISATION_S
from smartnav_graph.session.calibration.model import ImuNoise
from smartnav_graph.session.streams import Imu

# Intervals before and after a gap whose means are features, s.
MOMENTS = ((0.0, 0.1), (0.1, 0.3), (0.3, 0.6))
# Valid stretches that weights are fitted to, at least and at most.
LEAST, MOST = 30, 2000
# Weight of the target of the ridge regression, in stretches: the best is taken.
RIDGES = (1e-2, 1.0, 1e6)
# Share of the stretches, those with the most similar features, that give the noise of a gap.
ALIKE = 0.1
# Sines of the residuals, and cells of a stretch that their amplitudes are summed over.
SINES, CELLS = 6, 24
# Parts of the recording for cross-validation.
FOLDS = 6
# Noise of a bridge in units of that of recorded data: at least, and where nothing can be fitted.
FLOOR, UNKNOWN = 3.0, 30.0


@dataclass(frozen=True)
class Bridge:
    """Noise densities (3,) accel m/s^2/sqrt(Hz), gyro rad/s/sqrt(Hz) across a gap; expected (2, 6) : mean and slope of
    force m/s^2 and rate rad/s over it, None for a straight line; diffusion (6, 6) : q per second of the error of
    force m/s^2 and rate rad/s."""

    accel: Floats
    gyro: Floats
    expected: Floats | None = None
    diffusion: Floats = field(default_factory=lambda: np.zeros((6, 6)))

    def over(self, length_s: float) -> Bridge:
        """The bridge as white noise alone over a window at whose borders the error is zero or known."""
        within = np.diag(self.diffusion) * length_s**2 / 12.0
        white = np.sqrt(np.concatenate([self.accel, self.gyro]) ** 2 + within)
        return replace(self, accel=white[:3], gyro=white[3:], diffusion=np.zeros((6, 6)))


class Recorded:
    """Inertial samples (n, 6) and their running integral; `broken` counts intervals inside gaps."""

    def __init__(self, imu: Imu, gaps: Sequence[Gap]) -> None:
        self.t = seconds_since(imu.t_ns, int(imu.t_ns[0]))
        self.signal = np.concatenate([imu.accel, imu.gyro], axis=1)
        steps = 0.5 * (self.signal[1:] + self.signal[:-1]) * np.diff(self.t)[:, None]
        self.integral = np.concatenate([np.zeros((1, 6)), np.cumsum(steps, axis=0)])
        middle = 0.5 * (self.t[1:] + self.t[:-1])[:, None]
        self.first = np.concatenate([np.zeros((1, 6)), np.cumsum(middle * steps, axis=0)])  # integral of t times signal
        inside = np.zeros(len(self.t))  # of the interval that ends at each sample
        for gap in gaps:
            inside[np.searchsorted(imu.t_ns, gap.start_ns) + 1 : np.searchsorted(imu.t_ns, gap.end_ns) + 1] = 1.0
        self.broken = np.cumsum(inside)

    def at(self, table: Floats, t: Floats) -> Floats:
        """Columns of a table (n, k) interpolated at times (m,)."""
        return np.stack([np.interp(t, self.t, column) for column in table.T], axis=-1)

    def mean(self, start: Floats, end: Floats) -> Floats:
        """Means (m, 6) of force and rate from `start` (m,) to `end` (m,) s."""
        return np.asarray((self.at(self.integral, end) - self.at(self.integral, start)) / (end - start)[:, None])

    def slant(self, start: Floats, end: Floats) -> Floats:
        """Means (m, 6) of (2 x - 1) times force and rate, x from 0 at `start` (m,) to 1 at `end`."""
        length = (end - start)[:, None]
        lever = self.at(self.first, end) - self.at(self.first, start)
        middle = 0.5 * (start + end)[:, None]
        return np.asarray(2.0 * (lever / length - middle * self.mean(start, end)) / length)

    def valid(self, start: Floats, end: Floats) -> NDArray[np.bool_]:
        """Mask (m,) of the stretches inside the recording without a gap."""
        first, last = np.searchsorted(self.t, start, side="right") - 1, np.searchsorted(self.t, end)
        inside = (start >= self.t[0]) & (end <= self.t[-1])
        last = np.minimum(last, len(self.t) - 1)
        return np.asarray(inside & (self.broken[last] == self.broken[np.maximum(first, 0)]))


# A feature: mean before (-1) or after (+1) the gap, from and to s away; of no length: the sample at the border.
Feature = tuple[int, float, float]
FEATURES: tuple[Feature, ...] = tuple((side, a, b) for side in (-1, 1) for a, b in ((0.0, 0.0), *MOMENTS))
MARGIN_S = MOMENTS[-1][1]


def _features(recorded: Recorded, start: Floats, end: Floats, features: Sequence[Feature]) -> Floats:
    """Features (k) of gaps from `start` to `end` (m,): (m, 6, k)."""
    found = []
    for side, a, b in features:
        near, far = (end + a, end + b) if side > 0 else (start - a, start - b)
        first, last = (near, far) if side > 0 else (far, near)
        found.append(recorded.at(recorded.signal, near) if a == b else recorded.mean(first, last))
    return np.stack(found, axis=-1)


@dataclass(frozen=True)
class FittedModel:
    """Mean and slant over a gap of length_s as a linear function of its features: level (6,) that all are relative to,
    weights (2, 6, k) by axis; left (n, m, 6) : sines of the cross-validation residuals of each stretch; seen (m, 6, k)
    its features; correlation (6, 6) of the residuals."""

    length_s: float
    level: Floats
    weights: Floats
    left: Floats
    seen: Floats
    correlation: Floats

    def predict(self, seen: Floats) -> Floats:
        """Mean and slant (2, 6) of a gap with these features (6, k)."""
        found = np.einsum("jak,ak->ja", self.weights, seen - self.level[:, None])
        found[0] += self.level
        return np.asarray(found)

    def noise(self, seen: Floats) -> tuple[Floats, Floats]:
        """White density (6,) and diffusion (6, 6) of the stretches with the most similar features: a turn is harder to
        predict than a straight."""
        from scipy.optimize import nnls

        apart = np.linalg.norm(self.seen - seen, axis=2)
        count = max(LEAST, round(ALIKE * len(apart)))
        alike = np.argsort(apart, axis=0, kind="stable")[:count]
        spectrum = (np.take_along_axis(self.left, alike[None], axis=1) ** 2).mean(axis=1)
        frequency = np.pi * np.arange(1, SINES + 1) / self.length_s
        parts = np.stack([np.ones(SINES), frequency**-2.0], axis=1)
        white, root = np.sqrt(np.transpose([nnls(parts, column)[0] for column in spectrum.T]))
        return white, root[:, None] * self.correlation * root


def _fit(recorded: Recorded, length: float, features: Sequence[Feature]) -> FittedModel | None:
    """Weights for gaps of `length` s; None where there are too few valid stretches."""
    first, last = recorded.t[0] + MARGIN_S, recorded.t[-1] - length - MARGIN_S
    start = np.arange(first, last, max(length / 4, (last - first) / MOST))
    start = start[recorded.valid(start - MARGIN_S, start + length + MARGIN_S)]
    if len(start) < LEAST:
        return None
    end = start + length
    mean, slant, seen = recorded.mean(start, end), recorded.slant(start, end), _features(recorded, start, end, features)
    level = mean.mean(axis=0)
    fold, apart = _folds(start, length + 2.0 * MARGIN_S)
    x = (seen - level[:, None]).transpose(1, 0, 2)
    best = [
        [_best(y, rows, fold, apart, targets) for y, rows in zip(truth.T, x, strict=True)]
        for truth, targets in ((mean - level, _flat(features)), (slant, _slanting(features)))
    ]
    weights, error = (np.array([[pair[i] for pair in axes] for axes in best]) for i in range(2))
    predict = np.array([mean, slant]) - error.transpose(0, 2, 1)
    left = _sines(recorded, start, length, predict)
    return FittedModel(length, level, weights, left, seen, _correlation(left, (last - first) / length))


def _correlation(left: Floats, count: float) -> Floats:
    """Correlation (6, 6) of the axes by sines (n, m, 6), each with the same weight, shrunk to none by as many stretches
    as there are axes; count : stretches that do not overlap."""
    level = np.sqrt((left**2).mean(axis=1, keepdims=True))
    unit = (left / np.where(level > 0, level, 1.0)).reshape(-1, left.shape[2])
    shrink = count / (count + left.shape[2])
    return np.asarray(shrink * unit.T @ unit / len(unit) + (1.0 - shrink) * np.eye(left.shape[2]))


def _sines(recorded: Recorded, start: Floats, length: float, predict: Floats) -> Floats:
    """Amplitudes (n, m, 6) of the sines of the stretches less the curve by mean and slant (2, m, 6)."""
    x = (np.arange(CELLS) + 0.5) / CELLS
    borders = start[:, None] + length * np.arange(CELLS + 1) / CELLS
    within = np.diff(recorded.at(recorded.integral, borders), axis=1) * CELLS / length
    first, last = recorded.at(recorded.signal, start), recorded.at(recorded.signal, start + length)
    left = within - _curve(x[None, :, None], first[:, None], last[:, None], predict[:, :, None])
    sines = np.sin(np.pi * np.outer(np.arange(1, SINES + 1), x)) * np.sqrt(2.0 * length) / CELLS
    return np.asarray(np.einsum("nk,mka->nma", sines, left))


def _folds(start: Floats, margin_s: float) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Fold (m,) of every stretch, contiguous in time, and which stretches (folds, m) are disjoint from each fold."""
    edges = np.linspace(start[0], start[-1], FOLDS + 1)
    fold = np.clip(np.searchsorted(edges, start, side="right") - 1, 0, FOLDS - 1)
    apart = (start < edges[:-1, None] - margin_s) | (start > edges[1:, None] + margin_s)
    return fold, apart


def _flat(features: Sequence[Feature]) -> list[Floats]:
    """Targets of the weights of a mean: the mean of all features, or the straight line between the borders."""
    border = np.array([float(a == b) for _, a, b in features])
    return [np.full(len(features), 1.0 / len(features)), border / border.sum()]


def _slanting(features: Sequence[Feature]) -> list[Floats]:
    """The same of a slant: none, or that of the straight line."""
    border = np.array([side * float(a == b) for side, a, b in features])
    return [np.zeros(len(features)), border / 6.0]


def _best(
    y: Floats, x: Floats, fold: NDArray[np.intp], apart: NDArray[np.bool_], targets: Sequence[Floats]
) -> tuple[Floats, Floats]:
    """Weights (k,) for y (m,) from x (m, k) that are best in cross-validation, and their errors (m,)."""
    tried = []
    for target in targets:
        for ridge in RIDGES:
            error = np.empty(len(y))
            for k, train in enumerate(apart):
                rows = fold == k
                error[rows] = y[rows] - x[rows] @ _ridge(y[train], x[train], target, ridge)
            tried.append((float((error**2).mean()), target, ridge, error))
    _, target, ridge, error = min(tried, key=lambda item: item[0])
    return _ridge(y, x, target, ridge), error


def _ridge(y: Floats, x: Floats, target: Floats, ridge: float) -> Floats:
    """Weights (k,) for y (m,) from x (m, k), shrunk to `target` with the weight of `ridge` stretches."""
    if not len(y):
        return target
    normal = x.T @ x
    pull = ridge * max(float(np.trace(normal)) / len(x), 1e-30) * np.eye(len(target))
    return np.asarray(target + np.linalg.solve(normal + pull, x.T @ (y - x @ target)))


def bridges(imu: Imu, gaps: Sequence[Gap], floor: ImuNoise, *, causal: bool = False) -> dict[int, Bridge]:
    """The best bridge of every gap, by its start stamp. Where no valid stretch is as long as a gap, shorter ones
    are used. `causal` : each is fitted to the data until `MARGIN_S` after it, or in the first `INITIALISATION_S`."""
    if not gaps:
        return {}
    if not causal:
        recorded = Recorded(imu, gaps)
        return {gap.start_ns: _bridge(recorded, gap, imu, floor) for gap in gaps}
    found = {}
    for gap in gaps:
        now = max(gap.end_ns + round(MARGIN_S * NS), int(imu.t_ns[0]) + round(INITIALISATION_S * NS))
        known = imu.take(imu.t_ns <= now)
        recorded = Recorded(known, [other for other in gaps if other.end_ns <= known.t_ns[-1]])
        found[gap.start_ns] = _bridge(recorded, gap, known, floor)
    return found


def _bridge(recorded: Recorded, gap: Gap, imu: Imu, floor: ImuNoise) -> Bridge:
    start, end = (np.array([(stamp - int(imu.t_ns[0])) / NS]) for stamp in (gap.start_ns, gap.end_ns))
    features = [
        (side, a, b)
        for side, a, b in FEATURES
        if a == b or recorded.valid(*((end, end + b) if side > 0 else (start - b, start)))[0]
    ]
    least = np.array([floor.accel_noise_density] * 3 + [floor.gyro_noise_density] * 3)
    span = gap.length_s
    while span > 2 * float(np.median(np.diff(recorded.t))):
        fitted = _fit(recorded, span, features)
        if fitted is not None:
            seen = _features(recorded, start, end, features)[0]
            white, diffusion = fitted.noise(seen)
            white = np.maximum(white, FLOOR * least)
            found = Bridge(white[:3], white[3:], fitted.predict(seen), diffusion)
            return found if span == gap.length_s else found.over(span)
        span /= 2
    return Bridge(UNKNOWN * least[:3], UNKNOWN * least[3:])


def bridged(imu: Imu, gaps: Sequence[Gap], found: Mapping[int, Bridge]) -> Imu:
    """The inertial data with a curve of the mean and slant of its bridge across every gap: the straight line
    between its borders and a cubic on it. Where no samples are, the curve is sampled at the recording's own rate."""
    if not gaps:
        return imu
    recorded = Recorded(imu, gaps)
    t_ns = np.unique(np.concatenate([imu.t_ns, *(_inner(gap, imu) for gap in gaps if gap.kind == "missing")]))
    signal = recorded.at(recorded.signal, (t_ns - int(imu.t_ns[0])) / NS)
    for gap in gaps:
        expected = found[gap.start_ns].expected
        inside = slice(*np.searchsorted(t_ns, [gap.start_ns, gap.end_ns + 1]))
        if expected is not None:
            x = (t_ns[inside] - gap.start_ns) / (gap.end_ns - gap.start_ns)
            signal[inside] = _curve(x[:, None], signal[inside][0], signal[inside][-1], expected)
    return Imu(t_ns=t_ns, accel=signal[:, :3], gyro=signal[:, 3:])


def _inner(gap: Gap, imu: Imu) -> NDArray[np.int64]:
    period = max(int(np.median(np.diff(imu.t_ns))), 1)
    return np.arange(gap.start_ns + period, gap.end_ns, period, dtype=np.int64)


def _curve(x: Floats, first: Floats, last: Floats, predict: Floats) -> Floats:
    """Values at x from 0 to 1, from `first` to `last` (6,) with a given mean and slant."""
    mean, slant = predict
    bump = 6.0 * (mean - 0.5 * (first + last)) - 30.0 * (1.0 - 2.0 * x) * (slant - (last - first) / 6.0)
    return np.asarray((1.0 - x) * first + x * last + x * (1.0 - x) * bump)
