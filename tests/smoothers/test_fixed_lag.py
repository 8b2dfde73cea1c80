"""The sliding window: session states, what marginalising keeps, rows that come too late."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from differences import largest_difference
from exact import record

from smartnav_graph.core.errors import SolverError
from smartnav_graph.core.timebase import NS
from smartnav_graph.estimate.config import Config
from smartnav_graph.estimate.passes import run_pass, solve_passes
from smartnav_graph.estimate.problem import prepare
from smartnav_graph.estimate.run import initialise
from smartnav_graph.factors.gnss import GnssConfig
from smartnav_graph.graph.pass_state import PassState
from smartnav_graph.graph.states import key, session_key
from smartnav_graph.graph.update import FactorBatch, build_update
from smartnav_graph.simulation import motions
from smartnav_graph.smoothers import fixed_lag, incremental
from smartnav_graph.smoothers.batch import Batch
from smartnav_graph.smoothers.incremental import ReplayConfig
from smartnav_graph.smoothers.minimise import SolveConfig

FINE = SolveConfig(max_iterations=100, tolerance=1e-14, step_tolerance=1e-9)
ALL = PassState(stage=1)
T, L = (session_key(letter, "gnss") for letter in "TL")
DELAY_S = 0.06


@pytest.fixture(scope="module")
def problem():
    """A minute of walking figure eights; the fixes' clock 60 ms off, their lever arm a state."""
    made = record(motions.figure_eight(60.0), seed=2, fix_sigma=0.05)
    gnss = made.session.gnss
    session = made.session.replace(gnss=replace(gnss, t_ns=gnss.t_ns - round(DELAY_S * NS)), control=None)
    return prepare(session, Config(gnss=GnssConfig(lever_arm_sigma=0.3)))


@pytest.fixture(scope="module")
def updates(problem):
    """Steps built once, at the batch solution: preintegration and delays depend on the state they are made at."""
    prior = initialise(problem, 30.0).prior.with_position()
    solved, _, _ = solve_passes(problem, problem.windows, prior, ALL)
    smoother = Batch(initial_values=solved.values, t0_ns=problem.session.t0_ns)
    run_pass(smoother, problem.windows, [prior, *problem.builders], ALL)
    for update in smoother.updates:
        update.refresh = None  # never again
    return smoother.updates


@pytest.fixture(scope="module")
def batch(problem, updates):
    smoother = Batch(solve=FINE, t0_ns=problem.session.t0_ns)
    for update in updates:
        smoother.update(update)
    return smoother.estimate()


def replayed(updates, watch=lambda smoother: None, **options):
    smoother = incremental(ReplayConfig("fixed-lag", **options), updates[0].t_ns)
    for update in updates:
        smoother.update(replace(update, blocks=list(update.blocks)))
        watch(smoother)
    return smoother


def test_a_lag_longer_than_the_recording_is_batch(updates, batch):
    """All states, clock offset and lever arm too, and every covariance."""
    smoother = replayed(updates, lag_s=1e3, relinearize=1e-9)
    estimate, now = smoother.estimate(), smoother.session_now()
    metres, degrees = largest_difference(estimate, batch)
    assert metres < 1e-5 and np.radians(degrees) < 1e-5
    assert np.abs(estimate.states()[2] - batch.states()[2]).max() < 1e-5  # m/s
    assert set(estimate.session) == {"gnss_time_offset_s", "gnss_lever_arm_correction_m"}
    for name, state in estimate.session.items():
        assert not state.held
        np.testing.assert_allclose(state.value, batch.session[name].value, atol=1e-5)
        np.testing.assert_allclose(state.covariance, batch.session[name].covariance, rtol=1e-3)
        scalars = [name] if len(state.value) == 1 else [f"{name}_{i}" for i in range(3)]
        np.testing.assert_allclose([now[s][0] for s in scalars], state.value, atol=1e-9)
        np.testing.assert_allclose([now[s][1] for s in scalars], batch.session[name].sigma, rtol=1e-3)
    np.testing.assert_allclose(estimate.covariance, batch.covariance, rtol=1e-3, atol=1e-9)


def test_isam2_with_session_states_converges_to_batch(updates, batch):
    smoother = incremental(ReplayConfig("isam2", relinearize=1e-7, hold=False), updates[0].t_ns)
    for update in updates:
        smoother.update(replace(update, blocks=list(update.blocks)))
    for _ in range(10):
        smoother._engine.update()  # nothing new: iSAM2 goes on relinearising
    estimate = smoother.estimate()
    metres, degrees = largest_difference(estimate, batch)
    assert metres < 1e-5 and np.radians(degrees) < 1e-5
    for name, state in estimate.session.items():
        np.testing.assert_allclose(state.value, batch.session[name].value, atol=1e-5)


def test_session_states_converge_behind_a_short_lag(updates, batch):
    """What has left the lag has left its mark: within a tenth of a sigma of batch, as sure as batch."""
    smoother = replayed(updates, lag_s=5.0)
    estimate = smoother.estimate()
    clock, full = estimate.session["gnss_time_offset_s"], batch.session["gnss_time_offset_s"]
    assert clock.value[0] == pytest.approx(DELAY_S, abs=4 * full.sigma[0]) and full.sigma[0] < 0.01
    for name, state in batch.session.items():
        found = estimate.session[name]
        assert (np.abs(found.value - state.value) < 0.15 * state.sigma).all(), name
    last = smoother.latest()
    assert np.linalg.norm(last.nav.position() - batch.states()[1][-1]) < 0.2 * np.sqrt(
        np.trace(batch.covariance[-1][3:6, 3:6])
    )
    sigma, expected = (np.sqrt(np.diag(c)) for c in (last.covariance, batch.covariance[-1]))
    np.testing.assert_allclose(sigma, expected, rtol=0.02)


