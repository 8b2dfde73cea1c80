"""Attitude and gyro bias at the start by the first attitudes that fixes bring: the gyro between them must agree.

    R_k = R_0 D_k(b)        D_k : from the body at t_k to the body at the start, as the gyro says with bias b

Gauss-Newton over R_0 and b, robust, on stretches that double, so that an unknown bias never turns the guess away.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from smartnav_graph.core.arrays import Floats, Times
from smartnav_graph.core.so3 import exp, left_jacobian_inverse, log
from smartnav_graph.core.timebase import seconds_since
from smartnav_graph.graph.robust import loss_weights
from smartnav_graph.session.streams import Imu

LONGEST_S = 30.0
GRID_S = 0.05  # turns are taken together
ITERATIONS = 6
# What a fix's attitude and the body's own may differ by beside noise (an unknown mount), rad.
SLACK = 0.05
# Sigmas of the bias that may turn the body by half a turn between two attitudes, at most.
UNAMBIGUOUS = 2.5


@dataclass(frozen=True)
class AttitudeStart:
    """nav_R_body (3, 3) and gyro bias (3,) rad/s at the start."""

    nav_R_body: Floats
    gyro_bias: Floats


def _turns(imu: Imu, start_ns: int, t_s: Floats, bias: Floats) -> tuple[Floats, Floats]:
    """D (m, 3, 3) at times t_s (m,) after the start, and its derivative (m, 3, 3) by the bias (right side)."""
    t = seconds_since(imu.t_ns, start_ns)
    part = slice(max(int(np.searchsorted(t, 0.0)) - 1, 0), int(np.searchsorted(t, t_s[-1])) + 1)
    t, gyro = t[part], imu.gyro[part]
    rotate = np.cumsum(0.5 * (gyro[1:] + gyro[:-1]) * np.diff(t)[:, None], axis=0)
    border = np.unique(np.concatenate([np.arange(0.0, t_s[-1], GRID_S), t_s]))
    dt = np.diff(border)
    angle = np.stack([np.interp(border, t[1:], column) for column in rotate.T], axis=-1)
    steps = exp(np.diff(angle, axis=0) - bias * dt[:, None])
    D, J = np.eye(3), np.zeros((3, 3))
    turns, derivatives = [D], [J]
    for step, length in zip(steps, dt, strict=True):
        D, J = D @ step, step.T @ J - length * np.eye(3)
        turns.append(D)
        derivatives.append(J)
    at = np.searchsorted(border, t_s)
    return np.array(turns)[at], np.array(derivatives)[at]


def _refined(
    R: Floats, bias: Floats, seen: Floats, rotate: tuple[Floats, Floats], bias_sigma: float
) -> tuple[Floats, Floats]:
    """One robust Gauss-Newton step of R_0 (3, 3) and b (3,) for attitudes `seen` (m, 3, 3)."""
    D, J = rotate
    theta = log((R @ D) @ seen.transpose(0, 2, 1))
    left = left_jacobian_inverse(theta)
    by = np.concatenate([left, left @ R @ D @ J], axis=2) / SLACK  # R_0 <- Exp(w) R_0
    root = np.sqrt(loss_weights((theta**2).sum(axis=1) / SLACK**2, "huber")[0])[:, None]
    held = np.concatenate([np.zeros((3, 3)), np.eye(3) / bias_sigma], axis=1)
    A = np.concatenate([(by * root[:, :, None]).reshape(-1, 6), held])
    r = np.concatenate([(theta / SLACK * root).ravel(), bias / bias_sigma])
    step = np.linalg.lstsq(A, -r, rcond=None)[0]
    return np.asarray(exp(step[None, :3])[0] @ R), bias + step[3:]


def attitude_start(imu: Imu, start_ns: int, t_ns: Times, nav_R_body: Floats, bias_sigma: float) -> AttitudeStart | None:
    """Attitude and gyro bias at `start_ns` by the attitudes (m, 3, 3) at t_ns (m,) of the `LONGEST_S` after it.

    None where there are fewer than two, or so far apart that a bias of `bias_sigma` rad/s may hide whole turns.
    """
    t_s = seconds_since(t_ns, start_ns)
    chosen = (t_s >= 0.0) & (t_s <= LONGEST_S)
    t_s, seen = t_s[chosen], nav_R_body[chosen]
    if len(t_s) < 2 or np.diff(t_s).max() * UNAMBIGUOUS * bias_sigma > np.pi:
        return None
    bias, count = np.zeros(3), 2
    R = seen[0] @ _turns(imu, start_ns, t_s[:2], bias)[0][0].T
    while True:
        for _ in range(ITERATIONS):
            R, bias = _refined(R, bias, seen[:count], _turns(imu, start_ns, t_s[:count], bias), bias_sigma)
        if count >= len(t_s):
            return AttitudeStart(R, bias)
        count = min(2 * count, len(t_s))
