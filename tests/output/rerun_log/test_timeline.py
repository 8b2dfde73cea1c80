"""States on the time line, the log, the legend."""

from __future__ import annotations

import dataclasses

import numpy as np
from recordings import (
    OUTAGE,
    REJECTED_ROWS,
    make_session,
    make_solution,
    stamps,
    truth,
    write,
)

from smartnav_graph.core.timebase import NS, Gap
from smartnav_graph.graph.solution import Residuals
from smartnav_graph.output.rerun_log import events
from smartnav_graph.session.streams import ControlPoint


def test_legend_names_what_is_drawn_and_nothing_else(recording):
    legend = recording.rows("/legend", "TextDocument:text", static=True)[0][0]
    named = {line.split("]")[0][3:] for line in legend.splitlines() if line.startswith("* [")}
    assert named - {"/error/position"} < recording.paths  # its axes are below it
    drawn = {path for path in recording.paths if path.startswith("/world/")} - {"/world/gnss/current"}
    assert named == drawn | {"/error/position"}  # bands that an alignment may leave


def test_states_switch_at_gaps_outages_and_standstills(recording):
    component = "StateChange:state"
    assert recording.texts("/status/gnss", component) == ["fix", "outage", "fix"]
    times = recording.index("/status/gnss", component, "elapsed") / NS
    np.testing.assert_allclose(times, [0, OUTAGE[0] - 1, OUTAGE[1]])
    assert recording.texts("/status/imu", component) == ["recorded", "no samples", "recorded"]
    np.testing.assert_allclose(recording.index("/status/imu", component, "elapsed") / NS, [0, 24.98, 26.5])
    assert recording.texts("/status/motion", component) == ["standstill", "moving"]
    gate = recording.index("/status/gnss_gate", component, "elapsed") / NS
    assert gate[1] == make_session().seconds(make_session().gnss.t_ns)[REJECTED_ROWS[0]]


def test_log_tells_warnings_initialisation_gaps_and_rejections_in_order(recording):
    texts = recording.texts("/log", "TextLog:text")
    times = recording.index("/log", "TextLog:text", "elapsed")
    assert (np.diff(times) >= 0).all()
    assert "gnss: sigmas missing" in texts
    assert "initialisation: started while moving" in texts
    assert times[texts.index("IMU data gap: no samples for 1.52 s")] == 24_980_000_000
    assert times[texts.index("gnss: fix rejected at 7.00 s")] == 7 * NS
    assert times[texts.index("gnss: no fix used for 9.0 s")] == (OUTAGE[0] - 1) * NS


def test_fixes_without_residual_are_withheld_and_a_time_offset_does_not_confuse():
    solution = make_solution()
    session = make_session()
    kept = np.isin(solution.residuals.t_ns, session.gnss.t_ns[::2])
    shifted = {f.name: getattr(solution.residuals, f.name)[kept] for f in dataclasses.fields(Residuals)}
    shifted["t_ns"] = shifted["t_ns"] + 60_000_000  # the receiver's clock 0.06 s off
    use = events.fix_use(session.gnss, make_solution(residuals=Residuals(**shifted)))
    expected = np.where(np.arange(len(session.gnss)) % 2 == 0, events.USED, events.WITHHELD)
    expected[[row for row in REJECTED_ROWS if row % 2 == 0]] = events.REJECTED
    np.testing.assert_array_equal(use, expected)


def test_states_between_touching_spans():
    t, states = events.switches(0, [Gap(0, 5, "still"), Gap(10, 20, "a"), Gap(20, 30, "b")], "moving")
    assert list(zip(t.tolist(), states, strict=True)) == [
        (0, "still"),
        (5, "moving"),
        (10, "a"),
        (20, "b"),
        (30, "moving"),
    ]


def test_rejected_points_of_other_kinds_are_marked_too(tmp_path):
    control = ControlPoint(
        t_ns=stamps([5.0, 15.0, 25.0]), enu=truth(np.array([5.0, 15.0, 25.0])), point_id=np.array(["A", "B", "C"])
    )
    residuals = Residuals(
        t_ns=np.repeat(control.t_ns, 3),
        sensor=np.array(["control"] * 9, dtype=object),
        axis=np.tile([0, 1, 2], 3),
        whitened=np.ones(9),
        weight=np.ones(9),
        used=np.repeat([True, False, True], 3),
    )
    session = make_session(gnss=None, control=control)
    found = write(tmp_path / "run.rrd", session=session, solution=make_solution(residuals=residuals))
    assert found.texts("/status/control_gate", "StateChange:state") == ["accepted", "rejected", "accepted"]
    when = found.index("/status/control_gate", "StateChange:state", "elapsed") / NS
    assert when.tolist() == [0.0, 15.0, 25.0]
    drawn = found.values("/world/rejected", "Points3D:positions", static=True)[0]
    np.testing.assert_array_equal(drawn, control.enu[1:2].astype(np.float32))
    assert "control: fix rejected at 15.00 s" in found.texts("/log", "TextLog:text")


def test_the_verdict_is_shown_and_drawn_where_its_reasons_are(tmp_path):
    reason = {
        "level": "doubtful",
        "sensor": "gnss",
        "start_s": 10.0,
        "end_s": 20.0,
        "text": "fixes drift",
        "remedy": "",
    }
    verdict = {
        "level": "doubtful",
        "reasons": [reason, {"level": "doubtful", "sensor": "imu", "text": "without a time", "remedy": ""}],
    }
    found = write(tmp_path / "d.rrd", summary={"verdict": verdict})
    (text,) = found.rows("/verdict", "TextDocument:text", static=True)[0]
    assert text.startswith("**Verdict: doubtful**") and "fixes drift" in text and "without a time" in text
    assert found.texts("/status/verdict", "StateChange:state") == ["no objection", "gnss", "no objection"]
    assert "Verdict" in found.view_names()
    good = write(tmp_path / "g.rrd", summary={"verdict": {"level": "good", "reasons": []}})
    assert "/verdict" in good.paths and "/status/verdict" not in good.paths
