"""A solved problem -> Solution: nav axes, residuals by sensor, output rate, withheld rows scored."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.display import Summarised
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.so3 import rotate
from smartnav_graph.core.timebase import NS, interpolate, nearest, ns_from_seconds
from smartnav_graph.estimate.problem import TOO_LATE, Problem
from smartnav_graph.estimate.reweight.outliers import FixResiduals, fix_residuals, position_builders
from smartnav_graph.estimate.reweight.track_outliers import whitened
from smartnav_graph.factors.coplanarity import SMART
from smartnav_graph.factors.gnss import PositionBuilder
from smartnav_graph.factors.prior import UNKNOWN_ANGLE
from smartnav_graph.graph.interpolate import Kinematics, kinematics, states_at
from smartnav_graph.graph.pass_state import PassState
from smartnav_graph.graph.robust import loss_weights
from smartnav_graph.graph.solution import POS, ROT, Residuals, Solution
from smartnav_graph.graph.states import State
from smartnav_graph.graph.windows import Window
from smartnav_graph.session.streams import ABSOLUTE
from smartnav_graph.smoothers.estimate import Estimate, values_of
from smartnav_graph.smoothers.whole_graph import StackedFactors

# Stamps (m,), sensor, whitened residuals (m, d), weight (m,), used (m,).
Part = tuple[NDArray[np.int64], str, Floats, Floats, NDArray[np.bool_]]


@dataclass(frozen=True)
class SolvedProblem:
    """The estimate of a problem and the pass state it was made with."""

    problem: Problem
    estimate: Estimate
    pass_state: PassState

    @cached_property
    def fixes(self) -> Mapping[str, FixResiduals]:
        """Residuals of each stream of positions at its keyframes, by sensor."""
        windows = self.problem.windows
        return {
            builder.name: fix_residuals(builder, windows, self.estimate, self.pass_state)
            for builder in position_builders(self.problem.builders)
        }


@dataclass(frozen=True)
class Withheld(Summarised):
    """Withheld rows of one sensor: stamps (n,) and predicted minus recorded position (n, 3) m, nav axes, NaN where the
    row has no height; sigma (n, 3) m of that difference, NaN for rows without a sigma of their own."""

    t_ns: NDArray[np.int64]
    error: Floats
    sigma: Floats

    def facts(self) -> dict[str, str]:
        """Rows and RMS of the errors."""
        rms = np.sqrt(np.nansum(self.error**2, axis=1).mean()) if len(self.error) else np.nan
        return {"rows": str(len(self.t_ns)), "RMS": f"{rms:.3f} m"}

    def to_dict(self) -> dict[str, float | int]:
        """Count, horizontal and 3-D RMS, largest 3-D error, metres; unknown heights do not count."""
        square = np.nan_to_num(self.error**2)
        return {
            "count": len(self.error),
            "rms_horizontal_m": float(np.sqrt(square[:, :2].sum(axis=1).mean())),
            "rms_3d_m": float(np.sqrt(square.sum(axis=1).mean())),
            "max_m": float(np.sqrt(square.sum(axis=1).max())),
        }


def _solution(problem: Problem, t_ns: NDArray[np.int64], states: Kinematics, covariance: Floats) -> Solution:
    session = problem.session
    if problem.positions_only:  # the level attitude of the motion model is not that of the device
        covariance = covariance.copy()
        covariance[:, ROT], covariance[:, :, ROT] = 0.0, 0.0
        covariance[:, range(3), range(3)] = UNKNOWN_ANGLE**2
    return Solution(
        t_ns=t_ns,
        nav_R_body=states.R,
        nav_t_body=states.p,
        nav_v_body=states.v,
        accel_bias=states.bias[:, :3],
        gyro_bias=states.bias[:, 3:],
        covariance=covariance,
        t0_ns=session.t0_ns,
        origin=session.origin,
        forward=session.device.forward,
        up=session.device.up,
        imu=problem.imu,
        gravity=session.gravity,
        clock_epoch=session.clock_epoch,
        heights=session.heights,
    )


def to_solution(solved: SolvedProblem) -> Solution:
    """The keyframes with their residuals."""
    estimate = solved.estimate
    solution = _solution(solved.problem, estimate.t_ns, Kinematics(*estimate.states()), estimate.covariance)
    return replace(solution, residuals=residuals(solved))


def carried_over(problem: Problem, estimate: Estimate, windows: Sequence[Window]) -> gtsam.Values:
    """An estimate as gtsam.Values for other windows of the same stretch: states as predicted inside its own windows,
    session states as they are."""
    t_ns = np.array([window.t1_ns for window in windows], dtype=np.int64)
    there = states_at(problem.windows, Kinematics(*estimate.states()), problem.session.gravity, t_ns)
    values = values_of([window.index for window in windows], *there)
    for state in estimate.session.values():
        values.insert(state.key, state.value)
    return values


def causal_solution(problem: Problem, states: Sequence[State]) -> Solution:
    """The estimate of each keyframe when it became known."""
    poses = np.array([state.nav.pose().matrix() for state in states])
    kinematics = Kinematics(
        poses[:, :3, :3],
        poses[:, :3, 3],
        np.array([state.nav.velocity() for state in states]),
        np.array([state.bias.vector() for state in states]),
    )
    t_ns = np.array([state.t_ns for state in states], dtype=np.int64)
    return _solution(problem, t_ns, kinematics, np.array([state.covariance for state in states]))


def residuals(solved: SolvedProblem) -> Residuals:
    """Whitened residuals of every factor, and of rejected rows."""
    problem, estimate, pass_state = solved.problem, solved.estimate, solved.pass_state
    parts: list[Part] = []
    positions = {builder.name: builder for builder in position_builders(problem.builders)}
    for builder in positions.values():
        found = solved.fixes[builder.name]
        used = pass_state.used(builder.name, found.rows)
        white = found.residual / found.sigma
        weight = np.where(used, _weights(builder, white), 0.0)
        parts.append((estimate.t_ns[found.keyframe], builder.name, white, weight, used))
        parts += _of_late_rows(builder.name, problem, estimate)
    for sensor in sorted({block.sensor for block in estimate.blocks} - set(positions)):
        parts += [_of_stack(stack, estimate) for stack in estimate.stacks(sensor)]
    tracks = whitened(problem.builders, estimate, pass_state)
    if tracks is not None:
        parts.append((tracks[0], SMART, tracks[1], tracks[2].astype(np.float64), tracks[2]))
    native: dict[str, tuple[list[int], list[Floats]]] = {}
    for tag, factor in estimate.factors:
        if tag.sensor not in positions and isinstance(factor, gtsam.NoiseModelFactor) and tag.sensor != "prior":
            stamps, rows = native.setdefault(tag.sensor, ([], []))
            stamps.append(tag.t_ns)
            rows.append(factor.whitenedError(estimate.values))
    for sensor, (stamps, rows) in native.items():
        count = len(rows)
        used = np.ones(count, dtype=bool)
        stamps_ns = np.array(stamps, dtype=np.int64)
        parts.append((stamps_ns, problem.label(sensor), np.array(rows), np.ones(count), used))
    return _flat(parts)


def _of_stack(stack: StackedFactors, estimate: Estimate) -> Part:
    found = stack.measured(estimate.snapshot)
    weight = np.where(found.used, found.weight, 0.0)
    return stack.t_ns[found.row], stack.sensor, found.white, weight, found.used


def _of_late_rows(sensor: str, problem: Problem, estimate: Estimate) -> list[Part]:
    """Rows of a replay that have no keyframe of their own, at their measurement time."""
    stamps = {row.row: row.t_ns for window in problem.windows for row in window.delayed.get(sensor, ())}
    parts: list[Part] = []
    for stack in estimate.stacks(sensor) if stamps else ():
        late = np.isin(stack.rows, list(stamps))
        _, _, white, weight, used = _of_stack(stack, estimate)
        t_ns = np.array([stamps[row] for row in stack.rows[late].tolist()], dtype=np.int64)
        parts.append((t_ns, sensor, white[late], weight[late], used[late]))
    return parts


def _weights(builder: PositionBuilder, white: Floats) -> Floats:
    """Robust weights (n,) of the loss in force."""
    if builder.config.loss != "huber":
        return np.ones(len(white))
    return loss_weights((white**2).sum(axis=1), "huber", dim=white.shape[1])[0]


def _flat(parts: Sequence[Part]) -> Residuals:
    if not parts:
        return Residuals.empty()
    width = [rows.shape[1] if rows.ndim == 2 else 0 for _, _, rows, _, _ in parts]

    def spread(pick: Any) -> NDArray[Any]:
        return np.concatenate([np.repeat(pick(part), w) for part, w in zip(parts, width, strict=True)])

    return Residuals(
        t_ns=spread(lambda part: part[0]),
        sensor=np.concatenate([np.full(part[2].size, part[1], dtype=object) for part in parts]),
        axis=np.concatenate([np.tile(np.arange(w), len(part[0])) for part, w in zip(parts, width, strict=True)]),
        whitened=np.concatenate([part[2].ravel() for part in parts]),
        weight=spread(lambda part: part[3]),
        used=spread(lambda part: part[4]),
    )


def score_holdout(problem: Problem, keyframes: Solution, estimate: Estimate) -> dict[str, Withheld]:
    """Withheld rows against the smoothed prediction through their sensor's model: at its time offset, with its lever
    arm. Stamps t of a sensor with offset tau are IMU time t + tau; beyond the ends the velocity is constant."""
    scored = {}
    for name, stream in problem.withheld.items():
        inside = (stream.t_ns >= keyframes.t_ns[0]) & (stream.t_ns <= keyframes.t_ns[-1])
        rows = stream.take(inside)
        if not len(rows):
            continue
        lever = problem.session.lever_arms(rows) + estimate.session_value(f"{name}_lever_arm_correction_m", 3)
        p = predict_sensor(problem, keyframes, rows.t_ns, estimate.offset_s(name), lever)
        sigma = keyframes.sigmas[nearest(rows.t_ns, keyframes.t_ns), POS]
        own = np.full(p.shape, np.nan) if rows.sigma is None else rows.sigma
        error = p - problem.session.nav_position(rows)
        error[~rows.has_height, 2] = np.nan
        scored[name] = Withheld(rows.t_ns, error, np.hypot(sigma, own))
    return scored


def predict_sensor(
    problem: Problem, solution: Solution, t_ns: NDArray[np.int64], offset_s: float, lever: Floats
) -> Floats:
    """Position (n, 3) nav m of a sensor whose clock is off by `offset_s`, at lever arms (n, 3) or (3,) m body axes, at
    its own stamps t_ns (n,)."""
    shifted = t_ns + round(offset_s * NS)
    known = np.clip(shifted, solution.t_ns[0], solution.t_ns[-1])
    there = states_at(problem.windows, kinematics(solution), problem.session.gravity, known)
    return sensor_positions(there, (shifted - known) / NS, lever)


def sensor_positions(there: Kinematics, ahead_s: Floats, lever: Floats) -> Floats:
    """Positions (n, 3) of a sensor at lever arms (n, 3) or (3,), `ahead_s` (n,) after states by velocity alone."""
    arms = np.broadcast_to(lever, there.p.shape)
    return np.asarray(there.p + there.v * ahead_s[:, None] + rotate(there.R, arms))


def resample(problem: Problem, keyframes: Solution) -> Solution:
    """The solution at the rate asked for, at keyframes and images if at none. States by inertial prediction,
    covariances interpolated between keyframes."""
    rate = problem.config.run.rate
    first, last = int(keyframes.t_ns[0]), int(keyframes.t_ns[-1])
    if rate == "keyframes":
        seen = _image_times(problem)
        t_ns = np.union1d(keyframes.t_ns, seen[(seen >= first) & (seen <= last)])
        if len(t_ns) == len(keyframes.t_ns):
            return keyframes
    elif rate == "imu":
        imu = problem.session.require_imu()
        t_ns = imu.t_ns[(imu.t_ns >= first) & (imu.t_ns <= last)]
    else:
        t_ns = first + ns_from_seconds(np.arange(0.0, (last - first) / 1e9, 1.0 / float(rate)))
    if len(t_ns) > 2_000_000:
        raise SessionError("--rate", f"{len(t_ns)} output rows", "at most 2 000 000", "ask for a lower rate")
    states = states_at(problem.windows, kinematics(keyframes), problem.session.gravity, t_ns)
    flat = interpolate(t_ns, keyframes.t_ns, keyframes.covariance.reshape(-1, 225))
    return replace(_solution(problem, t_ns, states, flat.reshape(-1, 15, 15)), residuals=keyframes.residuals)


def _image_times(problem: Problem) -> NDArray[np.int64]:
    """Stamps of all images of which there are matches or tracks."""
    session = problem.session
    found = [stream.t_ns for stream in (session.matches, session.tracks) if stream is not None]
    if session.matches is not None:
        found.append(session.matches.t_1_ns)
    return np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *found]))


def used_counts(problem: Problem, pass_state: PassState) -> Mapping[str, int]:
    """Rows in use of every absolute sensor."""
    counts = {}
    for name in (builder.name for builder in problem.builders if builder.name in ABSOLUTE):
        there = sum(len(w.rows.get(name, ())) + len(w.delayed.get(name, ())) for w in problem.windows)
        unused = len(pass_state.rejected.get(name, ())) + problem.dropped.get(name, {}).get(TOO_LATE, 0)
        counts[name] = there - unused
    return counts
