"""Verdict by control points that the solution did not see."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from sessions import on_control, recorded

from smartnav_graph.estimate.config import Config, RunConfig
from smartnav_graph.estimate.run import smooth

CONFIG = replace(Config(), run=RunConfig(withhold=("control:every=2",)))


@pytest.mark.parametrize(("wrong_m", "named"), [(0.0, False), (8.0, True)])
def test_a_withheld_control_point_that_is_wrong_is_named(wrong_m, named):
    session = recorded(seconds=60.0, white_m=0.3)
    points = on_control(session, slice(5, 50, 6), 0.05, seed=1)
    held = smooth(session.replace(control=points), CONFIG).withheld["control"].t_ns
    row = int(np.searchsorted(points.t_ns, held[1]))
    enu = session.nav_position(points)
    enu[row, 0] += wrong_m
    run = smooth(session.replace(control=replace(points, lla=session.frame.lla_from_nav(enu))), CONFIG)
    found = [one for one in run.summary["verdict"]["reasons"] if one["text"].startswith("withheld control point")]
    assert [f"point {points.point_id[row]} is" in one["text"] for one in found] == [True] * named


def test_a_withheld_control_point_without_height_is_compared_in_plan():
    session = recorded(seconds=60.0, white_m=0.3)
    points = on_control(session, slice(5, 50, 6), 0.05, seed=1)
    flat = session.nav_position(points).copy()
    flat[:, 2] = np.nan
    run = smooth(session.replace(control=replace(points, lla=None, enu=flat)), CONFIG)
    held = run.withheld["control"]
    assert np.isnan(held.error[:, 2]).all() and held.to_dict()["rms_3d_m"] < 1.0
    assert not [one for one in run.summary["verdict"]["reasons"] if one["text"].startswith("withheld control point")]
