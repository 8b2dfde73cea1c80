"""Is the covariance of a car consistent with the vehicle constraint, the wheels and measured velocities, each alone?"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_nees import average_nees, outside, too_sure

from smartnav_graph.session.session import Session
from smartnav_graph.simulation import motions
from smartnav_graph.simulation.fixes import GnssModel
from smartnav_graph.simulation.scenarios import Scenario
from smartnav_graph.simulation.sensors import SpeedModel
from smartnav_graph.simulation.trajectory import Trajectory

SEEDS = 5
LONG = 30
GNSS = GnssModel(white_m=1.0)


def slipping_car(seconds: float, rng: np.random.Generator) -> Trajectory:
    """On the move; a phone turned by 3 deg, ahead of the rear axle and above it; slip of 0.15 m/s at 15 m/s."""
    car = motions.car(seconds, rng, start_speed=12.0)
    return replace(car, held_deg=(3.0, 2.0, 0.0), carried=(0.0, 1.2, 0.5), sway=(*car.sway, *motions.slip(rng, 0.15)))


def ride(seed: int, vehicle: str, gnss: GnssModel = GNSS, **sensors: SpeedModel) -> Session:
    """50 s in town with fixes of 1 m."""
    session = Scenario("ride", 50.0, slipping_car, "car", gnss=gnss, **sensors)(seed)
    return session.replace(static=None, device=replace(session.device, vehicle=vehicle))


RIDES = {
    "vehicle": lambda seed: ride(seed, "car"),
    "wheel": lambda seed: ride(seed, "none", wheel=SpeedModel(rate_hz=10.0, sigma_m_s=0.1)),
    "velocity": lambda seed: ride(seed, "none", velocity=SpeedModel(rate_hz=2.0, sigma_m_s=0.2)),
    "velocities of fixes": lambda seed: ride(seed, "none", GnssModel(white_m=1.0, velocity_m_s=0.1)),
    "vehicle and wheel": lambda seed: ride(seed, "car", wheel=SpeedModel(rate_hz=10.0, sigma_m_s=0.1)),
}


# The constraint claims 0.15 m/s at every speed, and the car slips by so much when it is fastest: these may be less sure
# than they could be.
SLIPPING = ("vehicle", "vehicle and wheel")


def test_the_vehicle_alone():
    assert too_sure(outside(average_nees(RIDES["vehicle"], SEEDS), SEEDS)) == {}


@pytest.mark.slow
@pytest.mark.parametrize("name", RIDES)
def test_each_alone_and_together(name):
    bad = outside(average_nees(RIDES[name], LONG), LONG)
    assert (too_sure(bad) if name in SLIPPING else bad) == {}
