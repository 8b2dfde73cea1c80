"""Errors of sensors that have no state: how large each would be if it had one, by the residuals of the solution.

With whitened residuals r and Jacobian A of all factors at the solution, and the derivatives J of r by some errors x,

    x = -(J^T M J)^-1 J^T M r      cov x = (J^T M J)^-1      M = 1 - A (A^T A)^-1 A^T

is what one more iteration of least squares with x as states without priors finds. Tested one by one are the clock
offset of each position sensor, its rate, a jump of it, the lever arm, scale factors of accelerometer and gyroscope, and
the focal length of the camera; where several sensors measure the position, an offset of each to the others.

Source: Foerstner, Wrobel (2016), Photogrammetric Computer Vision, 4.6.4; Rao (1973), Linear statistical inference, 6e.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.timebase import NS
from smartnav_graph.estimate.result.assemble import SolvedProblem
from smartnav_graph.factors.coplanar_rows import CompressedRows
from smartnav_graph.factors.imu import ImuBuilder
from smartnav_graph.graph.states import key, kind_of
from smartnav_graph.graph.update import FactorId, one_of
from smartnav_graph.smoothers.estimate import Estimate
from smartnav_graph.smoothers.redundancy import CALIBRATION
from smartnav_graph.smoothers.whole_graph import Snapshot, WholeGraph

# Parts of the fixes between which a clock may jump, and the least number of fixes that are tested.
PARTS, LEAST_FIXES = 10, 6
# Share of the information on an error that the states must leave for it to be known.
LEAST_LEFT = 1e-6
# Variance of the mean readings of windows over that of their noise, from which a scale factor shows.
EXCITED = 250.0
# Factors of image pairs, and a small relative change of the focal length.
PAIRS, FOCAL_STEP = "image_pairs", 1e-4


@dataclass(frozen=True)
class SensorError:
    """An error of `sensor` with its sigma. kind : ``clock`` and, from t_ns on, ``clock jump`` (s, to be added to its
    stamps), ``clock rate`` (s/s, of the time since the middle); ``lever arm`` (m), ``accelerometer scale`` and ``gyro
    scale`` along the body axis `axis`; ``focal length`` (relative); ``offset`` (m) of its positions to the east,
    north or up."""

    sensor: str
    kind: str
    axis: str = ""
    t_ns: int | None = None
    value: float = 0.0
    sigma: float = np.inf


def sensor_errors(solved: SolvedProblem) -> list[SensorError]:
    """Every error that the data determine."""
    names, linear = _linearized(solved.estimate)
    parts = _parts(names, linear, {*solved.fixes, "imu", PAIRS})
    found = [*_of_positions(solved, parts), *_of_inertial_data(solved, parts), *_of_images(solved, parts)]
    if not found:
        return []
    i, j, value = linear.sparseJacobian_()
    whole = csc_array((value, (i.astype(np.intp) - 1, j.astype(np.intp) - 1)))
    A, b = whole[:, :-1], whole[:, [-1]].toarray()[:, 0]
    J = np.zeros((len(b), len(found)))
    for k, (_, rows) in enumerate(found):
        for first, derivative in rows:
            J[first : first + len(derivative), k] = derivative
    cross = np.asarray(A.T @ J)
    normal = splu((A.T @ A).tocsc(), "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    fitted = cross.T @ normal.solve(np.column_stack([cross, A.T @ b]))
    information, score, power = J.T @ J - fitted[:, :-1], J.T @ b - fitted[:, -1], (J**2).sum(axis=0)
    known = np.diag(information) > LEAST_LEFT * power
    errors, constant = list[SensorError](), 0
    for k in np.flatnonzero(known).tolist():
        error = found[k][0]
        constant = k if error.kind == "clock" else constant
        beside = error.kind in ("clock rate", "clock jump", "lever arm") and known[constant]
        own = np.array([k, constant] if beside else [k])
        covariance = np.linalg.pinv(information[np.ix_(own, own)], hermitian=True)
        value, variance = float(covariance[0] @ score[own]), float(covariance[0, 0])
        errors.append(replace(error, value=value, sigma=float(np.sqrt(variance))))
    return errors


def _linearized(estimate: Estimate) -> tuple[list[FactorId], gtsam.GaussianFactorGraph]:
    """Every factor in use, and the linear system of them in that order."""
    priors = [
        gtsam.PriorFactorVector(state.key, state.prior_mean, gtsam.noiseModel.Diagonal.Sigmas(state.prior_sigma))
        for state in estimate.session.values()
        if not state.held
    ]
    graph = WholeGraph([*(factor for _, factor in estimate.factors), *priors], estimate.blocks, estimate.held)
    names = [factor for factor, _ in estimate.factors] + [FactorId(CALIBRATION, 0)] * len(priors)
    for stack in graph.stacks:
        pairs = zip(stack.t_ns[stack.used].tolist(), stack.rows[stack.used].tolist(), strict=True)
        names += [FactorId(stack.sensor, t_ns, row) for t_ns, row in pairs]
    return names, graph.linearize(estimate.values)


# First row and derivatives (m,) of the residuals of some factors.
Derivatives = Sequence[tuple[int, Floats]]


@dataclass(frozen=True)
class _Part:
    """A linear factor: its first row, and its derivatives (m, d) by state."""

    name: FactorId
    row: int
    by_state: Mapping[int, Floats]


def _parts(names: Sequence[FactorId], linear: Any, sensors: Collection[str]) -> list[_Part]:
    found, row = list[_Part](), 0
    for i, name in enumerate(names):
        factor = linear.at(i)
        if factor is None or factor.empty():
            continue
        A, right = factor.jacobian()
        if name.sensor in sensors:
            at, by_state = 0, dict[int, Floats]()
            for state in factor.keys():  # noqa: SIM118
                width = kind_of(state).dim
                by_state[state] = A[:, at : at + width]
                at += width
            found.append(_Part(name, row, by_state))
        row += len(right)
    return found


def _of_positions(solved: SolvedProblem, parts: Sequence[_Part]) -> Iterator[tuple[SensorError, Derivatives]]:
    estimate = solved.estimate
    R, _, v, _ = estimate.states()
    pose = {key("X", index): k for k, index in enumerate(estimate.indices)}
    for sensor in solved.fixes:
        rows = []
        for part in parts:
            states = [state for state in part.by_state if state in pose]
            if part.name.sensor == sensor and len(states) == 1:
                rows.append((part, part.by_state[states[0]][:, 3:6], pose[states[0]]))  # by the position, body axes
        if len(rows) < LEAST_FIXES:
            continue
        moved = [(part.row, W @ R[k].T @ v[k]) for part, W, k in rows]
        yield SensorError(sensor, "clock"), moved
        since = np.array([part.name.t_ns - estimate.t_ns[0] for part, _, _ in rows]) / NS
        since -= since.mean()
        yield SensorError(sensor, "clock rate"), [(row, t * by) for t, (row, by) in zip(since, moved, strict=True)]
        for first in sorted({n * len(rows) // PARTS for n in range(1, PARTS)} - {0}):
            yield SensorError(sensor, "clock jump", t_ns=rows[first][0].name.t_ns), moved[first:]
        for axis in range(3):
            yield SensorError(sensor, "lever arm", "xyz"[axis]), [(part.row, W[:, axis]) for part, W, _ in rows]
            if len(solved.fixes) > 1:
                shifted = [(part.row, W @ R[k].T[:, axis]) for part, W, k in rows]
                yield SensorError(sensor, "offset", ("east", "north", "up")[axis]), shifted


def _of_inertial_data(solved: SolvedProblem, parts: Sequence[_Part]) -> Iterator[tuple[SensorError, Derivatives]]:
    """A scale acts as a bias in proportion to the mean reading of a window. Where noise is what makes these means vary,
    they are no measure of the motion."""
    windows = {window.t1_ns: window for window in solved.problem.windows if window.kind == "normal"}
    bias = {key("B", index) for index in solved.estimate.indices}
    rows = [
        (part.row, next(J for state, J in part.by_state.items() if state in bias), windows[part.name.t_ns])
        for part in parts
        if part.name.sensor == "imu" and part.name.t_ns in windows
    ]
    imu = one_of(solved.problem.builders, ImuBuilder)
    if imu is None or not rows:
        return
    length_s = np.array([window.length_s for _, _, window in rows])
    kinds = (
        ("accelerometer scale", "accel", imu.noise.accel_noise_density * solved.pass_state.scale("accel"), 0),
        ("gyro scale", "gyro", imu.noise.gyro_noise_density * solved.pass_state.scale("gyro"), 3),
    )
    for kind, field, density, column in kinds:
        mean = np.array([w.dt @ getattr(w, field) / w.dt.sum() for _, _, w in rows])
        varies = np.var(mean, axis=0) > EXCITED * density**2 * float(np.mean(1.0 / length_s))
        for axis in np.flatnonzero(varies):
            derivatives = [(row, J[:, column + axis] * mean[k, axis]) for k, (row, J, _) in enumerate(rows)]
            yield SensorError("imu", kind, "xyz"[axis]), derivatives


def _of_images(solved: SolvedProblem, parts: Sequence[_Part]) -> Iterator[tuple[SensorError, Derivatives]]:
    """Directions by a focal length that is too small are too far from the axis: x (1 + f), y (1 + f) in every match,
    which is vec(E) with its entries multiplied by 1, 1 + f or (1 + f)^2."""
    by_pair = {part.name.row: part.row for part in parts if part.name.sensor == PAIRS}
    rows = list[tuple[int, Floats]]()
    across = np.array([1.0 + FOCAL_STEP, 1.0 + FOCAL_STEP, 1.0])
    for stack in solved.estimate.stacks(PAIRS):
        if not isinstance(stack.model, CompressedRows):
            continue
        moved = copy(stack.model)
        moved.root = stack.model.root.copy()
        moved.root[:, :, :9] *= np.outer(across, across).ravel()
        states = stack.states(Snapshot(solved.estimate.values, solved.estimate.held))
        change = [model.linearize(states, stack.data)[0] for model in (moved, stack.model)]
        derivative = (change[0] - change[1]) / FOCAL_STEP
        rows += [(by_pair[row], derivative[k]) for k, row in enumerate(stack.rows.tolist()) if row in by_pair]
    if len(rows) >= LEAST_FIXES:
        yield SensorError(PAIRS, "focal length"), rows
