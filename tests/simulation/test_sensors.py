"""Sensor readings: physics of the exact part, statistics of the noise."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from smartnav_graph.core.timebase import ns_from_seconds
from smartnav_graph.session.calibration.model import DEVICE_CLASSES
from smartnav_graph.simulation import motions, sensors
from smartnav_graph.simulation.trajectory import Truth

N = 120_000
T_NS = ns_from_seconds(np.arange(N) / 100)
QUIET = dataclasses.replace(DEVICE_CLASSES["mems"], accel_bias_walk=1e-12, gyro_bias_walk=1e-12)


def rest(n: int = N) -> Truth:
    zero = np.zeros((n, 3))
    return Truth(np.arange(n) / 100, np.broadcast_to(np.eye(3), (n, 3, 3)), zero, zero, zero, zero)


def test_a_device_lying_flat_reads_gravity_upwards():
    np.testing.assert_array_equal(sensors.specific_force(rest(3), 9.81), [[0, 0, 9.81]] * 3)


def test_a_tilted_device_reads_gravity_on_its_own_axes():
    truth = motions.static(1.0).sample([0.5])  # pitch 5 deg nose up, roll -3 deg
    pitch, roll = np.radians([5.0, -3.0])
    expected = 9.81 * np.array([-np.cos(pitch) * np.sin(roll), np.sin(pitch), np.cos(pitch) * np.cos(roll)])
    np.testing.assert_allclose(sensors.specific_force(truth, 9.81)[0], expected, atol=1e-12)


def test_free_fall_reads_nothing_and_speeding_up_reads_forward():
    falling = dataclasses.replace(rest(1), nav_a_body=np.array([[0.0, 0.0, -9.81]]))
    np.testing.assert_allclose(sensors.specific_force(falling, 9.81), 0.0, atol=1e-15)
    north = dataclasses.replace(rest(1), nav_a_body=np.array([[0.0, 2.0, 0.0]]))
    np.testing.assert_allclose(sensors.specific_force(north, 9.81), [[0.0, 2.0, 9.81]], atol=1e-15)


@pytest.mark.parametrize(("stream", "density"), [("accel", "accel_noise_density"), ("gyro", "gyro_noise_density")])
@pytest.mark.parametrize("seconds", [0.01, 1.0, 4.0])
def test_white_noise_has_its_density_at_every_averaging_time(stream, density, seconds):
    # Allan: the mean over tau has sigma = density / sqrt(tau); 4 sigma of a standard deviation of n values.
    imu, biases = sensors.imu(rest(), T_NS, QUIET, 9.81, np.random.default_rng(1))
    noise = getattr(imu, stream) - getattr(biases, stream) - ([0, 0, 9.81] if stream == "accel" else 0)
    m = round(seconds * 100)
    means = noise[: N // m * m].reshape(-1, m, 3).mean(axis=1)
    expected = getattr(QUIET, density) / np.sqrt(seconds)
    assert means.std() == pytest.approx(expected, rel=4 / np.sqrt(2 * means.size))


def test_bias_starts_with_its_sigma_and_walks_with_its_density():
    starts = np.array([sensors.random_walk(T_NS[:2], 0.3, 0.0, np.random.default_rng(s))[0] for s in range(400)])
    assert starts.std() == pytest.approx(0.3, rel=4 / np.sqrt(2 * starts.size))
    walk = sensors.random_walk(T_NS, 0.3, 1e-3, np.random.default_rng(2))
    for lag in (1, 100, 1000):  # rows of 10 ms; independent increments only
        steps = walk[lag::lag] - walk[:-lag:lag][: len(walk[lag::lag])]
        assert steps.std() == pytest.approx(1e-3 * np.sqrt(lag / 100), rel=4 / np.sqrt(2 * steps.size))


def test_noise_free_readings_are_the_truth():
    truth = motions.figure_eight(20.0).sample(np.arange(2000) / 100)
    imu, biases = sensors.imu(truth, T_NS[:2000], None, 9.81, np.random.default_rng(0))
    np.testing.assert_array_equal(imu.gyro, truth.body_rate)
    np.testing.assert_array_equal(biases.accel, 0.0)


def test_profiles_hold_the_published_sigmas_as_densities():
    s2, s5, i4 = (sensors.PROFILES[name] for name in ("galaxy-s2", "galaxy-s5", "iphone-4"))
    # quadratic mean of (0.0386, 0.0297, 0.0435) m/s^2 over sqrt(100 Hz), and so on
    assert s2.accel_noise_density == pytest.approx(3.770e-3, rel=1e-3)
    assert s2.gyro_noise_density == pytest.approx(2.625e-4, rel=1e-3)
    assert s5.accel_noise_density == pytest.approx(4.327e-3, rel=1e-3)
    assert i4.gyro_noise_density == pytest.approx(4.154e-4, rel=1e-3)
    assert sensors.PROFILES["mems"] == DEVICE_CLASSES["mems"]


def test_a_levelled_magnetometer_gives_the_heading():
    truth = motions.static(1.0).sample([0.0, 0.5])  # heading 40 deg
    field = np.array([0.0, 19.0, -45.0])
    rng = np.random.default_rng(0)
    flux = sensors.magnetometer(truth, T_NS[:2], sensors.MagnetometerModel(10.0, 0.0, 0.0), field, rng).field_ut
    np.testing.assert_allclose(truth.nav_R_body @ flux[0], np.tile(field, (2, 1)), atol=1e-12)
    ahead, right = (truth.nav_R_body[0] @ axis for axis in ([0, 1, 0], [1, 0, 0]))
    assert np.degrees(np.arctan2(ahead[0], ahead[1])) == pytest.approx(40.0)
    assert flux[0] @ [1, 0, 0] == pytest.approx(field @ right)
    assert field @ right < 0  # heading north-east, magnetic north lies to the left


def test_standard_pressure_is_the_table_of_the_standard_atmosphere():
    heights = np.array([0.0, 1000.0, 5000.0])
    np.testing.assert_allclose(sensors.standard_pressure(heights), [1013.25, 898.746, 540.199], atol=0.01)  # hPa, ICAO


def test_a_barometer_keeps_height_differences():
    heights = np.linspace(100.0, 110.0, 5000)
    reading = sensors.barometer(heights, T_NS[:5000], sensors.BarometerModel(), np.random.default_rng(3))
    slope = np.polyfit(heights, reading.pressure_hpa, 1)[0]
    assert slope == pytest.approx(-0.1189, abs=0.001)  # hPa a metre near 100 m


def test_a_pressure_walks_with_its_density():
    height = np.full(N, 100.0)
    steady, walking = (
        sensors.barometer(height, T_NS, model, np.random.default_rng(5)).pressure_hpa
        for model in (sensors.BarometerModel(sigma_hpa=0.0, walk_hpa=walk) for walk in (0.0, 0.02))
    )
    assert np.ptp(steady) == 0.0 and walking[0] == steady[0]
    for lag in (100, 1000):
        steps = walking[lag::lag] - walking[:-lag:lag][: len(walking[lag::lag])]
        assert steps.std() == pytest.approx(0.02 * np.sqrt(lag / 100), rel=4 / np.sqrt(2 * steps.size))


def test_iron_on_the_way_disturbs_for_its_while_only():
    field = np.array([0.0, 19.0, -45.0])
    quiet, passed = (
        sensors.magnetometer(rest(3000), T_NS[:3000], model, field, np.random.default_rng(6)).field_ut
        for model in (sensors.MagnetometerModel(disturbances=iron) for iron in ((), ((10.0, 4.0, 25.0),)))
    )
    extra = np.linalg.norm(passed - quiet, axis=1)
    t = np.arange(3000) / 100
    assert extra[(t < 10.0) | (t > 14.0)].max() < 1e-12 and np.abs((passed - quiet)[:, 2]).max() == 0.0
    assert extra[1200] == pytest.approx(25.0)


def test_wheel_and_velocity_sensors_scatter_as_they_say():
    truth = motions.figure_eight(20.0).sample(np.arange(2000) / 100)
    model = sensors.SpeedModel(sigma_m_s=0.2)
    seen = sensors.velocity(truth, T_NS[:2000], model, np.random.default_rng(7))
    off = np.einsum("nij,nj->ni", truth.nav_R_body, seen.velocity) - truth.nav_v_body
    assert off.std() == pytest.approx(0.2, rel=4 / np.sqrt(2 * off.size))
    counted = sensors.wheel(np.full(2000, 5.0), T_NS[:2000], model, np.random.default_rng(8))
    assert counted.speed.mean() == pytest.approx(5.0, abs=4 * 0.2 / np.sqrt(2000)) and (counted.sigma == 0.2).all()


def test_a_slipping_vehicle_has_the_side_speed_it_should_not_have():
    rng = np.random.default_rng(9)
    car = dataclasses.replace(motions.car(300.0, rng, start_speed=12.0), sway=motions.slip(rng, 0.15), sway_speed=12.0)
    truth = car.sample(np.arange(0.0, 300.0, 0.1))
    body = np.einsum("nji,nj->ni", truth.nav_R_body, truth.nav_v_body)
    share = np.sqrt((car.speed(truth.t) ** 2).mean()) / 12.0
    for axis in (0, 2):
        assert body[:, axis].std() == pytest.approx(0.15 * share, rel=0.1)
