"""Inertial windows as rows of a model, with further states that the readings depend on.

Preintegrated rotation, position and velocity follow small changes of the readings to first order; the derivatives by
states that cause such changes (biases, scale factors, errors across a data gap) are carried along.

Residual of a window, [rotation on the body side, position, velocity in axes of the first body frame]:

    Log(R^T R_j)        R_i^T (p_j - p)        R_i^T (v_j - v)

where R, p, v is the state at j predicted from keyframe i.

Source: Forster, Carlone, Dellaert, Scaramuzza (2017), On-manifold preintegration, IEEE T-RO 33(1), III-V.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.so3 import exp, left_jacobian_inverse, log, right_jacobian, rotate, skew
from smartnav_graph.factors.observation import propagate
from smartnav_graph.graph.states import STATES
from smartnav_graph.graph.windows import Window


class Integrated(NamedTuple):
    """A window preintegrated: dR (3, 3), dp (3,) m, dv (3,) m/s, and their derivatives (9, q) by the states."""

    dR: Floats
    dp: Floats
    dv: Floats
    by: Floats


def integrated(dt: Floats, force: Floats, rate: Floats, force_by: Floats, rate_by: Floats) -> Integrated:
    """Preintegrate intervals dt (m,) s of force (m, 3) and rate (m, 3), whose derivatives by q states are
    force_by and rate_by (m, 3, q).

    A turn psi_k of the attitude (first body frame) by errors of the rate turns every later force,
    psi_k+1 = psi_k + R_k+1 Jr(w dt) dw dt and df_k = psi_k x R_k a_k + R_k da_k; sums over the samples do the rest.
    """
    R = np.empty((len(dt) + 1, 3, 3))
    R[0] = np.eye(3)
    for k, turn in enumerate(exp(rate * dt[:, None])):
        R[k + 1] = R[k] @ turn
    led = rotate(R[:-1], force)
    change = R[1:] @ right_jacobian(rate * dt[:, None]) * dt[:, None, None] @ rate_by
    psi = np.zeros_like(change)
    psi[1:] = np.cumsum(change, axis=0)[:-1]
    dp, dv = _sums(led, dt)
    by = np.empty((9, force_by.shape[2]))
    by[:3] = R[-1].T @ change.sum(axis=0)
    by[3:6], by[6:] = _sums(skew(-led) @ psi + R[:-1] @ force_by, dt)
    return Integrated(R[-1], dp, dv, by)


def _sums(force: Floats, dt: Floats) -> tuple[Floats, Floats]:
    """Position and velocity that a force held over each interval adds up to; any trailing shape."""
    step = dt.reshape(-1, *[1] * (force.ndim - 1))
    gained = force * step
    speed = np.cumsum(gained, axis=0) - gained
    return np.asarray(((speed + 0.5 * gained) * step).sum(axis=0)), np.asarray(gained.sum(axis=0))


class InertialRow:
    """Row model of inertial windows that depend on the bias and on the states of kind `others`."""

    def __init__(self, others: Sequence[str]) -> None:
        self.letters: tuple[str, ...] = ("X", "V", "X", "V", "B", *others)
        self.sizes = [STATES[letter].dim for letter in self.letters[4:]]
        q = sum(self.sizes)
        self._at = {"dt": 1, "dR": 9, "dp": 3, "dv": 3, "by_bias": 9 * q, "bias": q, "gravity": 1, "root": 81}

    def unpacked(self, data: Floats) -> dict[str, Floats]:
        """Columns of the data (m, ...) by name."""
        out, start = {}, 0
        for name, width in self._at.items():
            out[name] = data[:, start : start + width]
            start += width
        return out

    def data(self, window: Window, found: Integrated, bias: Floats, covariance: Floats, gravity: float) -> Floats:
        """Data of one row, integrated at a bias (6,) and zero otherwise; covariance (9, 9) of GTSAM's preintegrated
        [rotation vector, position, velocity]."""
        turn = np.eye(9)
        turn[:3, :3] = right_jacobian(log(found.dR)[None])[0]
        root = np.linalg.inv(np.linalg.cholesky(turn @ covariance @ turn.T))
        base = np.concatenate([bias, np.zeros(sum(self.sizes[1:]))])
        parts = ([window.dt.sum()], found.dR, found.dp, found.dv, found.by, base, [gravity], root)
        return np.concatenate([np.ravel(part) for part in parts])

    def linearize(self, states: Sequence[Floats], data: Floats) -> tuple[Floats, list[Floats]]:
        pose, velocity, pose_j, velocity_j, *rest = states
        at = self.unpacked(data)
        there = propagate(pose, velocity, np.concatenate(rest, axis=1), at)
        Ri, Rj = pose[:, :3, :3], pose_j[:, :3, :3]
        back = Ri.transpose(0, 2, 1)
        turn = log(there.R.transpose(0, 2, 1) @ Rj)
        dp, dv = rotate(back, pose_j[:, :3, 3] - there.p), rotate(back, velocity_j - there.v)
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
        residual = rotate(root, np.concatenate([turn, dp, dv], axis=1))
        by_others = np.split(by_rest, np.cumsum(self.sizes)[:-1], axis=2)
        return residual, [root @ jacobian for jacobian in (by_pose, by_velocity, after, speed, *by_others)]
