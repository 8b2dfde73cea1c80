"""A small analytic run with attitude, velocity and a known covariance."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from smartnav_graph.core.timebase import NS
from smartnav_graph.graph.solution import Solution
from smartnav_graph.session.streams import Reference

T0 = 46_534_478_375_790


def make_truth(seconds: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position, velocity and attitude of a bumpy ride; heading passes +-180 deg."""
    t = seconds
    position = np.stack([20 * np.sin(0.2 * t) + t, 15 * np.cos(0.13 * t), 2 * np.sin(0.4 * t)], axis=-1)
    velocity = np.stack([4 * np.cos(0.2 * t) + 1, -1.95 * np.sin(0.13 * t), 0.8 * np.cos(0.4 * t)], axis=-1)
    rotation = Rotation.from_euler("ZYX", np.stack([0.3 * t, 0.1 * np.sin(t), 0.2 * np.cos(t)], axis=-1)).as_matrix()
    return position, velocity, rotation


def make_solution(seconds: np.ndarray, covariance: np.ndarray | None = None) -> Solution:
    position, velocity, rotation = make_truth(seconds)
    n = len(seconds)
    return Solution(
        t_ns=T0 + np.rint(seconds * NS).astype(np.int64),
        nav_R_body=rotation,
        nav_t_body=position,
        nav_v_body=velocity,
        accel_bias=np.zeros((n, 3)),
        gyro_bias=np.zeros((n, 3)),
        covariance=np.broadcast_to(0.01 * np.eye(15) if covariance is None else covariance, (n, 15, 15)),
        t0_ns=T0,
    )


def make_reference(seconds: np.ndarray, *, attitude: bool = True, velocity: bool = True) -> Reference:
    p, v, R = make_truth(seconds)
    return Reference(
        t_ns=T0 + np.rint(seconds * NS).astype(np.int64),
        enu=p,
        quat=Rotation.from_matrix(R).as_quat()[:, [3, 0, 1, 2]] if attitude else None,
        velocity=v if velocity else None,
    )
