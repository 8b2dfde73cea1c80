"""Estimate -> solution: residuals, output rate, withheld rows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from exact import LEVER, record
from sessions import positions, recorded, turned_deg, with_gnss

import smartnav_graph as sn
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.timebase import NS
from smartnav_graph.estimate.config import Config, RunConfig
from smartnav_graph.estimate.result.assemble import Withheld, resample
from smartnav_graph.factors.gnss import GnssConfig
from smartnav_graph.graph.robust import huber_limit
from smartnav_graph.session.session import Mount


@pytest.fixture(scope="module")
def eight():
    return recorded()


@pytest.fixture(scope="module")
def run(eight):
    return sn.run(eight)


def test_withheld_figures():
    """Errors (3, 4, 0) and (0, 0, 12): horizontal sqrt(25 / 2), 3-D sqrt(169 / 2), largest 12."""
    rows = Withheld(np.array([0, 1]), np.array([[3.0, 4.0, 0.0], [0.0, 0.0, 12.0]]), np.ones((2, 3)))
    assert rows.to_dict() == {
        "count": 2,
        "rms_horizontal_m": pytest.approx(np.sqrt(12.5)),
        "rms_3d_m": pytest.approx(np.sqrt(84.5)),
        "max_m": 12.0,
    }


def test_withheld_rows_are_predicted_through_the_lever_arm():
    """Exact data: the antenna is where it was, to centimetres; a metre off for who forgets the arm."""
    session = record(fix_sigma=0.05).session.replace(control=None)
    held = sn.run(session, withhold=("gnss:every=2",)).summary["withheld"]["gnss"]
    assert held["count"] == 15 and held["max_m"] < 0.02
    bare = session.replace(sensors={"gnss": Mount()})
    wrong = sn.run(bare, withhold=("gnss:every=2",)).solution.nav_t_body
    right = sn.run(session, withhold=("gnss:every=2",)).solution.nav_t_body
    assert np.median(np.linalg.norm(wrong - right, axis=1)) > 0.5 * np.linalg.norm(LEVER)


@pytest.mark.parametrize("offset_s", [0.2, -0.2])
def test_withheld_rows_are_predicted_at_their_time_offset(offset_s):
    """Exact data: a stamp t of the receiver is IMU time t + offset. With the wrong sign of the offset the errors are
    the motion in 0.4 s, about half a metre."""
    session = record(fix_sigma=0.05).session.replace(control=None)
    shifted = replace(session.gnss, t_ns=session.gnss.t_ns - round(offset_s * NS))
    run = sn.run(session.replace(gnss=shifted), withhold=("gnss:every=2",))
    assert run.summary["states"]["gnss_time_offset_s"]["value"] == pytest.approx(offset_s, abs=0.02)  # s
    held = run.summary["withheld"]["gnss"]
    assert held["count"] >= 14 and held["max_m"] < 0.05


def test_withheld_rows_beyond_the_keyframes_are_not_scored(eight):
    run = sn.run(eight, withhold=("gnss:every=2",), end_s=30.0)
    assert run.summary["withheld"]["gnss"]["count"] == 15


def test_residuals_are_there_for_every_factor(run):
    residuals = run.solution.residuals
    counts = {sensor: int(residuals.of(sensor).sum()) for sensor in sorted(set(residuals.sensor))}
    assert counts == {"gnss": 3 * 60, "imu": 9 * 61, "imu_bias": 6 * 61, "static": 3 * 7, "static_turn": 6 * 6}
    assert np.isfinite(residuals.whitened).all() and residuals.used.all() and (residuals.weight == 1.0).all()


def test_fix_residuals_are_what_they_say(eight, run):
    """Smoothed minus recorded over sigma, row by row, at the instant the receiver's clock speaks of."""
    residuals, solution = run.solution.residuals, run.solution
    mine = residuals.of("gnss")
    fixes = eight.nav_position(eight.gnss)
    at = np.searchsorted(solution.t_ns, eight.gnss.t_ns)
    later = run.summary["states"]["gnss_time_offset_s"]["value"] * solution.nav_v_body[at]
    expected = (solution.nav_t_body[at] + later - fixes) / eight.gnss.sigma
    assert residuals.whitened[mine].reshape(-1, 3) == pytest.approx(expected, abs=3e-3)  # 0.06 s: a t^2 / 2
    assert residuals.axis[mine].reshape(-1, 3).tolist() == [[0, 1, 2]] * 60
    assert np.array_equal(residuals.t_ns[mine].reshape(-1, 3)[:, 0], eight.gnss.t_ns)


