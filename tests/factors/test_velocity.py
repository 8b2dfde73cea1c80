"""Measured velocities: geometry worked by hand and derivatives."""

from __future__ import annotations

import numpy as np
import pytest
from numeric import assert_observation, random_rotations

from smartnav_graph.factors.velocity import BodyVelocity, NavVelocity

EAST = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])  # body y points east: x (right) points south


def residual(model, v, measured, arm=(0.0, 0.0, 0.0), sigma=(1.0, 1.0, 1.0)):
    data = np.concatenate([measured, arm, sigma])[None]
    return model.observe(EAST[None], np.zeros((1, 3)), np.array([v], dtype=float), [], data)[0][0]


def test_a_receiver_tells_nav_axes():
    assert residual(NavVelocity(), (5.0, 1.0, 0.2), (4.0, 1.0, 0.0), sigma=(0.5, 1, 0.1)) == pytest.approx([2, 0, 2])


def test_a_receiver_on_a_lever_arm_goes_round():
    # the arm's own velocity, 0.3 m/s to the body's right, is to the south
    assert residual(NavVelocity(), (5.0, 1.0, 0.0), (5.0, 0.7, 0.0), arm=(0.3, 0, 0)) == pytest.approx([0, 0, 0])


def test_an_odometer_tells_body_axes():
    assert residual(BodyVelocity(), (5.0, -1.0, 0.2), (1.0, 5.0, 0.2)) == pytest.approx([0, 0, 0])
    assert residual(BodyVelocity(), (5.0, -1.0, 0.2), (1.3, 5.0, 0.2), arm=(0.3, 0, 0)) == pytest.approx([0, 0, 0])


@pytest.mark.parametrize("model", [NavVelocity(), BodyVelocity()])
def test_derivatives(model):
    rng = np.random.default_rng(5)
    m = 5
    data = np.column_stack([rng.normal(0, 9, (m, 3)), rng.normal(0, 0.5, (m, 3)), rng.uniform(0.1, 0.3, (m, 3))])
    R, p, v = random_rotations(rng, m), rng.normal(0, 100, (m, 3)), rng.normal(0, 10, (m, 3))
    assert_observation(model, R, p, v, [], data)
