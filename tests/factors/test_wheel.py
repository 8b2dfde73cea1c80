"""Wheel speed: geometry worked by hand and derivatives."""

from __future__ import annotations

import numpy as np
import pytest
from numeric import assert_observation, random_rotations

from smartnav_graph.core.frames import body_R_vehicle
from smartnav_graph.factors.vehicle import MOUNT_SIZE
from smartnav_graph.factors.wheel import RearWheels

MODEL = RearWheels(body_R_vehicle("+y", "+z"))


def residual(v, speed, *, slope=0.0, rate=(0.0, 0.0, 0.0), place=(0.0, 0.0, 0.0), scale=0.0, delay=0.0, sigma=1.0):
    mount = np.zeros((1, MOUNT_SIZE))
    mount[0, 2:5] = place
    data = np.concatenate([[speed, slope], rate, [sigma]])[None]
    states = [mount, np.array([[scale, delay]])]
    return MODEL.observe(np.eye(3)[None], np.zeros((1, 3)), np.array([v], dtype=float), states, data)[0][0, 0]


def test_forward_velocity_less_speed():
    assert residual((1.0, 12.0, 0.5), 11.5, sigma=0.25) == pytest.approx(2.0)


def test_worn_tyres_turn_faster():
    assert residual((0.0, 10.0, 0.0), 10.2, scale=0.02) == pytest.approx(0.0)


def test_a_late_wheel_speaks_of_the_speed_before():
    # gaining 2 m/s^2, told 0.1 s late: reads 0.2 m/s too little
    assert residual((0.0, 10.0, 0.0), 9.8, slope=2.0, delay=0.1) == pytest.approx(0.0)


def test_a_device_right_of_the_middle_is_faster_in_a_left_turn():
    # the middle of the axle lies 0.3 m to the left; 0.5 rad/s
    assert residual((0.0, 10.15, 0.0), 10.0, rate=(0.0, 0.0, 0.5), place=(-1.0, 0.3, -1.0)) == pytest.approx(0.0)


def test_derivatives():
    rng = np.random.default_rng(4)
    m = 6
    speed, slope, sigma = rng.uniform(0, 20, m), rng.normal(0, 2, m), rng.uniform(0.05, 0.2, m)
    data = np.column_stack([speed, slope, rng.normal(0, 0.4, (m, 3)), sigma])
    mount = rng.normal(0, 1, (m, MOUNT_SIZE)) * [0.5, 0.5, 1, 1, 1, 1, 0.02, 0.02]
    wheel = rng.normal(0, 1, (m, 2)) * [0.05, 0.1]
    R, p, v = random_rotations(rng, m), rng.normal(0, 100, (m, 3)), rng.normal(0, 10, (m, 3))
    assert_observation(MODEL, R, p, v, [mount, wheel], data)
