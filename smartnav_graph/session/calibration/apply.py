"""Correction of inertial readings for the deterministic errors of the calibration."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from smartnav_graph.session.calibration.model import ImuErrors
from smartnav_graph.session.streams import Imu


def corrected(imu: Imu, errors: ImuErrors) -> Imu:
    """True rate and force by the calibration: matrix (reading - bias); the same object where there is nothing to do."""
    if errors == ImuErrors():
        return imu
    accel, gyro = (np.reshape(matrix, (3, 3)).T for matrix in (errors.accel_matrix, errors.gyro_matrix))
    return replace(
        imu,
        accel=(imu.accel - np.array(errors.accel_bias)) @ accel,
        gyro=(imu.gyro - np.array(errors.gyro_bias)) @ gyro,
    )
