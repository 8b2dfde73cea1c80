"""Session and config -> windows, builders, and what was left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from sessions import on_control, recorded, shifted, with_gnss

from smartnav_graph.core.errors import ConfigError, SessionError
from smartnav_graph.core.timebase import NS
from smartnav_graph.estimate.config import Config, RunConfig
from smartnav_graph.estimate.preparation import PREPARE, Notes
from smartnav_graph.estimate.problem import prepare
from smartnav_graph.session.detect.standstills import StandstillConfig
from smartnav_graph.session.streams import Temperature
from smartnav_graph.simulation.degrade import Degrade, degrade


@pytest.fixture(scope="module")
def eight():
    return recorded()


def run(**options) -> Config:
    return Config(run=RunConfig(**options))


def test_a_keyframe_at_every_fix_and_at_the_end(eight):
    problem = prepare(eight, Config())
    times = np.array([window.t1_ns for window in problem.windows])
    # and where the rest at the start ends
    (_, moves), *_ = problem.rests.spans()
    assert np.array_equal(times[:-1], np.union1d(eight.gnss.t_ns, [moves])) and times[-1] == eight.imu.t_ns[-1]
    assert [window.index for window in problem.windows] == list(range(62))
    assert [window.kind for window in problem.windows[:8]] == ["first", *["static"] * 6, "normal"]
    assert problem.windows[0].kind == "first" and problem.windows[0].rows["gnss"].tolist() == [0]
    assert [builder.name for builder in problem.builders] == ["imu", "gnss", "static"]
    assert not problem.dropped and not problem.gaps and problem.vehicle == "none"


def test_windows_hold_all_inertial_time(eight):
    problem = prepare(eight, Config())
    for window in problem.windows[1:]:
        assert window.dt.sum() == pytest.approx(window.length_s, abs=1e-9)


def test_sensors_are_chosen_by_name(eight):
    both = eight.replace(control=on_control(eight, slice(0, None, 10), 0.02, 0))
    for chosen, names in ((("control",), ["imu", "control", "static"]), (("-gnss",), None), ((), None)):
        builders = [builder.name for builder in prepare(both, run(sensors=chosen)).builders]
        assert builders == (names or ["imu", *(["gnss"] if not chosen else []), "control", "static"])


def test_an_unknown_sensor_is_refused(eight):
    with pytest.raises(ConfigError, match=r"--sensors: camera, gps not in this session; expected some of imu, gnss"):
        prepare(eight, run(sensors=("gps", "-camera")))


def test_the_inertial_stream_always_stays(eight):
    assert prepare(eight, run(sensors=("-imu",))).session.imu is not None


def test_stretch(eight):
    problem = prepare(eight, run(start_s=10.25, end_s=20.75))
    first, last = problem.windows[0].t1_ns, problem.windows[-1].t1_ns
    assert (first - eight.t0_ns, last - eight.t0_ns) == (10.25 * NS, 20.75 * NS)
    assert len(problem.session.gnss) == 10 and problem.session.t0_ns == eight.t0_ns  # time zero stays
    assert not problem.dropped


def test_rows_outside_are_dropped_and_counted(eight):
    problem = prepare(shifted(eight, 30.0), Config())
    assert problem.dropped == {"gnss": {"outside the inertial span": 30}}
    assert "gnss: 30 rows outside the inertial span; not used as recorded" in problem.warnings


def test_one_stream_outside_beside_a_good_one(eight):
    lost = with_gnss(eight, t_ns=eight.gnss.t_ns + 3600 * NS)
    lost = lost.replace(control=on_control(eight, slice(0, None, 10), 0.02, 0))
    with pytest.raises(SessionError, match="gnss: all 60 rows lie outside the inertial span"):
        prepare(lost, Config())


def test_leading_and_trailing_dead_reckoning_is_cut_and_told(eight):
    middle = eight.replace(gnss=eight.gnss.take(slice(25, 35)))
    config = Config(keyframes=replace(Config().keyframes, lead_s=5.0))
    problem = prepare(middle, config)
    assert (problem.windows[0].t1_ns - eight.t0_ns, problem.windows[-1].t1_ns - eight.t0_ns) == (20 * NS, 39 * NS)
    assert any("smoothed from 20.0 to 39.0 s only, 5 s around" in text for text in problem.warnings)
    assert len(prepare(middle, Config()).windows) == 62  # 60 s of lead reach everywhere


def test_gaps_become_windows_of_their_kind(eight):
    problem = prepare(degrade(eight, Degrade(drop_imu=((30.4, 1.5),)), 0), Config())
    (gap,) = problem.gaps
    inside = [w for w in problem.windows if w.t0_ns >= gap.start_ns and w.t1_ns <= gap.end_ns and w.index]
    assert {w.kind for w in inside} == {"gap"} and len(inside) == 4  # one fix within, half a second at most
    assert sum(w.kind == "gap" for w in problem.windows) == len(inside)
    assert inside[0].t0_ns == gap.start_ns and inside[-1].t1_ns == gap.end_ns


def test_gaps_outside_the_stretch_are_not_told_as_gaps(eight):
    holed = degrade(eight, Degrade(drop_imu=((30.4, 1.5),)), 0)
    assert not prepare(holed, run(end_s=20.0)).gaps


def test_streams_without_a_factor_are_told(eight):
    initial_values = Temperature(t_ns=eight.imu.t_ns[:2], temperature_c=[20.0, 20.5])
    warnings = prepare(eight.replace(temperature=initial_values), Config()).warnings
    assert "temperature: present, not used by the estimator" in warnings


def test_withheld_rows_are_kept_apart(eight):
    problem = prepare(eight, run(withhold=("gnss:every=4",)))
    assert len(problem.session.gnss) == 15 and len(problem.withheld["gnss"]) == 45
    assert len(problem.windows) == 62  # keyframes no further apart than a second


def test_without_inertial_data(eight):
    assert prepare(eight.replace(imu=None), Config()).positions_only
    with pytest.raises(SessionError, match="imu"):
        prepare(eight.replace(imu=None, gnss=None), Config())


def test_each_step_of_the_preparation_stands_alone(eight):
    notes = Notes(Config(run=RunConfig(start_s=5.0, end_s=20.0)))
    session = PREPARE["span"](eight, notes)
    assert session is eight and np.diff(notes.span) == 15 * NS
    session = PREPARE["outside"](session, notes)
    assert (session.gnss.t_ns >= notes.span[0]).all() and (session.gnss.t_ns <= notes.span[1]).all()
    assert not notes.dropped  # rows outside --from and --to are no loss
    notes.drop("older", {"gnss": 2})
    notes.drop("later", {"gnss": 1})
    assert notes.dropped == {"gnss": {"older": 2, "later": 1}}


def test_the_mounting_that_a_session_declares_is_used(eight):
    declared = eight.replace(device=replace(eight.device, vehicle="foot", mounting="foot"))
    assert prepare(declared, Config()).rests.on_foot
    options = Config(standstill=StandstillConfig(mounting="body"))
    assert not prepare(declared, options).rests.on_foot  # what the user says comes first
    assert not prepare(eight, Config()).rests.on_foot
    with pytest.raises(SessionError, match=r"mounting = 'shoe'; expected one of auto, foot, body"):
        replace(eight.device, mounting="shoe")
