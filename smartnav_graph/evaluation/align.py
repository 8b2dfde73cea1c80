"""Bringing a solution and a reference together: association in time, time offset, alignment in space."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from smartnav_graph.core.arrays import Floats, Mask, Times
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.so3 import best_rotation, from_quaternion, slerp
from smartnav_graph.core.timebase import NS, interpolate, seconds_since
from smartnav_graph.graph.interpolate import Kinematics, solution_at
from smartnav_graph.graph.solution import POS, ROT, VEL, Solution
from smartnav_graph.session.streams import Reference

METHODS = ("none", "yaw", "se3", "sim3")

_SEARCH_ROWS = 2000  # reference rows in the search for a time offset; more change it by less than a millisecond
_RANK = 1e-13  # second singular value over the first, below which positions on a line differ by rounding alone
_CANDIDATES = 5  # peaks of the speed correlation that are refined


@dataclass(frozen=True)
class FrameAlignment:
    """The similarity p_ref = scale R p_est + t; R (3, 3), t (3,) m."""

    R: Floats
    t: Floats
    scale: float = 1.0

    def position(self, rows: Floats) -> Floats:
        """Aligned positions (n, 3)."""
        return np.asarray(self.scale * rows @ self.R.T + self.t)


@dataclass(frozen=True, kw_only=True)
class StateSeries:
    """States at n times, of a solution or of a reference; None where not available.

    t_ns (n,) on the solution's clock; position (n, 3) m; rotation (n, 3, 3) nav_R_body; velocity (n, 3) m/s;
    covariance (n, 9, 9) of rotation, position, velocity, nav axes; sigma (n, 3) m. `inertial` gives the states between
    the rows by inertial data.
    """

    t_ns: Times
    position: Floats
    rotation: Floats | None = None
    velocity: Floats | None = None
    covariance: Floats | None = None
    sigma: Floats | None = None
    inertial: Callable[[Times], Kinematics] | None = None

    def __len__(self) -> int:
        return len(self.t_ns)

    def take(self, rows: Mask) -> StateSeries:
        """Only these rows."""
        known = {name: part for name, part in vars(self).items() if isinstance(part, np.ndarray)}
        return StateSeries(**{name: part[rows] for name, part in known.items()}, inertial=self.inertial)

    def inside(self, other: StateSeries) -> Mask:
        """Mask of the rows that lie within the span of `other`."""
        return np.asarray((self.t_ns >= other.t_ns[0]) & (self.t_ns <= other.t_ns[-1]))

    def at(self, t_ns: Times) -> StateSeries:
        """At stamps (q,) inside the span: by the inertial data, or without them linear, attitude by slerp. Covariances
        linear, which keeps them positive definite."""

        def between(values: Floats | None) -> Floats | None:
            if values is None:
                return None
            flat = interpolate(t_ns, self.t_ns, values.reshape(len(self), -1))
            return flat.reshape(len(t_ns), *values.shape[1:])

        there = None if self.inertial is None else self.inertial(t_ns)
        rotation = None if self.rotation is None else slerp(t_ns, self.t_ns, self.rotation)
        return StateSeries(
            t_ns=t_ns,
            position=interpolate(t_ns, self.t_ns, self.position) if there is None else there.p,
            rotation=rotation if there is None else there.R,
            velocity=between(self.velocity) if there is None else there.v,
            covariance=between(self.covariance),
            sigma=between(self.sigma),
        )


def states_of_solution(solution: Solution) -> StateSeries:
    """Attitude, position and velocity of a solution."""
    parts = np.r_[ROT, POS, VEL]
    return StateSeries(
        t_ns=solution.t_ns,
        position=solution.nav_t_body,
        rotation=solution.nav_R_body,
        velocity=solution.nav_v_body,
        covariance=solution.covariance[:, parts[:, None], parts],
        inertial=solution_at(solution),
    )


def states_of_reference(reference: Reference, offset_ns: int) -> StateSeries:
    """The reference on the solution's clock: its stamp t is solution time t + offset."""
    rotation = None
    if reference.quat is not None:
        norm = np.linalg.norm(reference.quat, axis=1)
        if (norm < 1e-6).any():
            row = int(np.argmin(norm))
            raise SessionError("reference", f"qw..qz are all zero at row {row}", "unit quaternions", row=row)
        rotation = from_quaternion(reference.quat)
    return StateSeries(
        t_ns=reference.t_ns + offset_ns,
        position=reference.enu,
        rotation=rotation,
        velocity=reference.velocity,
        sigma=reference.sigma,
    )


