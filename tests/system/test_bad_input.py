"""Bad and poor recordings, from the session to the run: a clear error, or a result that reports what it is based on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from exact import LEVER, record
from sessions import on_control, recorded, shifted, truth, turned_deg, with_gnss, with_imu

import smartnav_graph as sn
from smartnav_graph.core.errors import ConfigError, SessionError, SolverError
from smartnav_graph.estimate.config import Config
from smartnav_graph.session import folder as session_folder
from smartnav_graph.session.health import inspect
from smartnav_graph.session.session import Mount
from smartnav_graph.simulation import motions
from smartnav_graph.simulation.degrade import Degrade, degrade, write_degraded
from smartnav_graph.simulation.trajectory import Eight, Leg, Legs, Trajectory


@pytest.fixture(scope="module")
def eight():
    """A minute of figure eights with a phone, after 5 s of rest; fixes of 1 m."""
    return recorded(seed=1)


@pytest.fixture(scope="module")
def clean(eight):
    return sn.run(eight)


def error_rms(session, solution) -> float:
    """3-D RMS position error at the fixes' epochs, metres."""
    rows = np.flatnonzero(np.isin(solution.t_ns, session.reference.t_ns))
    off = solution.nav_t_body[rows] - truth(session, solution.t_ns[rows])[1]
    return float(np.sqrt((off**2).sum(axis=1).mean()))


def moving(seconds: float) -> Trajectory:
    """A slalom at 3 m/s, without a rest before."""
    legs = [Leg(4.0, 3.0, turn) for turn in (80.0, -130.0, 60.0, 90.0, -70.0)] * int(np.ceil(seconds / 20.0))
    return Trajectory(Legs(legs, speed=3.0, heading_deg=30.0), held_deg=(0.0, 10.0, 0.0))


def assert_finite(run) -> None:
    solution = run.solution
    for name in ("nav_t_body", "nav_R_body", "nav_v_body", "accel_bias", "gyro_bias", "covariance"):
        assert np.isfinite(getattr(solution, name)).all(), name
    variances = np.diagonal(solution.covariance, axis1=1, axis2=2)
    assert (variances > 0).all()


# ---- nothing absolute


def test_no_absolute_sensor_and_nothing_to_start_from():
    session = recorded(moving).replace(gnss=None)
    with pytest.raises(SolverError, match=r"no absolute sensor \(no position fix, no control point\) and no rest") as e:
        sn.smooth(session)
    assert "--initial" in str(e.value) and "gnss" in str(e.value)


def test_a_given_start_dead_reckons():
    session = recorded(moving).replace(gnss=None)
    run = sn.run(session, initial="0,0,0,0,0.1,1")
    assert run.summary["mode"] == "dead-reckoning" and run.summary["initialisation"]["method"] == "given"
    assert any("dead reckoning" in text for text in run.summary["warnings"])
    assert_finite(run)


def test_a_rest_at_the_start_dead_reckons(eight):
    run = sn.run(eight.replace(gnss=None))
    assert run.summary["mode"] == "dead-reckoning" and run.summary["used"] == {}
    assert "started from a rest of 5" in run.summary["initialisation"]["sentence"]
    assert any("errors grow with time" in text for text in run.summary["warnings"])
    assert_finite(run)
    sigma = run.solution.sigmas[:, 3]
    assert sigma[-1] > 50 * sigma[5]
    off = np.abs(run.solution.nav_t_body[5] - 0.0)
    assert (off < 3 * run.solution.sigmas[5, 3:6]).all()


# ---- clocks and spans


def test_fixes_all_outside_the_inertial_span(eight):
    with pytest.raises(SessionError, match=r"no row of gnss lies inside the imu's span 0 to 59\.990 s") as e:
        sn.smooth(shifted(eight, 1000.0))
    assert "one clock" in str(e.value)


def test_fixes_partly_outside_are_counted_and_reported(eight):
    run = sn.run(shifted(eight, -20.0), start_s=0.0)
    assert run.summary["dropped"] == {"gnss": {"outside the inertial span": 20}}
    assert any("20 of 60 rows lie outside the imu's span" in text for text in run.summary["warnings"])
    assert run.summary["used"]["gnss"] + run.summary["rejected"].get("gnss", 0) == 40


@pytest.mark.parametrize(("begin", "end", "keyframes"), [(0.0, 20.0, 22), (40.0, 59.0, 20), (-5.0, 1000.0, 62)])
def test_a_stretch_of_the_recording(eight, begin, end, keyframes):
    run = sn.run(eight, start_s=begin, end_s=end)
    assert run.summary["keyframes"] == keyframes  # one at the end of the rest, beside those of the fixes
    assert not run.summary["dropped"]  # rows beyond --from and --to are nobody's loss
    assert_finite(run)