def test_a_session_state_is_inserted_once_and_the_window_stays_small(updates):
    sizes, counts = [], []

    def watch(smoother) -> None:
        sizes.append(smoother._live.size())
        counts.append(len(smoother._factors) + len(smoother._blocks))

    smoother = replayed(updates, watch, lag_s=5.0)
    unary = Counter(
        f.keys()[0] for _, f in smoother._factors if isinstance(f, gtsam.PriorFactorVector) and f.keys()[0] in (T, L)
    )
    assert unary == {T: 1, L: 1}
    half = len(sizes) // 2
    assert max(sizes[half:]) <= max(sizes[10:half]) + 3 and max(counts[half:]) <= max(counts[10:half]) + 4
    assert smoother._left.size() == 3 * (len(updates) - len(smoother._inside))
    assert not smoother._left.exists(T) and smoother.values().exists(T)


def test_marginalising_keeps_the_latest_covariance(updates):
    """To first order nothing is lost: with and without a lag, linearised near the same point."""
    short, long = (replayed(updates[:25], lag_s=lag).latest() for lag in (4.0, 1e3))
    scale = np.sqrt(np.outer(np.diag(long.covariance), np.diag(long.covariance)))
    assert np.abs((short.covariance - long.covariance) / scale).max() < 0.03


def test_held_states_are_constants(problem, updates):
    held = {"gnss_time_offset_s": np.array([DELAY_S])}
    made = []
    for update in updates[:20]:
        copy = replace(update, blocks=list(update.blocks), session=dict(update.session), held={}, constants={})
        copy.hold(held)
        made.append(copy)
    estimate = replayed(made, lag_s=5.0).estimate()
    clock = estimate.session["gnss_time_offset_s"]
    assert clock.held and clock.value == DELAY_S and not estimate.values.exists(T)
    assert not estimate.session["gnss_lever_arm_correction_m"].held


class Level:
    """Height of a keyframe, m."""

    letters: tuple[str, ...] = ("X",)

    def linearize(self, states, data):
        (pose,) = states
        by_pose = np.concatenate([np.zeros((len(pose), 1, 3)), pose[:, None, 2, :3]], axis=2)
        return (pose[:, 2, 3:] - data) / 0.5, [by_pose / 0.5]


LEVEL = Level()


def test_rows_of_keyframes_that_have_left_are_counted_and_left_out(updates):
    """One block with rows of an old, an inner and the present keyframe: the old one alone is dropped."""
    smoother = replayed(updates[:30], lag_s=5.0)
    oldest, update = smoother._inside[0].index, updates[30]
    rows = FactorBatch(
        "level", LEVEL, [(key("X", i),) for i in (3, oldest + 3, 30)], np.zeros((3, 1)), 0, rows=(7, 8, 9)
    )
    smoother.update(replace(update, blocks=[*update.blocks, rows]))
    assert smoother.dropped == {"level": 1}
    kept = smoother.updates[-1].blocks[-1]
    assert kept.rows == (8, 9) and kept.data.shape == (2, 1)
    there = {(oldest_, block.rows) for oldest_, block in smoother._blocks if block.sensor == "level"}
    assert there == {(oldest + 3, (8,)), (30, (9,))}
    for following in updates[31:40]:
        smoother.update(replace(following, blocks=list(following.blocks)))
    assert [b.rows for _, b in smoother._blocks if b.sensor == "level"] == []


def test_isam2_holds_what_touches_every_update(updates):
    smoother = incremental(ReplayConfig("isam2"), updates[0].t_ns)
    for update in updates[:15]:
        smoother.update(
            replace(update, blocks=list(update.blocks), session=dict(update.session), held={}, constants={})
        )
    found = smoother.estimate().session
    assert all(state.held for state in found.values()) and found["gnss_time_offset_s"].value == 0.0


def test_a_step_that_is_no_number_names_its_state():
    delta = gtsam.VectorValues()
    delta.insert(key("X", 3), np.zeros(6))
    delta.insert(key("V", 4), np.array([0.0, np.nan, 0.0]))
    with pytest.raises(RuntimeError, match=r"Symbol: V4"):
        fixed_lag._check(delta, [key("X", 3), key("V", 4)])


def test_a_broken_measurement_is_told_with_its_time(updates):
    smoother = replayed(updates[:5])
    bad = FactorBatch("level", LEVEL, [(key("X", 5),)], np.full((1, 1), np.nan), 0)
    update = updates[5]
    with pytest.raises(SolverError, match=r"t = \d+\.\d\d s: .* not determined there \(keyframe \d, touched by"):
        smoother.update(replace(update, blocks=[*update.blocks, bad]))


def test_updates_are_built_on_what_is_known(problem):
    """End to end: the loop's own order of latest, build, update."""
    prior = initialise(problem, 30.0).prior.with_position()
    smoother = incremental(ReplayConfig("fixed-lag", lag_s=8.0), problem.session.t0_ns)
    for window in problem.windows[:20]:
        update = build_update(window, smoother.latest(), [prior, *problem.builders], ALL, problem.session.t0_ns)
        smoother.update(update)
        assert smoother.latest().index == window.index and np.isfinite(smoother.latest().covariance).all()
