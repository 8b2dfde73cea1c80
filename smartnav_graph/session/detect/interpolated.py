"""Fixes that were interpolated together with the inertial data beside them.

Where the rows of one table were interpolated across a gap, its positions lie on the straight line between both ends,
and the path does not. At time t of a gap from s to e they are off by the bow of a path of acceleration a,

    a (t - s) (e - t) / 2
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from smartnav_graph.core.arrays import Floats, Times
from smartnav_graph.core.timebase import NS, Gap
from smartnav_graph.session.streams import Imu

# Samples before and after a gap that show the acceleration, and those before it that show gravity, s.
BESIDE_S, LEVEL_S = 0.5, 30.0


def interpolation_error(t_ns: Times, imu: Imu, gaps: Sequence[Gap]) -> Floats:
    """How far (n,) m positions at t_ns (n,) may be off because they were interpolated; zero outside interpolated gaps,
    and where positions have stamps of their own."""
    out = np.zeros(len(t_ns))
    same = np.isin(t_ns, imu.t_ns)
    for gap in gaps:
        inside = same & (t_ns > gap.start_ns) & (t_ns < gap.end_ns)
        if gap.kind != "bridged" or not inside.any():
            continue
        start, end = np.searchsorted(imu.t_ns, [gap.start_ns, gap.end_ns])
        first, level = np.searchsorted(imu.t_ns, gap.start_ns - np.round(np.array([BESIDE_S, LEVEL_S]) * NS))
        last = int(np.searchsorted(imu.t_ns, gap.end_ns + round(BESIDE_S * NS)))
        gravity = np.median(imu.accel[level : start + 1], axis=0)
        sides = np.array([imu.accel[first : start + 1].mean(axis=0), imu.accel[end : last + 1].mean(axis=0)]) - gravity
        since, left = (t_ns[inside] - gap.start_ns) / NS, (gap.end_ns - t_ns[inside]) / NS
        out[inside] = np.sqrt((sides**2).sum() / 2.0) * since * left / 2.0
    return out