@pytest.mark.parametrize(("begin", "end"), [(60.0, None), (None, 0.0), (-10.0, -5.0), (100.0, 200.0)])
def test_nothing_inside_the_stretch_asked_for(eight, begin, end):
    with pytest.raises(ConfigError, match=r"--from, --to: nothing between .* inside 0 to 59\.99 s"):
        sn.smooth(eight, start_s=begin, end_s=end)


def test_a_stretch_without_fixes_is_no_start(eight):
    with pytest.raises(SolverError, match="no absolute sensor"):
        sn.smooth(eight, start_s=59.2, end_s=59.9)


# ---- units and dead sensors


@pytest.mark.parametrize(
    ("field", "factor", "reported"),
    [("accel", 1 / 9.81, "units of g"), ("accel", 9.81, "scaled by 9.81 twice"), ("gyro", 57.2958, "deg/s")],
)
def test_wrong_units_are_reported(eight, field, factor, reported):
    """Refused, with the repair that converts them."""
    wrong = with_imu(eight, **{field: getattr(eight.imu, field) * factor})
    with pytest.raises(SessionError, match=reported) as error:
        sn.run(wrong)
    assert "--repair units" in str(error.value)
    assert any(reported in str(finding) for finding in inspect(wrong).findings)


@pytest.mark.parametrize("field", ["accel", "gyro"])
def test_a_dead_inertial_sensor_is_refused(eight, field):
    dead = with_imu(eight, **{field: np.zeros_like(getattr(eight.imu, field))})
    with pytest.raises(SessionError, match=rf"imu: {field} is 0 0 0 in all 6000 rows"):
        sn.smooth(dead)


def test_repeated_fixes_are_reported(eight):
    stuck = with_gnss(eight, lla=np.tile(eight.gnss.lla[0], (60, 1)))
    assert any("in all 60 rows" in text for text in sn.run(stuck).summary["warnings"])


def test_a_value_that_is_no_number_is_refused_by_name(eight):
    accel = eight.imu.accel.copy()
    accel[777, 1] = np.nan
    with pytest.raises(SessionError, match="accel_y_m_s2 is nan at row 777"):
        with_imu(eight, accel=accel)


# ---- gaps


def test_a_gap_is_reported_and_its_uncertainty_grows(eight, clean):
    run = sn.run(degrade(eight, Degrade(drop_imu=((30.4, 3.0),)), 0))
    (gap,) = run.summary["gaps"]
    assert gap["kind"] == "missing" and gap["start_s"] == 30.39 and gap["length_s"] == pytest.approx(3.01)
    assert any("1 data gap without samples, 3.01 s in all" in text for text in run.summary["warnings"])
    inside, before = np.searchsorted(run.solution.seconds, (32.0, 28.0))
    whole = int(np.searchsorted(clean.solution.seconds, 32.0))
    assert run.solution.sigmas[inside, 6:9].max() > 2 * clean.solution.sigmas[whole, 6:9].max()
    assert run.solution.sigmas[inside, 6:9].max() > 2 * run.solution.sigmas[before, 6:9].max()
    assert error_rms(eight, run.solution) < 1.5 * error_rms(eight, clean.solution)


def test_a_gap_that_nobody_saw_would_be_worse(eight):
    """The rule off: the hole is bridged by one straight step, and its velocity sigma says nothing of it."""
    holed = degrade(eight, Degrade(drop_imu=((30.4, 3.0),)), 0)
    blind = replace(Config(), gaps=replace(Config().gaps, missing_s=100.0))
    run, seen = sn.run(holed, blind), sn.run(holed)
    assert run.summary["gaps"] == []
    row = int(np.searchsorted(run.solution.seconds, 32.0))
    assert run.solution.sigmas[row, 6:9].max() < 0.7 * seen.solution.sigmas[:, 6:9].max()


def test_repaired_faults_cost_little(eight, clean, tmp_path):
    """Repeated, swapped, broken rows and jittered stamps, with repairs declared on disk."""
    faults = Degrade(duplicates=0.01, swaps=0.005, nan_rows=0.001, jitter_ms=3.0)
    write_degraded(eight, faults, 0, tmp_path / "faulty")
    run = sn.run(session_folder.load(tmp_path / "faulty"))
    assert error_rms(eight, run.solution) < 1.15 * error_rms(eight, clean.solution)
    dropped = run.summary["dropped"]["imu"]
    assert dropped["non-finite rows dropped"] == 6 and dropped["stamps rebuilt"] > 5900
    assert any(text.startswith("imu: ") and "6 rows non-finite" in text for text in run.summary["warnings"])


