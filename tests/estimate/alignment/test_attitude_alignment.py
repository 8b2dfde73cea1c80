"""Attitude and gyro bias at the start by the first attitudes of fixes."""

from dataclasses import replace

import numpy as np
import pytest
from exact import START_NS, angle_deg, record

from smartnav_graph.core.so3 import exp
from smartnav_graph.core.timebase import ns_from_seconds
from smartnav_graph.estimate.alignment.attitude import attitude_start
from smartnav_graph.session.calibration.model import DEVICE_CLASSES

BIAS = np.array([0.1, -0.05, 0.08])  # rad/s, of a phone that its system has not corrected
SIGMA = 0.05


def start_of(every_s, *, bias=BIAS, noise=0.0, spoilt=()):
    made = record(noise=DEVICE_CLASSES["mems"], seed=1)
    imu = replace(made.session.imu, gyro=made.session.imu.gyro - made.biases.gyro + bias)
    t = np.arange(0.7, 29.0, every_s)
    turn = exp(noise * np.random.default_rng(0).standard_normal((len(t), 3)))
    seen = turn @ made.trajectory.sample(t).nav_R_body
    for row in spoilt:
        seen[row] = seen[row] @ exp(np.array([[0.0, 0.0, 2.5]]))[0]
    found = attitude_start(imu, START_NS, START_NS + ns_from_seconds(t), seen, SIGMA)
    return found, made.truth([START_NS]).nav_R_body[0]


@pytest.mark.parametrize("every_s", [1.0, 5.0])
def test_attitude_and_bias(every_s):
    found, truth = start_of(every_s, noise=0.01)
    np.testing.assert_allclose(found.gyro_bias, BIAS, atol=5e-3)
    assert angle_deg(found.nav_R_body, truth) < 3.0


def test_one_wrong_attitude_does_no_harm():
    found, truth = start_of(2.0, spoilt=[6])
    np.testing.assert_allclose(found.gyro_bias, BIAS, atol=0.02)
    assert angle_deg(found.nav_R_body, truth) < 8.0


@pytest.mark.parametrize("every_s", [28.0, 40.0])
def test_attitudes_too_far_apart_or_alone_say_nothing(every_s):
    assert start_of(every_s)[0] is None
