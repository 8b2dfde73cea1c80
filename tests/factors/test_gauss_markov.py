"""The correlated error of code receivers: its place in the residual, its derivative, its stationary statistics."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from exact import LEVER, assemble, assert_derivative, record
from scipy.stats import chi2

from smartnav_graph.core.timebase import NS, ns_from_seconds
from smartnav_graph.factors.gauss_markov import add_correlated_error
from smartnav_graph.factors.gnss import GnssConfig, PositionBuilder
from smartnav_graph.graph.pass_state import PassState
from smartnav_graph.graph.states import State, key
from smartnav_graph.graph.update import GraphUpdate
from smartnav_graph.graph.windows import PerWindow, Window
from smartnav_graph.session.calibration.model import GnssNoise
from smartnav_graph.simulation.fixes import gauss_markov
from smartnav_graph.smoothers.whole_graph import WholeGraph, custom_factor

NOISE = GnssNoise(correlated_horizontal_sigma=4.0, correlated_vertical_sigma=6.0, correlated_time=60.0)
CORRELATED = PassState(correlated=frozenset({"gnss"}))


@pytest.fixture(scope="module")
def graph():
    recording = record()
    made = assemble(recording.session, recording.truth, pass_state=CORRELATED)
    rng = np.random.default_rng(0)
    for window in made.windows:
        made.values.update(key("C", window.index), rng.uniform(-5, 5, 3))
    return made


def blocks(graph):
    return [block for update in graph.updates for block in update.blocks]


def test_every_fix_is_a_row_of_a_block_and_every_keyframe_has_its_state(graph):
    assert len(blocks(graph)) == 30 and graph.factors("gnss") == []
    assert {block.sensor for block in blocks(graph)} == {"gnss"}
    assert [list(update.chain) for update in graph.updates] == [[key("C", w.index)] for w in graph.windows]
    assert len(graph.factors("gnss_correlated_error")) == len(graph.windows)
    assert len(graph.factors("control")) == 6  # errors of surveyed points are independent


def test_the_residual_at_the_truth_is_the_correlated_error_over_sigma(graph):
    for block in blocks(graph):
        c = graph.values.atVector(block.keys[0][2])
        np.testing.assert_allclose(custom_factor(block, 0, {}).whitenedError(graph.values), c / 1.0, atol=1e-9)


def test_the_lever_arm_sign_shows(graph):
    block = blocks(graph)[10]
    wrong = block.data.copy()
    wrong[:, 3:6] *= -1
    poses = [graph.values.atPose3(block.keys[0][0]).matrix()[None], np.zeros((1, 3)), np.zeros((1, 3))]
    right, flipped = (block.model.linearize(poses, data)[0] for data in (block.data, wrong))
    assert np.linalg.norm(right) < 1e-9 and np.linalg.norm(flipped) > 1.9 * np.linalg.norm(LEVER)


def test_the_analytic_derivative_is_the_numerical_one(graph):
    block = blocks(graph)[12]
    delta = gtsam.VectorValues()
    delta.insert(block.keys[0][0], 0.05 * np.arange(1.0, 7.0))
    assert_derivative(custom_factor(block, 0, {}), graph.values.retract(delta))


def test_blocks_and_custom_factors_are_the_same_system(graph):
    whole = WholeGraph.of(graph.updates)
    one_by_one = gtsam.NonlinearFactorGraph()
    for update in graph.updates:
        for _, factor in update.factors:
            one_by_one.push_back(factor)
        for block in update.blocks:
            one_by_one.push_back(custom_factor(block, 0, {}))
    assert whole.error(graph.values) == pytest.approx(one_by_one.error(graph.values), rel=1e-12)
    assert whole.error(graph.values) > 10.0
    a, b = (g.linearize(graph.values).hessian() for g in (whole, one_by_one))
    for one, other in zip(a, b, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9 * np.abs(one).max())


# --- the process ------------------------------------------------------------------------------------------------------


def chain(seconds: np.ndarray) -> gtsam.NonlinearFactorGraph:
    """The factors of the process alone, keyframes at these times."""
    graph, empty = gtsam.NonlinearFactorGraph(), np.zeros((0, 3))
    t_ns = ns_from_seconds(seconds)
    for k, t in enumerate(t_ns):
        update = GraphUpdate(k, int(t), t / NS)
        window = Window(k, int(t_ns[max(k - 1, 0)]), int(t), "normal", np.zeros(0), empty, empty)
        add_correlated_error(update, window, State(k - 1, 0, None, None) if k else None, NOISE, PerWindow())
        for _, factor in update.factors:
            graph.push_back(factor)
    return graph


def values_of(rows: np.ndarray) -> gtsam.Values:
    values = gtsam.Values()
    for k, row in enumerate(rows):
        values.insert(key("C", k), row)
    return values


def test_the_process_is_stationary_with_an_exponential_correlation():
    t = np.array([0.0, 1.0, 11.0, 41.0, 161.0])
    joint = gtsam.Marginals(chain(t), values_of(np.zeros((5, 3))))
    keys = [key("C", k) for k in range(5)]
    found = joint.jointMarginalCovariance(keys).fullMatrix().reshape(5, 3, 5, 3)
    rho = np.exp(-np.abs(t[:, None] - t) / 60.0)
    for axis, sigma in enumerate((4.0, 4.0, 6.0)):
        np.testing.assert_allclose(found[:, axis, :, axis], sigma**2 * rho, rtol=1e-9)
    np.testing.assert_allclose(found[:, 0, :, 1], 0.0, atol=1e-12)


def test_simulated_correlated_errors_have_the_cost_of_its_degrees_of_freedom():
    t = np.cumsum(np.random.default_rng(0).uniform(0.2, 5.0, 200))
    rows = gauss_markov(ns_from_seconds(t), 4.0, 60.0, np.random.default_rng(1))  # vertical 1.5 times as large
    square = 2 * chain(t).error(values_of(rows))
    low, high = chi2(600).ppf([1e-4, 1 - 1e-4])
    assert low < square < high
    assert not low < 2 * chain(t).error(values_of(1.3 * rows)) < high


# --- which fixes have it ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("sigma", "noise", "config", "expected"),
    [
        (3.0, NOISE, GnssConfig(), True),
        (0.5, NOISE, GnssConfig(), True),
        (0.49, NOISE, GnssConfig(), False),  # carrier phase
        (3.0, GnssNoise(correlated_horizontal_sigma=0.0), GnssConfig(), False),
        (3.0, NOISE, GnssConfig(correlated=False), False),
    ],
)
def test_fixes_of_metres_have_a_correlated_error(sigma, noise, config, expected):
    n = 4
    fixes = PositionBuilder(
        "gnss", np.zeros((n, 3)), np.full((n, 3), sigma), np.ones(n, dtype=bool), np.zeros(3), config, noise
    )
    assert fixes.has_correlated_error(PassState()) == expected
