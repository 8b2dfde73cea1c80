"""Steps of the heights alone are found with time and size; climbs, outliers and jumps of all axes are none."""

from dataclasses import replace

import numpy as np
import pytest

from smartnav_graph.session.calibration.model import GnssNoise
from smartnav_graph.session.detect.heights import control_offset, height_steps, least_step, levels
from smartnav_graph.session.detect.motion import STEP_S, InertialMotion
from smartnav_graph.session.session import Session
from smartnav_graph.session.streams import ControlPoint, GnssFix

NS = 10**9
N = 300
T_NS = np.arange(N) * NS


def motion(height=None):
    """Inertial data of a drive with hills, with a bias of the accelerometer."""
    t = STEP_S * (np.arange(round(N / STEP_S)) + 0.5)
    seen = (hills(t) if height is None else height(t)) + 0.02 * t**2
    return InertialMotion(0, np.zeros(len(t)), np.zeros(len(t), dtype=complex), seen)


def hills(t):
    return 30.0 * np.sin(t / 20.0)


def fixes(sigma=0.05, height=hills, seed=0):
    t = T_NS / NS
    position = np.stack([10.0 * t, 50.0 * np.sin(t / 30.0), height(t)], axis=1)
    return position + np.random.default_rng(seed).normal(0.0, sigma, (N, 3))


def steps(position, inertial=None, **options):
    return height_steps(T_NS, position, inertial or motion(), **options)


@pytest.mark.parametrize(
    "planted", [{150: 47.0}, {100: -20.0}, {120: 30.0, 180: -30.0}, {60: 12.0, 120: 12.0, 200: -24}]
)
@pytest.mark.parametrize("sigma", [0.02, 0.3])
def test_steps_are_found_with_time_and_size(planted, sigma):
    position = fixes(sigma)
    for row, size in planted.items():
        position[row:, 2] += size
    found = steps(position)
    assert [step.t_ns for step in found] == [T_NS[row] for row in planted]
    np.testing.assert_allclose([step.size for step in found], list(planted.values()), atol=6.0 * max(sigma, 0.05))


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("sigma", [0.02, 1.0, 5.0])
def test_nothing_is_found_where_nothing_steps(sigma, seed):
    assert steps(fixes(sigma, seed=seed)) == []


def test_a_lift_is_no_step():
    def lift(t):
        return 20.0 * np.clip((t - 100.0) / 8.0, 0.0, 1.0)

    assert steps(fixes(height=lift), motion(lift)) == []


def test_a_bent_inertial_height_is_no_step_of_the_fixes():
    def bent(t):
        return hills(t) + 40.0 * np.tanh((t - 150.0) / 2.0)

    assert steps(fixes(0.3), motion(bent)) == []


def test_outliers_and_jumps_of_the_whole_position_are_no_steps():
    position = fixes()
    position[[40, 41, 90, 200], 2] += [60.0, 55.0, -80.0, 30.0]
    position[150:] += [60.0, 40.0, 50.0]
    assert steps(position) == []


def test_a_phone_steps_beyond_its_correlated_error():
    phone, noise = GnssFix(t_ns=T_NS, enu=fixes()), GnssNoise()
    surveyor = GnssFix(t_ns=T_NS, enu=fixes(), sigma=np.full((N, 3), 0.02))
    assert least_step(surveyor, noise) == 1.0
    assert least_step(phone, noise) > 2.0 * noise.correlated_vertical_sigma
    position = fixes()
    position[150:, 2] += 10.0
    assert steps(position) and not steps(position, least=least_step(phone, noise))


def test_levels_that_come_again_are_one_and_most_rows_stay():
    position = fixes()
    position[100:150, 2] += 30.0
    found = levels(steps(position), T_NS)
    assert found.level.tolist() == [0, 1, 0]
    np.testing.assert_allclose(found.offset, [0.0, 30.0], atol=0.3)
    shifted = found.shifted(GnssFix(t_ns=T_NS, enu=position))
    np.testing.assert_allclose(shifted.enu[:, 2], hills(T_NS / NS), atol=0.5)


def test_without_steps_there_is_one_level():
    found = levels([], T_NS)
    assert found.of(T_NS).tolist() == [0] * N and found.offset.tolist() == [0.0]
    stream = GnssFix(t_ns=T_NS, lla=fixes() * [1e-6, 1e-6, 1.0])
    np.testing.assert_allclose(replace(found, offset=found.offset + 47.0).shifted(stream).lla, stream.lla - [0, 0, 47])


@pytest.mark.parametrize(("count", "varies"), [(5, 0.0), (1, 5.0)])
def test_heights_over_surveyed_points(count, varies):
    at = np.linspace(20, N - 20, count).astype(int)
    points = ControlPoint(
        t_ns=T_NS[at], enu=fixes(0.0)[at] - [0.0, 0.0, 47.0], point_id=np.full(count, "a", dtype=object)
    )
    middle, spread = control_offset(Session(gnss=GnssFix(t_ns=T_NS, enu=fixes()), control=points))
    assert middle == pytest.approx(47.0, abs=0.3) and spread == pytest.approx(varies, abs=0.2)
    assert control_offset(Session(gnss=GnssFix(t_ns=T_NS, enu=fixes()))) is None
