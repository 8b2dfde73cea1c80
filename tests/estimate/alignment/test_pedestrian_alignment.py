"""A walker's way at first sight, and the starts that need it."""

from __future__ import annotations

import numpy as np
import pytest
from differences import wrap_deg
from scipy.spatial.transform import Rotation

import smartnav_graph as sn
from smartnav_graph.core import frames
from smartnav_graph.core.frames import body_R_vehicle
from smartnav_graph.core.timebase import interpolate
from smartnav_graph.estimate.alignment.pedestrian import Walk, walked
from smartnav_graph.graph.keyframes import KeyframeConfig, keyframe_times, make_windows
from smartnav_graph.graph.windows import Window
from smartnav_graph.session.calibration.model import StepNoise
from smartnav_graph.session.detect.steps import Steps, find_steps
from smartnav_graph.session.streams import ControlPoint
from smartnav_graph.simulation import motions
from smartnav_graph.simulation.scenarios import Scenario

PHONE = body_R_vehicle("+y", "+z")
BIAS = np.array([0.01, -0.02, 0.05])  # rad/s, 3 deg a second about the vertical


@pytest.fixture(scope="module")
def session() -> sn.Session:
    """A walk of 90 s, the phone pitched up 35 deg; its gyroscope has a bias."""
    made = Scenario("walk", 90.0, motions.walk, "foot", "galaxy-s2")(4)
    imu = made.imu
    return made.replace(static=None, imu=type(imu)(t_ns=imu.t_ns, accel=imu.accel, gyro=imu.gyro + BIAS))


def windows_of(session: sn.Session) -> list[Window]:
    options = KeyframeConfig()
    span = (int(session.imu.t_ns[0]), int(session.imu.t_ns[-1]))
    return make_windows(session.imu, keyframe_times(span, [], (), options), (), {}, options)


def fixes_of(session: sn.Session, every_s: float, sigma: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    t_ns = session.imu.t_ns[600 :: round(100 * every_s)]
    enu = interpolate(t_ns, session.reference.t_ns, session.reference.enu)
    return t_ns, enu + sigma * np.random.default_rng(1).standard_normal(enu.shape)


def sight(session: sn.Session, fixes: tuple[np.ndarray, np.ndarray], steps: Steps | None = None) -> Walk | None:
    steps = find_steps(session.imu) if steps is None else steps
    return walked(windows_of(session), steps, fixes, 0.7, 0.05, PHONE, StepNoise())


def headings(session: sn.Session, t_ns: np.ndarray) -> np.ndarray:
    R = Rotation.from_quat(session.reference.quat[:, [1, 2, 3, 0]]).as_matrix()
    heading = np.unwrap(frames.heading_pitch_roll_deg(R)[:, 0], period=360.0)
    return np.interp(t_ns - t_ns[0], session.reference.t_ns - t_ns[0], heading)


@pytest.mark.parametrize(("every_s", "sigma", "metres", "degrees"), [(10.0, 0.0, 2.0, 15.0), (20.0, 0.7, 4.0, 25.0)])
def test_a_few_points_and_the_steps_tell_the_way(session, every_s, sigma, metres, degrees):
    found = sight(session, fixes_of(session, every_s, sigma))
    t_ns = np.array([w.t1_ns for w in found.windows])
    inside = t_ns <= session.reference.t_ns[-1]
    off = found.p[inside] - interpolate(t_ns[inside], session.reference.t_ns, session.reference.enu)
    assert np.linalg.norm(off[:, :2], axis=1).max() < metres
    turned = frames.heading_pitch_roll_deg(found.R)[:, 0] - headings(session, t_ns)
    assert np.abs(wrap_deg(turned)).max() < degrees
    pitch = frames.heading_pitch_roll_deg(found.R)[:, 1]
    assert np.abs(pitch - 35.0).max() < 12.0  # it leans where it gains speed
    speed = np.linalg.norm(found.v, axis=1)
    assert speed[:4].max() < 0.3 and 1.0 < np.median(speed) < 1.6  # it stands for 5 s, then walks
    assert found.gyro_bias[0] @ found.R[0].T[:, 2] == pytest.approx(0.05, abs=0.03)


def test_the_values_hold_every_keyframe(session):
    found = sight(session, fixes_of(session, 10.0))
    assert found.values(5).size() == 15 and found.values().size() == 3 * len(found.windows)
    np.testing.assert_allclose(found.state(3).nav.position(), found.p[3])


def test_no_way_without_fixes_that_stand_apart_or_without_steps(session):
    t_ns, enu = fixes_of(session, 10.0)
    assert sight(session, (t_ns[:1], enu[:1])) is None
    assert sight(session, (t_ns, np.tile(enu[:1], (len(t_ns), 1)))) is None
    nothing = Steps(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))
    assert sight(session, (t_ns, enu), nothing) is None


def with_points(session: sn.Session, every_s: float) -> sn.Session:
    t_ns, enu = fixes_of(session, every_s, 0.7)
    names = np.array([f"W{k}" for k in range(len(t_ns))], dtype=object)
    return session.replace(control=ControlPoint(t_ns=t_ns, enu=enu, sigma=np.full(enu.shape, 0.7), point_id=names))


@pytest.mark.parametrize("begin_s", [0.0, 21.0])
def test_sparse_points_start_a_walk_from_any_moment(session, begin_s):
    run = sn.run(with_points(session, 15.0), start_s=begin_s)
    assert run.summary["initialisation"]["starts"] == 1
    assert "found from the steps, the fixes" in run.summary["initialisation"]["sentence"]
    turned = run.solution.heading_pitch_roll_deg[:, 0] - headings(session, run.solution.t_ns)
    assert np.abs(wrap_deg(turned)).max() < 25.0  # a hundred where the start is wrong


def test_dense_points_are_no_case_for_it(session):
    run = sn.run(with_points(session, 1.0), start_s=10.0, end_s=40.0)
    assert "from the fixes" in run.summary["initialisation"]["sentence"]
