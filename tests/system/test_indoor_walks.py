"""The public indoor walks: waypoints kept back, beside a straight line between those kept (labels good to a metre)."""

from __future__ import annotations

import numpy as np
import pytest

import smartnav_graph as sn
from smartnav_graph.core.timebase import interpolate
from smartnav_graph.session.streams import ControlPoint
from smartnav_graph.simulation import motions
from smartnav_graph.simulation.scenarios import Scenario


@pytest.fixture(scope="module", params=["B1", "F2"])
def trace(request, dataset) -> sn.Session:
    (file,) = (dataset("indoor_waypoints_ms") / "site1" / request.param).glob("*.txt")
    return sn.load(file)


@pytest.mark.parametrize(("every", "share"), [(2, 0.8), (4, 0.45)])
def test_steps_and_inertial_data_beat_a_straight_line(trace, every, share):
    run = sn.run(trace, withhold=(f"control:every={every}",))
    kept = np.arange(len(trace.control)) % every == 0
    line = interpolate(trace.control.t_ns[~kept], trace.control.t_ns[kept], trace.control.enu[kept])
    other = np.linalg.norm((line - trace.control.enu[~kept])[:, :2], axis=1)
    held = run.summary["withheld"]["control"]
    assert held["count"] == (~kept).sum()
    assert held["rms_horizontal_m"] < share * np.sqrt((other**2).mean())
    step = run.summary["states"]["step_factor"]
    assert 0.35 < step["value"][0] < 0.5 and abs(step["value"][1]) < 0.15  # held flat in front of the body
    assert run.summary["initialisation"]["starts"] == 1


def test_a_walk_that_nobody_declared_is_reported():
    session = Scenario("walk", 40.0, motions.walk, "none", "galaxy-s2")(1)
    t_ns = session.imu.t_ns[[600, 1800, 3000]]
    place = interpolate(t_ns, session.reference.t_ns, session.reference.enu)
    points = ControlPoint(t_ns=t_ns, enu=place, point_id=np.array(["a", "b", "c"], dtype=object))
    summary = sn.run(session.replace(static=None, control=points)).summary
    assert [w for w in summary["warnings"] if w.startswith("steps: a walk (")] and summary["factors"]["steps"] > 20
