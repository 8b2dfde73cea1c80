"""Surveyed points: position factors of their own sensor, with their own default sigma."""

from __future__ import annotations

import numpy as np
import pytest
from exact import LEVER, assemble, record

from smartnav_graph.core.errors import CalibrationError, SessionError
from smartnav_graph.estimate.config import Config
from smartnav_graph.factors import FACTORS
from smartnav_graph.factors.context import FactorContext
from smartnav_graph.graph.pass_state import PassState
from smartnav_graph.session.calibration.model import Calibration, ControlNoise
from smartnav_graph.session.session import Mount
from smartnav_graph.session.streams import ControlPoint


def made(session, sigma=0.05):
    context = FactorContext(session, Calibration(control_noise=ControlNoise(sigma)), (), "none", Config())
    return FACTORS["control"].build(context)


def points(**sigma) -> ControlPoint:
    return ControlPoint(t_ns=[0, 1], enu=np.eye(3)[:2], point_id=["A", "B"], **sigma)


def test_points_without_sigma_take_that_of_the_calibration():
    session = record().session.replace(control=points())
    np.testing.assert_array_equal(made(session).sigma, 0.05)
    np.testing.assert_array_equal(made(session, 0.2).sigma, 0.2)


def test_a_points_own_sigma_and_lever_arm_are_used():
    session = record().session.replace(control=points(sigma=np.full((2, 3), 0.01)))
    control = made(session)
    np.testing.assert_array_equal(control.sigma, 0.01)
    np.testing.assert_array_equal(control.lever, [LEVER, LEVER])
    assert control.own_sigma.all() and control.name == "control"


def test_each_point_has_the_lever_arm_of_the_sensor_that_stood_on_it():
    prism = (0.0, 0.1, 1.4)
    session = record().session.replace(
        control=points(sensor=["prism", ""]), sensors={"prism": Mount(body_t=prism), "control": Mount(body_t=LEVER)}
    )
    np.testing.assert_array_equal(made(session).lever, [prism, LEVER])


def test_a_sensor_that_is_not_placed_is_named():
    session = record().session.replace(control=points(sensor=["", "prism"]))
    with pytest.raises(SessionError, match=r"^control: row 1 was taken with 'prism', .*; expected \[sensors.prism\]"):
        made(session)


def test_the_sigma_of_surveyed_points_is_never_estimated():
    assert made(record().session).config.estimate_sigma is False


def test_control_and_fixes_are_rejected_apart():
    recording = record()
    both = assemble(recording.session, recording.truth, pass_state=PassState(rejected={"control": frozenset({0})}))
    assert [tag.row for tag, _ in both.factors("control")] == list(range(1, len(recording.session.control)))
    assert len(both.factors("gnss")) == len(recording.session.gnss)


def test_without_points_there_is_no_builder():
    assert made(record().session.replace(control=None)) is None


@pytest.mark.parametrize("sigma", [0.0, -1.0, float("nan")])
def test_a_sigma_that_is_not_positive_is_refused(sigma):
    with pytest.raises(CalibrationError, match=r"position_sigma = .*; expected a finite number > 0"):
        Calibration(control_noise=ControlNoise(sigma))
