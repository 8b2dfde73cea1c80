"""Inertial windows with scale factors and misalignments of both sensors as one session state.

The deterministic errors of accelerometer and gyroscope are matrices on the bias-free reading,

    force = (1 + M_a)(accel - b_a)        rate = (1 + M_g)(gyro - b_g)

with M_a and M_g row-major in the state S (18: accelerometer, gyroscope). Preintegrated rotation, position and velocity
follow a change of bias or S to first order; for one per cent and half a degree the second order is 1e-4 of gravity.

Residual of a window, [rotation on the body side, position, velocity in axes of the first body frame]:

    Log(R^T R_j)        R_i^T (p_j - p)        R_i^T (v_j - v)

where R, p, v is the state that keyframe i foretells for j.

Source: Forster, Carlone, Dellaert, Scaramuzza (2017), IEEE T-RO 33(1), III-V; Titterton, Weston (2004), Strapdown
Inertial Navigation Technology, 8.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from smartnav_graph.factors.observation import exp, foretold, left_jacobian_inverse, right_jacobian, skew, turned
from smartnav_graph.graph import Block, SessionState, Step, Window, key

Floats = NDArray[np.float64]

NAME = "imu_scale_misalignment"
_STATES = 24  # bias (6) and S (18) that a window follows


def scale_state(sigma: float) -> SessionState:
    """The state S with the same prior sigma for every element (a number: scale error, or rad)."""
    return SessionState("S", "imu", NAME, np.zeros(18), np.full(18, sigma))


class Integrated(NamedTuple):
    """A window preintegrated: dR (3, 3), dp (3,) m, dv (3,) m/s, and their derivatives (9, 24) by bias and S."""

    dR: Floats
    dp: Floats
    dv: Floats
    by: Floats


def integrated(window: Window, bias: Floats) -> Integrated:
    """Preintegrate at a bias (6,) and S = 0, with derivatives.

    A turn psi_k of the attitude (first body frame) by errors of the rate turns every later force,
    psi_k+1 = psi_k + R_k+1 Jr(w dt) dw dt and df_k = psi_k x R_k a_k + R_k da_k; sums over the samples do the rest.
    """
    dt = window.dt
    accel, gyro = window.accel - bias[:3], window.gyro - bias[3:]
    turns = exp(gyro * dt[:, None])
    R = np.empty((len(dt) + 1, 3, 3))
    R[0] = np.eye(3)
    for k, turn in enumerate(turns):
        R[k + 1] = R[k] @ turn
    force = turned(R[:-1], accel)
    by_rate = R[1:] @ right_jacobian(gyro * dt[:, None]) * dt[:, None, None]
    before = np.zeros((len(dt), 3, 12))  # gyro bias, then M_g
    change = np.concatenate([-by_rate, _outer(by_rate, gyro)], axis=2)
    before[1:] = np.cumsum(change, axis=0)[:-1]
    by_force = np.concatenate([-R[:-1], skew(-force) @ before[:, :, :3]], axis=2)
    by_force = np.concatenate([by_force, _outer(R[:-1], accel), skew(-force) @ before[:, :, 3:]], axis=2)
    dp, dv = _sums(force, dt)
    by = np.zeros((9, _STATES))
    turned_by = R[-1].T @ change.sum(axis=0)
    by[:3, 3:6], by[:3, 15:] = turned_by[:, :3], turned_by[:, 3:]
    by[3:6], by[6:] = _sums(by_force, dt)
    return Integrated(R[-1], dp, dv, by)


def _sums(force: Floats, dt: Floats) -> tuple[Floats, Floats]:
    """Position and velocity that a force held over each interval adds up to; any trailing shape."""
    step = dt.reshape(-1, *[1] * (force.ndim - 1))
    gained = force * step
    speed = np.cumsum(gained, axis=0) - gained
    return np.asarray(((speed + 0.5 * gained) * step).sum(axis=0)), np.asarray(gained.sum(axis=0))


def _outer(columns: Floats, reading: Floats) -> Floats:
    """Derivative (m, 3, 9) of columns (m, 3, 3) times M reading (m, 3), by M row-major."""
    return np.asarray(np.einsum("nir,nc->nirc", columns, reading).reshape(-1, 3, 9))


_AT = {"dt": 1, "dR": 9, "dp": 3, "dv": 3, "by_bias": 9 * _STATES, "bias": _STATES, "gravity": 1, "root": 81}


class ScaledWindow:
    """Row model of an inertial window; data as `columns` makes them."""

    letters: tuple[str, ...] = ("X", "V", "X", "V", "B", "S")

    def linearize(self, states: Sequence[Floats], data: Floats) -> tuple[Floats, list[Floats]]:
        """See `graph.RowModel`."""
        pose, velocity, pose_j, velocity_j, bias, scale = states
        at = unpacked(data)
        there = foretold(pose, velocity, np.concatenate([bias, scale], axis=1), at)
        Ri, Rj = pose[:, :3, :3], pose_j[:, :3, :3]
        back = Ri.transpose(0, 2, 1)
        turn = Rotation.from_matrix(there.R.transpose(0, 2, 1) @ Rj).as_rotvec()
        dp, dv = turned(back, pose_j[:, :3, 3] - there.p), turned(back, velocity_j - there.v)
        m = len(pose)
        by_there = np.zeros((m, 9, 9))
        by_there[:, :3, :3] = -left_jacobian_inverse(turn)
        by_there[:, 3:6, 3:6] = by_there[:, 6:, 6:] = -back
        by_pose, by_velocity, by_rest = (by_there @ jacobian for jacobian in there.by)
        by_pose[:, 3:6, :3] += skew(dp)
        by_pose[:, 6:, :3] += skew(dv)
        after, speed = np.zeros((m, 9, 6)), np.zeros((m, 9, 3))
        after[:, :3, :3] = left_jacobian_inverse(-turn)
        after[:, 3:6, 3:] = back @ Rj
        speed[:, 6:] = back
        root = at["root"].reshape(m, 9, 9)
        residual = turned(root, np.concatenate([turn, dp, dv], axis=1))
        jacobians = (by_pose, by_velocity, after, speed, by_rest[:, :, :6], by_rest[:, :, 6:])
        return residual, [root @ jacobian for jacobian in jacobians]


MODEL = ScaledWindow()


def unpacked(data: Floats) -> dict[str, Floats]:
    """Columns of the data by name."""
    out, start = {}, 0
    for name, width in _AT.items():
        out[name] = data[:, start : start + width]
        start += width
    return out


def columns(window: Window, bias: Floats, covariance: Floats, gravity: float) -> Floats:
    """Data of one row; covariance (9, 9) of GTSAM's preintegrated [rotation vector, position, velocity]."""
    found = integrated(window, bias)
    turn = np.eye(9)
    turn[:3, :3] = right_jacobian(Rotation.from_matrix(found.dR).as_rotvec()[None])[0]
    root = np.linalg.inv(np.linalg.cholesky(turn @ covariance @ turn.T))
    base = np.concatenate([bias, np.zeros(_STATES - 6)])
    parts = ([window.dt.sum()], found.dR, found.dp, found.dv, found.by, base, [gravity], root)
    return np.concatenate([np.ravel(part) for part in parts])


def add(step: Step, window: Window, bias: Any, covariance: Floats, gravity: float, sigma: float) -> None:
    """The row of one window, and the state S."""
    i, j = window.index - 1, window.index
    keys = (key("X", i), key("V", i), key("X", j), key("V", j), key("B", i), step.use(scale_state(sigma)))
    data = columns(window, bias.vector(), covariance, gravity)
    step.blocks.append(Block("imu", MODEL, [keys], data[None], window.t1_ns))
