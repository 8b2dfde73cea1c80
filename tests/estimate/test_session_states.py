"""States that hold for a whole session: found where the motion shows them, held where it does not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import smartnav_graph as sn
from smartnav_graph.estimate.config import Config
from smartnav_graph.factors.gnss import GnssConfig
from smartnav_graph.session.session import Mount
from smartnav_graph.simulation.scenarios import SCENARIOS


@pytest.fixture(scope="module")
def car() -> sn.Session:
    """Two minutes in town, fixes of 0.2 m whose clock is late by 0.15 s, antenna 0.6 m off the body's origin."""
    scenario = SCENARIOS["car-10min"]
    model = replace(scenario.gnss, white_m=0.2, offset_s=0.15)
    return replace(scenario, seconds=120.0, gnss=model)(seed=4)


def states(session: sn.Session, **options) -> dict:
    return sn.run(session, Config(gnss=GnssConfig(**options))).summary["states"]


def test_a_clock_offset_is_found_and_its_sigma_is_consistent(car):
    found = states(car)["gnss_time_offset_s"]
    assert not found["held"] and found["sigma"] < 0.02
    assert abs(found["value"] - 0.15) < 3 * found["sigma"]


def test_without_the_state_the_offset_bends_the_trajectory(car):
    truth = car.reference
    error = []
    for sigma in (0.2, 0.0):
        run = sn.run(car, Config(gnss=GnssConfig(time_offset_sigma=sigma)))
        near = np.searchsorted(run.solution.t_ns, truth.t_ns)
        same = np.flatnonzero(run.solution.t_ns[np.minimum(near, len(run.solution) - 1)] == truth.t_ns)
        error.append(np.sqrt(((run.solution.nav_t_body[near[same]] - truth.enu[same]) ** 2).sum(axis=1).mean()))
    assert error[0] < 0.25 * error[1]


def test_a_clock_offset_nobody_can_see_is_held():
    rest = replace(SCENARIOS["static-60s"], seconds=40.0)(seed=1)
    found = states(rest)["gnss_time_offset_s"]
    assert found == {"value": 0.0, "sigma": 0.2, "held": True}


def test_a_lever_arm_told_wrong_is_found(car):
    x, y, z = car.sensors["gnss"].body_t
    wrong = car.replace(sensors={"gnss": Mount(body_t=(x + 0.8, y - 0.5, z))})
    found = states(wrong, lever_arm_sigma=1.0)["gnss_lever_arm_correction_m"]
    assert not found["held"]
    error = np.array(found["value"]) - [-0.8, 0.5, 0.0]
    assert (np.abs(error) < 3.5 * np.array(found["sigma"])).all(), found
    assert max(found["sigma"][:2]) < 0.3  # turns show it along the ground; height hides in the accelerometer bias
