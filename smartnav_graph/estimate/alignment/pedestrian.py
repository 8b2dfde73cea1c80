"""A rough trajectory of a pedestrian: the path of the steps laid on the fixes.

    p(t) = p_0 + c S_b(t)        S_b(t) = integral of e^(i (yaw(u) - b u)) dl(u)

yaw is that of the device by gyroscope and levelled force, l the length of the steps (`steps`), p_0 and c complex: c
turns and scales the path, b is what the gyroscope's bias turns it about the vertical. A few fixes a minute leave the
first state of a dead reckoning open by far; this way is off by metres, and iterations from there end where they should.

Source: the similarity is the least-squares one of Umeyama (1991), IEEE T-PAMI 13(4), in the plane.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.so3 import exp
from smartnav_graph.core.timebase import NS, ns_from_seconds
from smartnav_graph.factors.pedestrian import level_yaw
from smartnav_graph.graph.states import State
from smartnav_graph.graph.windows import Window
from smartnav_graph.session.calibration.model import StepNoise
from smartnav_graph.session.detect.steps import Steps
from smartnav_graph.smoothers.estimate import values_of

Complexes = NDArray[np.complex128]

LEVELLING_S = 3.0  # the mean force of so many seconds is up: a walker's pace hardly changes
SPARSE_S = 2.0  # closer fixes are enough to find the first state
COARSE_BIASES = 41  # values of b tried within three sigma


@dataclass(frozen=True)
class Walk:
    """Rough state of every keyframe: attitude R (n, 3, 3), position p (n, 3) m, velocity v (n, 3) m/s in nav, gyro_bias
    (n, 3) rad/s."""

    windows: Sequence[Window]
    R: Floats
    p: Floats
    v: Floats
    gyro_bias: Floats

    def state(self, row: int = 0) -> State:
        """One keyframe."""
        window, nav = self.windows[row], (self.R[row], self.p[row], self.v[row])
        return State.of(window.index, window.t1_ns, nav, np.append(np.zeros(3), self.gyro_bias[row]))

    def values(self, count: int | None = None) -> gtsam.Values:
        """Initial values of the first `count` keyframes."""
        indices = [window.index for window in self.windows[:count]]
        bias = np.hstack([np.zeros_like(self.gyro_bias), self.gyro_bias])
        return values_of(indices, *(rows[: len(indices)] for rows in (self.R, self.p, self.v, bias)))


@dataclass(frozen=True)
class _Track:
    """At every border of the inertial intervals: stamps (m,), attitude levelled and of arbitrary heading (m, 3, 3), its
    yaw (m,), length of the steps (m,); keyframe (n,) row of each window's end."""

    t_ns: NDArray[np.int64]
    R: Floats
    yaw: Floats
    length: Floats
    keyframe: NDArray[np.intp]

    @property
    def t(self) -> Floats:
        return np.asarray((self.t_ns - self.t_ns[0]) / NS)

    def path(self, bias: float) -> Complexes:
        """S_b (m,)."""
        yaw = self.yaw - bias * self.t
        middle = 0.5 * (yaw[1:] + yaw[:-1])
        return np.concatenate([np.zeros(1), np.cumsum(np.diff(self.length) * np.exp(1j * middle))])


