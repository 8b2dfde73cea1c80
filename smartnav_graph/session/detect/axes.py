"""Sign, order and hand of the axes of gyro, accelerometer and fixes, by the motion that all of them see.

Each hypothesis changes the axes of one sensor; the scores of `clock` then compare the inertial motion with the fixes,
at the best lag near the one known. Gravity ties accelerometer to gyro, fixes tie the hand and the turns. Of the
accelerometer negated as a whole and fixes mirrored, only the up axis decides: both hypotheses fit about as well.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.timebase import NS
from smartnav_graph.session.detect.clock import LEAST_FIXES, FixTrack, course_score, shape_score, still_score
from smartnav_graph.session.detect.motion import InertialMotion, covered, motion_of, step_means
from smartnav_graph.session.streams import Imu

_MOST_FIXES, _AROUND_S = 150, 70.0  # fixes in a row that are used, and inertial data around them
_NEAR_S, _FAR_S = 3.0, 60.0
_GAIN = 8.0  # log likelihood over that of the axes as recorded
_SHARP = 8.0  # over that of any lag far away
_DISTINCT = 3.0  # over the next hypothesis, and of the shape over inertial data that see no motion


@dataclass(frozen=True)
class Axes:
    """Changes of axes (3, 3) of gyro and accel; `mirrored` : so are the fixes. sensor, text : of the fault."""

    sensor: str
    text: str
    gyro: Floats
    accel: Floats
    mirrored: bool = False


@dataclass(frozen=True)
class AxesFault:
    """Hypotheses that fit better than the axes as recorded, by `gain` in log likelihood; several where none of them is
    distinctly the best."""

    gain: float
    axes: tuple[Axes, ...]


def _hypotheses() -> Iterator[Axes]:
    same = np.eye(3)
    yield Axes("gyro", "all axes negated", -same, same)
    changes = {f"{'xyz'[k]} negated": np.diag(np.where(np.arange(3) == k, -1.0, 1.0)) for k in range(3)}
    changes |= {f"{'xyz'[i]} and {'xyz'[j]} exchanged": same[_exchanged(i, j)] for i, j in ((0, 1), (0, 2), (1, 2))}
    for text, change in changes.items():
        yield Axes("gyro", text, change, same)
        yield Axes("accel", text, same, change)
    yield Axes("accel", "all axes negated", same, -same)
    yield Axes("fixes", "mirrored (east and north exchanged, or north, east, down)", same, same, mirrored=True)


def _exchanged(i: int, j: int) -> list[int]:
    order = [0, 1, 2]
    order[i], order[j] = j, i
    return order


AXES = tuple(_hypotheses())


def find_axes_fault(imu: Imu, fixes: FixTrack, start_ns: int, lag_s: float = 0.0) -> AxesFault | None:
    """Whether axes other than the recorded ones fit clearly better; `fixes` counted from `start_ns`, near `lag_s`."""
    fixes = fixes.busiest(_MOST_FIXES)
    if len(fixes) < LEAST_FIXES:
        return None
    begin, end = (start_ns + round((t - lag_s) * NS) for t in (fixes.t[0] - _AROUND_S, fixes.t[-1] + _AROUND_S))
    imu = imu.take((imu.t_ns >= begin) & (imu.t_ns <= end))
    if len(imu) < 2 or not covered(imu):
        return None
    means, inertial_ns = step_means(imu), int(imu.t_ns[0])
    shifted = FixTrack(fixes.t - (inertial_ns - start_ns) / NS, fixes.position)
    near = lag_s + np.arange(-_NEAR_S, _NEAR_S + 1e-9, 0.25)
    away = np.arange(2.0 * _NEAR_S, _FAR_S, 1.0)
    lags = np.concatenate([near, lag_s - away, lag_s + away])
    same = Axes("", "", np.eye(3), np.eye(3))
    tried = (_score(motion_of(inertial_ns, *_changed(means, axes)), shifted, axes, lags) for axes in (same, *AXES))
    scores = [score for score in tried if score is not None]
    if len(scores) <= len(AXES):
        return None
    course, shape = np.array(scores).transpose(1, 0, 2)
    peaks, others = (part.max(axis=1) for part in np.split(course + shape, [len(near)], axis=1))
    order = np.argsort(-peaks)
    best, gain = int(order[0]), float(peaks.max() - peaks[0])
    at = int(np.argmax(course[best, : len(near)] + shape[best, : len(near)]))
    moving = shape[best, at] - still_score(shifted)
    if gain < _GAIN or peaks[best] - others[best] < _SHARP or moving < _DISTINCT:
        return None
    alike = [AXES[k - 1] for k in order if k > 0 and peaks[best] - peaks[k] < _DISTINCT]
    return AxesFault(gain, tuple(alike))


def _changed(means: tuple[Floats, Floats], axes: Axes) -> tuple[Floats, Floats]:
    """Means (n, 3) of gyro and accel with their axes changed."""
    return means[0] @ axes.gyro, means[1] @ axes.accel


def _score(motion: InertialMotion, fixes: FixTrack, axes: Axes, lags: Floats) -> tuple[Floats, Floats] | None:
    """Log likelihoods (k,) of lags (k,) s by course and shape."""
    track = FixTrack(fixes.t, np.conj(fixes.position)) if axes.mirrored else fixes
    shape = shape_score(motion, track, lags)
    return None if shape is None else (course_score(motion, track, lags), shape)
