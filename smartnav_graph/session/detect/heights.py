"""Steps of the heights alone: another datum, another receiver or filter, found beside the inertial data.

Around a step at t_k the heights h of the fixes less the inertial height D are, with start, velocity and bias of D,

    h - D = a + b t + c t^2 + s [t > t_k] + noise

and s, with its sigma, is found by least absolute values, whatever outliers there are. A step of the horizontal position
at the same time is none of a datum: those fixes are left to the outlier tests.

Source: Barrodale, Roberts (1973), SIAM J. Numer. Anal. 10(5), 839 (least absolute values), by reweighting.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from smartnav_graph.core.arrays import Floats, Indices, Times
from smartnav_graph.core.timebase import NS, interpolate
from smartnav_graph.session.calibration.model import CARRIER_PHASE_SIGMA, GnssNoise
from smartnav_graph.session.detect.motion import STEP_S, InertialMotion
from smartnav_graph.session.detect.scatter import agrees_with_neighbours
from smartnav_graph.session.session import Session
from smartnav_graph.session.stream import Positioned
from smartnav_graph.session.streams import GnssFix

# A step in sigmas, and the least one, m.
SIGNIFICANT, LEAST_M = 6.0, 1.0
# Sigmas of the difference of two correlated errors, which a step exceeds.
CORRELATED = 2.0
# Fixes on either side of a step, at least and at most, and their longest time from it, s.
LEAST_FIXES, MOST_FIXES, LONGEST_S = 5, 20, 20.0
# Steps of single differences in sigmas that are looked at, and how many.
NOTABLE, MOST_CANDIDATES, MOST_STEPS = 2.0, 100, 10
MAD = 1.4826  # sigma over a median absolute deviation
LEAST_SIGMA = 0.02  # m
SHARE = 0.2  # of a step that its two fixes may differ from it by, beside their noise
# Three sigmas of the difference of two medians of three, in sigmas of the difference of two heights.
NEAR_SIGMAS = 2.0
FEW_M = 5.0  # that the height over one or two points may vary by
ITERATIONS = 20


@dataclass(frozen=True)
class HeightStep:
    """Heights from `t_ns` on lie `size` +- `sigma` m above those before, which end at `before_ns`."""

    before_ns: int
    t_ns: int
    size: float
    sigma: float


@dataclass(frozen=True)
class HeightLevels:
    """Offsets (k,) m of heights from the datum of the solution, of the levels of a stream; `level` (m + 1,) is that of
    the rows before, between and after the steps at t_ns (m,). An offset of zero is the datum itself."""

    t_ns: Times
    level: Indices
    offset: Floats

    def of(self, t_ns: Times) -> Indices:
        """Level (n,) of the rows at t_ns (n,)."""
        return np.asarray(self.level[np.searchsorted(self.t_ns, t_ns, side="right")])

    def shifted(self, fixes: Positioned) -> Positioned:
        """Fixes with all heights on the datum of the solution."""
        rows = fixes.lla if fixes.enu is None else fixes.enu
        assert rows is not None  # checked when the stream was built
        moved = rows - np.outer(self.offset[self.of(fixes.t_ns)], [0.0, 0.0, 1.0])
        return replace(fixes, lla=moved) if fixes.enu is None else replace(fixes, enu=moved)


def height_steps(t_ns: Times, position: Floats, motion: InertialMotion, least: float = LEAST_M) -> list[HeightStep]:
    """Steps of the heights alone, of `least` m or more, in time order. position (n, 3) nav m of rows whose height is
    known, t_ns (n,)."""
    if len(t_ns) < 2 * LEAST_FIXES:
        return []
    t = (t_ns - motion.start_ns) / NS
    inertial = np.interp(t, STEP_S * (np.arange(len(motion.height)) + 0.5), motion.height)
    level = agrees_with_neighbours(t_ns, position[:, :2])
    raw, left = position[:, 2], position[:, 2] - inertial
    found: dict[int, tuple[float, float]] = {}
    while len(found) < MOST_STEPS:
        best, size, sigma, most = 0, 0.0, 0.0, 0.0
        jump = _jumps(left)
        noise = MAD * float(np.median(np.abs(jump)))
        for row in _candidates(jump, noise):
            if any(abs(row - other) < LEAST_FIXES for other in found) or not level[max(row - 2, 2) : row + 2].any():
                continue
            near = _near_step(left, row)
            if abs(near) < (1.0 - SHARE) * least - NEAR_SIGMAS * noise:
                continue  # no step of `least` passes the test below
            s, spread, gain = _step(t, left, row)
            if abs(jump[row - 1] - s) > SIGNIFICANT * noise + SHARE * abs(s):
                continue  # the inertial height bends there: between two fixes there is no such step
            if abs(near - s) > NEAR_SIGMAS * noise + SHARE * abs(s):
                continue  # nor between three before and three after
            if _near_step(raw, row) * np.sign(s) < 0.5 * abs(s):
                continue  # the inertial height steps, not the fixes
            if abs(s) > max(SIGNIFICANT * spread, least) and gain > most:
                best, size, sigma, most = int(row), s, spread, gain
        if not best:
            break
        found[best] = size, sigma
        after = np.arange(len(left)) >= best
        left, raw = left - size * after, raw - size * after
        for row in found:  # each once more without the others
            after = np.arange(len(left)) >= row
            with_it = left + found[row][0] * after
            found[row] = _step(t, with_it, row)[:2]
            left = with_it - found[row][0] * after
    return [HeightStep(int(t_ns[row - 1]), int(t_ns[row]), *found[row]) for row in sorted(found)]


def levels(steps: Sequence[HeightStep], t_ns: Times, least: float = LEAST_M) -> HeightLevels:
    """The levels between steps, as one where they differ by chance or by less than the `least` step; the one of most
    rows t_ns (n,) has no offset."""
    height = np.concatenate([[0.0], np.cumsum([step.size for step in steps])])
    variance = np.concatenate([[0.0], np.cumsum([step.sigma**2 for step in steps])])
    rows = np.diff(np.searchsorted(t_ns, [step.t_ns for step in steps]), prepend=0, append=len(t_ns))
    level = np.arange(len(height))
    for k in range(1, len(height)):
        same = np.abs(height[k] - height[:k]) < np.maximum(SIGNIFICANT * np.sqrt(variance[k] - variance[:k]), least)
        level[k] = level[np.argmax(same)] if same.any() else k
    names, level = np.unique(level, return_inverse=True)
    most = int(np.argmax(np.bincount(level, rows)))
    return HeightLevels(
        np.array([step.t_ns for step in steps], dtype=np.int64), level, height[names] - height[names[most]]
    )


def least_step(fixes: GnssFix, noise: GnssNoise) -> float:
    """Least step (m) that is not one of the correlated error of these fixes."""
    stated = np.inf if fixes.sigma is None else float(np.nanmedian(fixes.sigma[:, :2]))
    correlated = noise.correlated_vertical_sigma if stated >= CARRIER_PHASE_SIGMA else 0.0
    return max(LEAST_M, CORRELATED * float(np.sqrt(2.0)) * correlated)


def control_offset(session: Session) -> tuple[float, float] | None:
    """Median height (m) of the fixes over surveyed points, and how much it varies; None without both at one time."""
    gnss, control = session.gnss, session.control
    if gnss is None or control is None or gnss.has_height.sum() < 2:
        return None
    known = gnss.has_height
    t_ns, height = gnss.t_ns[known], session.nav_position(gnss)[known, 2]
    rows = control.has_height & (control.t_ns >= t_ns[0]) & (control.t_ns <= t_ns[-1])
    if not rows.any():
        return None
    off = interpolate(control.t_ns[rows], t_ns, height) - session.nav_position(control)[rows, 2]
    middle = float(np.median(off))
    return middle, float(np.median(np.abs(off - middle))) if len(off) > 2 else FEW_M


def _jumps(left: Floats) -> Floats:
    """Differences (n - 1,) m of neighbouring heights less the median of those around."""
    step = np.diff(left)
    around = np.lib.stride_tricks.sliding_window_view(np.pad(step, 4, mode="reflect"), 9)
    return np.asarray(step - np.median(around, axis=1))


def _near_step(left: Floats, row: int) -> float:
    """Median of three heights from a row on less that of the three before it and the rise between, m."""
    rise = np.median(np.delete(np.diff(left[row - LEAST_FIXES : row + LEAST_FIXES]), LEAST_FIXES - 1))
    return float(np.median(left[row : row + 3]) - np.median(left[row - 3 : row]) - 3.0 * rise)


def _candidates(jump: Floats, noise: float) -> Indices:
    """Rows that begin a notable step."""
    size = np.abs(jump)
    rows = np.flatnonzero(size > max(NOTABLE * noise, 0.5 * LEAST_M)) + 1
    rows = rows[(rows >= LEAST_FIXES) & (rows <= len(jump) + 1 - LEAST_FIXES)]
    return np.asarray(rows[np.argsort(-size[rows - 1])][:MOST_CANDIDATES])


def _step(t: Floats, left: Floats, row: int) -> tuple[float, float, float]:
    """Size and sigma (m) of a step that begins at a row, and by how much the logarithm of its likelihood is larger than
    that of none."""
    rows = np.arange(max(row - MOST_FIXES, 0), min(row + MOST_FIXES, len(t)))
    since = t[rows] - 0.5 * (t[row - 1] + t[row])
    near = np.abs(since) < LONGEST_S
    rows, since = rows[near], since[near]
    if min((since < 0).sum(), (since > 0).sum()) < LEAST_FIXES:
        return 0.0, 1.0, 0.0
    unit = since / np.abs(since).max()
    A = np.stack([np.ones_like(unit), unit, unit**2, since > 0], axis=1)
    x, off = _least_absolute(A, left[rows])
    _, without = _least_absolute(A[:, :3], left[rows])
    sigma = max(MAD * float(np.median(off)) * np.sqrt(len(off) / (len(off) - 4.0)), LEAST_SIGMA)
    spread = float(np.sqrt(0.5 * np.pi * np.linalg.inv(A.T @ A)[3, 3])) * sigma
    return float(x[3]), spread, len(off) * float(np.log(without.sum() / max(off.sum(), 1e-9)))


def _least_absolute(A: Floats, y: Floats) -> tuple[Floats, Floats]:
    """The x of least sum |y - A x|, and these residuals, `LEAST_SIGMA` at least."""
    off = np.ones(len(y))
    for _ in range(ITERATIONS):
        weighted = A.T / off
        x = np.linalg.solve(weighted @ A, weighted @ y)
        off = np.maximum(np.abs(y - A @ x), LEAST_SIGMA)
    return np.asarray(x), np.asarray(off)