# ---- poor geometry: no crash, consistent heading


@pytest.mark.parametrize("rows", [[10], [10, 19], [10, 20, 30]])
def test_few_fixes(rows):
    session = recorded(moving)
    run = sn.run(session.replace(gnss=session.gnss.take(np.array(rows))))
    assert_finite(run)
    assert run.summary["used"] == {"gnss": len(rows)}
    if len(rows) < 3:
        assert run.solution.sigma_heading_deg.min() > 20.0


def test_a_straight_line_leaves_the_heading_open():
    session = recorded(lambda s: Trajectory(Legs([Leg(s, 12.0)], speed=12.0, heading_deg=30.0)))
    run = sn.run(session)
    assert_finite(run)
    assert run.solution.sigma_heading_deg.min() > 20.0
    assert error_rms(session, run.solution) < 1.0  # m; the path does not suffer


def test_two_samples(eight):
    session = eight.replace(imu=eight.imu.take(slice(0, 2)))
    run = sn.run(session)
    assert_finite(run)
    assert run.summary["keyframes"] == 2 and run.solution.sigma_heading_deg.min() > 20.0
    with pytest.raises(SessionError, match="imu"):
        sn.smooth(eight.replace(imu=eight.imu.take(slice(0, 1))))


@pytest.mark.parametrize("seconds", [3.0, 10.0])
def test_shorter_than_the_initialisation(seconds):
    session = recorded(moving)
    run = sn.run(session, end_s=seconds)
    assert_finite(run)
    assert run.summary["initialisation"]["stretch_s"] <= seconds
    off = turned_deg(run.solution.nav_R_body, truth(session, run.solution.t_ns)[0])
    sigma = np.degrees(np.sqrt((run.solution.sigmas[:, :3] ** 2).sum(axis=1)))
    assert (off < 3 * sigma).all() and sigma.min() > 5.0


# ---- contradictions


def test_fixes_of_another_motion_do_not_pass_for_a_solution(eight, clean):
    car = sn.simulate("car-10min", 3)
    rows = car.gnss.take(slice(20, 80))
    other = eight.replace(gnss=replace(rows, t_ns=eight.gnss.t_ns, sigma=np.full((60, 3), 0.05)))
    run = sn.run(other)
    assert_finite(run)
    summary = run.summary
    assert summary["verdict"]["level"] == "contradictory" and summary["chi2_per_dof"]["overall"] > 5.0
    assert any(text.startswith("solve: ") for text in summary["warnings"])  # and a good fit says nothing of the kind
    assert not any(text.startswith("solve: ") for text in clean.summary["warnings"])


def test_every_fix_rejected_is_an_error(eight, monkeypatch):
    """Whatever rejects them: a run without any absolute measurement left is no solution."""
    from smartnav_graph.estimate import run
    from smartnav_graph.estimate.passes import solve_passes

    def nothing_left(*args, **options):
        found, pass_state, passes = solve(*args, **options)
        return found, replace(pass_state, rejected={"gnss": frozenset(range(60))}), passes

    solve = solve_passes
    monkeypatch.setattr(run, "solve_passes", nothing_left)
    with pytest.raises(SolverError, match=r"every absolute measurement was rejected \(gnss 60\)"):
        sn.run(eight, initial="0,0,0,0,10,20")


# ---- far starts


def test_a_start_ten_kilometres_off_ends_at_the_same_solution(eight):
    """Sigmas of 100 km and 180 deg: the prior has no weight, whatever its value."""
    near, far = (sn.smooth(eight, initial=f"{start},0,1e5,180") for start in ("0,0,0", "7000,-7000,300"))
    assert np.linalg.norm(near.nav_t_body - far.nav_t_body, axis=1).max() < 1e-3  # m
    assert turned_deg(near.nav_R_body, far.nav_R_body).max() < 5e-3
    assert error_rms(eight, far) < 1.0


def test_a_drive_started_ten_kilometres_off(kitti):
    near, far = (sn.smooth(kitti, initial=f"{start},0,1e5,180") for start in ("0,0,0", "7000,-7000,300"))
    assert np.linalg.norm(near.nav_t_body - far.nav_t_body, axis=1).max() < 1e-3  # m
    batch = sn.smooth(kitti)
    off = np.linalg.norm(batch.nav_t_body - far.nav_t_body, axis=1)  # another prior of tilt; in data gaps, other noise
    assert np.quantile(off, 0.95) < 0.1 and off.max() < 1.0  # m