def check_overlap(estimate: StateSeries, truth: StateSeries, t0_ns: int, offset_s: float) -> None:
    """Raise unless some reference stamps lie inside the run.

    Raises
    ------
    SessionError
        Either is empty, or the spans have no reference stamp in common; names both spans in seconds since time zero.
    """
    for name, track in (("solution", estimate), ("reference", truth)):
        if not len(track):
            raise SessionError(name, "has no rows", "at least one epoch", "check the file")
    if truth.inside(estimate).any():
        return

    def span(track: StateSeries) -> str:
        first, last = seconds_since(track.t_ns[[0, -1]], t0_ns)
        return f"{first:.3f} to {last:.3f} s"

    raise SessionError(
        "reference",
        f"spans {span(truth)} after time zero (time offset {offset_s:g} s included), the solution {span(estimate)}",
        "reference stamps inside the run",
        "give the shift between the two clocks with --time-offset SECONDS, or --time-offset auto",
    )


def fit_alignment(method: str, estimate: Floats, truth: Floats) -> FrameAlignment:
    """Alignment of positions (n, 3) that minimises sum |p_ref - (scale R p_est + t)|^2.

    ``yaw`` turns about the vertical only: psi = atan2(sum x_e y_n - x_n y_e, sum x_e y_e + x_n y_n) over centred
    horizontal positions x (estimate) and y (reference). ``se3`` and ``sim3`` follow Umeyama (1991, IEEE PAMI 13,
    376-380).

    Raises
    ------
    SessionError
        Unknown method, or positions that do not determine the rotation (no motion, or along a line).
    """
    if method == "none":
        return FrameAlignment(np.eye(3), np.zeros(3))
    if method == "yaw":
        return _fit_yaw(estimate, truth)
    if method not in METHODS:
        raise SessionError("--align", f"{method!r}", f"one of {', '.join(METHODS)}")
    R, singular = best_rotation(estimate, truth)
    if not singular[1] > _RANK * singular[0]:
        raise _degenerate(method, len(truth), "positions that span a plane")
    centre = estimate.mean(axis=0)
    scale = float(singular.sum() / ((estimate - centre) ** 2).sum()) if method == "sim3" else 1.0
    return FrameAlignment(R, truth.mean(axis=0) - scale * R @ centre, scale)


def _fit_yaw(estimate: Floats, truth: Floats) -> FrameAlignment:
    centre, target = estimate.mean(axis=0), truth.mean(axis=0)
    x, y = estimate - centre, truth - target
    sine = float((x[:, 0] * y[:, 1] - x[:, 1] * y[:, 0]).sum())
    cosine = float((x[:, :2] * y[:, :2]).sum())
    if np.hypot(sine, cosine) < 1e-12 * len(x):
        raise _degenerate("yaw", len(truth), "at least two different places")
    R = Rotation.from_euler("z", np.arctan2(sine, cosine)).as_matrix()
    return FrameAlignment(R, target - R @ centre)


def _degenerate(method: str, count: int, rule: str) -> SessionError:
    return SessionError(
        f"--align {method}",
        f"{count} associated positions do not determine the rotation",
        rule,
        "use --align none, or a reference in which the device moves",
    )


