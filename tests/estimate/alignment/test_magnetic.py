"""Where north is by the first seconds: with a hard iron of hundreds of uT, a gyro bias of degrees a second, no rest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from exact import GRAVITY, START_NS, angle_deg
from scipy.spatial.transform import Rotation

from smartnav_graph.core.so3 import exp
from smartnav_graph.core.timebase import NS, ns_from_seconds
from smartnav_graph.estimate.alignment.magnetic import (
    BIAS,
    FIELD,
    GRID_S,
    IRON,
    UP,
    FieldStart,
    Seen,
    field_start,
    fit,
    turns,
)
from smartnav_graph.session.calibration.model import DEVICE_CLASSES, MagnetometerNoise
from smartnav_graph.session.streams import Imu, Magnetometer
from smartnav_graph.simulation import motions, sensors
from smartnav_graph.simulation.trajectory import Trajectory

CLASS = DEVICE_CLASSES["mems"]
NOISE = MagnetometerNoise()
DECLINATION = np.radians(4.6)
NAV_FIELD = np.array([19.0 * np.sin(DECLINATION), 19.0 * np.cos(DECLINATION), -45.0])
GYRO_BIAS = np.array([0.1, -0.02, 0.015])  # rad/s, as an iPhone 5 has it
FOUND_IRON = np.array([100.0, 288.0, 70.0])


def in_the_hand(seed: int) -> Trajectory:
    """A phone that is carried about without a rest, swaying."""
    walk = motions.walk(60.0, np.random.default_rng(seed))
    return replace(walk, held_deg=(0.0, 35.0, 4.0))


def recorded(
    motion: Trajectory, seed: int, *, gyro_bias=GYRO_BIAS, iron=FOUND_IRON, begin: float = 8.0, seconds: float = 40.0
) -> tuple[Imu, Magnetometer, np.ndarray]:
    """IMU at 100 Hz, field at 20 Hz with the iron of a hall (a field of 2 uT that stays alike for a second), and the
    attitude at the start."""
    rng = np.random.default_rng(seed)
    t = begin + np.arange(round(seconds * 100)) / 100
    t_ns = START_NS + ns_from_seconds(t)
    imu, _ = sensors.imu(motion.sample(t), t_ns, replace(CLASS, gyro_bias_sigma=1e-9), GRAVITY, rng)
    imu = replace(imu, gyro=imu.gyro + gyro_bias)
    slow = motion.sample(t[::5])
    hall = np.repeat(2.0 * rng.standard_normal((len(slow.t) // 20 + 1, 3)), 20, axis=0)[: len(slow.t)]
    field_ut = np.einsum("nji,nj->ni", slow.nav_R_body, NAV_FIELD + hall) + iron + 0.5 * rng.standard_normal(hall.shape)
    return imu, Magnetometer(t_ns=t_ns[::5], field_ut=field_ut), motion.sample([begin]).nav_R_body[0]


def start_of(imu: Imu, magnetometer: Magnetometer, iron_sigma: float = 250.0, **changes) -> FieldStart | None:
    noise = changes.get("noise", NOISE)
    return field_start(imu, magnetometer, int(imu.t_ns[0]), CLASS, noise, iron_sigma, DECLINATION)


def test_heading_tilt_and_bias_of_a_phone_in_the_hand():
    """10 walks: within three of the sigmas it claims, gyro bias to 0.6 deg/s; tilt is off by the accelerometer bias,
    0.3 m/s^2 an axis: 1.8 deg."""
    for seed in range(10):
        imu, magnetometer, R = recorded(in_the_hand(seed), seed)
        start = start_of(imu, magnetometer)
        assert start is not None and 0.02 < start.heading_sigma < 0.5
        off = start.nav_R_body @ R.T
        assert abs(np.arctan2(off[1, 0], off[0, 0])) < 3 * start.heading_sigma
        assert np.degrees(np.arccos(off[2, 2])) < 6.0
        assert np.degrees(np.abs(start.gyro_bias - GYRO_BIAS)).max() < 0.6
        assert np.abs(start.iron - FOUND_IRON)[:2].max() < 5 * start.iron_sigma
        assert start.length_s == pytest.approx(30.0)


def test_the_heading_turns_with_the_declination():
    imu, magnetometer, _ = recorded(in_the_hand(1), 1)
    one, other = (
        field_start(imu, magnetometer, int(imu.t_ns[0]), CLASS, NOISE, 250.0, declination)
        for declination in (0.0, np.radians(10.0))
    )
    turn = other.nav_R_body @ one.nav_R_body.T
    assert np.degrees(np.arctan2(turn[1, 0], turn[0, 0])) == pytest.approx(-10.0)  # needle east of north: north is left
    assert angle_deg(turn, np.eye(3)) == pytest.approx(10.0)


def test_soft_iron_is_undone():
    soft = np.array([[1.1, 0.05, 0.0], [0.05, 0.9, 0.02], [0.0, 0.02, 1.05]])
    imu, magnetometer, R = recorded(in_the_hand(2), 2, iron=np.zeros(3))
    spoilt = replace(magnetometer, field_ut=magnetometer.field_ut @ np.linalg.inv(soft).T)
    start = start_of(imu, spoilt, 1.0, noise=replace(NOISE, soft_iron=tuple(soft.ravel())))
    plain = start_of(imu, magnetometer, 1.0)
    assert angle_deg(start.nav_R_body, plain.nav_R_body) < 0.5
    assert angle_deg(start.nav_R_body, R) < 15.0


def test_a_device_that_does_not_turn_tells_north_only_when_it_is_calibrated():
    imu, magnetometer, R = recorded(motions.static(60.0), 3, gyro_bias=np.zeros(3), iron=np.zeros(3))
    assert start_of(imu, magnetometer, 15.0) is None
    start = start_of(imu, magnetometer, 1.0)
    assert start is not None and angle_deg(start.nav_R_body, R) < np.degrees(3 * start.heading_sigma)


def test_no_start_where_the_sensors_do_not_overlap_for_long_enough():
    imu, magnetometer, _ = recorded(in_the_hand(4), 4)
    short = magnetometer.take(magnetometer.t_ns < imu.t_ns[0] + 3 * NS)
    late = magnetometer.take(magnetometer.t_ns > imu.t_ns[0] + 2 * NS)
    assert start_of(imu, short) is None and start_of(imu, late) is None


def test_only_the_first_thirty_seconds_count():
    imu, magnetometer, _ = recorded(in_the_hand(5), 5)
    end = imu.t_ns[0] + 30 * NS + NS // 10
    cut = start_of(imu.take(imu.t_ns <= end), magnetometer.take(magnetometer.t_ns <= end))
    np.testing.assert_array_equal(cut.nav_R_body, start_of(imu, magnetometer).nav_R_body)


# --- the parts --------------------------------------------------------------------------------------------------------


def test_turns_are_those_of_a_constant_rate_and_their_derivative_is_the_numerical_one():
    rate, bias = np.tile([0.3, -0.5, 1.0], (40, 1)), np.array([0.02, 0.0, -0.05])
    R, J = turns(rate, bias)
    middle = (np.arange(40) + 0.5) * GRID_S
    np.testing.assert_allclose(R, exp((rate - bias) * middle[:, None]), atol=1e-12)
    step = 1e-6
    for axis in range(3):
        up, down = (turns(rate, bias + sign * step * np.eye(3)[axis])[0] for sign in (1, -1))
        change = R.transpose(0, 2, 1) @ (up - down) / (2 * step)
        numeric = np.stack([change[:, 2, 1], change[:, 0, 2], change[:, 1, 0]], axis=1)
        # the bias of one interval of 0.05 s turns about its own axis, to first order
        np.testing.assert_allclose(J[:, :, axis], numeric, atol=0.05 * middle.max())


def test_an_exact_turn_is_fitted_exactly():
    rate = 0.8 * np.sin(np.arange(400)[:, None] * GRID_S * [0.9, 1.3, 0.7]) + [0.0, 0.0, 0.3]
    R0 = Rotation.from_euler("ZXY", [0.5, 0.3, -0.2]).as_matrix()
    gravity, bias, iron = np.array([0.0, 0.0, GRAVITY]), GYRO_BIAS / 5, FOUND_IRON
    R, _ = turns(rate, np.zeros(3))
    force, reading = (np.einsum("nji,j->ni", R, R0.T @ field) for field in (gravity, NAV_FIELD))
    seen = Seen(rate + bias, force, reading + iron)
    x0 = np.concatenate([np.zeros(3), np.zeros(3), force[0], reading[0] + iron])
    weak = np.array([1e3] * 3 + [1e6] * 3)
    x = fit(seen, fit(seen, x0, np.zeros(6), weak, NOISE).x, np.zeros(6), weak, NOISE).x
    np.testing.assert_allclose(x[BIAS], bias, atol=1e-6)
    np.testing.assert_allclose(x[IRON], iron, atol=1e-2)
    np.testing.assert_allclose(x[UP], R0.T @ gravity, atol=1e-3)
    np.testing.assert_allclose(x[FIELD], R0.T @ NAV_FIELD, atol=1e-2)
