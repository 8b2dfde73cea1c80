"""A calibration given to a session: kept with it, or taken out of its readings."""

from __future__ import annotations

import dataclasses

import numpy as np

from smartnav_graph.session.calibration.model import Calibration, ImuErrors, MagnetometerNoise
from smartnav_graph.session.session import Session


def applied(calibration: Calibration, session: Session, *, correct: bool = False) -> Session:
    """The session with a calibration, which replaces the one it has.

    correct : the deterministic errors of IMU and magnetometer are taken out of the readings, and out of the
    calibration, so that they are not taken out twice
    """
    if not correct:
        return session.replace(calibration=calibration)
    imu, magnetometer, noise = session.imu, session.magnetometer, calibration.magnetometer_noise
    if imu is not None:
        imu = calibration.imu_errors.corrected(imu, session.temperature)
    if magnetometer is not None:
        true = (magnetometer.field_ut - np.array(noise.hard_iron_ut)) @ np.reshape(noise.soft_iron, (3, 3)).T
        magnetometer = dataclasses.replace(magnetometer, field_ut=true)
    plain = MagnetometerNoise()
    noise = dataclasses.replace(noise, hard_iron_ut=plain.hard_iron_ut, soft_iron=plain.soft_iron)
    rest = dataclasses.replace(calibration, imu_errors=ImuErrors(), magnetometer_noise=noise)
    return session.replace(imu=imu, magnetometer=magnetometer, calibration=rest)
