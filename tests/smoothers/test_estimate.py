"""States, covariances and their axes; what GTSAM's complaint becomes."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from differences import largest_difference
from exact import record

from smartnav_graph.estimate.config import Config
from smartnav_graph.estimate.passes import solve_passes
from smartnav_graph.estimate.problem import prepare
from smartnav_graph.estimate.run import initialise
from smartnav_graph.graph.pass_state import PassState
from smartnav_graph.graph.states import KEYFRAME_LETTERS, State, key
from smartnav_graph.graph.update import FactorId, GraphUpdate
from smartnav_graph.smoothers import estimate as room
from smartnav_graph.smoothers.whole_graph import custom_factor


@pytest.fixture(scope="module")
def solved():
    problem = prepare(record(seed=0, fix_sigma=0.1).session, Config())
    initial = initialise(problem)
    return solve_passes(problem, problem.windows, initial.prior, PassState())[0]


def test_a_state_goes_into_values_and_comes_back():
    nav = gtsam.NavState(gtsam.Pose3(gtsam.Rot3.Yaw(1.0), np.array([1.0, 2.0, 3.0])), np.array([4.0, 5.0, 6.0]))
    bias = gtsam.imuBias.ConstantBias(np.full(3, 0.1), np.full(3, 0.01))
    values = gtsam.Values()
    for letter, value in (("X", nav.pose()), ("V", nav.velocity()), ("B", bias)):
        values.insert(key(letter, 7), value)
    state = room.state_at(values, 7, 123)
    assert isinstance(state, State) and (state.index, state.t_ns) == (7, 123)
    assert state.nav.equals(nav, 0.0) and state.bias.equals(bias, 0.0)
    R, p, v, b = room.states_of(values, [7])
    assert (R.shape, p.shape, v.shape, b.shape) == ((1, 3, 3), (1, 3), (1, 3), (1, 6))
    assert np.array_equal(b[0], [0.1] * 3 + [0.01] * 3)


def test_body_covariance_in_nav_axes():
    """Heading north seen from a body turned by 90 deg: variances 9 along body x are 9 along nav y."""
    joint = np.diag([9.0, 1.0, 1.0, 16.0, 1.0, 1.0] + [2.0, 3.0, 4.0] + [5.0] * 6)[None]
    turned = room.to_nav_axes(joint, gtsam.Rot3.Yaw(np.pi / 2).matrix()[None])[0]
    assert np.diag(turned) == pytest.approx(
        [1, 9, 1, 1, 16, 1, 2, 3, 4, 5, 5, 5, 5, 5, 5]
    )  # velocity is in nav already


def as_factors(estimate: room.Estimate) -> gtsam.NonlinearFactorGraph:
    """The same problem as factors of GTSAM alone: one CustomFactor a row, a prior a session state."""
    graph = gtsam.NonlinearFactorGraph()
    for _, factor in estimate.factors:
        graph.push_back(factor)
    for block in estimate.blocks:
        for row in np.flatnonzero(block.used):
            graph.push_back(custom_factor(block, int(row), {}))
    for state in estimate.session.values():
        sigmas = gtsam.noiseModel.Diagonal.Sigmas(state.prior_sigma)
        graph.push_back(gtsam.PriorFactorVector(state.key, state.prior_mean, sigmas))
    return graph


def on_tangent(marginals: gtsam.Marginals, names: list[int]) -> np.ndarray:
    """Joint covariance of states from GTSAM, in this order."""
    joint = marginals.jointMarginalCovariance(names)
    return np.block([[joint.at(one, other) for other in names] for one in names])


def test_covariance_of_all_keyframes_is_that_of_gtsam(solved):
    """Joint of each keyframe, with the next, and of the session states, which touch them all."""
    assert solved.session["gnss_time_offset_s"].sigma[0] < 0.1 and not solved.session["gnss_time_offset_s"].held
    marginals = gtsam.Marginals(as_factors(solved), solved.values)
    states = [[key(letter, i) for letter in KEYFRAME_LETTERS] for i in solved.indices]
    for i in (0, 7, len(states) - 1):
        turn = np.eye(15)
        turn[:3, :3] = turn[3:6, 3:6] = solved.values.atPose3(states[i][0]).rotation().matrix()
        own = on_tangent(marginals, states[i])
        scale = np.sqrt(np.outer(np.diag(own), np.diag(own)))
        np.testing.assert_allclose(solved.marginals.joint[i] / scale, own / scale, atol=1e-5)
        np.testing.assert_allclose(solved.covariance[i], turn @ own @ turn.T, rtol=1e-4, atol=1e-12)
    for i in (0, 12, len(states) - 2):
        both = on_tangent(marginals, states[i] + states[i + 1])
        sigma = np.sqrt(np.diag(both))
        cross = both[:15, 15:] / np.outer(sigma[:15], sigma[15:])
        np.testing.assert_allclose(solved.marginals.following[i] / np.outer(sigma[:15], sigma[15:]), cross, atol=1e-5)
    for state in solved.session.values():
        np.testing.assert_allclose(state.covariance, marginals.marginalCovariance(state.key), rtol=1e-5)


def test_covariances_are_symmetric_and_positive(solved):
    assert np.array_equal(solved.covariance, solved.covariance.transpose(0, 2, 1))
    assert np.linalg.eigvalsh(solved.covariance).min() > 0.0


def test_the_solution_is_stationary(solved):
    """The gradient of the cost vanishes: an undamped step from the solution goes nowhere."""
    graph = as_factors(solved)
    step = graph.linearize(solved.values).optimize()
    assert np.abs(step.vector()).max() < 1e-4  # rad, m, m/s
    assert solved.cost == pytest.approx(graph.error(solved.values)) and solved.converged


def test_largest_difference(solved):
    moved = gtsam.Values(solved.values)
    i = solved.indices[3]
    pose = moved.atPose3(key("X", i))
    moved.update(key("X", i), pose.compose(gtsam.Pose3(gtsam.Rot3.Rx(np.radians(1e-3)), np.array([0.0, 0.03, 0.04]))))
    other = room.Estimate(**{**vars_of(solved), "values": moved})
    metres, degrees = largest_difference(solved, other)
    assert metres == pytest.approx(0.05) and degrees == pytest.approx(1e-3, rel=1e-6)
    assert largest_difference(solved, solved) == pytest.approx((0.0, 0.0), abs=1e-9)


def test_largest_difference_near_half_a_turn(solved):
    moved = gtsam.Values(solved.values)
    name = key("X", solved.indices[0])
    moved.update(name, moved.atPose3(name).compose(gtsam.Pose3(gtsam.Rot3.Rz(np.radians(179.0)), np.zeros(3))))
    other = room.Estimate(**{**vars_of(solved), "values": moved})
    assert largest_difference(solved, other)[1] == pytest.approx(179.0, abs=1e-6)


def vars_of(estimate: room.Estimate) -> dict:
    return {name: getattr(estimate, name) for name in estimate.__dataclass_fields__}


def complaint() -> RuntimeError:
    """GTSAM's own words about a pose without attitude."""
    graph = gtsam.NonlinearFactorGraph()
    graph.add(gtsam.GPSFactor(key("X", 21), np.zeros(3), gtsam.noiseModel.Unit.Create(3)))
    values = gtsam.Values()
    values.insert(key("X", 21), gtsam.Pose3())
    with pytest.raises(RuntimeError) as caught:
        graph.linearize(values).optimize()
    return caught.value


