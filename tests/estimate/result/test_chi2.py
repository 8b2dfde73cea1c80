"""Chi-square by sensor: one where the noise is what is assumed, whatever other sensors there are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from exact import LEVER, START_NS, record

import smartnav_graph as sn
from smartnav_graph.core.timebase import NS, ns_from_seconds
from smartnav_graph.estimate.config import Config
from smartnav_graph.factors.imu import ImuConfig
from smartnav_graph.graph.robust import expected_weighted_square, loss_weights
from smartnav_graph.session.calibration.model import ImuNoise
from smartnav_graph.session.detect.standstills import StandstillConfig
from smartnav_graph.session.streams import Velocity, WheelSpeed
from smartnav_graph.simulation.trajectory import Leg, Legs, Trajectory

SIGMA, WHEEL_SIGMA, FIX_SIGMA = 0.02, 0.2, 0.1  # m/s, m/s, m
# Coarse enough for good velocities to check it; the gyroscope's part in the velocity of a lever arm is small.
NOISE = ImuNoise(
    accel_noise_density=0.05,
    gyro_noise_density=3e-4,
    accel_bias_walk=0.01,
    gyro_bias_walk=0.001,
    accel_bias_sigma=0.1,
    gyro_bias_sigma=0.01,
)
SEEDS = range(10)
# Noise as simulated, and nothing that is true by definition: a rest of a simulation is at rest exactly.
AS_SIMULATED = replace(
    Config(),
    imu=ImuConfig(estimate_noise=False),
    standstill=StandstillConfig(detect=False),
    gnss=replace(Config().gnss, loss="none", correlated=False),
)


def ride(seed: int):
    """A car for half a minute, with fixes, control points and velocities of white noise."""
    legs = [Leg(6.0, 10.0), Leg(8.0, 10.0, 80.0), Leg(6.0, 4.0), Leg(8.0, 9.0, -60.0)]
    made = record(Trajectory(Legs(legs, speed=6.0)), noise=NOISE, fix_sigma=FIX_SIGMA, seed=seed)
    rng = np.random.default_rng((seed, 7))
    session, path = made.session, made.trajectory
    t = np.arange(0.0, path.duration, 0.05)
    there, fixes = path.sample(t[::2]), path.sample((session.gnss.t_ns - START_NS) / NS)
    of_fixes = fixes.nav_v_body + np.einsum("nij,nj->ni", fixes.nav_R_body, np.cross(fixes.body_rate, LEVER))

    def noisy(rows, sigma=SIGMA):
        return rows + sigma * rng.standard_normal(rows.shape)

    return session.replace(
        wheel=WheelSpeed(
            t_ns=START_NS + ns_from_seconds(t),
            speed=noisy(path.speed(t), WHEEL_SIGMA),
            sigma=np.full(len(t), WHEEL_SIGMA),
        ),
        velocity=Velocity(
            t_ns=START_NS + ns_from_seconds(there.t),
            velocity=noisy(np.einsum("nji,nj->ni", there.nav_R_body, there.nav_v_body)),
            sigma=np.full((len(there.t), 3), SIGMA),
        ),
        gnss=replace(session.gnss, velocity=noisy(of_fixes), sigma_velocity=np.full(of_fixes.shape, SIGMA)),
    )


@pytest.fixture(scope="module")
def summaries():
    return [sn.run(ride(seed), AS_SIMULATED).summary for seed in SEEDS]


@pytest.mark.parametrize("sensor", ["imu", "gnss", "control", "gnss_velocity", "velocity", "wheel", "overall"])
def test_it_is_one_for_every_sensor_of_consistent_data(summaries, sensor):
    """A quadratic form of redundancy r has a variance of at most 2 r: four standard deviations, on both sides."""
    redundancy = [
        sum(one["redundancy"].values()) if sensor == "overall" else one["redundancy"][sensor] for one in summaries
    ]
    square = sum(one["chi2_per_dof"][sensor] * r for one, r in zip(summaries, redundancy, strict=True))
    total = sum(redundancy)
    assert total > 100
    assert square / total == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / total))


def test_the_redundancies_are_all_residuals_less_all_unknowns(summaries):
    """15 unknowns a keyframe and the session states, which have as many prior rows; 12 prior rows at the start: an
    error of 24 in the sum shows."""
    one = summaries[0]
    factors = one["factors"]
    rows = {"prior": 4, "imu": 9, "imu_bias": 6, "gnss": 3, "control": 3, "gnss_velocity": 3, "velocity": 3, "wheel": 1}
    assert set(factors) == set(rows)
    expected = sum(rows[name] * count for name, count in factors.items()) - 15 * one["keyframes"]
    assert sum(one["redundancy"].values()) == pytest.approx(expected, abs=0.1)
    assert 2.0 * one["cost"] / one["chi2_per_dof"]["overall"] == pytest.approx(expected, abs=0.1)


def test_a_sensor_that_the_solution_follows_has_none_and_says_why():
    """Three control points alone: position, heading and velocity come from them, nothing checks them."""
    session = ride(0).replace(gnss=None, velocity=None, wheel=None)
    control = session.control.take(np.arange(1))
    summary = sn.run(
        session.replace(control=control), replace(AS_SIMULATED, imu=ImuConfig(estimate_noise=False))
    ).summary
    assert "control" not in summary["chi2_per_dof"]
    assert "redundancy 0.0" in summary["without_chi2"]["control"]


@pytest.mark.parametrize(("loss", "dim"), [("none", 3), ("huber", 1), ("huber", 3), ("cauchy", 2)])
def test_the_expected_square_under_a_loss_is_that_of_a_sample(loss, dim):
    square = (np.random.default_rng(0).standard_normal((200_000, dim)) ** 2).sum(axis=1)
    sample = (loss_weights(square, loss, 1.0, dim)[0] * square).mean() / dim
    assert expected_weighted_square(loss, dim) == pytest.approx(sample, rel=0.01)


def test_the_inertial_one_hardly_moves_when_a_vehicle_joins(kitti):
    """It moved by a factor of two as long as each sensor was divided by all that others left."""
    alone, car = (
        sn.run(kitti, replace(Config(), run=replace(Config().run, vehicle=vehicle))).summary["chi2_per_dof"]["imu"]
        for vehicle in ("none", "car")
    )
    assert car == pytest.approx(alone, rel=0.2)  # 1.37 and 1.40
