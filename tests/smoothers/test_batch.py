"""The batch smoother: settled stretches, warm values, observability."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from differences import largest_difference
from exact import record

from smartnav_graph.core.errors import ConfigError, SolverError
from smartnav_graph.estimate.config import Config
from smartnav_graph.estimate.problem import prepare
from smartnav_graph.estimate.run import initialise
from smartnav_graph.graph.pass_state import PassState
from smartnav_graph.graph.states import key
from smartnav_graph.graph.update import build_update
from smartnav_graph.smoothers import batch
from smartnav_graph.smoothers.batch import Batch, BatchConfig, check_covariance
from smartnav_graph.smoothers.minimise import SolveConfig

FINE = SolveConfig(max_iterations=100, tolerance=1e-13, step_tolerance=1e-8)


@pytest.fixture(scope="module")
def problem():
    return prepare(record(seed=2, fix_sigma=0.5).session, Config())


@pytest.fixture(scope="module")
def prior(problem):
    return initialise(problem).prior


def fill(problem, prior, batch: Batch, change=lambda update: None) -> Batch:
    for window in problem.windows:
        update = build_update(window, batch.latest(), [prior, *problem.builders], PassState(), problem.session.t0_ns)
        change(update)
        batch.update(update)
    return batch


def test_nothing_is_known_before_the_first_step():
    assert Batch().latest() is None


def test_the_latest_state_is_that_of_the_last_step(problem, prior):
    batch = Batch(t0_ns=problem.session.t0_ns)
    for window in problem.windows[:4]:
        batch.update(
            build_update(window, batch.latest(), [prior, *problem.builders], PassState(), problem.session.t0_ns)
        )
        assert (batch.latest().index, batch.latest().t_ns) == (window.index, window.t1_ns)


@pytest.mark.parametrize("settle_s", [3.0, 10.0, 1000.0])
def test_settling_on_the_way_does_not_change_the_solution(problem, prior, settle_s):
    one = fill(problem, prior, Batch(BatchConfig(30.0), FINE)).estimate()
    other = fill(problem, prior, Batch(BatchConfig(settle_s, max(settle_s, 240.0)), FINE)).estimate()
    metres, degrees = largest_difference(one, other)
    assert metres < 1e-3 and degrees < 5e-3  # preintegration at slightly other biases
    assert one.converged and other.converged


def test_warm_values_ten_kilometres_off(problem, prior):
    """Every state moved by 10 km: the same solution, to a millimetre."""
    solved = fill(problem, prior, Batch(solve=FINE)).estimate()
    away = gtsam.Values(solved.values)
    for i in solved.indices:
        pose = away.atPose3(key("X", i))
        shift = pose.translation() + np.array([7_000.0, -7_000.0, 300.0])
        away.update(key("X", i), gtsam.Pose3(pose.rotation(), shift))
    again = fill(problem, prior, Batch(solve=FINE, initial_values=away)).estimate()
    metres, degrees = largest_difference(solved, again)
    assert metres < 1e-3 and degrees < 5e-3 and again.converged


def test_without_anything_absolute_it_names_a_keyframe(problem, prior):
    """No prior, no fix: position and heading hang in the air."""

    def only_inertial(update) -> None:
        update.factors = [(tag, factor) for tag, factor in update.factors if tag.sensor.startswith("imu")]
        update.blocks = []

    batch = fill(problem, prior, Batch(t0_ns=problem.session.t0_ns), only_inertial)
    with pytest.raises(SolverError, match=r"t = \d+\.\d\d s: .* not determined there \(keyframe \d+, touched by") as e:
        batch.estimate()
    assert "imu" in str(e.value) and "add position fixes" in str(e.value)


@pytest.mark.parametrize("value", [np.nan, -1.0, np.inf, 1e19])
def test_variances_that_cannot_be(problem, prior, value):
    batch = fill(problem, prior, Batch())
    covariance = np.tile(np.eye(15), (len(batch.updates), 1, 1))
    check_covariance(covariance, batch.updates, problem.session.t0_ns)
    covariance[5, 4, 4] = value
    with pytest.raises(SolverError, match=r"keyframe 5, touched by .*imu") as e:
        check_covariance(covariance, batch.updates, problem.session.t0_ns)
    seconds = (batch.updates[5].t_ns - problem.session.t0_ns) / 1e9
    assert str(e.value).startswith(f"t = {seconds:.2f} s")


@pytest.mark.parametrize(("settle_s", "longest_s"), [(0.0, 10.0), (20.0, 10.0), (-1.0, 1.0)])
def test_options(settle_s, longest_s):
    with pytest.raises(ConfigError, match="settle_s"):
        BatchConfig(settle_s, longest_s)


def test_the_prior_of_a_new_stretch_has_the_marginals_of_the_last_keyframe_times_one_and_a_half(problem, prior):
    """A linearised covariance is optimistic, so it is widened: by 1.5 in variance, no more and no less."""
    whole = fill(problem, prior, Batch(BatchConfig(1000.0, 1000.0)))
    solved = whole.estimate()
    graph = gtsam.NonlinearFactorGraph()
    for _, factor in solved.factors:
        graph.push_back(factor)
    linear = graph.linearize(solved.values)
    tree, marginals = linear.eliminateMultifrontal(), gtsam.Marginals(graph, solved.values)
    last = whole.updates[-1]
    for factor in map(batch._anchor(tree, solved.values, last).at, range(3)):
        (name,) = factor.keys()
        ratio = factor.noiseModel().covariance() / marginals.marginalCovariance(name)
        np.testing.assert_allclose(np.diag(ratio), 1.5, rtol=1e-6)
