"""Is the covariance consistent where standstills hold the trajectory? See `test_nees` for the bounds."""

from __future__ import annotations

import numpy as np
import pytest
from differences import average_nees_bounds
from sessions import on_control, recorded
from test_nees import PARTS, average_nees

from smartnav_graph.session.session import Session
from smartnav_graph.simulation.trajectory import Leg, Legs, Sway, Trajectory


def stop_and_go(seconds: float) -> Trajectory:
    """A trolley: rest, corridor with a turn, stop, corridor with a turn, stop."""
    legs = [Leg(6.0, 0.0)]
    for turn in (90.0, -60.0):
        legs += [Leg(2.0, 1.0), Leg(4.0, 1.0), Leg(3.0, 1.0, turn), Leg(2.0, 0.0), Leg(4.0, 0.0)]
    return Trajectory(Legs(legs, heading_deg=25.0), sway=(Sway(6.0, shift=(0.0, 0.0, 2e-4), tilt=(0.0, 1e-3, 0.0)),))


def with_fixes(seed: int) -> Session:
    return recorded(stop_and_go, 36.0, seed)


def with_points(seed: int) -> Session:
    """No fixes: a surveyed point of 5 cm at each stop."""
    session = with_fixes(seed)
    rows = np.flatnonzero(np.isin(session.seconds(session.gnss.t_ns), (3.0, 19.0, 34.0)))
    return session.replace(gnss=None, sensors={}, control=on_control(session, rows, 0.05, seed), static=None)


def outside(averages: dict[tuple[str, float], float], seeds: int) -> dict[tuple[str, float], float]:
    """Averages that a consistent covariance would not give. At a rest the sigmas are a centimetre per second and the
    noise of the gyro, but this trolley does not move at all: velocities and gyro biases may be better than their
    sigmas."""
    bad = {}
    for (name, fraction), value in averages.items():
        dof = PARTS[name].stop - PARTS[name].start
        low, high = (bound / dof for bound in average_nees_bounds(dof, seeds, 0.998))
        if not (0.0 if name in ("velocity", "gyro bias") else low) <= value <= high:
            bad[name, fraction] = value
    return bad


@pytest.mark.parametrize("make", [with_fixes, with_points])
def test_standstills_alone(make):
    assert outside(average_nees(make, 4), 4) == {}


@pytest.mark.slow
@pytest.mark.parametrize("make", [with_fixes, with_points])
def test_standstills_alone_over_thirty_seeds(make):
    assert outside(average_nees(make, 30), 30) == {}
