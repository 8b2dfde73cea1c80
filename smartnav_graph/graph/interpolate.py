"""States inside windows: inertial prediction from the keyframe before, bent to meet the keyframe after.

Serves output at any rate and the scoring of withheld fixes. The end discrepancy of a window is spread over it: the
rotation linearly, position and velocity by the cubic that meets both at both ends.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.so3 import exp, log
from smartnav_graph.core.timebase import NS
from smartnav_graph.graph.keyframes import KeyframeConfig, make_windows
from smartnav_graph.graph.solution import Solution
from smartnav_graph.graph.windows import Window

# Inertial samples that are integrated together: some twenty megabytes.
MOST_SAMPLES = 1 << 16


class Kinematics(NamedTuple):
    """Attitude (n, 3, 3), position (n, 3) m and velocity (n, 3) m/s in nav, with bias (n, 6) accel then gyro."""

    R: Floats
    p: Floats
    v: Floats
    bias: Floats


def kinematics(solution: Solution) -> Kinematics:
    """The states of a solution as `states_at` takes them."""
    bias = np.concatenate([solution.accel_bias, solution.gyro_bias], axis=1)
    return Kinematics(solution.nav_R_body, solution.nav_t_body, solution.nav_v_body, bias)


def solution_at(solution: Solution) -> Callable[[NDArray[np.int64]], Kinematics] | None:
    """States of a solution at any stamps (q,) inside its span, by its inertial data; None where it has none, or none
    between its epochs."""
    imu = solution.imu
    if imu is None or len(imu) < 2 * len(solution):
        return None
    windows = make_windows(imu, solution.t_ns, (), {}, KeyframeConfig())
    return partial(states_at, windows, kinematics(solution), solution.gravity)


def states_at(windows: Sequence[Window], states: Kinematics, gravity: float, t_ns: NDArray[np.int64]) -> Kinematics:
    """Smoothed states at arbitrary times inside the windows.

    Parameters
    ----------
    windows : all windows in time order; states : the smoothed keyframes, row k at windows[k].t1_ns
    gravity : m/s^2; t_ns (q,) stamps in [windows[0].t1_ns, windows[-1].t1_ns]
    """
    ends = np.array([w.t1_ns for w in windows], dtype=np.int64)
    index = np.searchsorted(ends, t_ns)
    if len(t_ns) and (index.max() >= len(windows) or t_ns.min() < ends[0]):
        raise ValueError("a time outside the windows")
    out = Kinematics(*(x[index].copy() for x in states))
    open_rows = np.flatnonzero(ends[index] != t_ns)
    if len(open_rows):
        used, where = np.unique(index[open_rows], return_inverse=True)
        inner = _inside([windows[k] for k in used], used, states, gravity, where, t_ns[open_rows])
        for target, source in zip(out, inner, strict=True):
            target[open_rows] = source
    return out


def _integrated(
    windows: Sequence[Window],
    index: NDArray[np.intp],
    states: Kinematics,
    gravity: float,
    where: NDArray[np.intp],
    t_ns: NDArray[np.int64],
) -> tuple[Kinematics, Kinematics]:
    """From the keyframe before each window (rows `index` - 1 of `states`) to the times t_ns (q,), each inside window
    `where` (q,), and to the windows' ends; windows of about the same length together."""
    before = Kinematics(*(x[index - 1] for x in states))
    ends, there = Kinematics(*(x.copy() for x in before)), Kinematics(*(x[where] for x in before))
    tau = (t_ns - np.array([w.t0_ns for w in windows], dtype=np.int64)[where]) / NS
    place = np.empty(len(windows), dtype=np.intp)
    for group in _alike(np.array([len(w.dt) for w in windows])):
        place[:] = -1
        place[group] = np.arange(len(group))
        asked = np.flatnonzero(place[where] >= 0)
        start = Kinematics(*(x[group] for x in before))
        found = _of_group([windows[k] for k in group], start, gravity, place[where[asked]], tau[asked])
        for whole, part, rows in ((there, found[0], asked), (ends, found[1], group)):
            for target, source in zip(whole[:3], part, strict=True):
                target[rows] = source
    return there, ends


