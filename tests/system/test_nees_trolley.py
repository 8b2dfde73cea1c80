"""Twenty minutes with a trolley by inertial data and standstills alone: how far off, and consistent about it?

The start is known (at rest in the origin, facing north); nothing else measures a position. What vision adds is measured
against these.
"""

from __future__ import annotations

from dataclasses import replace
from unittest.mock import patch

import pytest
from sessions import rms
from test_nees import average_nees, outside

import smartnav_graph as sn
from smartnav_graph.simulation import recording
from smartnav_graph.simulation.scenarios import SCENARIOS

TROLLEY = replace(SCENARIOS["trolley-20min"], camera=None)


def alone(seed: int) -> sn.Session:
    """The session with the truth at every inertial sample, and so at every keyframe."""
    with patch.object(recording, "SLOW_ROWS", 1):
        return TROLLEY(seed)


def test_one_run_is_off_by_metres_and_degrees():
    session = alone(0)
    position, heading = rms(session, sn.smooth(session))
    assert 0.2 < position < 4.5 and 0.5 < heading < 12.0


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_every_run_stays_within_bounds(seed):
    session = alone(seed)
    position, heading = rms(session, sn.smooth(session))
    assert position < 4.5 and heading < 12.0


@pytest.mark.slow
def test_covariances_are_consistent_over_thirty_runs():
    assert outside(average_nees(alone)) == {}


@pytest.mark.slow
def test_a_gyro_that_drifts_more_than_stated_is_caught():
    def bold(seed: int) -> sn.Session:
        session = alone(seed)
        noise = replace(session.calibration.imu_noise, gyro_bias_walk=2e-6)
        return session.replace(calibration=replace(session.calibration, imu_noise=noise))

    bad = outside(average_nees(bold, 8), 8)
    assert bad["rotation", 0.9] > 1.5
