"""Tracks as points in space in whole runs: they follow on image pairs, are tested, and report it."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from test_coplanarity import errors

from smartnav_graph.estimate import config
from smartnav_graph.estimate.passes import solve_passes
from smartnav_graph.estimate.problem import prepare
from smartnav_graph.estimate.replay import replay
from smartnav_graph.estimate.reweight.track_outliers import check_tracks
from smartnav_graph.estimate.run import initialise, smooth
from smartnav_graph.factors.smart import IN_USE, REASONS
from smartnav_graph.graph.states import KEYFRAME_LETTERS, key
from smartnav_graph.simulation.scenarios import SCENARIOS, simulate
from smartnav_graph.smoothers.whole_graph import WholeGraph


def options(**sections):
    return config.from_dict({"smart": {"enabled": True}, **sections}, "test")


@pytest.fixture(scope="module")
def room():
    return simulate("room-30s", 0)


@pytest.fixture(scope="module")
def run(room):
    return smooth(room, options())


def test_tracks_hold_at_least_what_pairs_hold(room, run):
    metres, degrees = errors(run.solution, room.reference)
    pairs = errors(smooth(room, config.from_dict({}, "test")).solution, room.reference)
    assert metres < 0.05 and degrees < 0.5
    assert metres < 1.1 * pairs[0]  # 0.020 beside 0.030 m


def test_the_covariance_is_consistent(room, run):
    rows = np.isin(room.reference.t_ns, run.solution.t_ns)
    at = np.searchsorted(run.solution.t_ns, room.reference.t_ns[rows])
    error = run.solution.nav_t_body[at] - room.reference.enu[rows]
    P = run.solution.covariance[at][:, 3:6, 3:6]
    assert 0.1 < np.einsum("ni,nij,nj->n", error, np.linalg.inv(P), error).mean() / 3 < 3.0


def test_the_account_is_complete(run):
    summary = run.summary
    builder = next(b for b in run.problem.builders if b.name == "smart")
    assert sum(summary["tracks"].values()) == len(builder.sightings)
    assert summary["factors"]["smart"] == summary["tracks"][REASONS[IN_USE]] > 300
    assert "image_pairs" not in summary["factors"] and "image_pairs" not in summary
    assert summary["chi2_per_dof"]["smart"] == pytest.approx(1.0, abs=0.1)
    assert 0.7 < summary["chi2_per_dof"]["overall"] < 1.3
    residuals = run.solution.residuals
    inside = residuals.of("smart")
    selection = builder.selection(run.pass_state)
    count = selection.use[selection.verdict == IN_USE].sum()
    assert (inside & residuals.used).sum() == 2 * count
    assert summary["rejected"]["tracks"] == (inside & ~residuals.used).sum() // 2


def test_what_the_pairs_found_of_the_camera_is_held(run):
    states = run.summary["states"]
    assert states["images_time_offset_s"]["held"] and states["camera_boresight_rad"]["held"]
    assert states["images_time_offset_s"]["value"] == pytest.approx(0.0, abs=0.002)


def test_wrong_observations_are_left_out():
    room = SCENARIOS["room-30s"]
    faults = replace(room.camera.faults, outliers=(0.1, 0.2), glitches=((12.0, 17.0),))
    session = replace(room, camera=replace(room.camera, faults=faults))(0)
    found = smooth(session, options())
    metres, degrees = errors(found.solution, session.reference)
    assert metres < 0.06 and degrees < 0.5
    assert found.summary["rejected"]["tracks"] > 300


@pytest.mark.slow
def test_a_camera_that_is_late_and_reads_row_by_row():
    """Clock 15 ms and boresight off by half a degree, 30 ms of readout: taken off every observation at its point."""
    room = SCENARIOS["room-30s"]
    camera = replace(room.camera.camera, readout_s=0.03)
    session = replace(room, camera=replace(room.camera, camera=camera, clock_s=0.015, boresight_deg=(0.3, -0.3, 0.2)))(
        0
    )
    assert errors(smooth(session, options()).solution, session.reference)[0] < 0.06


def test_tracks_of_something_else_are_refused(room):
    rng = np.random.default_rng(0)
    noise = room.replace(tracks=replace(room.tracks, xy_n=rng.uniform(-0.5, 0.5, room.tracks.xy_n.shape), xy_px=None))
    found = smooth(noise, options())
    alone = smooth(room, config.from_dict({"image_pairs": {"enabled": False}}, "test"))
    assert any("smart: tracks are refused as the image pairs are" in text for text in found.summary["warnings"])
    assert errors(found.solution, room.reference)[0] <= 1.1 * errors(alone.solution, room.reference)[0]


def test_without_pairs_tracks_are_tested_by_the_other_sensors_alone(room):
    """Half a minute of a phone's accelerometer is too poor: refused, and reported."""
    found = smooth(room, options(image_pairs={"enabled": False}))
    assert any("smart: refused, only" in text for text in found.summary["warnings"])
    assert "smart" not in found.summary["factors"] and found.summary["rejected"].get("smart") is None


