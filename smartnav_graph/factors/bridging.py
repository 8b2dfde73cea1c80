"""Across a gap in the inertial data: what the recording itself tells of how best to bridge it, and how well that goes.

Force and rate are remembered: their mean over a gap is foretold from means over moments before and after it,

    mean over the gap = sum_j w_j x_j,    x = means over 0 - 0.1, 0.1 - 0.3, 0.3 - 0.6 s before the gap and after it,

axis by axis, with the weights that served best on the honest stretches of the same recording, each of which is bridged
as if it were a gap (ridge regression towards equal weights). What is left there, by leaving out one stretch at a time,
is the noise of the bridge. Vibration asks for long means, a turn for a slope: the recording knows.

Source: Priestley (1981), Spectral Analysis and Time Series, 10.3, on linear interpolation; Hastie, Tibshirani, Friedman
(2009), The Elements of Statistical Learning, 7.10, on leaving one out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.calibration.model import ImuNoise
from smartnav_graph.streams import Imu
from smartnav_graph.timebase import NS, Gap, seconds_since

Floats = NDArray[np.float64]

# Moments before and after a gap that are looked at, s.
MOMENTS = ((0.0, 0.1), (0.1, 0.3), (0.3, 0.6))
# Honest stretches that weights are found from, at least and at most.
LEAST, MOST = 30, 2000
# Weight of equal weights, in stretches of typical size.
RIDGE = 1e-2
# Share of its own truth that a stretch may tell.
MOST_LEVERAGE = 0.9
# A bridge is never surer than so many times honest data; so many times where there is nothing to learn from.
FLOOR, UNKNOWN = 3.0, 30.0


@dataclass(frozen=True)
class Bridge:
    """Noise densities (3,) accel m/s^2/sqrt(Hz) and gyro rad/s/sqrt(Hz) across a gap; mean (6,) of force m/s^2 and rate
    rad/s over it, None where nothing is known and a straight line has to do."""

    accel: Floats
    gyro: Floats
    mean: Floats | None = None


class Recorded:
    """Inertial samples (n, 6) and their running integral; `broken` counts intervals inside gaps."""

    def __init__(self, imu: Imu, gaps: Sequence[Gap]) -> None:
        self.t = seconds_since(imu.t_ns, int(imu.t_ns[0]))
        self.signal = np.concatenate([imu.accel, imu.gyro], axis=1)
        steps = 0.5 * (self.signal[1:] + self.signal[:-1]) * np.diff(self.t)[:, None]
        self.integral = np.concatenate([np.zeros((1, 6)), np.cumsum(steps, axis=0)])
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

    def honest(self, start: Floats, end: Floats) -> NDArray[np.bool_]:
        """Mask (m,) of the stretches inside the recording without a gap."""
        first, last = np.searchsorted(self.t, start, side="right") - 1, np.searchsorted(self.t, end)
        inside = (start >= self.t[0]) & (end <= self.t[-1])
        last = np.minimum(last, len(self.t) - 1)
        return np.asarray(inside & (self.broken[last] == self.broken[np.maximum(first, 0)]))


# A look: before (-1) or after (+1) the gap, from and to s away from it; of no length: the sample at the border.
Look = tuple[int, float, float]
LOOKS: tuple[Look, ...] = tuple((side, a, b) for side in (-1, 1) for a, b in ((0.0, 0.0), *MOMENTS))
REACH = MOMENTS[-1][1]
START_S = 30.0  # what a replay may look at before it begins


def _seen(recorded: Recorded, start: Floats, end: Floats, looks: Sequence[Look]) -> Floats:
    """What the looks (k) show around gaps from `start` to `end` (m,): (m, 6, k)."""
    found = []
    for side, a, b in looks:
        near, far = (end + a, end + b) if side > 0 else (start - a, start - b)
        first, last = (near, far) if side > 0 else (far, near)
        found.append(recorded.at(recorded.signal, near) if a == b else recorded.mean(first, last))
    return np.stack(found, axis=-1)


@dataclass(frozen=True)
class Learnt:
    """level (6,) that all counts from; weights (6, k) of the looks by axis; error (6,) rms of the mean over the gap, as
    it serves stretches not seen."""

    level: Floats
    weights: Floats
    error: Floats

    def mean(self, seen: Floats) -> Floats:
        """The foretold mean (6,) of what the looks (6, k) show."""
        return np.asarray(self.level + np.einsum("ak,ak->a", self.weights, seen - self.level[:, None]))


def _learn(recorded: Recorded, length: float, looks: Sequence[Look]) -> Learnt | None:
    """Weights for gaps of `length` s; None where there are too few honest stretches."""
    first, last = recorded.t[0] + REACH, recorded.t[-1] - length - REACH
    start = np.arange(first, last, max(length / 4, (last - first) / MOST))
    start = start[recorded.honest(start - REACH, start + length + REACH)]
    if len(start) < LEAST:
        return None
    truth, seen = recorded.mean(start, start + length), _seen(recorded, start, start + length, looks)
    level = truth.mean(axis=0)
    weights, error = zip(
        *(_ridge(y, x) for y, x in zip((truth - level).T, _by_axis(seen, level), strict=True)), strict=True
    )
    return Learnt(level, np.array(weights), np.array(error))


def _by_axis(seen: Floats, level: Floats) -> Floats:
    return np.asarray((seen - level[:, None]).transpose(1, 0, 2))


def _ridge(y: Floats, x: Floats) -> tuple[Floats, float]:
    """Weights (k,) for y (m,) from x (m, k), drawn towards equal ones, and the rms of y left out one at a time."""
    count = x.shape[1]
    normal, equal = x.T @ x, np.full(count, 1.0 / count)
    size = max(float(np.trace(normal)) / len(x), 1e-30)
    hat = np.linalg.solve(normal + RIDGE * size * np.eye(count), x.T)
    weights = equal + hat @ (y - x @ equal)
    leverage = np.minimum(np.einsum("nk,kn->n", x, hat), MOST_LEVERAGE)
    return weights, float(np.sqrt((((y - x @ weights) / (1.0 - leverage)) ** 2).mean()))


def bridges(imu: Imu, gaps: Sequence[Gap], floor: ImuNoise, *, causal: bool = False) -> dict[int, Bridge]:
    """The best bridge of every gap, by its start stamp. Where no honest stretch is as long as a gap, shorter ones stand
    in. `causal` : each is learnt from what was recorded by `REACH` after it, or in the first `START_S`."""
    if not causal:
        recorded = Recorded(imu, gaps)
        return {gap.start_ns: _bridge(recorded, gap, imu, floor) for gap in gaps}
    found = {}
    for gap in gaps:
        now = max(gap.end_ns + round(REACH * NS), int(imu.t_ns[0]) + round(START_S * NS))
        known = imu.take(imu.t_ns <= now)
        recorded = Recorded(known, [other for other in gaps if other.end_ns <= known.t_ns[-1]])
        found[gap.start_ns] = _bridge(recorded, gap, known, floor)
    return found


def _bridge(recorded: Recorded, gap: Gap, imu: Imu, floor: ImuNoise) -> Bridge:
    start, end = (np.array([(stamp - int(imu.t_ns[0])) / NS]) for stamp in (gap.start_ns, gap.end_ns))
    looks = [
        (side, a, b)
        for side, a, b in LOOKS
        if a == b or recorded.honest(*((end, end + b) if side > 0 else (start - b, start)))[0]
    ]
    least = np.array([floor.accel_noise_density] * 3 + [floor.gyro_noise_density] * 3)
    span = gap.length_s
    while span > 2 * float(np.median(np.diff(recorded.t))):
        learnt = _learn(recorded, span, looks)
        if learnt is not None:
            density = np.maximum(learnt.error * np.sqrt(span), FLOOR * least)
            return Bridge(density[:3], density[3:], learnt.mean(_seen(recorded, start, end, looks)[0]))
        span /= 2
    return Bridge(UNKNOWN * least[:3], UNKNOWN * least[3:])


def bridged(imu: Imu, gaps: Sequence[Gap], floor: ImuNoise, *, causal: bool = False) -> Imu:
    """The inertial data with a curve of the foretold mean across every gap: the straight line between its borders and a
    parabola on it. Where no samples are, the curve is sampled at the recording's own rate."""
    if not gaps:
        return imu
    found, recorded = bridges(imu, gaps, floor, causal=causal), Recorded(imu, gaps)
    t_ns = np.unique(np.concatenate([imu.t_ns, *(_inner(gap, imu) for gap in gaps if gap.kind == "missing")]))
    signal = recorded.at(recorded.signal, (t_ns - int(imu.t_ns[0])) / NS)
    for gap in gaps:
        mean = found[gap.start_ns].mean
        inside = slice(*np.searchsorted(t_ns, [gap.start_ns, gap.end_ns + 1]))
        if mean is not None:
            signal[inside] = _curve(t_ns[inside], signal[inside][0], signal[inside][-1], mean)
    return Imu(t_ns=t_ns, accel=signal[:, :3], gyro=signal[:, 3:])


def _inner(gap: Gap, imu: Imu) -> NDArray[np.int64]:
    """Stamps strictly inside a gap, at the recording's rate."""
    period = max(int(np.median(np.diff(imu.t_ns))), 1)
    return np.arange(gap.start_ns + period, gap.end_ns, period, dtype=np.int64)


def _curve(t_ns: NDArray[np.int64], first: Floats, last: Floats, mean: Floats) -> Floats:
    """Values (m, 6) from `first` to `last` (6,) with the mean asked for."""
    x = ((t_ns - t_ns[0]) / (t_ns[-1] - t_ns[0]))[:, None]
    return np.asarray((1.0 - x) * first + x * last + 6.0 * x * (1.0 - x) * (mean - 0.5 * (first + last)))
