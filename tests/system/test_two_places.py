"""Half of all fixes far away: no motion explains both places, and every smoother says so."""

from dataclasses import replace

import numpy as np
import pytest

import smartnav_graph as sn
from smartnav_graph.smoothers.incremental import ReplayConfig


def two_places(kind, metres, axis):
    session = sn.simulate("figure-eight-60s")
    position = session.nav_position(session.gnss)
    rows = np.arange(len(position))
    there = {
        "half": np.random.default_rng(0).random(len(rows)) < 0.5,
        "every other": rows % 2 == 1,
        "blocks": rows // 12 % 2 == 1,
        "thirds": rows % 3 == 0,
    }[kind]
    away = np.outer(there * metres, np.eye(3)[axis])
    return session, session.replace(gnss=replace(session.gnss, lla=None, enu=position + away))


CASES = [("half", 1e6, 0), ("every other", 5e6, 1), ("blocks", 5e4, 0), ("thirds", 1e6, 1)]


@pytest.mark.parametrize("smoother", ["batch", "fixed-lag", "isam2"])
@pytest.mark.parametrize(("kind", "metres", "axis"), CASES)
def test_fixes_of_two_places_contradict_each_other(smoother, kind, metres, axis):
    _, faulty = two_places(kind, metres, axis)
    causal = smoother != "batch"
    config = sn.Config(replay=ReplayConfig(smoother=smoother)) if causal else sn.Config()
    run = sn.run(faulty, config, causal=causal)
    assert run.summary["verdict"]["level"] == "contradictory"
    reason = run.summary["verdict"]["reasons"][0]
    assert reason["sensor"] == "gnss" and reason["size"] == pytest.approx(metres, rel=0.01)
    assert run.summary["position_sigma_m"]["median"] < 2.0  # of one place
    assert set(run.summary["dropped"]["gnss"]) == {"out of reach of the others"}


def test_one_place_is_good():
    session, _ = two_places("half", 0.0, 0)
    assert sn.run(session).summary["verdict"]["level"] == "good"
