"""Tests of the verdict by measurements that the solution did not see: withheld fixes and control points, and fixes left
out one by one."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from smartnav_graph.core.arrays import Floats, Times
from smartnav_graph.core.timebase import NS, interpolate
from smartnav_graph.estimate.result.left_out import left_out
from smartnav_graph.estimate.result.reasons import LEVELS, Reason, VerdictInputs
from smartnav_graph.session.streams import ControlPoint

# RMS at withheld fixes against that of interpolating the kept ones, and the least number of them.
WORSE_THAN_INTERPOLATION, LEAST_WITHHELD = 1.1, 20
# Standard deviations by which a mean of squares is clearly larger, and a withheld control point is off.
CLEARLY, CONTRARY_POINT = 4.0, 5.0
# Chi-square per degree of freedom of residuals that are no less than their sigmas.
NO_LESS = 0.8


def predictions(inputs: VerdictInputs) -> Iterator[Reason]:
    """Withheld fixes: the solution against interpolation of the kept ones."""
    session = inputs.solved.problem.session
    for name, held in inputs.withheld.items():
        stream, rows = session.positions().get(name), len(held.t_ns)
        if stream is None or rows < LEAST_WITHHELD or len(stream) < 2:
            continue
        missing = session.nav_position(inputs.solved.problem.withheld[name])
        at = np.searchsorted(inputs.solved.problem.withheld[name].t_ns, held.t_ns)
        curves = interpolated(held.t_ns, stream.t_ns, session.nav_position(stream))
        ours, theirs = _rms(held.error), min(_rms(curve - missing[at]) for curve in curves)
        if ours > WORSE_THAN_INTERPOLATION * theirs:
            text = f"withheld fixes are predicted to {ours:.2f} m, to {theirs:.2f} m by interpolation of the kept ones"
            yield Reason(LEVELS[1], name, text, "check clock, axes and calibration of the inertial data", ours)


def withheld_points(inputs: VerdictInputs) -> Iterator[Reason]:
    """Withheld control points farther off than both sigmas allow."""
    held, points = inputs.withheld.get("control"), inputs.solved.problem.withheld.get("control")
    if held is None or not isinstance(points, ControlPoint):
        return
    off = np.nan_to_num(np.abs(held.error / held.sigma)).max(axis=1)
    contrary = np.flatnonzero(off > CONTRARY_POINT)
    if not len(contrary):
        return
    k, more = contrary[0], len(contrary) - 1
    name = points.point_id[np.searchsorted(points.t_ns, held.t_ns[k])]
    apart = np.sqrt(np.nansum(held.error[k] ** 2))
    text = f"withheld control point {name} is {apart:.2f} m off, {off[k]:.0f} sigma"
    text += f"; so are {more} more" if more else ""
    start = float(inputs.solved.problem.session.seconds(int(held.t_ns[k])))
    yield Reason(LEVELS[1], "control", text, "check the point, its sigma and the time of the visit", off[k], start)


def fixes_left_out(inputs: VerdictInputs) -> Iterator[Reason]:
    """Fixes left out one by one: the solution against curves through their neighbours, where the residuals are no less
    than the sigmas: the solution follows fixes no better than these say."""
    misfit = inputs.fit.per_dof()
    for found in left_out(inputs.solved, LEAST_WITHHELD) if inputs.together else ():
        ours, theirs = found.rms
        worse = ours > WORSE_THAN_INTERPOLATION * theirs and found.sigmas > CLEARLY
        if worse and misfit.get(found.sensor, 1.0) > NO_LESS:
            text = (
                f"fixes left out one by one are predicted to {ours:.2f} m, by their neighbours alone to {theirs:.2f} m"
            )
            yield Reason(LEVELS[1], found.sensor, text, "check clock, axes, lever arm and calibration", ours)


def interpolated(t_ns: Times, kept_ns: Times, position: Floats) -> tuple[Floats, Floats]:
    """Positions (n, 3) at t_ns (n,) by the line and by the cubic spline through those (m, 3) at kept_ns (m,); at both
    ends, beyond them, constant."""
    from scipy.interpolate import CubicSpline

    first = np.flatnonzero(np.concatenate([[True], np.diff(kept_ns) > 0]))
    seconds = (kept_ns[first] - kept_ns[0]) / NS
    at = (np.clip(t_ns, kept_ns[0], kept_ns[-1]) - kept_ns[0]) / NS
    return interpolate(t_ns, kept_ns, position), CubicSpline(seconds, position[first])(at)


def _rms(error: Floats) -> float:
    return float(np.sqrt((error[:, :2] ** 2).sum(axis=1).mean()))
