"""A start in motion by images: gravity and speed of a camera in a hand, and silence where nothing fits."""

from dataclasses import replace

import numpy as np
import pytest

from smartnav_graph.core.so3 import from_quaternion
from smartnav_graph.core.timebase import NS
from smartnav_graph.estimate.alignment.visual import visual_start
from smartnav_graph.estimate.config import Config, RunConfig
from smartnav_graph.estimate.problem import prepare
from smartnav_graph.estimate.run import initialise
from smartnav_graph.factors.coplanarity import CoplanarityBuilder
from smartnav_graph.graph.update import one_of
from smartnav_graph.simulation.scenarios import simulate

START_S = 8.0


@pytest.fixture(scope="module")
def problem():
    return prepare(simulate("room-30s", 0), Config(run=RunConfig(start_s=START_S)))


def started(problem, **changes):
    builder = one_of(problem.builders, CoplanarityBuilder)
    session, noise = problem.session, problem.calibration.imu_noise
    imu = replace(session.require_imu(), **changes)
    start_ns = problem.windows[0].t1_ns
    return visual_start(builder, imu, start_ns, session.gravity, noise, problem.camera_turns.gyro_bias)


def test_gravity_and_velocity_are_those_of_the_truth(problem):
    found, truth = started(problem), problem.session.reference
    at = int(np.argmin(np.abs(truth.t_ns - problem.windows[0].t1_ns)))
    body_R_nav = from_quaternion(truth.quat[at : at + 1])[0].T
    velocity = (truth.enu[at + 1] - truth.enu[at - 1]) / ((truth.t_ns[at + 1] - truth.t_ns[at - 1]) / NS)
    down = body_R_nav @ [0.0, 0.0, -problem.session.gravity]
    assert np.degrees(np.linalg.norm(found.gravity - down)) / problem.session.gravity < 2.0  # deg: the bias of a phone
    off = np.abs(found.velocity - body_R_nav @ velocity)
    assert (off < 3.0 * found.velocity_sigma + 0.02).all() and np.linalg.norm(found.velocity_sigma) < 0.5  # m/s


def test_a_session_without_rest_and_fixes_begins_with_it(problem):
    initial = initialise(problem)
    assert initial.method in ("visual", "static")
    assert initial.method == "static" or "by images" in initial.sentence


def test_inertial_data_of_another_motion_give_none(problem):
    imu = problem.session.require_imu()
    assert started(problem, gyro=imu.gyro[::-1].copy()) is None
