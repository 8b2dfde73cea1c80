"""What a problem tells of its first state: its absolute positions and attitudes, a magnetometer, a walker's way."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from smartnav_graph.core.arrays import Floats, Times
from smartnav_graph.core.timebase import NS
from smartnav_graph.estimate.alignment.attitude import LONGEST_S, AttitudeStart, attitude_start
from smartnav_graph.estimate.alignment.initialiser import Initialiser
from smartnav_graph.estimate.alignment.magnetic import field_start
from smartnav_graph.estimate.alignment.pedestrian import SPARSE_S, Walk, walked
from smartnav_graph.estimate.problem import Problem
from smartnav_graph.estimate.reweight.outliers import position_builders
from smartnav_graph.factors.magnetometer import MagnetometerBuilder
from smartnav_graph.factors.pedestrian import StepBuilder
from smartnav_graph.factors.pose_fix import AttitudeBuilder


def initialiser_of(problem: Problem, longest_s: float | None = None) -> Initialiser:
    """The initialiser of a problem; `longest_s` bounds the stretch it may look at, and what it may know (replay)."""
    session, config = problem.session, problem.config.initialise
    causal = longest_s is not None
    if longest_s is not None:
        most = min(config.max_stretch_s, longest_s)
        config = replace(config, max_stretch_s=most, stretch_s=min(config.stretch_s, most))
    t_ns, positions, sources, known = _absolute_positions(problem)
    return Initialiser(
        windows=problem.windows,
        imu=session.require_imu(),
        fixes=(t_ns, positions),
        sources=sources,
        arrival_ns=known if causal else None,
        fix_sigma=max((float(np.median(b.sigma)) for b in position_builders(problem.builders)), default=1.0),
        gravity=session.gravity,
        noise=problem.calibration.imu_noise,
        forward=session.device.forward,
        config=config,
        weak=problem.config.prior,
        standstill=problem.rests_at_start,
        attitude_start=_oriented(problem, causal=causal),
        walk=_walked(problem, (t_ns, positions), known, config.max_stretch_s if causal else None),
        rest_end_ns=_standing(problem, config.rest_s),
        **_north(problem, causal=causal),
    )


def _standing(problem: Problem, shortest_s: float) -> int | None:
    """End of the standstill told of that the first keyframe lies in, if it lasts long enough."""
    start = problem.windows[0].t1_ns
    spans = () if problem.rests is None else problem.rests.confirmed
    ends = [b for a, b in spans if a <= start < b and b - start >= shortest_s * NS]
    return ends[0] if ends else None


def _walked(problem: Problem, fixes: tuple[Times, Floats], known: Times, causal_s: float | None) -> Walk | None:
    """First sight of a walker's way, where fixes are far apart; by what is known after `causal_s` seconds."""
    steps = next((b for b in problem.builders if isinstance(b, StepBuilder)), None)
    if steps is None or len(fixes[0]) < 2 or float(np.median(np.diff(fixes[0]))) < SPARSE_S * NS:
        return None
    end = problem.windows[-1].t1_ns if causal_s is None else problem.windows[0].t1_ns + int(causal_s * NS)
    used, noise = known <= end, problem.calibration
    return walked(
        [window for window in problem.windows if window.t1_ns <= end],
        steps.steps,
        (fixes[0][used], fixes[1][used]),
        max((float(np.median(b.sigma[:, :2])) for b in position_builders(problem.builders)), default=1.0),
        noise.imu_noise.gyro_bias_sigma,
        steps.model.body_R_vehicle,
        noise.step_noise,
    )


def _oriented(problem: Problem, *, causal: bool) -> AttitudeStart | None:
    """Attitude and gyro bias at the start by the first pose fixes that have an attitude."""
    builder = next((b for b in problem.builders if isinstance(b, AttitudeBuilder)), None)
    stream = problem.session.pose_fixes
    if builder is None or stream is None:
        return None
    start, sigma = problem.windows[0].t1_ns, problem.calibration.imu_noise.gyro_bias_sigma
    rows = builder.known & ((stream.available_ns <= start + LONGEST_S * NS) if causal else True)
    nav_R_body = builder.attitude[rows] @ builder.mount.T
    return attitude_start(problem.session.require_imu(), start, stream.t_ns[rows], nav_R_body, sigma)


def _north(problem: Problem, *, causal: bool) -> dict[str, Any]:
    """What the magnetometer says of the start, for the initialiser."""
    builder = next((b for b in problem.builders if isinstance(b, MagnetometerBuilder)), None)
    stream = problem.session.magnetometer
    if builder is None or stream is None:
        return {"magnetometer": None, "declination_deg": 0.0}
    start = field_start(
        problem.session.require_imu(),
        stream,
        problem.windows[0].t1_ns,
        problem.calibration.imu_noise,
        builder.noise,
        builder.iron_sigma,
        builder.declination,
    )
    if start is not None:
        builder.begin(start.iron, start.iron_sigma)
    return {
        "magnetometer": stream,
        "declination_deg": problem.session.declination_deg,
        "iron_sigma": builder.iron_sigma,
        "magnetic_stage": builder.stage if builder.speaks(causal) else None,
        "field_start": start,
    }


def _absolute_positions(problem: Problem) -> tuple[Times, Floats, list[tuple[str, int]], Times]:
    """Stamps, nav positions, sensor and row, and arrival of all absolute measurements, in time order."""
    streams = problem.session.positions()
    if not streams:
        return np.zeros(0, dtype=np.int64), np.zeros((0, 3)), [], np.zeros(0, dtype=np.int64)
    t = np.concatenate([stream.t_ns for stream in streams.values()])
    p = np.concatenate([problem.session.nav_position(stream) for stream in streams.values()])
    sources = [(name, row) for name, stream in streams.items() for row in range(len(stream))]
    order = np.argsort(t, kind="stable")
    known = np.concatenate([stream.available_ns for stream in streams.values()])
    return t[order], p[order], [sources[i] for i in order], known[order]
