"""Errors of sensors that have no state: how large each would be if it had one, by the residuals of the solution, and
how far they may move it (`smoothers.sensitivity`).

Tested one by one are the clock offset of each position sensor, its rate, a jump of it, the lever arm, a stretch of its
positions along east and north; where several sensors measure the position, an offset of each to the others; scale
factors of accelerometer and gyroscope, and the focal length of a camera that has no state for it. Errors that a class
of devices has, and no state takes, are in the covariance (consider covariance): with their prior D, information I and
score s by the data,

    m = C s      C = (I + D^-1)^-1      P <- P + S (C + m m^T) S^T

where S is the change of the states by each error, which the solution does not correct.

Source: Rao (1973), Linear statistical inference, 6e; Schmidt (1966), Advances in Control Systems 3, 293.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.frames import STANDARD_GRAVITY
from smartnav_graph.core.so3 import log, rotate_back
from smartnav_graph.core.timebase import NS
from smartnav_graph.estimate.result.assemble import SolvedProblem
from smartnav_graph.factors.coplanar_rows import CompressedRows
from smartnav_graph.factors.imu import ImuBuilder
from smartnav_graph.graph.states import key
from smartnav_graph.graph.update import one_of
from smartnav_graph.smoothers.sensitivity import Derivatives, LinearPart, LinearSystem, Sensitivity

# Parts of the fixes between which a clock may jump, and the least number of fixes that are tested.
PARTS, LEAST_FIXES = 10, 6
# Share of the information on an error that the states must leave for it to be known.
LEAST_LEFT = 1e-6
# Variance of the mean readings of windows over that of their noise, from which a scale factor shows.
EXCITED = 250.0
# Factors of image pairs.
PAIRS = "image_pairs"
# Errors of a class of devices: scale factors, of each axis by itself and of all axes of a sensor alike (voltage,
# temperature, clock), and rate by specific force, rad/s / (m/s^2).
SCALE_SIGMA, COMMON_SCALE_SIGMA = 0.002, 0.006
# Velocity of a foot in its stances, m/s along each body axis: heights of walks and runs leave a level floor at 3 to 11
# mm/s.
STANCE_SPEED = 0.01
G_SENSITIVITY_SIGMA = float(np.radians(0.02)) / STANDARD_GRAVITY


@dataclass(frozen=True)
class SensorError:
    """An error of `sensor` with its sigma. kind : ``clock`` and, from t_ns on, ``clock jump`` (s, to be added to its
    stamps), ``clock rate`` (s/s, of the time since the middle); ``lever arm`` (m), ``accelerometer scale``, ``gyro
    scale`` and ``stance velocity`` of a foot (m/s) along the body axis `axis`; ``g-sensitivity`` of the gyro axis by
    the force along another, rad/s / (m/s^2); ``focal length`` (relative); of its positions to the east, north or up
    ``offset`` (m) and ``stretch`` (relative).

    prior_sigma : of what devices of the class have, zero where it is not in the covariance; shows : whether the data
    can say of it
    """

    sensor: str
    kind: str
    axis: str = ""
    t_ns: int | None = None
    value: float = 0.0
    sigma: float = np.inf
    prior_sigma: float = 0.0
    shows: bool = True


class Unmodelled(NamedTuple):
    """Errors without a state, what the data say of them, the change (n, 15, m) of the keyframes by each that has a
    prior, and the linear system that shows it."""

    errors: Sequence[SensorError]
    found: Sensitivity
    change: Floats
    linear: LinearSystem

    def covariance(self) -> Floats:
        """What they add to the covariance (n, 15, 15) of the keyframes."""
        sigma, kind = (np.array([getattr(error, name) for error in self.errors]) for name in ("prior_sigma", "kind"))
        own = np.flatnonzero(sigma)
        common = np.array([COMMON_SCALE_SIGMA if name.endswith("scale") else 0.0 for name in kind[own]])
        prior = np.diag(sigma[own] ** 2) + np.outer(common, common) * (kind[own, None] == kind[own])
        left = np.linalg.solve(np.eye(len(own)) + prior @ self.found.information[np.ix_(own, own)], prior)
        middle = left @ self.found.score[own]
        added = self.change @ (left + np.outer(middle, middle)) @ self.change.transpose(0, 2, 1)
        return np.asarray(0.5 * (added + added.transpose(0, 2, 1)))


def unmodelled(solved: SolvedProblem) -> Unmodelled | None:
    """Every error that is looked at; None where there is none."""
    linear = LinearSystem(solved.estimate)
    parts = linear.parts({"imu", "static", PAIRS})
    found = [*_of_positions(solved, linear), *_of_inertial_data(solved, parts), *_of_images(solved, parts)]
    found += _of_stances(solved, parts)
    if not found:
        return None
    own = [k for k, (error, _) in enumerate(found) if error.prior_sigma]
    sensitivity = linear.sensitivity([rows for _, rows in found], own)
    return Unmodelled([error for error, _ in found], sensitivity, linear.keyframes(sensitivity.change), linear)


def sensor_errors(looked_at: Unmodelled | None) -> list[SensorError]:
    """Every error that the data determine, by itself or beside a clock offset."""
    if looked_at is None:
        return []
    found, errors, constant = looked_at.found, list[SensorError](), 0
    known = (found.left > LEAST_LEFT) & [error.shows for error in looked_at.errors]
    for k in np.flatnonzero(known).tolist():
        error = looked_at.errors[k]
        constant = k if error.kind == "clock" else constant
        beside = error.kind in ("clock rate", "clock jump", "lever arm") and known[constant]
        own = np.array([k, constant] if beside else [k])
        covariance = np.linalg.pinv(found.information[np.ix_(own, own)], hermitian=True)
        value, variance = float(covariance[0] @ found.score[own]), float(covariance[0, 0])
        errors.append(replace(error, value=value, sigma=float(np.sqrt(variance))))
    return errors


def _of_positions(solved: SolvedProblem, linear: LinearSystem) -> Iterator[tuple[SensorError, Derivatives]]:
    estimate = solved.estimate
    R, p, v, _ = estimate.states()
    middle = p.mean(axis=0)
    for sensor in solved.fixes:
        rows = linear.at_poses(sensor)
        if len(rows) < LEAST_FIXES:
            continue
        moved = [(part.row, W @ R[k].T @ v[k]) for part, W, k in rows]
        yield SensorError(sensor, "clock"), moved
        since = np.array([part.name.t_ns - estimate.t_ns[0] for part, _, _ in rows]) / NS
        since -= since.mean()
        yield SensorError(sensor, "clock rate"), [(row, t * by) for t, (row, by) in zip(since, moved, strict=True)]
        for first in sorted({n * len(rows) // PARTS for n in range(1, PARTS)} - {0}):
            yield SensorError(sensor, "clock jump", t_ns=rows[first][0].name.t_ns), moved[first:]
        for axis, name in enumerate(("east", "north", "up")):
            yield SensorError(sensor, "lever arm", "xyz"[axis]), [(part.row, W[:, axis]) for part, W, _ in rows]
            shifted = [(part.row, W @ R[k].T[:, axis]) for part, W, k in rows]
            if len(solved.fixes) > 1:
                yield SensorError(sensor, "offset", name), shifted
            if name != "up":
                from_middle = [p[k, axis] - middle[axis] for _, _, k in rows]
                stretched = [(row, d * by) for d, (row, by) in zip(from_middle, shifted, strict=True)]
                yield SensorError(sensor, "stretch", name), stretched


def _of_inertial_data(solved: SolvedProblem, parts: Sequence[LinearPart]) -> Iterator[tuple[SensorError, Derivatives]]:
    """An error in proportion to a reading acts as a bias in proportion to its mean over a window, by the solution. That
    of the mean specific force is a bias. Where noise is what makes these means vary, they are no measure of the motion;
    of a foot, what its stances leave looks the same.
    """
    imu, estimate = one_of(solved.problem.builders, ImuBuilder), solved.estimate
    windows = {window.t1_ns: window for window in solved.problem.windows if window.kind == "normal"}
    place = {key("B", index): k for k, index in enumerate(estimate.indices[:-1])}
    inertial = [part for part in parts if part.name.sensor == "imu" and part.name.t_ns in windows]
    rows = [(part.row, part.by_state[b], place[b]) for part in inertial for b in part.by_state if b in place]
    if imu is None or not rows:
        return
    R, _, v, _ = estimate.states()
    on_foot = solved.problem.rests is not None and solved.problem.rests.on_foot
    scale_sigma, sensitivity_sigma = (0.0, 0.0) if imu.is_known else (SCALE_SIGMA, G_SENSITIVITY_SIGMA)
    first = np.array([k for _, _, k in rows])
    length_s = np.diff(estimate.t_ns)[first, None] / NS
    turned = log(R[first].transpose(0, 2, 1) @ R[first + 1]) / length_s
    accel = (v[first + 1] - v[first]) / length_s + [0.0, 0.0, solved.problem.session.gravity]
    force = rotate_back(0.5 * (R[first] + R[first + 1]), accel)
    force -= force.mean(axis=0)

    def directions(bias: int, reading: Floats) -> Derivatives:
        return [(row, by[:, bias] * one) for (row, by, _), one in zip(rows, reading.tolist(), strict=True)]

    kinds = (
        ("accelerometer scale", force, imu.noise.accel_noise_density * solved.pass_state.scale("accel"), 0),
        ("gyro scale", turned, imu.noise.gyro_noise_density * solved.pass_state.scale("gyro"), 3),
    )
    for kind, reading, density, bias in kinds:
        varies = (np.var(reading, axis=0) > EXCITED * density**2 * float(np.mean(1.0 / length_s))) & (not on_foot)
        for axis in range(3):
            error = SensorError("imu", kind, "xyz"[axis], prior_sigma=scale_sigma, shows=bool(varies[axis]))
            yield error, directions(bias + axis, reading[:, axis])
    for gyro in range(3):
        for axis in range(3):
            error = SensorError("imu", "g-sensitivity", "xyz"[gyro], prior_sigma=sensitivity_sigma, shows=False)
            yield error, directions(3 + gyro, force[:, axis])


def _of_stances(solved: SolvedProblem, parts: Sequence[LinearPart]) -> Iterator[tuple[SensorError, Derivatives]]:
    """A foot in a stance is never quite at rest, and what the swing before leaves in the velocity is alike in every
    step: a velocity in body axes that all stances have."""
    rests, estimate = solved.problem.rests, solved.estimate
    if rests is None or not rests.on_foot:
        return
    place = {key("V", index): k for k, index in enumerate(estimate.indices)}
    R = estimate.states()[0]
    rows = [
        (part.row, -by @ R[place[name]])
        for part in parts
        if part.name.sensor == "static" and np.isnan(rests.over(rests.turn_sigma, part.name.t_ns, part.name.t_ns))
        for name, by in part.by_state.items()
        if name in place
    ]
    for axis in range(3) if rows else ():
        error = SensorError("static", "stance velocity", "xyz"[axis], prior_sigma=STANCE_SPEED, shows=False)
        yield error, [(row, by[:, axis]) for row, by in rows]


def _of_images(solved: SolvedProblem, parts: Sequence[LinearPart]) -> Iterator[tuple[SensorError, Derivatives]]:
    """Of a camera whose focal length is no state."""
    by_pair = {part.name.row: part.row for part in parts if part.name.sensor == PAIRS}
    rows = list[tuple[int, Floats]]()
    for stack in solved.estimate.stacks(PAIRS):
        if not isinstance(stack.model, CompressedRows) or stack.model.rig.focal:
            continue
        model = copy(stack.model)
        model.rig = replace(model.rig, focal=True)
        states = [*stack.states(solved.estimate.snapshot), np.zeros((len(stack.data), 1))]
        derivative = model.linearize(states, stack.data)[1][-1][:, :, 0]
        rows += [(by_pair[row], derivative[k]) for k, row in enumerate(stack.rows.tolist()) if row in by_pair]
    if len(rows) >= LEAST_FIXES:
        yield SensorError(PAIRS, "focal length"), rows
