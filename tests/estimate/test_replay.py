"""Replay: the batch solution one window at a time, causal, and interruptible."""

from __future__ import annotations

import numpy as np
import pytest
from differences import largest_difference
from sessions import positions, recorded, shifted, turned_deg, with_gnss, with_imu

import smartnav_graph as sn
from smartnav_graph.core.timebase import NS
from smartnav_graph.estimate.config import Config
from smartnav_graph.estimate.problem import prepare
from smartnav_graph.estimate.replay import replay
from smartnav_graph.estimate.run import initialise
from smartnav_graph.graph.pass_state import PassState
from smartnav_graph.graph.update import build_update
from smartnav_graph.output.run_folder import read_run, write_run
from smartnav_graph.smoothers import incremental
from smartnav_graph.smoothers.batch import Batch
from smartnav_graph.smoothers.incremental import ReplayConfig
from smartnav_graph.smoothers.minimise import SolveConfig

SMOOTHERS = ("isam2", "fixed-lag")


def configured(smoother: str, **options) -> Config:
    return Config(replay=ReplayConfig(smoother=smoother, **options))


def build_updates(problem):
    """Updates of a problem, built once: preintegration depends on the bias it is made at."""
    initial = initialise(problem)
    maker = Batch(problem.config.batch, problem.config.solver, None, problem.session.t0_ns)
    for window in problem.windows:
        update = build_update(
            window, maker.latest(), [initial.prior, *problem.builders], PassState(), problem.session.t0_ns
        )
        update.refresh = None  # never again
        maker.update(update)
    return maker.updates


@pytest.mark.parametrize("seed", range(3))
def test_batch_and_converged_isam2_agree_on_the_same_updates(seed):
    problem = prepare(sn.simulate("figure-eight-60s", seed), Config())
    updates = build_updates(problem)
    batch = Batch(problem.config.batch, SolveConfig(200, 1e-15, 1e-10), None, problem.session.t0_ns)
    causal = incremental(ReplayConfig("isam2", relinearize=1e-7), problem.session.t0_ns)
    for update in updates:
        batch.update(update)
        causal.update(update)
    for _ in range(10):
        causal._engine.update()  # nothing new: iSAM2 goes on relinearising
    one, other = batch.estimate(), causal.estimate()
    metres, degrees = largest_difference(one, other)
    assert metres < 1e-5  # m
    assert np.radians(degrees) < 1e-5  # rad
    assert np.abs(one.states()[2] - other.states()[2]).max() < 1e-5  # m/s
    assert one.covariance == pytest.approx(other.covariance, rel=1e-3, abs=1e-9)


@pytest.mark.parametrize("smoother", SMOOTHERS)
def test_polish_gives_the_batch_solution(smoother):
    session = recorded()
    batch, run = sn.smooth(session), sn.run(session, configured(smoother), causal=True)
    assert np.linalg.norm(run.solution.nav_t_body - batch.nav_t_body, axis=1).max() < 1e-3  # m
    assert turned_deg(run.solution.nav_R_body, batch.nav_R_body).max() < 5e-3
    assert run.summary["mode"] == f"replay {smoother}" and run.summary["polish"]["passes"] >= 1


@pytest.mark.parametrize("smoother", SMOOTHERS)
def test_what_comes_later_changes_nothing_before(smoother):
    """Other data after 40 s, behind the 30 s of the initialisation: causal states up to 40 s are the same bits."""
    session, cut = recorded(), 40
    after_imu = session.imu.t_ns > session.t0_ns + cut * NS
    after_fix = session.gnss.t_ns > session.t0_ns + cut * NS
    changed = with_imu(session, accel=session.imu.accel + 1.0 * after_imu[:, None])
    changed = with_gnss(changed, lla=session.gnss.lla + 1e-4 * after_fix[:, None])
    config = configured(smoother, polish=False)
    one, other = (sn.run(s, config, causal=True) for s in (session, changed))
    assert one.summary["delay_s"] <= 30.0
    known = one.causal.seconds <= cut
    for name in ("nav_t_body", "nav_R_body", "nav_v_body", "accel_bias", "gyro_bias", "covariance"):
        before, now = getattr(one.causal, name), getattr(other.causal, name)
        assert np.array_equal(before[known], now[known]), name
    assert np.linalg.norm(one.causal.nav_t_body - other.causal.nav_t_body, axis=1)[~known].min() > 0.1


