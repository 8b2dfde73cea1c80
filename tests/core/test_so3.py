"""The laws of rotations: products, exponential and logarithm, quaternions, skew matrices, Jacobians."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from smartnav_graph.core.so3 import (
    across,
    exp,
    from_quaternion,
    left_jacobian_inverse,
    log,
    quaternion,
    right_jacobian,
    rotate,
    rotate_back,
    skew,
)

vectors = hnp.arrays(np.float64, (4, 3), elements=st.floats(-10.0, 10.0))
# From no turn at all over the borders of the series to half a turn.
angles = st.sampled_from([0.0, 1e-12, 1e-8, 1e-5, 9.99e-4, 1.001e-3, 0.1, 1.0, 2.0, 3.0, np.pi - 1e-6, np.pi - 1e-9])
axes = hnp.arrays(np.float64, (1, 3), elements=st.floats(-1.0, 1.0)).filter(lambda v: np.linalg.norm(v) > 0.1)


def rotation_vector(axis, angle):
    return angle * axis / np.linalg.norm(axis)


@given(axes)
def test_across_is_perpendicular(v):
    both = across(v)[0]
    np.testing.assert_allclose(both.T @ both, np.eye(2), atol=1e-14)
    np.testing.assert_allclose(v @ both, 0.0, atol=1e-14 * np.abs(v).max())


@given(vectors)
def test_exp_gives_rotation_matrices(w):
    R = exp(w)
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.broadcast_to(np.eye(3), (4, 3, 3)), atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(R), 1.0, atol=1e-14)
    np.testing.assert_allclose(rotate(R, w), w, atol=1e-13)  # the axis stays where it is
    np.testing.assert_allclose(R @ exp(-w), np.broadcast_to(np.eye(3), (4, 3, 3)), atol=1e-14)


def test_exp_turns_counter_clockwise():
    np.testing.assert_allclose(exp(np.array([0.0, 0.0, np.pi / 2])) @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=1e-15)
    np.testing.assert_allclose(exp(np.array([np.pi / 2, 0.0, 0.0])) @ [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], atol=1e-15)


@given(vectors)
def test_exp_is_the_power_series(w):
    w = 0.1 * w[:1]
    power, total = np.eye(3)[None], np.eye(3)[None]
    for k in range(1, 30):
        power = power @ skew(w) / k
        total = total + power
    np.testing.assert_allclose(exp(w), total, atol=1e-13)


@given(vectors)
def test_exp_of_log(w):
    R = exp(w)
    np.testing.assert_allclose(exp(log(R)), R, atol=1e-12)
    assert np.linalg.norm(log(R), axis=1).max() <= np.pi + 1e-12


@given(axes, angles)
def test_log_of_exp(axis, angle):
    w = rotation_vector(axis, angle)
    np.testing.assert_allclose(log(exp(w)), w, atol=1e-8 if angle > 3.1 else 1e-14)


def test_exp_and_log_of_any_shape():
    w = np.random.default_rng(0).uniform(-1.0, 1.0, (2, 5, 3))
    assert exp(w).shape == (2, 5, 3, 3) and exp(w[0, 0]).shape == (3, 3) and exp(w[:0, 0]).shape == (0, 3, 3)
    np.testing.assert_allclose(log(exp(w)), w, atol=1e-14)
    np.testing.assert_array_equal(exp(w)[1, 2], exp(w[1, 2]))


@given(vectors, vectors)
def test_skew_is_the_cross_product(a, b):
    np.testing.assert_allclose(rotate(skew(a), b), np.cross(a, b), atol=1e-13)
    np.testing.assert_array_equal(skew(a), -skew(a).transpose(0, 2, 1))


@given(vectors, vectors)
def test_rotations_row_by_row(w, v):
    R = exp(w)
    np.testing.assert_allclose(rotate(R, v), [one @ row for one, row in zip(R, v, strict=True)], atol=1e-13)
    np.testing.assert_allclose(rotate_back(R, rotate(R, v)), v, atol=1e-13)


@given(vectors)
def test_quaternions(w):
    R = exp(w)
    q = quaternion(R)
    assert (q[:, 0] >= 0.0).all()
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1.0, atol=1e-14)
    np.testing.assert_allclose(from_quaternion(q), R, atol=1e-14)
    np.testing.assert_allclose(from_quaternion(-2.0 * q), R, atol=1e-14)


def test_the_real_part_of_a_quaternion_comes_first():
    quarter = np.array([[np.cos(np.pi / 4), 0.0, 0.0, np.sin(np.pi / 4)]])
    np.testing.assert_allclose(quaternion(exp(np.array([[0.0, 0.0, np.pi / 2]]))), quarter, atol=1e-15)


@given(axes, angles, axes)
def test_jacobians_are_the_numerical_derivatives(axis, angle, direction):
    theta, d = rotation_vector(axis, angle), rotation_vector(direction, 1e-6)
    R = exp(theta)
    right = log(R.transpose(0, 2, 1) @ exp(theta + d)) - log(R.transpose(0, 2, 1) @ exp(theta - d))
    np.testing.assert_allclose(right / 2, rotate(right_jacobian(theta), d), atol=1e-14)
    if angle < 3.1:  # beyond, the logarithm of the turned rotation may be that of the other way round
        left = log(exp(d) @ R) - log(exp(-d) @ R)
        np.testing.assert_allclose(left / 2, rotate(left_jacobian_inverse(theta), d), atol=1e-14)


@pytest.mark.parametrize("angle", [0.0, 1e-3, 1.0, 3.0, np.pi, 4.0, 6.0])
def test_left_and_right_jacobians_belong_together(angle):
    theta = rotation_vector(np.array([[2.0, -1.0, 2.0]]), angle)
    # the left Jacobian is the transpose of the right one
    product = left_jacobian_inverse(theta)[0] @ right_jacobian(theta)[0].T
    np.testing.assert_allclose(product, np.eye(3), atol=1e-9)
