"""Rows that become known after the time they speak of: which window they reach, and what replay does with them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from sessions import on_control, positions, recorded, with_gnss, with_imu

import smartnav_graph as sn
from smartnav_graph.core.timebase import NS
from smartnav_graph.estimate.config import Config
from smartnav_graph.estimate.problem import batch_problem, prepare
from smartnav_graph.estimate.replay import replay
from smartnav_graph.factors.gnss import GnssConfig
from smartnav_graph.graph import delayed
from smartnav_graph.graph.keyframes import KeyframeConfig
from smartnav_graph.graph.windows import Window
from smartnav_graph.session.session import Session
from smartnav_graph.session.streams import GnssFix
from smartnav_graph.smoothers.incremental import ReplayConfig

EMPTY = np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3))


def windows(*ends_s: float) -> list[Window]:
    stamps = [round(t * NS) for t in ends_s]
    starts = [stamps[0], *stamps[:-1]]
    return [Window(k, t0, t1, "normal", *EMPTY) for k, (t0, t1) in enumerate(zip(starts, stamps, strict=True))]


def fixes(t_s: list[float], arrival_s: list[float]) -> GnssFix:
    t, known = (np.array([round(x * NS) for x in column]) for column in (t_s, arrival_s))
    return GnssFix(t_ns=t, arrival_ns=known, enu=np.zeros((len(t), 3)))


@pytest.mark.parametrize(
    ("t_s", "arrival_s", "arrives", "speaks"),
    [
        (1.2, 1.7, 2, 2),  # inside one window
        (1.2, 2.0, 2, 2),  # known just as it ends
        (1.2, 2.1, 3, 2),
        (1.0, 1.5, 2, 2),  # at a keyframe: the instant at the start of the next window
        (0.0, 3.9, 4, 1),
        (2.999, 3.001, 4, 3),
    ],
)
def test_a_row_reaches_the_window_in_which_it_arrives(t_s, arrival_s, arrives, speaks):
    found, lost = delayed.assign(windows(0, 1, 2, 3, 4), {"gnss": fixes([t_s], [arrival_s])}, 1000)
    assert [w.index for w in found if w.delayed] == [arrives] and not lost
    (row,) = found[arrives].delayed["gnss"]
    assert (row.row, row.t_ns, row.window.index) == (0, round(t_s * NS), speaks)
    assert row.window.t0_ns <= row.t_ns < row.window.t1_ns <= found[arrives].t1_ns


def test_late_rows_leave_the_keyframe_they_share_an_epoch_with():
    stream = fixes([1.0, 2.0], [1.0, 2.5])
    made = windows(0, 1, 2, 3)
    made = [replace(w, rows={"gnss": np.array([w.index - 1])} if w.index in (1, 2) else {}) for w in made]
    found, _ = delayed.assign(made, {"gnss": stream}, 1000)
    assert found[1].rows["gnss"].tolist() == [0] and not found[2].rows
    assert [row.row for row in found[3].delayed["gnss"]] == [1]


def test_rows_are_handed_over_as_they_arrive_and_lost_ones_counted():
    stream = fixes([0.1, 0.2, 0.3, 0.4], [1.9, 1.5, 9.0, 0.4])
    found, lost = delayed.assign(windows(0, 1, 2), {"gnss": stream}, 1000)
    assert [row.row for row in found[2].delayed["gnss"]] == [1, 0] and lost == {"gnss": 1}
    assert delayed.is_delayed(stream, 1000).tolist() == [True, True, True, False]


def test_nothing_late_changes_nothing():
    made = windows(0, 1, 2)
    found, lost = delayed.assign(made, {"gnss": replace(fixes([1.0], [1.0]), arrival_ns=None)}, 1000)
    assert all(one is other for one, other in zip(found, made, strict=True)) and lost == {}


def test_what_was_not_known_is_forgotten():
    made = [replace(w, rows={"gnss": np.array([w.index])}) for w in windows(0, 1, 2)]
    found = delayed.drop_unknown(made, {"gnss": fixes([0.0, 1.0, 2.0], [0.0, 2.5, 2.0])}, 2 * NS)
    assert [w.rows for w in found] == [{"gnss": [0]}, {}, {"gnss": [2]}]


# --- a whole replay ---------------------------------------------------------------------------------------------------


def with_delay(session: Session, seconds: float, rows: slice = slice(None)) -> Session:
    """The same fixes, known later."""
    arrival = np.array(session.gnss.t_ns)
    arrival[rows] += round(seconds * NS)
    return with_gnss(session, arrival_ns=arrival)


def with_points(seconds: float = 60.0) -> Session:
    """Fixes that are known at once, and control points between them that are known 2 s later."""
    session = recorded(seconds=seconds)
    points = on_control(session, slice(5, None, 7), 0.02, 1)
    return session.replace(control=replace(points, arrival_ns=points.t_ns + 2 * NS))


def config(smoother: str = "fixed-lag", **options) -> Config:
    return Config(replay=ReplayConfig(smoother=smoother, **options))


def test_no_keyframe_stands_where_nobody_knew_of_a_row():
    session = with_delay(recorded(), 1.3)
    options = replace(config(), keyframes=KeyframeConfig(max_spacing_s=1.5))
    causal, batch = prepare(session, options, causal=True), prepare(session, options)
    causal_ns, batch_ns = ([w.t1_ns for w in p.windows] for p in (causal, batch))
    known = session.gnss.arrival_ns[:-1]
    assert np.isin(session.gnss.t_ns, batch_ns).all() and np.isin(known, causal_ns).all()
    assert np.isin(session.gnss.t_ns, causal_ns).sum() <= 2  # the start, and a border of the rest
    assert sum(len(w.delayed.get("gnss", ())) for w in causal.windows) == len(known)
    assert causal.dropped == {"gnss": {"arrived after the end": 1}} and batch.dropped == {}
    again = batch_problem(causal)
    assert [(w.t1_ns, dict(w.rows)) for w in again.windows] == [(w.t1_ns, dict(w.rows)) for w in batch.windows]
    prompt = prepare(recorded(), options, causal=True)
    assert batch_problem(prompt) is prompt


@pytest.mark.parametrize("smoother", ["isam2", "fixed-lag"])
def test_a_late_row_moves_nothing_before_it_arrives(smoother):
    """Rows after 40 s are moved by 10 m: what was known before the first of them arrived is the same bits."""
    session = with_delay(recorded(), 1.3)
    moved = session.gnss.t_ns > session.t0_ns + 40 * NS
    changed = with_gnss(session, lla=session.gnss.lla + 1e-4 * moved[:, None])
    changed = with_imu(changed, accel=session.imu.accel + (session.imu.t_ns > session.t0_ns + 42 * NS)[:, None])
    one, other = (sn.run(s, config(smoother, polish=False), causal=True).causal for s in (session, changed))
    known = one.seconds <= 41.0 + 1.3
    known &= one.seconds <= 42.0
    assert known.sum() > 40
    for name in ("nav_t_body", "nav_R_body", "nav_v_body", "accel_bias", "gyro_bias", "covariance"):
        assert np.array_equal(getattr(one, name)[known], getattr(other, name)[known]), name
    assert np.linalg.norm(one.nav_t_body - other.nav_t_body, axis=1)[one.seconds > 43.0].min() > 0.1


def test_late_points_help_once_they_are_known():
    """Control points of 2 cm known 2 s late: the causal estimate is far better than with fixes of 1 m alone."""
    session = with_points()
    with_late = sn.run(session, config(polish=False), causal=True)
    without = sn.run(session.replace(control=None), config(polish=False), causal=True)
    errors = []
    for run in (with_late, without):
        off = run.causal.nav_t_body - positions(session, run.causal.t_ns)
        errors.append(np.sqrt((off[run.causal.seconds > 20.0] ** 2).sum(axis=1).mean()))
    assert errors[0] < 0.6 * errors[1], errors


def test_the_polish_uses_every_row_at_its_own_time():
    session = with_points()
    batch, run = sn.run(session), sn.run(session, config(), causal=True)
    assert np.array_equal(run.solution.t_ns, batch.solution.t_ns)
    # m; two ways to noise that is found to within a few per cent
    assert np.linalg.norm(run.solution.nav_t_body - batch.solution.nav_t_body, axis=1).max() < 5e-3
    known_at_once = session.replace(control=replace(session.control, arrival_ns=None))
    assert np.array_equal(batch.solution.nav_t_body, sn.run(known_at_once).solution.nav_t_body)


def test_rows_older_than_the_lag_are_counted_and_told():
    session = recorded()
    arrival = np.array(session.gnss.t_ns)
    arrival[[20, 30]] += 12 * NS
    late_ones = with_gnss(session, arrival_ns=arrival)
    run = sn.run(late_ones, config(polish=False), causal=True)
    assert run.summary["dropped"] == {"gnss": {"older than the lag": 2}}
    assert any("gnss: 2 rows older than the lag" in text for text in run.summary["warnings"])
    rows = run.solution.residuals
    mine = rows.of("gnss")
    assert len(set(rows.t_ns[mine].tolist())) >= len(session.gnss) - 2
    longer = sn.run(late_ones, config(polish=False, lag_s=15.0), causal=True)
    everything = sn.run(late_ones, config("isam2", polish=False), causal=True)
    assert longer.summary["dropped"] == everything.summary["dropped"] == {}


@pytest.mark.parametrize("seconds", [0.05, 0.5])
def test_a_replay_whose_fixes_are_all_late(seconds):
    """A latency throughout: a replay like any other, told how many fixes it used."""
    errors = []
    for session in (recorded(), with_delay(recorded(), seconds)):
        run = sn.run(session, config(polish=False), causal=True)
        off = run.causal.nav_t_body - positions(session, run.causal.t_ns)
        errors.append(np.sqrt((off[run.causal.seconds > 31.0, :2] ** 2).sum(axis=1).mean()))
    assert errors[1] < 1.4 * errors[0], errors
    assert run.summary["mode"] == "replay fixed-lag" and run.summary["used"]["gnss"] == len(session.gnss)
    assert run.solution.residuals.of("gnss").sum() == 3 * len(session.gnss)


def test_an_interrupted_replay_polishes_with_what_it_knew():
    def interrupted(stage: str, done: int, total: int) -> None:
        if stage == "replay" and done == 43:
            raise KeyboardInterrupt

    session = with_points()
    run = replay(session, config(), progress=interrupted)
    end = run.causal.t_ns[-1]
    used = run.summary["used"]["control"]
    assert used == int((session.control.arrival_ns <= end).sum()) < int((session.control.t_ns <= end).sum())


def test_without_a_loss_a_late_row_is_least_squares():
    session = with_points()
    options = replace(config(polish=False), gnss=GnssConfig(loss="none"))
    run = sn.run(session, options, causal=True)
    assert np.isfinite(run.causal.covariance).all()


@pytest.mark.parametrize("smoother", ["isam2", "fixed-lag"])
def test_a_gap_is_bridged_by_what_came_before(smoother):
    """Rougher motion after 42 s teaches batch to trust the bridge less; a replay was past it by then."""
    session = recorded()
    seconds = session.seconds(session.imu.t_ns)
    session = session.replace(imu=session.imu.take((seconds < 36.0) | (seconds > 37.5)))
    after = session.seconds(session.imu.t_ns) > 42.0
    shaking = 3.0 * np.random.default_rng(0).standard_normal(session.imu.accel.shape) * after[:, None]
    changed = with_imu(session, accel=session.imu.accel + shaking)
    one, other = (sn.run(s, config(smoother, polish=False), causal=True) for s in (session, changed))
    assert [gap["start_s"] for gap in one.summary["gaps"]] == [pytest.approx(36.0, abs=0.02)]
    known = one.causal.seconds <= 42.0
    assert np.array_equal(one.causal.nav_t_body[known], other.causal.nav_t_body[known])
    assert np.array_equal(one.causal.covariance[known], other.causal.covariance[known])
    whole, shaken = (prepare(s, Config(), causal=False).builders[0].bridges for s in (session, changed))
    rough, calm = ([bridge.over(1.5) for bridge in bridges.values()] for bridges in (shaken, whole))
    assert all((one.accel > 1.2 * other.accel).any() for one, other in zip(rough, calm, strict=True))
