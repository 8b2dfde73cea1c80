"""Which pass follows which: the decision alone, on small fakes."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest
from exact import record

from smartnav_graph.core.progress import silent
from smartnav_graph.estimate.config import Config
from smartnav_graph.estimate.passes import (
    LEAST_SQUARES_ERROR_M,
    PREDICTION_ERROR_M,
    RESTART_PASSES,
    Pass,
    causal_start,
    next_pass,
)
from smartnav_graph.estimate.problem import prepare
from smartnav_graph.estimate.run import initialise
from smartnav_graph.graph.pass_state import PassState, Phase
from smartnav_graph.simulation import motions

FIRST_VALUES, VALUES = object(), object()
PLAIN, ROBUST, GATED = (PassState(phase=phase) for phase in (Phase.PLAIN, Phase.ROBUST, Phase.GATED))
SECOND_STAGE = PassState(stage=1)


def of(state: PassState, **options) -> Pass:
    return Pass(state, 10, initial_values=VALUES, first_values=FIRST_VALUES, **options)


def solved(converged: bool = True) -> SimpleNamespace:
    return SimpleNamespace(converged=converged, values=VALUES)


@pytest.mark.parametrize(
    ("pass_", "updated", "done"),
    [
        (of(PLAIN), PLAIN, True),
        (of(PLAIN, number=10), GATED, False),
        (of(PLAIN, coarse_start=True), SECOND_STAGE, False),  # an initial guess needs no second stage
    ],
    ids=["nothing changed", "the limit is reached", "coarse start"],
)
def test_the_last_pass(pass_, updated, done):
    assert next_pass(pass_, solved(), updated, done=done) is None


def test_a_pass_begins_where_the_one_before_ended():
    pass_ = of(PLAIN, start_error_m=3.0, causal_start=True)
    following = next_pass(pass_, solved(), GATED, done=False)
    assert following == replace(pass_, number=2, pass_state=GATED, start_error_m=0.0, causal_start=False)
    assert following.initial_values is VALUES


def test_the_first_robust_pass_begins_where_least_squares_did():
    following = next_pass(of(PLAIN), solved(), ROBUST, done=False)
    assert following.initial_values is FIRST_VALUES and following.start_error_m == PREDICTION_ERROR_M


def test_after_a_restart_it_begins_at_least_squares():
    following = next_pass(of(PLAIN, restarted=True), solved(), ROBUST, done=False)
    assert following.initial_values is VALUES and following.start_error_m == LEAST_SQUARES_ERROR_M


def test_a_robust_pass_that_diverges_restarts_least_squares_once():
    state = replace(ROBUST, robust_floor_m=3.0, rejected={"gnss": frozenset({1})})
    following = next_pass(of(state), solved(converged=False), GATED, done=False)
    assert following.pass_state == PLAIN and following.initial_values is FIRST_VALUES
    assert following.restarted and following.limit == 10 + RESTART_PASSES
    again = next_pass(replace(following, pass_state=state), solved(converged=False), GATED, done=False)
    assert again.pass_state == GATED and again.limit == following.limit


def test_from_a_coarse_start_a_robust_pass_goes_on():
    following = next_pass(of(ROBUST, coarse_start=True), solved(converged=False), GATED, done=False)
    assert following.pass_state == GATED and not following.restarted
    following = next_pass(of(PLAIN, coarse_start=True), solved(), ROBUST, done=False)
    assert following.initial_values is VALUES and following.start_error_m == 0.0


@pytest.mark.parametrize("diverged", [True, False])
def test_images_join_a_diverged_trajectory_window_by_window(diverged):
    following = next_pass(of(GATED), solved(), SECOND_STAGE, done=False, diverged=diverged)
    assert following.causal_start is diverged


def test_a_causal_start_needs_no_prior_on_the_position():
    problem = prepare(record(motions.figure_eight(20.0), seed=2, fix_sigma=0.2).session, Config())
    prior = replace(initialise(problem).prior, sigma_pos=None)
    values, _ = causal_start(problem, problem.windows, prior, PassState(), silent)
    assert values.size() >= 3 * len(problem.windows)
