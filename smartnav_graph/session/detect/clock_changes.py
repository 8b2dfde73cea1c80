"""A clock of fixes that does not keep step with that of the inertial data: a jump inside the stream, or another rate.

Every window of fixes has its own scores of lags (see `clock`). Two lags, one before and one after a border, or a lag
that grows with time, must explain the windows clearly better than one lag for all.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from smartnav_graph.session.detect.clock import FixTrack, course_score, shape_scores
from smartnav_graph.session.detect.motion import InertialMotion

_WINDOWS = ((40.0, 5), (20.0, 3))  # length, s, and degree of the polynomial; the first that gives enough
_LEAST_WINDOWS = 4
_RANGE_S, _STEP_S = 12.0, 0.2
_LEAST_JUMP_S, _LEAST_RATE = 2.5, 0.003  # what receivers' own lags change by
_GAIN = 20.0  # log likelihood over that of one lag


@dataclass(frozen=True)
class ClockChange:
    """Lag that changes by `size` s at `at_s`, seconds since the start of the motion; where `is_rate`, by `size` s a
    second from there on."""

    size: float
    at_s: float
    gain: float
    is_rate: bool


def find_clock_change(motion: InertialMotion, fixes: FixTrack, lag_s: float = 0.0) -> ClockChange | None:
    """The jump or rate of the clock of fixes, near `lag_s`, that explains them clearly better than one lag."""
    windows = next((w for w in _WINDOWS if len(fixes.windows(*w)) >= _LEAST_WINDOWS), None)
    if windows is None:
        return None
    rows = fixes.windows(*windows)
    lags = lag_s + np.arange(-_RANGE_S, _RANGE_S + 1e-9, _STEP_S)
    score = shape_scores(motion, fixes, lags, *windows)
    score += [course_score(motion, FixTrack(fixes.t[part], fixes.position[part]), lags) for part in rows]
    before = np.cumsum(score, axis=0)[:-1]
    after, one = score.sum(axis=0) - before, float(score.sum(axis=0).max())
    gains = before.max(axis=1) + after.max(axis=1) - one
    at = int(np.argmax(gains))
    jump = float(lags[after[at].argmax()] - lags[before[at].argmax()])
    found = []
    if gains[at] > _GAIN and abs(jump) > _LEAST_JUMP_S:
        found.append(ClockChange(jump, float(fixes.t[rows[at].stop - 1]), float(gains[at]), False))
    middle = np.array([fixes.t[part].mean() for part in rows])
    since, at_one = middle - middle.mean(), lags[np.abs(lags - lag_s) < 0.5 * _RANGE_S]
    rates = np.arange(-0.03, 0.0301, 0.001)
    by_rate = [
        sum(np.interp(at_one + rate * t, lags, row) for t, row in zip(since, score, strict=True)).max()
        for rate in rates
    ]
    best = int(np.argmax(by_rate))
    if by_rate[best] - one > _GAIN and abs(rates[best]) > _LEAST_RATE:
        found.append(ClockChange(float(rates[best]), float(middle[0]), float(by_rate[best] - one), True))
    return max(found, key=lambda change: change.gain, default=None)
