"""What a run remembers of itself agrees with its solution and its summary."""

from __future__ import annotations

from collections import Counter
from types import SimpleNamespace

import gtsam
import numpy as np
import pytest
from exact import record

from smartnav_graph.core.timebase import NS
from smartnav_graph.estimate.config import Config
from smartnav_graph.estimate.replay import replay
from smartnav_graph.estimate.result import diagnostics
from smartnav_graph.estimate.run import smooth
from smartnav_graph.graph.robust import robust
from smartnav_graph.graph.states import STATES, key
from smartnav_graph.graph.update import FactorBatch, FactorId, GraphUpdate
from smartnav_graph.simulation import motions
from smartnav_graph.smoothers.incremental import ReplayConfig


@pytest.fixture(scope="module")
def session():
    """Forty seconds of walking figure eights with fixes, whose clock is a state."""
    return record(motions.figure_eight(40.0), seed=4, fix_sigma=0.05).session.replace(control=None)


@pytest.fixture(scope="module")
def replayed(session):
    return replay(session, Config(replay=ReplayConfig(lag_s=5.0, polish=False)))


def test_wiring_has_every_factor_in_use_with_the_states_it_touches(session):
    run = smooth(session, Config())
    layout = run.diagnostics.layout
    assert Counter(layout.sensor.tolist()) == run.summary["factors"]
    assert set(layout.letter) <= set(STATES)
    imu = np.flatnonzero(layout.sensor == "imu")
    for place, factor in ((1, imu[0]), (7, imu[6])):
        touched = layout.factor == factor
        got = sorted(zip(layout.letter[touched].tolist(), layout.index[touched].tolist(), strict=True))
        assert set(got) >= {(letter, i) for letter in "XV" for i in (place - 1, place)}
    assert run.diagnostics.updates is None and run.diagnostics.pairs is None
    np.testing.assert_array_equal(run.diagnostics.keyframe_ns, run.solution.t_ns)


def test_updates_are_one_a_keyframe_and_end_at_the_causal_states(replayed):
    updates, causal = replayed.diagnostics.updates, replayed.causal
    np.testing.assert_array_equal(updates.t_ns, causal.t_ns)
    last = updates.edge[1:] - 1  # the newest keyframe of each window is the causal estimate itself
    np.testing.assert_array_equal(updates.past_ns[last], causal.t_ns)
    np.testing.assert_allclose(updates.past[last], causal.nav_t_body, atol=1e-12)


def test_windows_are_as_long_as_the_lag_and_what_they_tell_last_is_the_solution(replayed):
    updates = replayed.diagnostics.updates
    length = (updates.past_ns[updates.edge[1:] - 1] - updates.past_ns[updates.edge[:-1]]) / NS
    assert length.max() <= 5.0 + 1e-9
    assert length[-1] > 4.0
    final = slice(updates.edge[-2], updates.edge[-1])
    rows = np.isin(replayed.solution.t_ns, updates.past_ns[final])
    np.testing.assert_allclose(replayed.solution.nav_t_body[rows], updates.past[final], atol=1e-9)


def test_correction_is_the_largest_move_of_what_two_windows_share(replayed):
    updates = replayed.diagnostics.updates
    k = 20
    before, now = (
        dict(zip(updates.past_ns[a:b].tolist(), updates.past[a:b], strict=True))
        for a, b in zip(updates.edge[k - 1 : k + 1], updates.edge[k : k + 2], strict=True)
    )
    moves = [np.linalg.norm(now[t] - before[t]) for t in now.keys() & before.keys()]
    assert updates.corrected[k] == pytest.approx(max(moves))
    assert updates.corrected[k] > 0


def test_clock_offset_is_followed_from_its_prior_to_what_is_found(replayed):
    found = replayed.diagnostics.updates.states["gnss_time_offset_s"]
    stated = replayed.summary["states"]["gnss_time_offset_s"]
    assert found[-1, 0] == pytest.approx(stated["value"], abs=1e-6)
    # two ways to the covariance: the window's tail, and the recursion over the graph of all keyframes
    assert found[-1, 1] == pytest.approx(stated["sigma"], rel=0.2)
    assert np.nanmax(found[:, 1]) == pytest.approx(0.2, rel=0.01)  # the prior's
    assert found[-1, 1] < 0.05


def test_isam2_tells_its_effort_and_a_window_too(session):
    config = Config(replay=ReplayConfig(smoother="isam2", lag_s=5.0, polish=False))
    updates = replay(session, config).diagnostics.updates
    assert updates.solved[5:].min() > 0
    assert updates.states == {}  # held there
    assert np.diff(updates.edge).max() < 40


def test_rows_that_are_let_go_of_are_counted():
    unit = gtsam.noiseModel.Unit.Create(3)

    def fix(model):
        return FactorId("gnss", 0, 0), gtsam.GPSFactor(key("X", 0), np.zeros(3), model)

    def block(loss, used):
        return FactorBatch(
            "gnss", None, [(key("X", 0),)] * len(used), np.zeros((len(used), 9)), 0, used=used, loss=loss
        )

    update = GraphUpdate(0, 0, 0.0)
    update.factors = [fix(unit), fix(robust(unit, "cauchy")), fix(robust(unit, "huber"))]
    update.blocks = [block("cauchy", (True,)), block("none", (True, False)), block("huber", (True,))]
    assert diagnostics.doubted_rows(update) == 3


def test_stamps_lie_in_the_window_that_ends_at_their_keyframe():
    keyframes = np.array([10, 20, 30])
    assert diagnostics.window_of(np.array([0, 10, 11, 20, 29, 31]), keyframes).tolist() == [0, 0, 1, 1, 2, 2]


def test_no_update_is_told_that_was_not_taken_in_whole():
    smoother = SimpleNamespace(
        recent=lambda: (np.array([5]), np.zeros((1, 3))), effort=SimpleNamespace(solved=3, relinearised=0)
    )
    smoother.session_now, smoother.latest = dict, lambda: SimpleNamespace(t_ns=5)
    log, step = diagnostics.UpdateLog(smoother), GraphUpdate(0, 5, 0.0)
    log.take(step, 0.001)
    smoother.session_now = lambda: (_ for _ in ()).throw(KeyboardInterrupt)
    with pytest.raises(KeyboardInterrupt):
        log.take(step, 0.001)
    assert len(log.updates().t_ns) == 1