def test_an_outlier_is_rejected_and_its_residual_shown(eight):
    lla = eight.gnss.lla.copy()
    lla[30, 0] += 80.0 / 111_200.0  # 80 m north
    run = sn.run(with_gnss(eight, lla=lla))
    residuals = run.solution.residuals
    out = ~residuals.used
    assert run.summary["rejected"] == {"gnss": 1} and run.summary["used"] == {"gnss": 59}
    assert out.sum() == 3 and (residuals.weight[out] == 0.0).all()
    assert residuals.whitened[out][1] == pytest.approx(-80.0, abs=3.0)


def test_huber_weights_are_told(eight):
    lla = eight.gnss.lla.copy()
    lla[30, 0] += 80.0 / 111_200.0
    solution = sn.smooth(with_gnss(eight, lla=lla), Config(gnss=GnssConfig(loss="huber")))
    weight = solution.residuals.weight[solution.residuals.of("gnss")].reshape(-1, 3)
    assert weight[30] == pytest.approx(np.full(3, huber_limit(3) / 80.0), rel=0.05)
    assert weight.max() == 1.0


@pytest.mark.parametrize(("rate", "rows"), [("imu", 6000), ("10", 600), ("0.5", 30), ("keyframes", 62)])
def test_output_rates(eight, run, rate, rows):
    dense = sn.smooth(eight, rate=rate)
    assert len(dense) == rows
    assert np.isfinite(dense.covariance).all()
    common, at, own = np.intersect1d(dense.t_ns, run.solution.t_ns, return_indices=True)
    assert len(common) >= 30
    assert dense.nav_t_body[at] == pytest.approx(run.solution.nav_t_body[own], abs=1e-9)
    assert turned_deg(dense.nav_R_body[at], run.solution.nav_R_body[own]).max() < 1e-6


def test_between_keyframes_the_path_is_inertial_not_a_chord():
    """1 Hz fixes of an exact turn with 0.4 m sagitta: states at 100 Hz are true to centimetres."""
    recording = record(fix_sigma=0.05)
    dense = sn.smooth(recording.session.replace(control=None), rate="imu")
    exact = recording.truth(dense.t_ns)
    assert np.linalg.norm(dense.nav_t_body - exact.nav_t_body, axis=1).max() < 0.03  # m
    assert np.linalg.norm(dense.nav_v_body - exact.nav_v_body, axis=1).max() < 0.05  # m/s
    keyframes = sn.smooth(recording.session.replace(control=None))
    chord = np.stack([np.interp(dense.seconds, keyframes.seconds, x) for x in keyframes.nav_t_body.T], axis=-1)
    assert np.linalg.norm(chord - exact.nav_t_body, axis=1).max() > 0.1


def test_too_many_output_rows_are_refused(run):
    t_ns = run.solution.t_ns.copy()
    t_ns[-1] = t_ns[0] + 2001 * NS
    problem = replace(run.problem, config=Config(run=RunConfig(rate="1000")))
    with pytest.raises(SessionError, match=r"--rate: 2001000 output rows; expected at most 2 000 000"):
        resample(problem, replace(run.solution, t_ns=t_ns))


def test_a_solution_knows_where_it_is(eight, run):
    solution = run.solution
    assert (solution.t0_ns, solution.origin, solution.forward, solution.up) == (eight.t0_ns, eight.origin, "+y", "+z")
    assert np.linalg.norm(solution.nav_t_body[:60] - positions(eight, solution.t_ns[:60]), axis=1).max() < 3.0
