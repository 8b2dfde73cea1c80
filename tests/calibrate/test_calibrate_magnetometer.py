"""Magnetometer by turns: coverage, spread before and after of real phones, refusals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from simulated import DATASETS, Coverage, real

import smartnav_graph as sn
from smartnav_graph.calibrate import magnetometer
from smartnav_graph.core.errors import CalibrationError
from smartnav_graph.session.calibration.model import Calibration
from smartnav_graph.session.streams import Imu, Magnetometer

HARD = np.array([120.0, -40.0, 15.0])
SOFT = np.array([[1.03, 0.01, -0.02], [0.01, 0.98, 0.015], [-0.02, 0.015, 0.99]])
TURN = np.radians([0.8, -1.2, 0.5])
FIELD = np.array([0.0, 21.0, -43.0])
OPTIONS = magnetometer.MagnetometerOptions(strength_ut=float(np.linalg.norm(FIELD)))


def turned_in_air(seed, noise=0.4, soft=SOFT, count=1500):
    """Slow turns about all axes; S (m - hard) is the field in the sensor's axes, R of it that in the device's."""
    rng, t = np.random.default_rng(seed), np.arange(count) / 25.0
    angles = np.stack([0.9 * t + rng.uniform(0, 6), 1.1 * np.sin(0.37 * t) + rng.uniform(0, 6), 0.53 * t], axis=1)
    attitude = Rotation.from_euler("zyx", angles)
    body = attitude.inv().apply(FIELD)
    own = Rotation.from_rotvec(TURN).inv().apply(body)
    readings = np.linalg.solve(soft, own.T).T + HARD + noise * rng.standard_normal(own.shape)
    t_ns = np.round(t * 1e9).astype(np.int64)
    force = attitude.inv().apply([0, 0, 9.81]) + 0.05 * rng.standard_normal(own.shape)
    imu = Imu(t_ns=t_ns, accel=force, gyro=np.zeros_like(force))
    return sn.Session(imu=imu, magnetometer=Magnetometer(t_ns=t_ns, field_ut=readings), gravity_m_s2=9.81)


def covered(seeds):
    count = Coverage()
    for seed in seeds:
        values = magnetometer.fit([turned_in_air(seed)], OPTIONS).values
        for i, axis in enumerate("xyz"):
            count.add("hard iron", values[f"hard_iron_{axis}"], HARD[i])
            count.add("turn", values[f"turn_{axis}"], np.degrees(TURN[i]))
        for i, j in magnetometer.PAIRS:
            count.add("soft iron", values[f"soft_iron_{'xyz'[i]}{'xyz'[j]}"], SOFT[i, j])
    return count


def test_sigmas_cover_the_truth():
    covered(range(6)).check()


@pytest.mark.slow
def test_sigmas_cover_the_truth_in_95_of_100():
    shares = covered(range(100, 200)).check()
    print(shares)
    assert all(0.92 <= share <= 0.98 for share, _ in shares.values())


def test_a_calibration_gives_the_field_in_the_axes_of_the_device():
    session = turned_in_air(1)
    noise = magnetometer.fit([session], OPTIONS).change(Calibration()).magnetometer_noise
    whole = Rotation.from_rotvec(TURN).as_matrix() @ SOFT
    assert np.allclose(np.reshape(noise.soft_iron, (3, 3)), whole, atol=3e-3)
    assert np.allclose(noise.hard_iron_ut, HARD, atol=0.1) and noise.sigma_ut == pytest.approx(0.4, rel=0.1)


def test_a_sphere_is_kept_where_an_ellipsoid_predicts_no_better():
    result = magnetometer.fit([turned_in_air(2, soft=np.eye(3))], OPTIONS)
    assert "is no better" in result.refused["soft_iron_xy"] and "soft_iron_xy" not in result.values
    unknown = magnetometer.fit([turned_in_air(2)], magnetometer.MagnetometerOptions())
    assert "the place is not known" in unknown.refused["scale"]


def test_bad_recordings_are_named():
    good = turned_in_air(3)
    flat = replace(good.magnetometer, field_ut=good.magnetometer.field_ut * [1, 1, 0.01])
    with pytest.raises(CalibrationError, match="lie in a plane"):
        magnetometer.fit([good.replace(magnetometer=flat)], OPTIONS)
    still = replace(good.magnetometer, field_ut=good.magnetometer.field_ut * [1, 0, 1])
    with pytest.raises(CalibrationError, match="y of the magnetometer is constant"):
        magnetometer.fit([good.replace(magnetometer=still)], OPTIONS)
    for unit, found in ((0.01, r"of 0\.4"), (1000.0, r"of 4.*e\+04")):  # gauss, nT
        other = replace(good.magnetometer, field_ut=good.magnetometer.field_ut * unit)
        for session in (good, good.replace(origin=None)):
            with pytest.raises(CalibrationError, match=f"turn about a field {found}.*import it in uT"):
                magnetometer.fit([session.replace(magnetometer=other)], magnetometer.MagnetometerOptions())
    with pytest.raises(CalibrationError, match="has no magnetometer"):
        magnetometer.fit([good.replace(magnetometer=None)], OPTIONS)


@real("phone_mocap_tyrex")
def test_the_field_of_a_phone_has_one_length():
    session = sn.load(DATASETS / "phone_mocap_tyrex" / "android" / "calib_mag_Nexus5_d1")
    found = magnetometer.fit([session], magnetometer.MagnetometerOptions()).residuals
    assert found["length"].rms < 0.5 * found["length_before"].rms
    assert found["length_left_out"].rms < 1.5
