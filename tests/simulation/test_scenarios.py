"""Named sessions: correct noise, truth on exact stamps, the same seed the same session."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp
from scipy.stats import chi2

from smartnav_graph.core.errors import ConfigError
from smartnav_graph.core.frames import magnetic_field_ut
from smartnav_graph.core.timebase import NS
from smartnav_graph.session import folder as session_folder
from smartnav_graph.simulation.recording import ORIGIN, YEAR
from smartnav_graph.simulation.scenarios import SCENARIOS, simulate

# Force m/s^2, height m, field uT and pressure hPa of the first samples of walk-60s, seed 3.
GOLDEN = [-0.4846241127340646, 95.72895993292332, -16.798879451632178, 1001.4255208012221]
QUICK = [name for name in SCENARIOS if SCENARIOS[name].seconds <= 600.0]


@pytest.fixture(scope="module")
def sessions():
    return {name: simulate(name, 3) for name in QUICK}


def nav_R_body(reference):
    return Rotation.from_quat(reference.quat[:, [1, 2, 3, 0]]).as_matrix()


@pytest.mark.parametrize("name", QUICK)
def test_the_truth_stands_on_inertial_stamps_and_at_every_aiding_epoch(sessions, name):
    s = sessions[name]
    assert np.isin(s.reference.t_ns, s.imu.t_ns).all()
    for stream in (s.gnss, s.control, s.pose_fixes, s.magnetometer, s.barometer, s.wheel, s.velocity):
        assert stream is None or np.isin(stream.t_ns, s.reference.t_ns).all()
    np.testing.assert_array_equal(np.diff(s.imu.t_ns), NS // 100)
    assert np.diff(s.reference.t_ns).max() == NS // 10
    np.testing.assert_allclose(np.linalg.norm(s.reference.quat, axis=1), 1.0, atol=1e-12)


ON_TIME = [name for name in QUICK if SCENARIOS[name].gnss is not None and not SCENARIOS[name].gnss.offset_s]


@pytest.mark.parametrize("name", ON_TIME)
def test_fixes_scatter_round_the_antenna_as_their_sigma_says(sessions, name):
    s = sessions[name]
    rows = np.searchsorted(s.reference.t_ns, s.gnss.t_ns)
    antenna = s.reference.enu[rows] + nav_R_body(s.reference)[rows] @ np.array(s.mount("gnss").body_t)
    white = (s.nav_position(s.gnss) - antenna) / s.gnss.sigma
    if name == "phone-car-5min":  # 4 m of Gauss-Markov errors beside the 3 m of the sigma column
        assert white.std() > 1.2
    else:
        assert white.std() == pytest.approx(1.0, rel=4 / np.sqrt(2 * white.size))
        assert np.abs(white.mean(axis=0)).max() < 4 / np.sqrt(len(white))
    assert s.calibration.gnss_noise.horizontal_sigma == s.gnss.sigma[0, 0]
    assert s.calibration.gnss_noise.vertical_sigma == s.gnss.sigma[0, 2]


@pytest.mark.parametrize("name", ["walk-60s", "static-60s", "trolley-loop", "phone-car-5min"])
def test_standstills_read_gravity_and_biases_with_the_noise_of_the_calibration(sessions, name):
    s = sessions[name]
    start, end = s.static.t_ns[0], s.static.t_end_ns[0]
    rows = (s.imu.t_ns >= start) & (s.imu.t_ns <= end)
    there = (s.reference.t_ns >= start) & (s.reference.t_ns <= end)
    assert np.abs(s.reference.velocity[there]).max() == 0.0
    R = nav_R_body(s.reference)[there][0]
    noise, n = s.calibration.imu_noise, rows.sum()
    expected = R.T @ [0, 0, s.gravity] + s.reference.accel_bias[there].mean(axis=0)
    # the bias between the reference's rows walks far less than the mean's noise
    np.testing.assert_allclose(
        s.imu.accel[rows].mean(axis=0), expected, atol=4 * noise.accel_noise_density * 10 / np.sqrt(n) + 1e-4
    )
    gyro = s.imu.gyro[rows] - s.reference.gyro_bias[there].mean(axis=0)
    assert gyro.std() == pytest.approx(noise.gyro_noise_density * 10, rel=0.1)


def test_gravity_is_normal_gravity_at_the_origin(sessions):
    assert sessions["walk-60s"].gravity == pytest.approx(9.8123, abs=1e-3)  # m/s^2 at 52 N


def test_the_magnetic_field_is_that_of_middle_europe():
    e, n, u = magnetic_field_ut(ORIGIN, YEAR)
    assert np.hypot(np.hypot(e, n), u) == pytest.approx(49.7, abs=0.5)  # uT
    assert np.degrees(np.arctan2(e, n)) == pytest.approx(4.6, abs=0.7)  # deg east
    assert np.degrees(np.arctan2(-u, np.hypot(e, n))) == pytest.approx(67.3, abs=0.5)  # deg down


def test_the_trolley_stops_on_control_points_and_comes_home(sessions):
    s = sessions["trolley-loop"]
    assert s.gnss is None and len(s.control) == len(s.static) == 9
    points = s.nav_position(s.control)
    assert np.linalg.norm(points[-1] - points[0]) < 5 * 0.02 * np.sqrt(3)
    inside = (s.control.t_ns > s.static.t_ns) & (s.control.t_ns < s.static.t_end_ns)
    assert inside.all()


def test_the_phone_in_the_car_starts_moving(sessions):
    assert np.linalg.norm(sessions["phone-car-5min"].reference.velocity[0]) > 10.0  # m/s


def test_the_batch_benchmark_has_its_size():
    s = simulate("car-37min", 0)
    assert len(s.imu) == 222_000 and len(s.gnss) == 2220
    assert s.device.vehicle == "car" and s.gnss.sigma[0, 0] == 3.0


def test_recordings_of_old_scenarios_stay_what_they_were():
    """Seeds name recordings: figures measured on them must not move when a sensor is added to the simulation."""
    s = simulate("walk-60s", 3)
    first = [s.imu.accel[0, 0], s.gnss.lla[0, 2], s.magnetometer.field_ut[0, 0], s.barometer.pressure_hpa[0]]
    np.testing.assert_allclose(first, GOLDEN, rtol=1e-12)


@pytest.fixture(scope="module")
def late():
    """A receiver whose clock is 0.06 s off, in a car."""
    return SCENARIOS["car-all-2min"].gnss, simulate("car-all-2min", 3)


def at(s, t_ns):
    """Position, velocity and attitude of the truth at these stamps, interpolated over a tenth of a second."""
    r = s.reference
    t, own = (np.asarray(x - r.t_ns[0], dtype=float) for x in (t_ns, r.t_ns))
    enu, v = (CubicSpline(own, rows)(t) for rows in (r.enu, r.velocity))
    return enu, v, Slerp(own, Rotation.from_matrix(nav_R_body(r)))(t)


def test_a_fix_speaks_of_a_time_later_by_the_offset(late):
    model, s = late
    fixes = s.nav_position(s.gnss)[:-1]
    square = {}
    for offset in (0.0, 0.06, 0.12):
        p, _, R = at(s, s.gnss.t_ns[:-1] + round(offset * NS))
        square[offset] = (((fixes - p - R.apply(model.body_t_antenna)) / s.gnss.sigma[:-1]) ** 2).mean()
    assert square[0.06] == pytest.approx(1.0, abs=4 * np.sqrt(2 / (3 * len(fixes))))
    assert square[0.06] < min(square[0.0], square[0.12])


def test_velocities_are_the_antenna_s(late):
    model, s = late
    _, v, _ = at(s, s.gnss.t_ns[:-1] + round(model.offset_s * NS))
    step = NS // 100
    turning = [at(s, s.gnss.t_ns[1:-1] + round(model.offset_s * NS) + sign * step)[2] for sign in (-1, 1)]
    rate = (turning[1].apply(model.body_t_antenna) - turning[0].apply(model.body_t_antenna)) / 0.02
    white = (s.gnss.velocity[1:-1] - v[1:] - rate) / s.gnss.sigma_velocity[1:-1]
    assert white.std() == pytest.approx(1.0, rel=4 / np.sqrt(2 * white.size))


def test_wheels_count_the_way_and_not_the_phone_ahead_of_the_axle(late):
    _, s = late
    _, v, R = at(s, s.wheel.t_ns)
    forward = Rotation.from_euler("ZX", [3.0, 2.0], degrees=True).inv().apply([0.0, 1.0, 0.0])
    off = R.inv().apply(v) @ forward - s.wheel.speed
    assert off.std() == pytest.approx(s.wheel.sigma[0], rel=0.1)
    moving = s.wheel.speed > 5.0
    sideways = (R.inv().apply(v) @ Rotation.from_euler("ZX", [3.0, 2.0], degrees=True).inv().apply([1.0, 0.0, 0.0]))[
        moving
    ]
    turn = np.gradient(np.unwrap(R.as_euler("ZXY")[:, 0]), 0.1)[moving]
    slope = np.polyfit(turn, sideways, 1)[0]
    assert slope == pytest.approx(-1.2, abs=0.4)  # m ahead of the axle; sways of 0.1 m/s on top


def test_pose_fixes_scatter_as_they_say_and_are_known_later(sessions):
    s = sessions["walk-all-2min"]
    fix = s.pose_fixes
    np.testing.assert_array_equal(fix.arrival_ns - fix.t_ns, NS)
    p, _, R = at(s, fix.t_ns)
    white = (s.nav_position(fix) - p) / fix.sigma
    turn = (Rotation.from_quat(fix.quat[:, [1, 2, 3, 0]]) * R.inv()).as_rotvec() / fix.sigma_rot
    for rows in (white, turn):
        low, high = chi2(rows.size).ppf([1e-3, 1 - 1e-3])
        assert low < (rows**2).sum() < high


def test_the_same_seed_gives_the_same_session_and_another_another():
    first, again, other = simulate("walk-60s", 7), simulate("walk-60s", 7), simulate("walk-60s", 8)
    for name, stream in first.streams().items():
        for column, values in stream.columns().items():
            np.testing.assert_array_equal(values, getattr(again, name).columns()[column])
    assert not np.array_equal(first.imu.gyro, other.imu.gyro)
    assert not np.array_equal(first.reference.enu, other.reference.enu)


def test_the_calibration_can_be_left_out():
    assert simulate("static-60s", calibrated=False).calibration is None


def test_a_simulated_session_survives_the_disk(tmp_path, sessions):
    session_folder.save(sessions["walk-60s"], tmp_path / "s")
    back = session_folder.load(tmp_path / "s")
    assert back.calibration == sessions["walk-60s"].calibration and not back.dropped
    np.testing.assert_array_equal(back.reference.accel_bias, sessions["walk-60s"].reference.accel_bias)


def test_an_unknown_scenario_is_reported_with_the_known_ones():
    with pytest.raises(ConfigError) as error:
        simulate("walk")
    assert str(error.value).startswith("simulate: scenario 'walk'; expected one of walk-60s, walk-10min, car-10min")
