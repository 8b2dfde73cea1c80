"""The prior of the first keyframe: sigmas in nav axes whatever the attitude, and nothing later."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from smartnav_graph.core.timebase import NS
from smartnav_graph.factors.prior import UNKNOWN_ANGLE, PriorBuilder
from smartnav_graph.graph.pass_state import PassState
from smartnav_graph.graph.states import State, key
from smartnav_graph.graph.update import GraphUpdate
from smartnav_graph.graph.windows import Window

ZERO = gtsam.imuBias.ConstantBias()
# A phone on its side, pitched up by 90 deg: body and nav axes have nothing in common.
ATTITUDES = {
    "level": gtsam.Rot3(),
    "yaw 90 deg": gtsam.Rot3.Rz(np.pi / 2),
    "pitch 90 deg": gtsam.Rot3.Rx(np.pi / 2),
    "any": gtsam.Rot3.Ypr(2.5, -1.0, 0.7),
}


def window(kind: str = "first") -> Window:
    empty = np.zeros((0, 3))
    return Window(0, NS, NS, kind, np.zeros(0), empty, empty)


def prior(attitude: gtsam.Rot3, **changes) -> PriorBuilder:
    nav = gtsam.NavState(attitude, np.array([1.0, 2.0, 3.0]), np.array([4.0, 5.0, 6.0]))
    sigmas = {
        "sigma_rot": np.array([0.1, 0.2, 0.3]),
        "sigma_pos": np.array([1.0, 2.0, 4.0]),
        "sigma_vel": np.full(3, 0.5),
        "sigma_bias": np.array([0.3] * 3 + [0.05] * 3),
        "velocity_mean": np.array([4.0, 5.0, 6.0]),
        "bias_mean": ZERO,
    }
    return PriorBuilder(State(0, NS, nav, ZERO), **{**sigmas, **changes})


def step_of(builder: PriorBuilder, kind: str = "first") -> GraphUpdate:
    update = GraphUpdate(0, NS, 0.0)
    builder.add(update, window(kind), None, PassState())
    return update


def values_at(attitude: gtsam.Rot3, position=(1.0, 2.0, 3.0), velocity=(4.0, 5.0, 6.0), bias=ZERO) -> gtsam.Values:
    values = gtsam.Values()
    values.insert(key("X", 0), gtsam.Pose3(attitude, np.array(position)))
    values.insert(key("V", 0), np.array(velocity))
    values.insert(key("B", 0), bias)
    return values


def cost(update: GraphUpdate, values: gtsam.Values) -> float:
    return sum(factor.error(values) for _, factor in update.factors)


@pytest.mark.parametrize("attitude", ATTITUDES.values(), ids=ATTITUDES)
@pytest.mark.parametrize("sigma_pos", [None, np.array([1.0, 2.0, 4.0])], ids=["free position", "held position"])
@pytest.mark.parametrize("axis", range(3))
def test_one_sigma_about_a_nav_axis_costs_a_half(attitude, sigma_pos, axis):
    update = step_of(prior(attitude, sigma_pos=sigma_pos))
    turn = np.zeros(3)
    turn[axis] = [0.1, 0.2, 0.3][axis]
    moved = values_at(gtsam.Rot3.Expmap(turn).compose(attitude))
    assert cost(update, values_at(attitude)) == pytest.approx(0.0, abs=1e-12)
    assert cost(update, moved) == pytest.approx(0.5, rel=1e-2)


@pytest.mark.parametrize("attitude", ATTITUDES.values(), ids=ATTITUDES)
@pytest.mark.parametrize("axis", range(3))
def test_one_sigma_along_a_nav_axis_costs_a_half(attitude, axis):
    shift = np.diag([1.0, 2.0, 4.0])[axis]
    moved = values_at(attitude, position=np.array([1.0, 2.0, 3.0]) + shift)
    assert cost(step_of(prior(attitude)), moved) == pytest.approx(0.5, rel=1e-6)
    assert cost(step_of(prior(attitude, sigma_pos=None)), moved) == pytest.approx(0.0, abs=1e-12)


def test_velocity_and_bias_have_their_own_means_and_sigmas():
    mean = gtsam.imuBias.ConstantBias(np.zeros(3), np.array([0.01, 0.0, 0.0]))
    update = step_of(prior(gtsam.Rot3(), bias_mean=mean, velocity_mean=np.zeros(3)))
    off = gtsam.imuBias.ConstantBias(np.array([0.3, 0, 0]), np.array([0.06, 0.0, 0.0]))
    assert cost(update, values_at(gtsam.Rot3(), velocity=(0, 0, 0), bias=off)) == pytest.approx(1.0, rel=1e-9)
    assert cost(update, values_at(gtsam.Rot3(), velocity=(0.5, 0, 0), bias=mean)) == pytest.approx(0.5, rel=1e-9)


def test_the_prior_is_also_the_first_guess():
    update = step_of(prior(ATTITUDES["any"]))
    values = update.values()
    np.testing.assert_allclose(values.atPose3(key("X", 0)).translation(), [1, 2, 3])
    np.testing.assert_allclose(values.atPose3(key("X", 0)).rotation().matrix(), ATTITUDES["any"].matrix())
    np.testing.assert_allclose(values.atVector(key("V", 0)), [4, 5, 6])


@pytest.mark.parametrize("kind", ["normal", "gap", "static"])
def test_later_windows_get_nothing(kind):
    assert step_of(prior(gtsam.Rot3()), kind).factors == []


def test_an_unknown_angle_has_the_spread_of_a_full_circle():
    assert np.random.default_rng(0).uniform(-np.pi, np.pi, 200_000).std() == pytest.approx(UNKNOWN_ANGLE, rel=0.01)