def find_time_offset(solution: Solution, reference: Reference, method: str) -> float:
    """Seconds to add to the reference's stamps so that it agrees best with the solution.

    1. Coarse: normalised cross-correlation of the two speeds on a common grid, at every lag that keeps half of the
       shorter span in common. The best peaks are candidates, and so is 0 where the spans overlap as they are.
    2. Fine: around each candidate the RMS position difference after `method` alignment is minimised over the offset
       (bounded scalar search, 0.1 ms). The candidate with the smallest RMS wins.

    Clocks may differ by any amount. A run at constant speed leaves only candidate 0.

    Raises
    ------
    SessionError
        No candidate: the speeds do not vary and the spans do not overlap.
    """
    from scipy.optimize import minimize_scalar

    estimate, truth = states_of_solution(solution), states_of_reference(reference, 0)
    periods = [float(np.median(np.diff(track.t_ns))) / NS for track in (estimate, truth) if len(track) > 1]
    step_s = float(np.clip(max(periods, default=0.1), 0.05, 1.0))
    results = []
    for coarse in _candidates(estimate, truth, step_s):
        cost = _cost(estimate, truth, method, coarse, step_s)
        if cost is not None:
            best = minimize_scalar(cost, bounds=(-step_s, step_s), method="bounded", options={"xatol": 1e-4})
            results.append((float(best.fun), coarse + float(best.x)))
    if not results:
        check_overlap(estimate, truth, solution.t0_ns, 0.0)
        raise SessionError("--time-offset auto", "the offset is not observable", remedy="give it in seconds")
    return min(results)[1]


def _speed(track: StateSeries, step_s: float) -> Floats:
    grid = track.t_ns[0] + np.arange(0, track.t_ns[-1] - track.t_ns[0], round(step_s * NS))
    position = interpolate(grid, track.t_ns, track.position)
    return np.asarray(np.linalg.norm(np.diff(position, axis=0), axis=1) / step_s)


def _candidates(estimate: StateSeries, truth: StateSeries, step_s: float) -> list[float]:
    out = [0.0] if truth.inside(estimate).any() else []
    a, b = _speed(estimate, step_s), _speed(truth, step_s)
    if min(len(a), len(b)) < 4:
        return out
    correlation, lags = _correlate(a, b)
    peak = np.flatnonzero((correlation >= np.roll(correlation, 1)) & (correlation >= np.roll(correlation, -1)))
    best = peak[np.argsort(-correlation[peak], kind="stable")][:_CANDIDATES]
    start = float(estimate.t_ns[0] - truth.t_ns[0]) / NS
    return out + [start + step_s * float(lags[i]) for i in best if correlation[i] > 0.0]


def _correlate(a: Floats, b: Floats) -> tuple[Floats, NDArray[np.int64]]:
    """Pearson correlation of a[i + lag] with b[i] over their overlap; 0 where nothing varies."""
    from scipy.signal import correlate, correlation_lags

    ones_a, ones_b = np.ones_like(a), np.ones_like(b)

    def total(x: Floats, y: Floats) -> Floats:
        return np.asarray(correlate(x, y, method="fft"))

    n = np.maximum(np.rint(total(ones_a, ones_b)), 1.0)
    mean_a, mean_b = total(a, ones_b) / n, total(ones_a, b) / n
    variance = (total(a**2, ones_b) / n - mean_a**2) * (total(ones_a, b**2) / n - mean_b**2)
    covariance = total(a, b) / n - mean_a * mean_b
    usable = (n >= 0.5 * min(len(a), len(b))) & (variance > 1e-12)
    lags = np.asarray(correlation_lags(len(a), len(b)), dtype=np.int64)
    return np.where(usable, covariance / np.sqrt(np.where(usable, variance, 1.0)), 0.0), lags


def _cost(
    estimate: StateSeries, truth: StateSeries, method: str, coarse_s: float, margin_s: float
) -> Callable[[float], float] | None:
    """RMS position difference by the offset beyond `coarse_s`; the rows are inside the run for all up to `margin_s`."""
    t_ns, margin = truth.t_ns + round(coarse_s * NS), round(margin_s * NS)
    rows = np.flatnonzero((t_ns - margin >= estimate.t_ns[0]) & (t_ns + margin <= estimate.t_ns[-1]))
    if len(rows) < 3:
        return None
    rows = rows[:: -(-len(rows) // _SEARCH_ROWS)]
    target, stamps = truth.position[rows], t_ns[rows]

    def rms(extra_s: float) -> float:
        position = estimate.at(stamps + round(extra_s * NS)).position
        difference = fit_alignment(method, position, target).position(position) - target
        return float(np.sqrt((difference**2).sum(axis=1).mean()))

    return rms
