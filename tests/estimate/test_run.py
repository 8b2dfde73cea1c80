"""The loop: passes, first state, outliers, progress, and the door to it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from sessions import positions, recorded, turned_deg, with_gnss

import smartnav_graph as sn
from smartnav_graph.core.errors import ConfigError
from smartnav_graph.estimate.config import Config, RunConfig
from smartnav_graph.estimate.passes import solve_passes
from smartnav_graph.estimate.problem import prepare
from smartnav_graph.estimate.replay import replay
from smartnav_graph.estimate.run import initialise, smooth
from smartnav_graph.graph.pass_state import PassState
from smartnav_graph.simulation.degrade import Degrade, degrade
from smartnav_graph.simulation.fixes import Outliers


@pytest.fixture(scope="module")
def eight():
    return recorded()


@pytest.fixture(scope="module")
def run(eight):
    return sn.run(eight)


def test_truth_is_within_the_sigmas(eight, run):
    inner = run.solution.t_ns[:60]
    off = run.solution.nav_t_body[:60] - positions(eight, inner)
    assert np.sqrt((off**2).mean()) < 0.6  # m; a fix has 1 m and 1.5 m
    assert np.mean((off / run.solution.sigmas[:60, 3:6]) ** 2) == pytest.approx(1.0, abs=0.7)


def test_the_same_session_gives_the_same_bits(eight, run):
    again = sn.run(eight)
    assert np.array_equal(again.solution.nav_t_body, run.solution.nav_t_body)
    assert np.array_equal(again.solution.covariance, run.solution.covariance)


def test_the_door_and_the_room_are_the_same(eight, run):
    inner = smooth(eight, Config())
    assert np.array_equal(inner.solution.nav_t_body, sn.smooth(eight).nav_t_body)
    assert inner.session.gnss is not None and inner.causal is None and not inner.withheld
    with pytest.raises(ConfigError, match="unknown option outages"):
        sn.smooth(eight, outages=3)


def without_origin(session):
    """The same in metric local positions."""
    local = with_gnss(session, lla=None, enu=session.nav_position(session.gnss))
    return local.replace(origin=None, gravity_m_s2=session.gravity, reference=None)


def test_a_shifted_world_is_the_same_world(eight, run):
    """The origin of the local frame is a choice: moved by 3 km, the solution moves with it."""
    shift = np.array([3000.0, -2000.0, 50.0])
    enu = eight.nav_position(eight.gnss)
    local = without_origin(eight)
    base, moved = (sn.smooth(with_gnss(local, enu=enu + s)) for s in (0.0 * shift, shift))
    assert moved.nav_t_body - base.nav_t_body == pytest.approx(np.tile(shift, (62, 1)), abs=1e-3)
    assert turned_deg(moved.nav_R_body, base.nav_R_body).max() < 1e-2


def test_a_turned_world_is_the_same_world(eight):
    """Everything turned by 90 deg about the vertical: headings turn with it, covariances too."""
    enu = eight.nav_position(eight.gnss)
    local = without_origin(eight)
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    base, turned = (sn.smooth(with_gnss(local, enu=rows)) for rows in (enu, enu @ turn.T))
    assert turned.nav_t_body == pytest.approx(base.nav_t_body @ turn.T, abs=1e-3)
    assert turned_deg(turned.nav_R_body, turn @ base.nav_R_body).max() < 1e-2
    assert turned.sigmas[:, [3, 4]] == pytest.approx(base.sigmas[:, [4, 3]], rel=1e-3)


def test_a_loss_that_loses_its_way_begins_again_from_least_squares():
    """A good fix looks wrong in the first minute; among outliers looked for stretch by stretch, the drive is lost."""
    session = sn.simulate("phone-car-5min", 26)
    run = sn.run(session)
    assert run.summary["converged"] and not any(run.summary["rejected"].values())
    at = np.searchsorted(session.reference.t_ns, run.solution.t_ns[[100, 200]])
    assert np.linalg.norm(run.solution.nav_t_body[[100, 200]] - session.reference.enu[at], axis=1).max() < 15.0


@pytest.mark.parametrize("kind", [pytest.param("isolated", marks=pytest.mark.slow), "burst"])
def test_outliers_end_at_the_solution_without_them(kind):
    """5 % of the fixes off by 50 to 200 m: least squares over the rest, as if they had not been there."""
    session = sn.simulate("phone-car-5min", 1)
    faulty = degrade(session, Degrade(outliers=Outliers(kind, 0.05, 50.0, 200.0)), 1)
    bad = faulty.gnss.extra["is_outlier"] == 1
    run = sn.run(faulty)
    best = sn.smooth(session.replace(gnss=session.gnss.take(~bad)))
    _, at, own = np.intersect1d(run.solution.t_ns, best.t_ns, return_indices=True)
    off = np.linalg.norm(run.solution.nav_t_body[at] - best.nav_t_body[own], axis=1)
    assert run.summary["rejected"]["gnss"] == pytest.approx(bad.sum(), abs=2)
    assert np.sqrt((off**2).mean()) < 1.0  # m


def test_passes_are_bounded_and_told(eight):
    assert sn.run(eight, passes=1).summary["passes"] == 1
    problem = prepare(eight, Config(run=RunConfig(passes=2)))
    initial = initialise(problem)
    _, pass_state, passes = solve_passes(problem, problem.windows, initial.prior, PassState())
    assert 1 <= passes <= 2 and isinstance(pass_state, PassState)


def test_the_first_state_may_look_at_thirty_seconds_only(eight):
    problem = prepare(eight, Config())
    assert initialise(problem, 10.0).stretch_s <= 10.0
    assert initialise(problem, 30.0).stretch_s <= 30.0


def test_progress_is_told(eight):
    seen = []
    smooth(eight, progress=lambda *row: seen.append(row))
    assert seen[:2] == [("preparing", 0, 0), ("finding the start", 0, 0)]
    assert seen[2:4] == [("pass 1 of at most 14", 0, 62), ("pass 1 of at most 14", 1, 62)]
    assert seen[-1][0].endswith("solving")
    seen.clear()
    replay(eight, progress=lambda *row: seen.append(row))
    assert seen[2:4] == [("replay", 0, 62), ("replay", 1, 62)] and seen[-1][0].endswith("solving")


def test_stages_add_up(run):
    timings = run.summary["timings_s"]
    assert timings["total"] > 0 and all(seconds >= 0 for seconds in timings.values())


def test_a_given_start_is_taken(eight, run):
    given = sn.run(eight, initial="0,0,0,0,3,10")
    assert given.summary["initialisation"]["method"] == "given"
    assert "position +- 3 m" in given.summary["initialisation"]["sentence"]
    assert np.linalg.norm(given.solution.nav_t_body - run.solution.nav_t_body, axis=1).max() < 1.0


def test_a_wrong_start_believed_firmly_costs(eight, run):
    """A start 30 m off with a sigma of 5 cm bends the first seconds, and the fixes there say so."""
    bent = sn.run(eight, initial="30,0,0,0,0.05,5")
    assert bent.summary["cost"] > run.summary["cost"] + 30.0
    off = np.linalg.norm(bent.solution.nav_t_body - run.solution.nav_t_body, axis=1)
    assert off[0] > 20.0 and off[-1] < 5.0  # m; the end suffers little


def test_noisier_fixes_are_held_less(eight):
    """The same errors with ten times the sigmas: the covariance grows, the chi-square falls."""
    loose = sn.run(with_gnss(eight, sigma=10.0 * eight.gnss.sigma))
    tight = sn.run(eight)
    assert loose.summary["position_sigma_m"]["median"] > 2 * tight.summary["position_sigma_m"]["median"]


def test_fixes_with_correlated_errors_get_a_state_and_a_larger_sigma():
    """Phone fixes: taken as white their covariance is several times too small."""
    session = sn.simulate("phone-car-5min", 0)
    correlated = sn.run(session)
    white = sn.run(session, replace(Config(), gnss=replace(Config().gnss, correlated=False)))
    assert correlated.summary["position_sigma_m"]["median"] > 2 * white.summary["position_sigma_m"]["median"]