def test_a_replay_has_pairs_and_its_polish_tracks(room, run):
    replayed = replay(room, options())
    assert "smart" in replayed.summary["factors"]
    # images refute a standstill sooner or later, and with it goes a keyframe
    common, one, other = np.intersect1d(replayed.solution.t_ns, run.solution.t_ns, return_indices=True)
    assert len(common) > 0.98 * len(run.solution.t_ns)
    np.testing.assert_allclose(replayed.solution.nav_t_body[one], run.solution.nav_t_body[other], atol=0.01)  # m
    pairs = replay(room, config.from_dict({"replay": {"polish": False}}, "test"))
    np.testing.assert_allclose(replayed.causal.nav_t_body, pairs.causal.nav_t_body, atol=1e-9)


@pytest.mark.slow
def test_images_that_share_a_keyframe_count_once(room):
    """Tracks of a second image 50 us after each: one pose has one observation of a track."""
    tracks = room.tracks
    both = np.argsort(np.concatenate([tracks.t_ns, tracks.t_ns + 50_000]), kind="stable")
    twice = {name: np.concatenate([column, column])[both] for name, column in tracks.columns().items()}
    twice["t_ns"] = np.concatenate([tracks.t_ns, tracks.t_ns + 50_000])[both]
    doubled = room.replace(tracks=type(tracks).from_columns(twice))
    found = smooth(doubled, options(image_pairs={"rate_hz": 1e6, "spans": [2, 8]}, run={"end_s": 9.0}))
    assert found.summary["factors"]["smart"] > 50
    builder = next(b for b in found.problem.builders if b.name == "smart")
    selection = builder.selection(found.pass_state)
    used = selection.use & (selection.verdict == IN_USE)[:, None]
    assert (builder.sightings.image[used] % 2 == 0).all()


@pytest.fixture(scope="module")
def solved(room):
    """The first seconds: problem, estimate and memory with tracks in force."""
    problem = prepare(room, options(run={"end_s": 9.0}))
    initial = initialise(problem)
    estimate, pass_state, _ = solve_passes(
        problem, problem.windows, initial.prior, initial.pass_state, initial_values=initial.initial_values
    )
    assert pass_state.outlier_tests["smart"] == 2
    return problem, estimate, pass_state


def test_tracks_that_turn_out_wrong_give_way_to_pairs(solved):
    problem, estimate, pass_state = solved
    builder = replace(next(b for b in problem.builders if b.name == "smart"))
    pairs = next(b for b in problem.builders if b.name == "image_pairs")
    assert pairs.replaced(pass_state) and "images_time_offset_s" in pass_state.fixed_states
    xy = np.random.default_rng(0).uniform(-0.5, 0.5, builder.sightings.xy.shape)
    builder.sightings = replace(builder.sightings, xy=xy)
    first = replace(pass_state, outlier_tests={**pass_state.outlier_tests, "smart": 1})
    again = check_tracks([builder, pairs], estimate, first)
    assert not pairs.replaced(again) and not builder.in_force(again)
    assert "images_time_offset_s" not in again.fixed_states and "camera_boresight_rad" not in again.fixed_states
    assert "too poor to test them by" in builder.selection(again).refused
    assert check_tracks([builder, pairs], estimate, again) is again


def test_marginals_are_those_of_the_whole_system(solved):
    """The recursion over the Bayes net, whose keyframes are tied over many, beside a dense inverse."""
    _, estimate, _ = solved
    held = {state.key: state.value for state in estimate.session.values() if state.held}
    linear = WholeGraph([factor for _, factor in estimate.factors], estimate.blocks, held).linearize(estimate.values)
    order = gtsam.Ordering()
    for index in estimate.indices:
        for letter in KEYFRAME_LETTERS:
            order.push_back(key(letter, index))
    dense = np.linalg.inv(linear.hessian(order)[0])
    for k in range(0, len(estimate.indices), 5):
        block = dense[15 * k : 15 * k + 15, 15 * k : 15 * k + 15]
        np.testing.assert_allclose(estimate.marginals.joint[k], block, rtol=1e-3, atol=1e-7)
