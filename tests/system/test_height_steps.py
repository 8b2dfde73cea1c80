"""A step of the datum of heights moves heights alone: the horizontal result is that of the recording without it."""

from dataclasses import replace

import numpy as np
import pytest

import smartnav_graph as sn


def stepped(session, offset):
    """The session with heights moved by offset(share of the rows before)."""
    gnss = session.gnss
    position = session.nav_position(gnss)
    up = np.array([offset(share) for share in np.arange(len(gnss)) / len(gnss)])
    return session.replace(gnss=replace(gnss, lla=None, enu=position + np.outer(up, [0, 0, 1])))


def horizontal_sigma(run):
    return float(np.sqrt(np.median(np.trace(run.solution.covariance[:, 3:5, 3:5], axis1=1, axis2=2)) / 2))


def reasons(run):
    return [r for r in run.summary["verdict"]["reasons"] if "heights step" in r["text"]]


@pytest.mark.parametrize("causal", [False, True])
def test_47_m_from_half_way_on(causal):
    session = sn.load("gtsam-kitti")
    good = sn.run(session, end_s=120.0)
    run = sn.run(stepped(session, lambda share: 47.0 * (share > 0.13)), end_s=120.0, causal=causal)
    assert horizontal_sigma(run) < 0.1
    same = np.isin(run.solution.t_ns, good.solution.t_ns)
    away = run.solution.nav_t_body[same] - good.solution.nav_t_body[np.isin(good.solution.t_ns, run.solution.t_ns)]
    assert np.sqrt((away[:, :2] ** 2).sum(axis=1).mean()) < 0.1
    assert run.summary["verdict"]["level"] == "doubtful"
    (reason,) = reasons(run)
    assert reason["size"] == pytest.approx(47.0, abs=0.5)
    assert reason["end_s"] == pytest.approx(63.9, abs=0.1)
    if not causal:
        assert np.ptp(away[:, 2]) < 0.5  # one datum throughout
    assert not reasons(good)


def test_a_block_in_the_middle_has_a_state_of_its_own():
    session = sn.simulate("figure-eight-60s")
    good, run = sn.run(session), sn.run(stepped(session, lambda share: 60.0 * (0.35 < share < 0.65)))
    away = run.solution.nav_t_body - good.solution.nav_t_body
    assert np.abs(away[:, :2]).max() < 0.1
    assert len(reasons(run)) == 2 and not reasons(good)
    states = {name: state for name, state in run.summary["states"].items() if "height_offset" in name}
    found = {float(name.split("_")[3]) + state["value"]: state["sigma"] for name, state in states.items()}
    assert found
    for height, sigma in found.items():  # of the block, or of what is before and after it
        assert min(abs(abs(height) - 60.0), abs(height)) < 4.0 * sigma
