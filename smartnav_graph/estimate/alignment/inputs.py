"""A problem -> its first stretch: positions and attitudes, magnetic field, the path of a pedestrian, a rest."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from smartnav_graph.core.timebase import NS
from smartnav_graph.estimate.alignment.attitude import LONGEST_S, AttitudeStart, attitude_start
from smartnav_graph.estimate.alignment.first_stretch import FirstStretch, Fixes
from smartnav_graph.estimate.alignment.initial_state import UserStart
from smartnav_graph.estimate.alignment.magnetic import field_start
from smartnav_graph.estimate.alignment.multilateration import multilaterate
from smartnav_graph.estimate.alignment.pedestrian import SPARSE_S, Walk, walked
from smartnav_graph.estimate.alignment.visual import VisualStart, visual_start
from smartnav_graph.estimate.problem import Problem
from smartnav_graph.estimate.reweight.outliers import position_builders
from smartnav_graph.factors.coplanarity import CoplanarityBuilder
from smartnav_graph.factors.imu import ImuBuilder
from smartnav_graph.factors.magnetometer import IRON, MagnetometerBuilder
from smartnav_graph.factors.pedestrian import StepBuilder
from smartnav_graph.factors.pose_fix import AttitudeBuilder
from smartnav_graph.factors.ranging import RangeBuilder
from smartnav_graph.graph.pass_state import PassState, Phase
from smartnav_graph.graph.update import one_of


def first_stretch(problem: Problem, longest_s: float | None = None) -> FirstStretch:
    """The first stretch of a problem; `longest_s` bounds its length, and what may be known of it (replay)."""
    session, config = problem.session, problem.config.initialise
    causal = longest_s is not None
    if longest_s is not None:
        most = min(config.max_stretch_s, longest_s)
        config = replace(config, max_stretch_s=most, stretch_s=min(config.stretch_s, most))
    fixes = absolute_positions(problem)
    return FirstStretch(
        windows=problem.windows,
        imu=session.require_imu(),
        fixes=fixes if causal else replace(fixes, available_ns=fixes.t_ns),
        fix_sigma=_fix_sigma(problem, 3),
        gravity=session.gravity,
        noise=problem.calibration.imu_noise,
        forward=session.device.forward,
        up=session.device.up,
        config=config,
        weak=problem.config.prior,
        standstill=problem.rests_at_start,
        attitude_start=_oriented(problem, causal=causal),
        visual=None if len(fixes) else _seen(problem),
        walk=_walked(problem, fixes, config.max_stretch_s if causal else None),
        rest_end_ns=_standing(problem, config.rest_s),
        user=UserStart.parse(problem.config.run.initial) if problem.config.run.initial else None,
        **_north(problem, causal=causal),
    )


def _fix_sigma(problem: Problem, axes: int) -> float:
    """Typical sigma (m) of the worst stream of positions, over its first `axes`."""
    builders = position_builders(problem.builders)
    return max((float(np.median(b.sigma[b.typical, :axes])) for b in builders), default=1.0)


def _standing(problem: Problem, shortest_s: float) -> int | None:
    """End of the listed standstill that the first keyframe lies in, if it lasts long enough."""
    start = problem.windows[0].t1_ns
    spans = () if problem.rests is None else problem.rests.confirmed
    ends = [b for a, b in spans if a <= start < b and b - start >= shortest_s * NS]
    return ends[0] if ends else None


def _walked(problem: Problem, fixes: Fixes, causal_s: float | None) -> Walk | None:
    """The rough path of a pedestrian, where fixes are far apart; by what is known after `causal_s` seconds."""
    steps = one_of(problem.builders, StepBuilder)
    end = problem.windows[-1].t1_ns if causal_s is None else problem.windows[0].t1_ns + int(causal_s * NS)
    used, noise = fixes.available_ns <= end, problem.calibration
    if steps is None or not steps.walks(end) or used.sum() < 2:
        return None
    if float(np.median(np.diff(fixes.t_ns[used]))) < SPARSE_S * NS:
        return None
    return walked(
        [window for window in problem.windows if window.t1_ns <= end],
        steps.steps,
        (fixes.t_ns[used], fixes.position[used]),
        _fix_sigma(problem, 2),
        noise.imu_noise.gyro_bias_sigma,
        steps.model.body_R_vehicle,
        noise.step_noise,
    )


def _seen(problem: Problem) -> VisualStart | None:
    """The start by images and inertial data."""
    builder, turns = one_of(problem.builders, CoplanarityBuilder), problem.camera_turns
    if builder is None:
        return None
    session, bias = problem.session, np.zeros(3) if turns is None else turns.gyro_bias
    start_ns, noise = problem.windows[0].t1_ns, problem.calibration.imu_noise
    return visual_start(builder, session.require_imu(), start_ns, session.gravity, noise, bias)


def _oriented(problem: Problem, *, causal: bool) -> AttitudeStart | None:
    """Attitude and gyro bias at the start by the first pose fixes that have an attitude."""
    builder = one_of(problem.builders, AttitudeBuilder)
    stream = problem.session.pose_fixes
    if builder is None or stream is None:
        return None
    start, sigma = problem.windows[0].t1_ns, problem.calibration.imu_noise.gyro_bias_sigma
    rows = builder.known & ((stream.available_ns <= start + LONGEST_S * NS) if causal else True)
    nav_R_body = builder.attitude[rows] @ builder.mount.T
    return attitude_start(problem.session.require_imu(), start, stream.t_ns[rows], nav_R_body, sigma)


def _known_noise(problem: Problem) -> PassState:
    imu = one_of(problem.builders, ImuBuilder)
    return PassState() if imu is None else PassState(noise_scales=imu.prior_scales())


def _north(problem: Problem, *, causal: bool) -> dict[str, Any]:
    known = _known_noise(problem)
    builder, phase = one_of(problem.builders, MagnetometerBuilder), Phase.CAUSAL if causal else Phase.PLAIN
    stream = problem.session.magnetometer
    if builder is None or stream is None:
        return {"pass_state": known}
    start = field_start(
        problem.session.require_imu(),
        stream,
        problem.windows[0].t1_ns,
        problem.calibration.imu_noise,
        builder.noise,
        builder.iron_sigma,
        builder.declination,
    )
    found = known if start is None else replace(known, aligned_states={IRON: (start.iron, start.iron_sigma)})
    return {
        "magnetometer": stream,
        "declination_deg": problem.session.declination_deg,
        "iron_sigma": builder.iron_sigma,
        "magnetic_stage": builder.stage if builder.usable(replace(found, phase=phase)) else None,
        "field_start": start,
        "pass_state": found,
    }


def measured_positions(problem: Problem) -> Fixes:
    """The positions of all streams that have some."""
    streams = problem.session.positions()
    if not streams:
        return Fixes.none()
    return Fixes(
        np.concatenate([stream.t_ns for stream in streams.values()]),
        np.concatenate([problem.session.nav_position(stream) for stream in streams.values()]),
        np.concatenate([stream.available_ns for stream in streams.values()]),
        [(name, row) for name, stream in streams.items() for row in range(len(stream))],
    )


def ranged_positions(problem: Problem) -> Fixes:
    """Positions by multilateration, where ranges are all there is."""
    builder, ranges = one_of(problem.builders, RangeBuilder), problem.session.ranges
    if builder is None or ranges is None or problem.session.positions() or problem.config.run.initial:
        return Fixes.none()
    found = multilaterate(ranges, builder.anchor, builder.sigma)
    return Fixes(found.t_ns, found.position, found.available_ns, [(builder.name, int(row)) for row in found.row])


# What gives the positions of the first stretch. A sensor whose rows give positions only together adds a function, which
# gives none where the measured ones suffice.
POSITIONS: Sequence[Callable[[Problem], Fixes]] = (measured_positions, ranged_positions)


def absolute_positions(problem: Problem) -> Fixes:
    """All positions, in time order."""
    return Fixes.sorted([positions(problem) for positions in POSITIONS])