def _alike(lengths: NDArray[np.intp]) -> Iterator[NDArray[np.intp]]:
    """Rows in groups whose lengths (n,) differ by less than two, of at most `MOST_SAMPLES` unless a row alone has
    more."""
    order = np.argsort(-lengths, kind="stable")
    first = 0
    while first < len(order):
        longest = int(lengths[order[first]])
        alike = int(np.searchsorted(-lengths[order], -longest / 2, side="left"))
        last = max(min(alike, first + MOST_SAMPLES // max(longest, 1)), first + 1)
        yield order[first:last]
        first = last


def _of_group(
    windows: Sequence[Window], start: Kinematics, gravity: float, where: NDArray[np.intp], tau: Floats
) -> tuple[tuple[Floats, ...], tuple[Floats, ...]]:
    """Attitude, position and velocity `tau` (q,) s after the begin of windows `where` (q,), and at the ends of the
    windows, as preintegration does it (see `keyframes.make_windows` on the half turn)."""
    count, depth = len(windows), max(len(w.dt) for w in windows)
    dt, force, rate = np.zeros((depth, count, 1)), np.zeros((depth, count, 3)), np.zeros((depth, count, 3))
    interval = np.empty(len(where), dtype=np.intp)
    part = np.empty((len(where), 1))
    rows = np.split(np.argsort(where, kind="stable"), np.cumsum(np.bincount(where, minlength=count))[:-1])
    for k, (w, asked) in enumerate(zip(windows, rows, strict=True)):
        m = len(w.dt)
        dt[:m, k, 0], force[:m, k], rate[:m, k] = w.dt, w.accel - start.bias[k, :3], w.gyro - start.bias[k, 3:]
        border = np.concatenate([[0.0], np.cumsum(w.dt)])
        interval[asked] = np.minimum(np.searchsorted(border, tau[asked], side="right") - 1, m - 1)
        part[asked, 0] = tau[asked] - border[interval[asked]]
    R = np.empty((depth + 1, count, 3, 3))
    R[0] = start.R
    for j, turn in enumerate(exp((rate * dt).reshape(-1, 3)).reshape(depth, count, 3, 3)):
        np.matmul(R[j], turn, out=R[j + 1])
    a = np.einsum("...ij,...j->...i", R[:-1], force) + np.array([0.0, 0.0, -gravity])
    v = np.cumsum(np.concatenate([start.v[None], a * dt]), axis=0)
    p = np.cumsum(np.concatenate([start.p[None], v[:-1] * dt + 0.5 * a * dt**2]), axis=0)
    at = interval, where
    turned = R[at] @ exp(rate[at] * part)
    moved = p[at] + v[at] * part + 0.5 * a[at] * part**2
    return (turned, moved, v[at] + a[at] * part), (R[-1], p[-1], v[-1])


def _inside(
    windows: Sequence[Window],
    index: NDArray[np.intp],
    states: Kinematics,
    gravity: float,
    where: NDArray[np.intp],
    t_ns: NDArray[np.int64],
) -> Kinematics:
    there, ends = _integrated(windows, index, states, gravity, where, t_ns)
    start, length = (np.array([getattr(w, name) for w in windows]) for name in ("t0_ns", "length_s"))
    turn = log(ends.R.transpose(0, 2, 1) @ states.R[index])
    dp, dv = (states.p[index] - ends.p)[where], (states.v[index] - ends.v)[where]
    T = length[where][:, None]
    x = ((t_ns - start[where]) / NS)[:, None] / T
    return Kinematics(
        there.R @ exp(x * turn[where]),
        there.p + dp * (3 * x**2 - 2 * x**3) + dv * T * (x**3 - x**2),
        there.v + dp / T * (6 * x - 6 * x**2) + dv * (3 * x**2 - 2 * x),
        (1 - x) * states.bias[index - 1][where] + x * states.bias[index][where],
    )


def predicted_at(windows: Sequence[Window], states: Kinematics, gravity: float, t_ns: NDArray[np.int64]) -> Kinematics:
    """States predicted from the keyframe before, at times in (windows[0].t1_ns, windows[-1].t1_ns].

    At a keyframe's own time that is its prediction. Parameters as `states_at`; `states` may be causal ones.
    """
    ends = np.array([w.t1_ns for w in windows], dtype=np.int64)
    index = np.searchsorted(ends, t_ns)
    if len(t_ns) and (index.max() >= len(windows) or index.min() < 1):
        raise ValueError("a time outside the windows")
    used, where = np.unique(index, return_inverse=True)
    return _integrated([windows[k] for k in used], used, states, gravity, where, t_ns)[0]
