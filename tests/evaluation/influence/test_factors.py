"""The linear system that a run leaves: the same as the solver's, and the same after a round trip."""

import numpy as np
import pytest

import smartnav_graph as sn
from smartnav_graph.evaluation.influence import Influence, influence_of_keyframe
from smartnav_graph.factors import builder_of

OPTIONS = {"end_s": 20.0, "initial": "0,0,0,0,3,30"}


@pytest.fixture(scope="module")
def run():
    return sn.run(sn.simulate("figure-eight-60s", 3), **OPTIONS)


@pytest.fixture(scope="module")
def influence(run):
    return Influence.of(run.estimate, run.problem.windows)


def test_every_factor_in_use_is_there(run, influence):
    counts = {}
    for group in influence.groups:
        counts[group.sensor] = counts.get(group.sensor, 0) + len(group.t_ns)
    reported = run.summary["factors"]
    assert {name: counts[name] for name in reported} == reported
    free = sum(not state.held for state in run.estimate.session.values())
    assert counts.get("calibration", 0) == free


def test_rows_are_the_whitened_residuals_of_the_factors(run, influence):
    """Half their squares is GTSAM's own error, sensor by sensor; only a loss separates the two."""
    for sensor in ("imu", "imu_bias", "prior"):
        half = 0.5 * sum(float((g.augmented[:, :, -1] ** 2).sum()) for g in influence.groups if g.sensor == sensor)
        errors = [factor.error(run.estimate.values) for tag, factor in run.estimate.factors if tag.sensor == sensor]
        assert half == pytest.approx(sum(errors), rel=1e-9), sensor


@pytest.mark.parametrize("place", [0, 10, -1])
def test_the_covariance_is_that_of_the_solution(run, influence, place):
    """Shares of all sources make up the variance, and shifts balance at the solution."""
    found = influence_of_keyframe(influence, range(len(influence.keyframes))[place])
    np.testing.assert_allclose(found.covariance, run.estimate.covariance[place], rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(found.share.sum(axis=0), 1.0, atol=1e-9)
    assert np.abs(found.shift.sum(axis=0)).max() < 0.01  # sigma: the solver's last step is as small


def test_a_fix_shifts_against_its_residual(run, influence):
    """The fix at a keyframe draws the place to where it lies: against predicted minus recorded."""
    last = len(influence.keyframes) - 1
    found, rows = influence_of_keyframe(influence, last), run.solution.residuals
    mine = rows.of("gnss") & (rows.t_ns == influence.keyframes.t_ns[last])
    shift = found.shift_at_keyframe[found.sources.index("gnss"), 3:6]
    assert (np.sign(shift) == -np.sign(rows.whitened[mine])).all()


def test_a_round_trip_is_exact(influence, tmp_path):
    influence.write(tmp_path)
    back = Influence.read(tmp_path)
    one, other = influence_of_keyframe(influence, 5), influence_of_keyframe(back, 5)
    assert one.sources == other.sources
    np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-12)
    for name in ("share", "at_keyframe", "without", "shift", "shift_at_keyframe", "own"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=1e-6, atol=1e-9, err_msg=name)
    assert back.keyframes.kind.tolist() == influence.keyframes.kind.tolist()


def test_tags_are_reported_by_their_builder():
    reported = [
        builder_of(tag)
        for tag in ("imu_bias", "gnss_velocity", "gnss_correlated_error", "static_turn", "rest", "prior")
    ]
    assert reported == ["imu", "gnss_velocity", "gnss", "static", "prior", "prior"]
