"""Positions without inertial data: between keyframes the velocity is constant up to white noise of acceleration.

With density q (m/s^2/sqrt(Hz)) and window length T, errors of velocity and position have, on each axis,

    var v = q^2 T        cov(p, v) = q^2 T^2 / 2        var p = q^2 T^3 / 3

which are those of preintegrated inertial data that show no turn and no acceleration, with noise q of the
accelerometer. So the motion model is such a stream, of a level device: q is found from the positions like the noise of
an accelerometer. No measurement depends on the attitude.

Source: Särkkä (2013), Bayesian Filtering and Smoothing, example 4.3; Barfoot (2017), State Estimation, 11.1.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from smartnav_graph.core.timebase import NS
from smartnav_graph.estimate.notes import Notes, PreparationStep
from smartnav_graph.estimate.preparation import PREPARE
from smartnav_graph.session.calibration.model import WHITE_ACCELERATION, Calibration
from smartnav_graph.session.session import Device, Mount, Session
from smartnav_graph.session.streams import POSITIONS, Imu

STEP_S = 0.2  # of the model's stream; a window of a second has var p to 1 %
_KEPT = {*POSITIONS, "barometer", "reference"}


def constant_velocity(session: Session, notes: Notes) -> Session:
    """The session with the motion model in place of inertial data, and without what needs the attitude of the device:
    other sensors, lever arms, constraints of a vehicle. Clock offsets of fixes are not observable."""
    stamps = np.concatenate([stream.t_ns for stream in session.positions().values()])
    step = round(STEP_S * NS)
    t_ns = np.arange(session.t0_ns, int(stamps.max()) + step, step, dtype=np.int64)
    still, force = np.zeros((len(t_ns), 3)), np.tile([0.0, 0.0, session.gravity], (len(t_ns), 1))
    config, known = notes.config, session.calibration or Calibration()
    known_clock = {"time_offset_sigma": 0.0, "lever_arm_sigma": 0.0}
    of_factors = {
        "imu": replace(config.imu, scale_sigma=0.0),
        "gnss": replace(config.gnss, **known_clock),
        "pose_fixes": replace(config.pose_fixes, **known_clock, attitude=False),
    }
    run, keyframes = replace(config.run, vehicle="none"), replace(config.keyframes, lead_s=0.0)
    notes.config = replace(config, run=run, keyframes=keyframes, **of_factors)
    notes.calibration = replace(known, imu_noise=WHITE_ACCELERATION)
    unused = [name for name in session.streams() if name not in _KEPT]
    if unused:
        notes.warnings.append(f"{', '.join(unused)}: not used, as there are no inertial data that give the attitude")
    mounts = {name: replace(mount, body_t=Mount().body_t) for name, mount in session.sensors.items()}
    return session.replace(
        **dict.fromkeys(unused),
        imu=Imu(t_ns=t_ns, gyro=still, accel=force),
        device=Device(name=session.device.name),
        sensors=mounts,
    )


# As `preparation.PREPARE`, of a session without inertial data.
PREPARE_POSITIONS: Mapping[str, PreparationStep] = {
    **{name: PREPARE[name] for name in ("health", "sensors")},
    "model": constant_velocity,
    **{name: PREPARE[name] for name in ("span", "reach", "latency", "holdout", "sigmas", "outside", "lead")},
}