def walked(
    windows: Sequence[Window],
    steps: Steps,
    fixes: tuple[NDArray[np.int64], Floats],
    fix_sigma: float,
    bias_sigma: float,
    body_R_vehicle: Floats,
    noise: StepNoise,
) -> Walk | None:
    """The trajectory through `windows`, or None where all fixes are at one place or there are no steps.

    Parameters
    ----------
    fixes : stamps (k,) and nav positions (k, 3) m; fix_sigma : m; bias_sigma : rad/s, of the gyroscope
    body_R_vehicle : axes of the device's forward, left and up
    """
    track = _tracked(windows, steps, body_R_vehicle)
    inside = (fixes[0] >= track.t_ns[0]) & (fixes[0] <= track.t_ns[-1])
    t_ns, places = fixes[0][inside], fixes[1][inside]
    if len(t_ns) < 2 or np.ptp(places[:, :2], axis=0).max() < 3.0 * fix_sigma or not np.ptp(track.length):
        return None
    rows, target = np.searchsorted(track.t_ns, t_ns), places[:, 0] + 1j * places[:, 1]

    def fit(bias: float) -> tuple[float, complex, complex]:
        path = track.path(bias)[rows]
        (c, p0), *_ = np.linalg.lstsq(np.stack([path, np.ones_like(path)], axis=-1), target, rcond=None)
        square = float((np.abs(target - p0 - c * path) ** 2).sum())
        scale = (abs(c) - noise.factor) / noise.factor_sigma
        return square / fix_sigma**2 + (bias / bias_sigma) ** 2 + scale**2, c, p0

    bias = _least(lambda b: fit(b)[0], bias_sigma)
    _, c, p0 = fit(bias)
    place = p0 + c * track.path(bias)
    off = float(np.sqrt((np.abs(target - place[rows]) ** 2).mean()))
    return _walk(windows, track, place, np.interp(track.t_ns, t_ns, places[:, 2]), (c, bias, off))


def _least(cost: Callable[[float], float], sigma: float) -> float:
    """The bias of least cost: the best of a grid, refined."""
    from scipy.optimize import minimize_scalar

    grid = np.linspace(-3.0 * sigma, 3.0 * sigma, COARSE_BIASES)
    best = float(grid[np.argmin([cost(b) for b in grid])])
    step = float(grid[1] - grid[0])
    return float(minimize_scalar(cost, bounds=(best - step, best + step), method="bounded").x)


def _tracked(windows: Sequence[Window], steps: Steps, body_R_vehicle: Floats) -> _Track:
    """Gyroscope integrated, the attitude corrected towards the mean force at the end of every window."""
    R = _level(windows)
    stamps, attitudes, ends = [np.array([windows[0].t1_ns])], [R[None]], [0]
    for window in windows[1:]:
        inner, force = [], np.zeros(3)
        for turn, accel in zip(exp(window.gyro * window.dt[:, None]), window.accel, strict=True):
            force += R @ accel
            R = R @ turn
            inner.append(R)
        if window.kind != "gap":
            up = force / np.linalg.norm(force)
            share = min(window.length_s / LEVELLING_S, 1.0)
            tilt = Rotation.from_rotvec(share * np.cross(up, [0.0, 0.0, 1.0]))
            R = tilt.as_matrix() @ R
            inner[-1] = R
        attitudes.append(np.array(inner))
        stamps.append(window.t0_ns + ns_from_seconds(np.cumsum(window.dt)))
        ends.append(ends[-1] + len(inner))
    t_ns, R_all = np.concatenate(stamps), np.concatenate(attitudes)
    yaw = np.unwrap(level_yaw(R_all @ body_R_vehicle))
    return _Track(t_ns, R_all, yaw, steps.travelled(t_ns), np.array(ends))


def _level(windows: Sequence[Window]) -> Floats:
    """Attitude of arbitrary heading whose up is the mean force of the first seconds."""
    first = [w for w in windows if w.t1_ns - windows[0].t1_ns <= LEVELLING_S * NS] or list(windows)
    mean = np.concatenate([w.accel for w in (first if len(first) > 1 else windows)]).mean(axis=0)
    up = mean / np.linalg.norm(mean)
    aside = np.cross(np.eye(3)[np.argmin(np.abs(up))], up)
    aside /= np.linalg.norm(aside)
    return np.stack([aside, np.cross(up, aside), up])


def _walk(
    windows: Sequence[Window], track: _Track, place: Complexes, height: Floats, found: tuple[complex, float, float]
) -> Walk:
    c, bias, _ = found
    at = track.keyframe
    turn = np.angle(c) - bias * track.t[at]
    about_up = exp(np.outer(turn, [0.0, 0.0, 1.0]))
    R = about_up @ track.R[at]
    p = np.column_stack([place.real[at], place.imag[at], height[at]])
    around = [np.interp(track.t[at] + s, track.t, part) for part in (place.real, place.imag) for s in (0.5, -0.5)]
    v = np.column_stack([around[0] - around[1], around[2] - around[3], np.zeros(len(at))])
    return Walk(windows, R, p, v, bias * R[:, 2, :])