def test_an_indeterminate_system_is_told_with_time_state_and_sensors():
    update = GraphUpdate(21, 12_500_000_000, 0.0)
    for sensor in ("imu", "gnss"):
        update.add(FactorId(sensor, update.t_ns), None)
    error = room.indeterminate(complaint(), [update], 2_000_000_000)
    text = str(error)
    assert text.startswith("t = 10.50 s: position or attitude is not determined there")
    assert "keyframe 21, touched by gnss, imu" in text
    assert "expected an absolute measurement nearby; add position fixes" in text and "--initial" in text


@pytest.mark.parametrize(("letter", "name"), [("v", "velocity"), ("b", "an inertial bias"), ("x", "position")])
def test_the_state_is_named(letter, name):
    error = room.indeterminate(RuntimeError(f"near variable\n 123 (Symbol: {letter}4)"), [GraphUpdate(4, 0, 0.0)], 0)
    assert name in str(error) and "touched by nothing" in str(error)


def test_another_complaint_keeps_its_words():
    assert "Something else" in str(room.indeterminate(RuntimeError("Something else\nat length"), [], 0))


def test_a_state_of_the_session_is_named():
    error = room.indeterminate(RuntimeError("near variable\n 123 (Symbol: t99)"), [GraphUpdate(4, 0, 0.0)], 0)
    assert "T (t99) is not determined" in str(error)


def test_the_order_names_every_state_once():
    updates = [GraphUpdate(i, 0, 0.0) for i in range(11)]
    updates[3].chain = {key("C", 3): np.zeros(3)}
    order = room.chronological_order(updates)
    names = [order.at(i) for i in range(order.size())]
    expected = [key(letter, i) for letter in KEYFRAME_LETTERS for i in range(11)] + [key("C", 3)]
    assert sorted(names) == sorted(expected)
