"""Errors without a state, found from the residuals of a solution: their size, and silence where there is none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from planted_faults import focal_length
from sessions import on_control, recorded, shifted, truth, with_gnss, with_imu

import smartnav_graph as sn
from smartnav_graph.core.so3 import log
from smartnav_graph.estimate.config import Config, RunConfig
from smartnav_graph.estimate.result import summary
from smartnav_graph.estimate.result.assemble import SolvedProblem
from smartnav_graph.estimate.result.score_tests import SensorError, _of_inertial_data, sensor_errors, unmodelled
from smartnav_graph.estimate.run import smooth
from smartnav_graph.evaluation.metrics import nees
from smartnav_graph.factors.coplanarity import CoplanarityConfig
from smartnav_graph.factors.gnss import GnssConfig
from smartnav_graph.factors.imu import ImuConfig
from smartnav_graph.session.calibration.model import DEVICE_CLASSES
from smartnav_graph.session.session import Mount

CONFIG = replace(Config(), gnss=GnssConfig(time_offset_sigma=0.0))


@pytest.fixture(scope="module")
def eight():
    return recorded(seconds=120.0, white_m=0.3)


@pytest.fixture
def found(monkeypatch):
    """The errors of a session by kind and axis."""
    kept: list[SensorError] = []
    original = summary.verdict

    def verdict(inputs):
        kept.extend(sensor_errors(inputs.unmodelled))
        return original(inputs)

    def of(session, config=CONFIG):
        monkeypatch.setattr(summary, "verdict", verdict)
        kept.clear()
        smooth(session, config)
        errors = (error for error in kept if error.t_ns is None and error.sensor != "control")
        return {(error.kind, error.axis): error for error in errors}

    return of


def test_none_is_significant_where_there_is_none(eight, found):
    errors = found(eight)
    of_fixes = {"clock", "clock rate", "lever arm", "stretch"}
    assert {kind for kind, _ in errors} == of_fixes | {"accelerometer scale", "gyro scale"}
    assert all(abs(error.value) < 4.0 * error.sigma for error in errors.values())


def assert_near(error: SensorError, value: float) -> None:
    assert abs(error.value) > 4.0 * error.sigma
    assert error.value == pytest.approx(value, rel=0.3)  # to first order, and beside biases that it shares


def test_a_late_clock(eight, found):
    assert_near(found(shifted(eight, 0.5))["clock", ""], -0.5)  # s


def test_a_clock_at_another_rate(eight, found):
    """Stamps of the fixes that grow by one per cent too much, as beside a slow clock of the inertial data."""
    since = eight.gnss.t_ns - eight.gnss.t_ns[0]
    fast = with_gnss(eight, t_ns=eight.gnss.t_ns + since // 100)
    assert_near(found(fast)["clock rate", ""], -0.01)


def test_a_wrong_lever_arm(eight, found):
    wrong = eight.replace(sensors={"gnss": Mount(body_t=(-1.0, 0.0, 0.0))})
    assert_near(found(wrong)["lever arm", "x"], 1.0)  # m


def test_positions_of_another_scale_along_one_axis(eight, found):
    stretched = with_gnss(eight, lla=eight.frame.lla_from_nav(eight.nav_position(eight.gnss) * [0.9, 1.0, 1.0]))
    assert_near(found(stretched)["stretch", "east"], -0.1)


def test_positions_of_another_datum_than_surveyed_points(eight, found):
    points = on_control(eight, np.arange(5, 115, 10), 0.05, seed=1)
    assert abs(found(eight.replace(control=points))["offset", "east"].value) < 0.5  # m
    shifted_fixes = with_gnss(eight, lla=None, enu=eight.nav_position(eight.gnss) + 5.0 * np.eye(3)[0])
    both = found(shifted_fixes.replace(control=points))
    assert both["offset", "east"].value == pytest.approx(5.0, abs=0.5)  # m, of the fixes
    assert abs(both["offset", "north"].value) < 1.0  # points and fixes that exclude each other bend the path


def test_a_wrong_gyro_scale(eight, found):
    wrong = with_imu(eight, gyro=eight.imu.gyro * [1.0, 1.0, 1.03])
    assert_near(found(wrong)["gyro scale", "z"], 0.03)


def test_a_wrong_focal_length(found):
    """Half a minute in a room, whose turns and accelerations the inertial data know."""
    room = sn.load("gtsam-euroc")
    known = replace(CONFIG, image_pairs=CoplanarityConfig(focal_sigma=0.0))
    right, wrong = (found(focal_length(factor)(room, np.random.default_rng(0)), known) for factor in (1.0, 1.05))
    assert abs(right["focal length", ""].value) < 0.01
    assert_near(wrong["focal length", ""], 0.05)


def test_readings_that_are_only_noise_have_no_scale(eight, found):
    """About the horizontal axes the device turns little: its readings are bias and noise, which a scale of 100 % would
    explain."""
    rng = np.random.default_rng(0)
    noise = rng.normal(0.0, 0.01, (len(eight.imu), 2))
    errors = found(with_imu(eight, gyro=np.column_stack([noise, eight.imu.gyro[:, 2]])))
    assert ("gyro scale", "x") not in errors and ("gyro scale", "y") not in errors


@pytest.fixture(scope="module")
def by_class(eight):
    """The same with a device of which no more than its class is known."""
    return eight.replace(calibration=replace(eight.calibration, imu_noise=DEVICE_CLASSES["mems"]))


def looked_at(session, config=CONFIG):
    run = smooth(session, config)
    return unmodelled(SolvedProblem(run.problem, run.estimate, run.pass_state)), run


def test_the_solution_moves_as_the_sensitivity_says(eight):
    """A solution of wrong readings is off by its change by the error, here 0.2 % about the vertical axis; the mean of a
    window does not see the sway inside it."""
    steady = replace(CONFIG, imu=ImuConfig(estimate_noise=False))
    found, right = looked_at(eight, steady)
    wrong = smooth(with_imu(eight, gyro=eight.imu.gyro * [1.0, 1.0, 1.002]), steady)
    solved = SolvedProblem(right.problem, right.estimate, right.pass_state)
    inertial = _of_inertial_data(solved, found.linear.parts({"imu"}))
    rows = next(rows for error, rows in inertial if (error.kind, error.axis) == ("gyro scale", "z"))
    change = found.linear.keyframes(found.linear.sensitivity([rows], [0]).change)
    moved = right.solution.nav_t_body - wrong.solution.nav_t_body
    assert moved == pytest.approx(0.002 * change[:, 3:6, 0], abs=0.2 * np.abs(moved).max())


def test_scale_errors_of_the_class_are_in_the_covariance(by_class):
    """Without them a scale error of 1 % leaves the 95 % region of the attitude at most epochs."""
    wrong = with_imu(by_class, gyro=1.01 * by_class.imu.gyro, accel=1.01 * by_class.imu.accel)
    found, run = looked_at(wrong)
    known = np.isin(run.solution.t_ns, by_class.reference.t_ns)
    R = truth(by_class, run.solution.t_ns[known])[0]
    error = log(R @ run.solution.nav_R_body[known].transpose(0, 2, 1))
    own = run.solution.covariance[known, :3, :3]
    square, without = nees(error, own), nees(error, own - found.covariance()[known, :3, :3])
    assert np.mean(square < 7.8) > 0.9 > np.mean(without < 7.8)


def test_stances_of_a_foot_make_the_height_uncertain_with_time():
    """Without fixes a velocity that all stances have moves the height by it times the time: 1 cm/s of prior sigma."""
    run = smooth(sn.simulate("static-60s", 0), replace(CONFIG, run=RunConfig(sensors=("imu", "static"))))
    solved = SolvedProblem(run.problem, run.estimate, run.pass_state)
    assert unmodelled(solved) is None
    rests = replace(run.problem.rests, on_foot=True, turn_sigma=np.full(len(run.problem.rests.t_ns), np.nan))
    found = unmodelled(replace(solved, problem=replace(run.problem, rests=rests)))
    assert {error.axis for error in found.errors if error.kind == "stance velocity"} == set("xyz")
    height = np.sqrt(found.covariance()[:, 5, 5])
    seconds = (run.estimate.t_ns - run.estimate.t_ns[0]) / 1e9
    assert height[-1] == pytest.approx(0.01 * seconds[-1], rel=0.2)


def test_a_calibrated_device_has_none(eight):
    found, _ = looked_at(eight)
    assert not found.covariance().any()
