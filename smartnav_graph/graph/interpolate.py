"""States inside windows: inertial prediction from the keyframe before, bent to meet the keyframe after.

Serves output at any rate and the scoring of withheld fixes. The end discrepancy of a window is spread over it: the
rotation linearly, position and velocity by the cubic that meets both at both ends.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.so3 import exp, log, rotate
from smartnav_graph.core.timebase import NS
from smartnav_graph.graph.windows import Window


class Kinematics(NamedTuple):
    """Attitude (n, 3, 3), position (n, 3) m and velocity (n, 3) m/s in nav, with bias (n, 6) accel then gyro."""

    R: Floats
    p: Floats
    v: Floats
    bias: Floats


def _advance(R: Floats, p: Floats, v: Floats, accel: Floats, gyro: Floats, dt: Floats, g: Floats) -> tuple[Floats, ...]:
    """One interval for many rows, as preintegration does it (see `keyframes.make_windows` on the half turn)."""
    a = rotate(R, accel) + g
    return R @ exp(gyro * dt[:, None]), p + v * dt[:, None] + 0.5 * a * dt[:, None] ** 2, v + a * dt[:, None]


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
    `where` (q,), and to the windows' ends."""
    count, depth = len(windows), max(len(w.dt) for w in windows)
    dt = np.zeros((count, depth))
    accel, gyro = np.zeros((count, depth, 3)), np.zeros((count, depth, 3))
    for row, w in enumerate(windows):
        m = len(w.dt)
        dt[row, :m], accel[row, :m], gyro[row, :m] = w.dt, w.accel, w.gyro
    bias = states.bias[index - 1]
    accel -= bias[:, None, :3]
    gyro -= bias[:, None, 3:]
    g = np.array([0.0, 0.0, -gravity])

    R = np.empty((depth + 1, count, 3, 3))
    p, v = np.empty((depth + 1, count, 3)), np.empty((depth + 1, count, 3))
    R[0], p[0], v[0] = states.R[index - 1], states.p[index - 1], states.v[index - 1]
    for j in range(depth):
        R[j + 1], p[j + 1], v[j + 1] = _advance(R[j], p[j], v[j], accel[:, j], gyro[:, j], dt[:, j], g)

    ends = Kinematics(R[depth], p[depth], v[depth], states.bias[index - 1])
    tau = (t_ns - np.array([w.t0_ns for w in windows], dtype=np.int64)[where]) / NS
    border = np.concatenate([np.zeros((count, 1)), np.cumsum(dt, axis=1)], axis=1)
    j = np.minimum((border[where] <= tau[:, None]).sum(axis=1) - 1, depth - 1)
    part = tau - border[where, j]
    Rq, pq, vq = _advance(R[j, where], p[j, where], v[j, where], accel[where, j], gyro[where, j], part, g)
    return Kinematics(Rq, pq, vq, ends.bias[where]), ends


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


def foretold_at(windows: Sequence[Window], states: Kinematics, gravity: float, t_ns: NDArray[np.int64]) -> Kinematics:
    """States that the keyframe before foretells, at times in (windows[0].t1_ns, windows[-1].t1_ns].

    At a keyframe's own time that is what was foretold of it. Parameters as `states_at`; `states` may be causal ones.
    """
    ends = np.array([w.t1_ns for w in windows], dtype=np.int64)
    index = np.searchsorted(ends, t_ns)
    if len(t_ns) and (index.max() >= len(windows) or index.min() < 1):
        raise ValueError("a time outside the windows")
    used, where = np.unique(index, return_inverse=True)
    return _integrated([windows[k] for k in used], used, states, gravity, where, t_ns)[0]
