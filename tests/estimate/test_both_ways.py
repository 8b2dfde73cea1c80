"""The filter from both ends."""

from __future__ import annotations

import numpy as np
import pytest

import smartnav_graph as sn
from smartnav_graph.estimate.both_ways import both_ways, reversed_session
from smartnav_graph.estimate.config import RunConfig
from smartnav_graph.session.calibration.model import Calibration, ImuErrors
from smartnav_graph.simulation.scenarios import simulate


@pytest.fixture(scope="module")
def drive() -> sn.Session:
    return simulate("car-10min", 1)


def test_reversed_twice_is_the_session(drive):
    found = reversed_session(reversed_session(drive))
    for name, stream in found.streams().items():
        for column, values in stream.columns().items():
            np.testing.assert_array_equal(values, getattr(drive, name).columns()[column])
    assert found.device.forward == drive.device.forward
    once = reversed_session(drive)
    np.testing.assert_array_equal(once.imu.gyro[0], -drive.imu.gyro[-1])
    np.testing.assert_array_equal(once.imu.accel[0], drive.imu.accel[-1])


def test_the_ways_differ_as_their_sigmas_say(drive):
    found = both_ways(drive, sn.Config(run=RunConfig(end_s=120.0)))
    ratio = found.difference[10:-10] / found.sigma[10:-10]
    assert 0.3 < np.sqrt(np.mean(ratio**2)) < 1.5
    assert np.abs(found.difference).max() < 20.0  # m


def test_a_heading_that_one_way_cannot_know_is_in_the_difference(drive):
    """Without fixes in the middle minute the two ways drift apart there, as their sigmas say."""
    t = (drive.gnss.t_ns - drive.t0_ns) / 1e9
    outage = drive.replace(gnss=drive.gnss.take((t < 30.0) | (t > 90.0)), barometer=None)
    found = both_ways(outage, sn.Config(run=RunConfig(end_s=120.0)))
    t = (found.t_ns - drive.t0_ns) / 1e9
    inside, before = (t > 45.0) & (t < 75.0), (t > 15.0) & (t < 30.0)
    assert found.sigma[inside, :2].mean() > 3.0 * found.sigma[before, :2].mean()
    assert np.abs(found.difference[inside]).max() < 5.0 * found.sigma[inside].max()


def test_a_known_bias_of_the_gyro_has_the_other_sign_backward(drive):
    errors = ImuErrors(gyro_bias=(0.1, 0.0, -0.2))
    known = drive.replace(calibration=Calibration(imu_errors=errors))
    back = reversed_session(known)
    assert back.calibration.imu_errors.gyro_bias == (-0.1, 0.0, 0.2)
    ahead = errors.corrected(known.imu, None).gyro
    assert back.calibration.imu_errors.corrected(back.imu, None).gyro == pytest.approx(-ahead[::-1])
