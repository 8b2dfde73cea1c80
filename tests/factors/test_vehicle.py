"""The wheeled vehicle's constraint: geometry worked by hand, derivatives, and what each state is for."""

from __future__ import annotations

import numpy as np
import pytest
from numeric import assert_observation, random_rotations

from smartnav_graph.factors.vehicle import MOUNT_SIZE, NonHolonomic
from smartnav_graph.frames import body_R_vehicle

PHONE = NonHolonomic(body_R_vehicle("+y", "+z"))
COMMA = NonHolonomic(body_R_vehicle("+x", "-z"))


def residual(model, R, v, mount=None, rate=(0.0, 0.0, 0.0), force=(0.0, 0.0, 9.81), sigma=(1.0, 1.0)):
    """Lateral and vertical m/s of one row; rate and force in declared vehicle axes."""
    mount = np.zeros((1, MOUNT_SIZE)) if mount is None else np.atleast_2d(mount)
    data = np.concatenate([rate, force, sigma])[None]
    return model.observe(np.asarray(R)[None], np.zeros((1, 3)), np.array([v], dtype=float), [mount], data)[0][0]


def mount(**values: float) -> np.ndarray:
    names = ("pitch", "yaw", "x", "y", "z", "h", "slip", "squat")
    return np.array([values.get(name, 0.0) for name in names])


@pytest.mark.parametrize(("model", "forward"), [(PHONE, (0.0, 1.0, 0.0)), (COMMA, (1.0, 0.0, 0.0))])
def test_riding_along_the_declared_forward_axis_is_free(model, forward):
    assert residual(model, np.eye(3), 13.0 * np.array(forward)) == pytest.approx([0.0, 0.0])


def test_a_slide_to_the_left_and_a_lift_are_seen_with_their_sign():
    # phone axes: forward is y, so left is -x
    assert residual(PHONE, np.eye(3), (-0.4, 5.0, 0.3)) == pytest.approx([0.4, 0.3])


def test_the_sigma_whitens_each_row():
    assert residual(PHONE, np.eye(3), (-0.4, 5.0, 0.3), sigma=(0.2, 0.1)) == pytest.approx([2.0, 3.0])


def test_a_mount_turned_to_the_left_and_pitched_takes_a_slant_ride_as_straight():
    yaw, pitch = 0.3, -0.2
    # the vehicle's own forward axis in declared axes (forward, left, up): Rz(yaw) Ry(pitch) e_x, pitch nose down
    ahead = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), -np.sin(pitch)])
    nav = 10.0 * np.array([-ahead[1], ahead[0], ahead[2]])  # phone axes: right, ahead, up
    assert residual(PHONE, np.eye(3), nav, mount(pitch=pitch, yaw=yaw)) == pytest.approx([0.0, 0.0], abs=1e-12)


def test_a_device_ahead_of_the_rear_axle_swings_out_in_a_left_turn():
    # 0.5 rad/s to the left, 1.2 m ahead of the axle: 0.6 m/s to the left, which the lever arm explains
    swing = (-0.6, 8.0, 0.0)
    assert residual(PHONE, np.eye(3), swing, rate=(0.0, 0.0, 0.5)) == pytest.approx([0.6, 0.0])
    assert residual(PHONE, np.eye(3), swing, mount(x=-1.2), rate=(0.0, 0.0, 0.5)) == pytest.approx([0.0, 0.0])


def test_a_device_above_the_road_sways_with_roll_and_one_behind_lifts_with_pitch():
    # right side down at 0.1 rad/s, 1 m above the road: 0.1 m/s to the right; the axle stands at z = -1
    assert residual(PHONE, np.eye(3), (0.1, 8.0, 0.0), mount(z=-1.0), rate=(0.1, 0.0, 0.0)) == pytest.approx([0, 0])
    # nose up is a negative turn about left: 1.4 m behind the point that keeps to the road goes down
    assert residual(PHONE, np.eye(3), (0.0, 8.0, -0.14), mount(h=1.4), rate=(0.0, -0.1, 0.0)) == pytest.approx([0, 0])


def test_tyres_slip_outwards_and_the_nose_rises_under_thrust():
    # force 3 m/s^2 to the left, 0.008 rad per m/s^2, 10 m/s: the axle moves 0.24 m/s to the right
    assert residual(PHONE, np.eye(3), (0.24, 10.0, 0.0), mount(slip=0.008), force=(0, 3, 9.8)) == pytest.approx([0, 0])
    # thrust 2 m/s^2 lifts the nose: the body's own up axis leans back, and the ride looks like one downwards
    assert residual(PHONE, np.eye(3), (0, 10.0, -0.1), mount(squat=0.005), force=(2, 0, 9.8)) == pytest.approx([0, 0])


@pytest.mark.parametrize("model", [PHONE, COMMA])
def test_derivatives(model):
    rng = np.random.default_rng(2)
    m = 7
    data = np.concatenate([rng.normal(0, 0.4, (m, 3)), rng.normal(0, 4, (m, 3)), rng.uniform(0.1, 0.3, (m, 2))], axis=1)
    state = rng.normal(0, 1, (m, MOUNT_SIZE)) * [0.5, 0.5, 1, 1, 1, 1, 0.02, 0.02]
    R, p, v = random_rotations(rng, m), rng.normal(0, 100, (m, 3)), rng.normal(0, 10, (m, 3))
    assert_observation(model, R, p, v, [state], data)