@pytest.mark.parametrize("smoother", SMOOTHERS)
def test_a_recording_cut_off_is_the_beginning_of_the_whole(smoother):
    session, config = recorded(), configured(smoother, polish=False)
    whole, part = (sn.replay(session, config, end_s=end) for end in (None, 45.0))
    assert part.seconds[-1] == 45.0 and len(part) >= 46
    assert np.array_equal(part.t_ns, whole.t_ns[: len(part)])
    assert np.array_equal(part.nav_t_body, whole.nav_t_body[: len(part)])
    assert np.array_equal(part.covariance, whole.covariance[: len(part)])


def test_the_causal_covariance_shrinks_where_fixes_come_and_holds_its_errors():
    session = recorded()
    causal = sn.replay(session, configured("fixed-lag"))
    off = causal.nav_t_body - positions(session, causal.t_ns)
    assert np.isfinite(causal.covariance).all()
    assert np.mean((off[10:] / causal.sigmas[10:, 3:6]) ** 2) == pytest.approx(1.0, abs=0.7)
    assert causal.sigmas[-1, 3:5].max() < 0.8  # m; one fix has 1 m


@pytest.mark.parametrize("smoother", SMOOTHERS)
def test_an_interrupt_leaves_a_valid_partial_run(smoother, tmp_path):
    def interrupted(stage: str, done: int, total: int) -> None:
        if stage == "replay" and done == 21:
            raise KeyboardInterrupt

    session = recorded()
    run = replay(session, configured(smoother), progress=interrupted)
    assert run.summary["mode"] == f"replay {smoother}, interrupted"
    assert len(run.causal) == len(run.solution) == run.summary["keyframes"] == 21
    assert 18.0 < run.solution.seconds[-1] <= 20.0 and np.isfinite(run.solution.covariance).all()
    write_run(run, tmp_path / "run")
    stored = read_run(tmp_path / "run")
    assert len(stored.solution) == 21 and "interrupted" in stored.summary["mode"]


def test_an_interrupt_before_there_is_anything_goes_through():
    def interrupted(stage: str, done: int, total: int) -> None:
        if stage == "replay" and done == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        replay(recorded(), configured("fixed-lag"), progress=interrupted)


def test_a_heading_open_for_long_does_not_lengthen_the_delay():
    """Batch looks at a minute of this recording for its start; a replay may look at 30 s."""
    session = recorded(white_m=5.0)
    assert sn.run(session).summary["initialisation"]["stretch_s"] > 45.0
    config = configured("fixed-lag", polish=False)
    whole, part = (sn.run(session, config, causal=True, end_s=end) for end in (None, 40.0))
    assert whole.summary["delay_s"] <= 30.0
    assert np.array_equal(part.causal.nav_t_body, whole.causal.nav_t_body[: len(part.causal)])


def test_latency_and_delay_are_told():
    run = sn.run(recorded(), configured("fixed-lag", polish=False), causal=True)
    update = run.summary["update_ms"]
    assert set(update) == {"median", "p99", "max"} and 0 < update["median"] <= update["p99"] <= update["max"]
    assert run.summary["delay_s"] == 30.0
    assert "polish" not in run.summary
    assert not any("chi-square" in text for text in run.summary["warnings"])  # states never solved together


@pytest.mark.parametrize("smoother", SMOOTHERS)
@pytest.mark.parametrize("late_s", [0.5037, 12.0])
def test_the_first_fix_may_come_late(smoother, late_s):
    """A phone's inertial samples start before its receiver does: until then the position is open, and said to be."""
    session = recorded()
    first = session.gnss.t_ns >= session.t0_ns + late_s * NS
    late = shifted(session, late_s) if late_s < 1.0 else session.replace(gnss=session.gnss.take(first))
    run = sn.run(late, configured(smoother), causal=True)
    before = run.causal.seconds < min(late_s, 12.0)
    assert before.any() and run.causal.sigmas[before, 3].min() > 1e4
    assert run.causal.sigmas[~before, 3].max() < 1.1
    assert np.linalg.norm(run.solution.nav_t_body - sn.smooth(late).nav_t_body, axis=1).max() < 1e-3


def test_gross_outliers_do_not_turn_a_replay_over():
    session = recorded()
    lla = session.gnss.lla.copy()
    lla[[35, 36, 50], 1] += 100.0 / 68_600.0  # 100 m east
    causal = sn.replay(with_gnss(session, lla=lla), configured("fixed-lag"))
    off = causal.nav_t_body - positions(session, causal.t_ns)
    assert np.linalg.norm(off[31:, :2], axis=1).max() < 5.0  # m
