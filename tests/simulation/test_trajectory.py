"""Motions are exact: derivatives agree with each other, and GTSAM integrates their inertial readings back to them."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from smartnav_graph.core.errors import ConfigError
from smartnav_graph.core.timebase import ns_from_seconds
from smartnav_graph.simulation import motions, sensors
from smartnav_graph.simulation.trajectory import Leg, Legs, Trajectory

GRAVITY = 9.81


def climbing_turn() -> Trajectory:
    """Every term at once: a held device on a climbing turn while speeding up."""
    legs = [Leg(8.0, 6.0, 200.0, 20.0), Leg(8.0, 2.0, -150.0, -10.0)]
    return Trajectory(
        Legs(legs, speed=1.0, heading_deg=70.0), held_deg=(30.0, 50.0, -20.0), sway=motions._STEPS, sway_speed=6.0
    )


def motion(name: str) -> Trajectory:
    rng = np.random.default_rng(5)
    return {
        "walk": lambda: motions.walk(60.0, rng),
        "car": lambda: motions.car(60.0, rng),
        "moving car": lambda: motions.car(60.0, rng, start_speed=12.0),
        "trolley": lambda: motions.trolley(1, rest=5.0),
        "static": lambda: motions.static(60.0),
        "figure eight": lambda: motions.figure_eight(60.0),
        "climbing turn": climbing_turn,
    }[name]()


NAMES = ("walk", "car", "moving car", "trolley", "static", "figure eight", "climbing turn")


def derivative(trajectory: Trajectory, t: np.ndarray, name: str, h: float = 2e-3) -> np.ndarray:
    """Central difference of sixth order."""
    weights = {-3: -1, -2: 9, -1: -45, 1: 45, 2: -9, 3: 1}
    return sum(w * getattr(trajectory.sample(t + k * h), name) for k, w in weights.items()) / (60 * h)


def smooth_times(trajectory: Trajectory) -> np.ndarray:
    """Times away from the joints of the pieces, where the higher derivatives of the difference formula jump."""
    t = np.linspace(0.1, min(trajectory.duration, 60.0) - 0.1, 3001)
    return t[np.abs(t[:, None] - trajectory.way.breaks).min(axis=1) > 0.01]


@pytest.mark.parametrize("name", NAMES)
def test_velocity_acceleration_and_body_rate_are_the_derivatives(name):
    trajectory = motion(name)
    t = smooth_times(trajectory)
    truth = trajectory.sample(t)
    np.testing.assert_allclose(derivative(trajectory, t, "nav_t_body"), truth.nav_v_body, atol=1e-9)  # m/s
    np.testing.assert_allclose(derivative(trajectory, t, "nav_v_body"), truth.nav_a_body, atol=2e-8)  # m/s^2
    rate = np.einsum("nji,njk->nik", truth.nav_R_body, derivative(trajectory, t, "nav_R_body"))
    np.testing.assert_allclose(
        np.stack([rate[:, 2, 1], rate[:, 0, 2], rate[:, 1, 0]], axis=-1), truth.body_rate, atol=1e-9
    )  # rad/s
    np.testing.assert_allclose(rate + np.swapaxes(rate, 1, 2), 0.0, atol=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_nothing_jumps_where_pieces_join(name):
    trajectory = motion(name)
    joints = trajectory.way.breaks[1:-1]
    before, after = trajectory.sample(joints - 1e-9), trajectory.sample(joints + 1e-9)
    for field in ("nav_R_body", "nav_t_body", "nav_v_body", "nav_a_body", "body_rate"):
        np.testing.assert_allclose(getattr(before, field), getattr(after, field), atol=1e-6)


@pytest.mark.parametrize("name", NAMES)
def test_attitude_is_a_rotation(name):
    R = motion(name).sample(np.linspace(0, 16, 500)).nav_R_body
    np.testing.assert_allclose(np.swapaxes(R, 1, 2) @ R, np.broadcast_to(np.eye(3), R.shape), atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(R), 1.0, atol=1e-14)


def integrate(trajectory: Trajectory, start: float, seconds: float, *, mean: bool) -> float:
    """Position error in m after GTSAM integrated the exact 100 Hz readings from the true first state.

    GTSAM holds force and rate over an interval and turns the force by the attitude at its start. Right to second order
    are therefore the mean of both ends and, for the force, half an interval's turn. In stretches of 0.1 s because its
    sum of rotation vectors is of first order in the rotation gathered so far.
    """
    t = start + np.arange(round(seconds * 100) + 1) / 100
    truth = trajectory.sample(t)
    imu, _ = sensors.imu(truth, ns_from_seconds(t), None, GRAVITY, np.random.default_rng(0))
    accel, gyro = ((x[:-1] + x[1:]) / 2 if mean else x[:-1] for x in (imu.accel, imu.gyro))
    accel = accel + 0.005 * np.cross(gyro, accel) if mean else accel
    params = gtsam.PreintegrationParams.MakeSharedU(GRAVITY)
    state = gtsam.NavState(gtsam.Rot3(truth.nav_R_body[0]), truth.nav_t_body[0], truth.nav_v_body[0])
    for k in range(0, len(accel), 10):
        preintegrated = gtsam.PreintegratedImuMeasurements(params)
        for force, rate in zip(accel[k : k + 10], gyro[k : k + 10], strict=True):
            preintegrated.integrateMeasurement(force, rate, 0.01)
        state = preintegrated.predict(state, gtsam.imuBias.ConstantBias())
    turned = gtsam.Rot3(truth.nav_R_body[-1]).between(state.attitude()).axisAngle()[1]
    assert not mean or np.degrees(turned) < 0.05
    return float(np.linalg.norm(state.position() - truth.nav_t_body[-1]))


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("start", [0.0, 5.5])
def test_gtsam_integrates_the_readings_back_to_the_motion(name, start):
    assert integrate(motion(name), start, 10.0, mean=True) < 0.02  # m after 10 s


def test_holding_a_sample_over_the_next_interval_is_wrong_to_first_order():
    assert integrate(motion("moving car"), 2.0, 10.0, mean=False) > 10 * integrate(
        motion("moving car"), 2.0, 10.0, mean=True
    )


def test_a_quarter_turn_at_constant_speed_is_the_fresnel_like_integral():
    # Oracle: adaptive quadrature of the same speed and heading, written down anew.
    from scipy.integrate import quad

    trajectory = Trajectory(Legs([Leg(4.0, 3.0, 90.0)], speed=3.0, heading_deg=0.0))

    def psi(t: float) -> float:
        x = t / 4.0
        return np.pi / 2 * x**3 * (10 - 15 * x + 6 * x**2)

    east = quad(lambda t: -3 * np.sin(psi(t)), 0, 4, epsabs=1e-13)[0]
    north = quad(lambda t: 3 * np.cos(psi(t)), 0, 4, epsabs=1e-13)[0]
    end = trajectory.sample([4.0])
    np.testing.assert_allclose(end.nav_t_body[0], [east, north, 0.0], atol=1e-12)
    # It left northwards and turned left: now it heads west.
    np.testing.assert_allclose(end.nav_R_body[0] @ [0, 1, 0], [-1, 0, 0], atol=1e-12)


def test_a_car_moves_along_its_own_forward_axis():
    truth = motion("car").sample(np.linspace(0, 60, 2000))
    sideways = np.einsum("nji,nj->ni", truth.nav_R_body, truth.nav_v_body)[:, [0, 2]]
    assert np.abs(sideways).max() < 0.15  # m/s: only the springs
    assert truth.nav_v_body[:, :2].max() > 5.0


def test_trolley_and_figure_eight_close():
    trolley = motions.trolley(2)
    np.testing.assert_allclose(trolley.sample([trolley.duration]).nav_t_body, 0.0, atol=1e-9)
    assert len(trolley.rests) == 9
    laps = motions.figure_eight(60.0).sample([12.0, 32.0, 52.0]).nav_t_body
    np.testing.assert_allclose(laps[1:, :2], laps[:1, :2].repeat(2, 0), atol=0.05)  # m: the sway is not in step
    inner = motions.figure_eight(60.0)
    np.testing.assert_allclose(*(inner.way(np.array([t]))[0] for t in (12.0, 32.0)), atol=1e-12)


@pytest.mark.parametrize("name", ["walk", "car", "trolley", "figure eight"])
def test_standstills_stand_still(name):
    trajectory = motion(name)
    start, end = trajectory.rests[0]
    assert end - start >= 5.0
    truth = trajectory.sample(np.linspace(start, end, 100))
    for field in ("nav_v_body", "nav_a_body", "body_rate"):
        np.testing.assert_array_equal(getattr(truth, field), 0.0)


def test_a_time_outside_the_motion_is_refused():
    with pytest.raises(ConfigError, match=r"trajectory: time 0\.0 \.\. 61\.0 s; expected within 0 \.\. 60\.0 s"):
        motions.static(60.0).sample([0.0, 61.0])
    with pytest.raises(ConfigError, match="expected within"):
        motions.static(60.0).sample([np.nan])
