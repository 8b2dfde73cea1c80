"""Inertial windows with scale factors and misalignments of both sensors as one session state.

The deterministic errors of accelerometer and gyroscope are matrices on the bias-free reading,

    force = (1 + M_a)(accel - b_a)        rate = (1 + M_g)(gyro - b_g)

with M_a and M_g row-major in the state S (18: accelerometer, gyroscope). Preintegrated rotation, position and velocity
follow a change of bias or S to first order; for one per cent and half a degree the second order is 1e-4 of gravity.

Source: Titterton, Weston (2004), Strapdown Inertial Navigation Technology, 8; `preintegration` on the residual.
"""

from __future__ import annotations

import gtsam
import numpy as np

from smartnav_graph.core.arrays import Floats
from smartnav_graph.factors import preintegration
from smartnav_graph.factors.preintegration import InertialRow, Integrated
from smartnav_graph.graph.states import SessionState, key
from smartnav_graph.graph.update import FactorBatch, GraphUpdate
from smartnav_graph.graph.windows import Window

NAME = "imu_scale_misalignment"
MODEL = InertialRow("S")


def scale_state(sigma: float) -> SessionState:
    """The state S with the same prior sigma for every element (a number: scale error, or rad)."""
    return SessionState("S", "imu", NAME, np.zeros(18), np.full(18, sigma))


def integrated_with_intrinsics(window: Window, bias: Floats) -> Integrated:
    """Preintegrate at a bias (6,) and S = 0, with derivatives by bias and S (24)."""
    force, rate = window.accel - bias[:3], window.gyro - bias[3:]
    force_by, rate_by = np.zeros((2, len(window.dt), 3, 24))
    force_by[:, :, :3] = rate_by[:, :, 3:6] = -np.eye(3)
    force_by[:, :, 6:15], rate_by[:, :, 15:] = _by_elements(force), _by_elements(rate)
    return preintegration.integrated(window.dt, force, rate, force_by, rate_by)


def _by_elements(reading: Floats) -> Floats:
    """Derivative (m, 3, 9) of M reading (m, 3), by M row-major."""
    return np.asarray(np.einsum("ir,nc->nirc", np.eye(3), reading).reshape(-1, 3, 9))


def columns(window: Window, bias: Floats, covariance: Floats, gravity: float) -> Floats:
    """Data of one row; covariance (9, 9) of GTSAM's preintegrated [rotation vector, position, velocity]."""
    return MODEL.data(window, integrated_with_intrinsics(window, bias), bias, covariance, gravity)


def add(
    update: GraphUpdate,
    window: Window,
    bias: gtsam.imuBias.ConstantBias,
    covariance: Floats,
    gravity: float,
    sigma: float,
) -> None:
    """The row of one window, and the state S."""
    i, j = window.index - 1, window.index
    keys = (key("X", i), key("V", i), key("X", j), key("V", j), key("B", i), update.use(scale_state(sigma)))
    data = columns(window, bias.vector(), covariance, gravity)
    update.blocks.append(FactorBatch("imu", MODEL, [keys], data[None], window.t1_ns))