# ---- rates and shared epochs


def test_control_points_and_fixes_at_the_same_epochs(eight, clean):
    both = eight.replace(control=on_control(eight, slice(0, None, 7), 0.02, 0))
    run = sn.run(both)
    assert run.summary["used"] == {"gnss": 60, "control": 9}
    assert run.summary["keyframes"] == clean.summary["keyframes"]  # they share theirs
    assert error_rms(eight, run.solution) < 0.5 * error_rms(eight, clean.solution)


def test_control_points_and_fixes_share_the_first_epoch_without_a_rest():
    session = recorded(moving)
    run = sn.run(session.replace(control=on_control(session, slice(0, None, 7), 0.02, 0)))
    assert_finite(run)
    assert error_rms(session, run.solution) < 0.5


def test_fixes_at_ten_hertz():
    session = recorded(rate_hz=10.0, seconds=30.0)
    run = sn.run(session)
    assert run.summary["keyframes"] == 302  # the end of the rest is one more
    assert error_rms(session, run.solution) < 0.5


@pytest.mark.parametrize(("hertz", "bound_m", "bound_deg"), [(10.0, 0.2, 5.0), (400.0, 0.025, 1.0)])
def test_inertial_rates(hertz, bound_m, bound_deg):
    recording = record(motions.figure_eight(40.0), hertz=hertz, fix_sigma=0.05)
    solution = sn.smooth(recording.session)
    exact = recording.truth(solution.t_ns)
    assert np.linalg.norm(solution.nav_t_body - exact.nav_t_body, axis=1).max() < bound_m
    assert turned_deg(solution.nav_R_body, exact.nav_R_body).max() < bound_deg


# ---- analytic cases: turns, lever arms, half turns, vertical


def turning(seconds: float) -> Trajectory:
    """Two left turns of 360 deg at 5 m/s: the heading passes north and south."""
    legs = [Leg(5.0, 5.0), Leg(15.0, 5.0, 360.0), Leg(15.0, 5.0, 360.0), Leg(5.0, 5.0)]
    return Trajectory(Legs(legs, speed=5.0, heading_deg=20.0))


def test_a_turn_with_a_lever_arm():
    recording = record(turning(40.0), fix_sigma=0.05)
    solution = sn.smooth(recording.session)
    exact = recording.truth(solution.t_ns)
    assert np.linalg.norm(solution.nav_t_body - exact.nav_t_body, axis=1).max() < 0.02  # m
    assert turned_deg(solution.nav_R_body, exact.nav_R_body).max() < 0.5
    wrong = recording.session.replace(sensors={name: Mount() for name in ("gnss", "control")})
    off = np.linalg.norm(sn.smooth(wrong).nav_t_body - exact.nav_t_body, axis=1)
    assert np.median(off) > 0.5 * np.linalg.norm(LEVER)  # the antenna, not the body


def test_headings_through_north_and_south():
    solution = sn.smooth(record(turning(40.0), fix_sigma=0.05).session, rate="20")
    heading = solution.heading_pitch_roll_deg[:, 0]
    assert heading.min() < 3.0 and heading.max() > 357.0
    turned = np.unwrap(heading, period=360.0)
    assert turned[0] - turned[-1] == pytest.approx(720.0, abs=0.5)
    assert np.abs(np.diff(turned)).max() < 3.0  # 20 Hz at most 45 deg/s


def test_pitched_straight_up():
    """The phone's top points up: pitch 90 deg, where heading and roll are not defined one by one."""
    up = Trajectory(Eight(60.0, rest=5.0, ramp=5.0, period=20.0, speed=6.0), held_deg=(0.0, 90.0, 0.0))
    session = recorded(lambda s: up, white_m=0.1, body_t_antenna=(0.3, 0.2, 0.1))
    run = sn.run(session)
    assert_finite(run)
    rows = np.flatnonzero(np.isin(run.solution.t_ns, session.reference.t_ns))
    assert turned_deg(run.solution.nav_R_body[rows], truth(session, run.solution.t_ns[rows])[0]).mean() < 1.0
    assert np.abs(run.solution.heading_pitch_roll_deg[:, 1] - 90.0).max() < 1.0
    assert np.isfinite(run.solution.heading_pitch_roll_deg).all()
