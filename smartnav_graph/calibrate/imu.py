"""Accelerometer and gyro from one recording of rests and turns: see `accelerometer` and `gyro`."""

from __future__ import annotations

from collections.abc import Sequence

from smartnav_graph.calibrate.gyro import GyroOptions, fit_both
from smartnav_graph.calibrate.result import CalibrationResult
from smartnav_graph.calibrate.static import one_session
from smartnav_graph.session.calibration.model import Calibration
from smartnav_graph.session.session import Session


def fit(sources: Sequence[Session], options: GyroOptions) -> CalibrationResult:
    """Calibrate both by one recording."""
    accel, gyro = fit_both(one_session(sources), options)
    both = (("accel", accel), ("gyro", gyro))

    def change(known: Calibration) -> Calibration:
        return gyro.change(accel.change(known))

    return CalibrationResult(
        {**accel.values, **gyro.values},
        {f"{sensor}_{n}": r for sensor, part in both for n, r in part.residuals.items()},
        {**accel.refused, **gyro.refused},
        (*accel.warnings, *gyro.warnings),
        change,
        (*accel.charts, *gyro.charts),
    )
