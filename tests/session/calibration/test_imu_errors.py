"""Scale, misalignment and bias of a calibrated device are taken out of its readings, once."""

from __future__ import annotations

import tomllib
from dataclasses import replace

import numpy as np
import pytest
from exact import eight, record

import smartnav_graph as sn
from smartnav_graph.core.errors import CalibrationError
from smartnav_graph.estimate.config import Config
from smartnav_graph.estimate.problem import prepare
from smartnav_graph.session.calibration import model
from smartnav_graph.session.calibration.model import DEVICE_CLASSES, Calibration, ImuErrors

ACCEL = (1.01, 0.002, -0.003, 0.001, 0.99, 0.004, 0.0, -0.002, 1.005)
GYRO = (0.98, 0.0, 0.005, -0.004, 1.02, 0.0, 0.003, 0.001, 1.0)
ERRORS = ImuErrors(ACCEL, GYRO, (0.3, -0.2, 0.1), (0.01, 0.02, -0.03))


@pytest.fixture(scope="module")
def clean():
    """Half a minute of the class device; its noise is known."""
    noise = DEVICE_CLASSES["mems"]
    return record(eight(30.0), noise=noise, fix_sigma=0.5, hertz=50.0, seed=2).session.replace(control=None)


def with_errors(session):
    """Readings as a device with `ERRORS` gives them: matrix^-1 true + bias."""
    imu = session.imu
    accel = imu.accel @ np.linalg.inv(np.reshape(ACCEL, (3, 3))).T + ERRORS.accel_bias
    gyro = imu.gyro @ np.linalg.inv(np.reshape(GYRO, (3, 3))).T + ERRORS.gyro_bias
    calibration = replace(session.calibration, imu_errors=ERRORS)
    return session.replace(imu=replace(imu, accel=accel, gyro=gyro), calibration=calibration)


def test_true_is_matrix_times_reading_less_bias():
    imu = sn.simulate("static-60s").imu
    found = ERRORS.corrected(imu)
    row = np.reshape(ACCEL, (3, 3)) @ (imu.accel[7] - np.array(ERRORS.accel_bias))
    np.testing.assert_allclose(found.accel[7], row, rtol=1e-14)
    row = np.reshape(GYRO, (3, 3)) @ (imu.gyro[7] - np.array(ERRORS.gyro_bias))
    np.testing.assert_allclose(found.gyro[7], row, rtol=1e-14)
    np.testing.assert_array_equal(found.t_ns, imu.t_ns)


def test_nothing_known_changes_nothing():
    imu = sn.simulate("static-60s").imu
    assert ImuErrors().corrected(imu) is imu


def test_a_calibrated_device_gives_the_solution_of_a_perfect_one(clean):
    plain, found = (sn.smooth(session) for session in (clean, with_errors(clean)))
    np.testing.assert_allclose(found.nav_t_body, plain.nav_t_body, atol=1e-5)  # m
    np.testing.assert_allclose(found.nav_R_body, plain.nav_R_body, atol=1e-5)
    uncalibrated = with_errors(clean).replace(calibration=clean.calibration)
    assert np.abs(sn.smooth(uncalibrated).accel_bias - plain.accel_bias).max() > 0.1


def test_the_errors_are_taken_out_once(clean):
    once = prepare(with_errors(clean), Config())
    again = prepare(once.session, Config())
    np.testing.assert_array_equal(once.session.imu.accel, again.session.imu.accel)
    assert once.calibration.imu_errors == ERRORS  # what the run is based on


def test_text_and_back():
    one = Calibration(imu_errors=ERRORS)
    assert model.calibration_from_dict(tomllib.loads(model.calibration_toml(one))) == one


@pytest.mark.parametrize(
    ("wrong", "part"),
    [
        ({"accel_matrix": (1.0, 0.0, 0.0)}, "accel_matrix = [1.0, 0.0, 0.0]; expected nine numbers within 0.3"),
        ({"gyro_matrix": (0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)}, "of the identity, row by row; turn axes"),
        ({"gyro_matrix": (float("nan"), *GYRO[1:])}, "gyro_matrix = [nan"),
        ({"gyro_bias": (0.0, float("inf"), 0.0)}, "expected finite numbers; give m/s^2 and rad/s"),
    ],
)
def test_what_is_no_calibration_is_refused(wrong, part):
    with pytest.raises(CalibrationError) as error:
        ImuErrors(**wrong)
    assert part in str(error.value)
