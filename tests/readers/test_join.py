"""Files joined into one session: clocks tied by stamps or by motion, control points, places."""

import dataclasses

import numpy as np
import pyproj
import pytest

import smartnav_graph as sn
from smartnav_graph.cli import main
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.timebase import NS, gps_from_utc, utc_from_gps
from smartnav_graph.readers.clock_tie import tie
from smartnav_graph.readers.join import join, shifted
from smartnav_graph.session import folder as session_folder
from smartnav_graph.simulation import scenarios
from tests.sessions import recorded


@pytest.fixture(scope="module")
def drive():
    """Two minutes of a car in town, fixes at 1 Hz with .3 m."""
    session = recorded(lambda s: scenarios._moving_car(s, np.random.default_rng(3)), 120.0, white_m=0.3)
    return session.replace(gnss=session.gnss.take(slice(None)))


@pytest.fixture
def parts(drive, tmp_path):
    """The inertial log as a session folder, and the fixes apart."""
    session_folder.save(drive.replace(gnss=None, reference=None), tmp_path / "log")
    return str(tmp_path / "log"), drive.replace(imu=None, static=None, reference=None)


def fix_list(session, path, shift_ns=0, stamp=str):
    """The fixes as a list with their stamps in ns, or as `stamp` writes them."""
    rows = [
        f"{stamp(int(t) + shift_ns)},{lat!r},{lon!r},{height!r}"
        for t, (lat, lon, height) in zip(session.gnss.t_ns, session.gnss.lla.tolist(), strict=True)
    ]
    path.write_text("\n".join(["t_ns,lat,lon,height", *rows]))
    return str(path)


def test_one_clock(parts, drive, tmp_path):
    log, fixes = parts
    joined = join([log, fix_list(fixes, tmp_path / "fixes.csv")])
    assert "both have one clock" in str(joined.ties[0])
    np.testing.assert_array_equal(joined.session.gnss.t_ns, drive.gnss.t_ns)
    np.testing.assert_allclose(joined.session.gnss.lla, drive.gnss.lla)
    assert joined.session.origin == drive.origin and len(joined.session.imu) == len(drive.imu)


def test_gps_time_against_unix_time(drive):
    fixes = drive.replace(imu=None, static=None, reference=None)
    in_gps = dataclasses.replace(fixes.gnss, t_ns=gps_from_utc(fixes.gnss.t_ns))
    found = tie(drive, fixes.replace(gnss=in_gps, clock_epoch="gps"), "a.pos")
    assert found.how == "gps time against unix time"
    np.testing.assert_array_equal(in_gps.t_ns + found.shift_ns, drive.gnss.t_ns)


def test_gps_from_utc_is_the_inverse():
    t = np.array(["1999-01-01", "2016-12-31T23:59:59", "2025-06-01"], dtype="datetime64[ns]").astype(np.int64)
    np.testing.assert_array_equal(utc_from_gps(gps_from_utc(t)), t)


@pytest.mark.parametrize(
    ("clock", "how"),
    [
        (lambda t: t + 2 * 3600 * NS, "local time, UTC\\+2 h"),
        (lambda t: gps_from_utc(t) % (604_800 * NS), "GPS time of week 2369"),
        (lambda t: t % (86_400 * NS), "time of day, UTC"),
        (lambda t: t - t[0], "seconds since the first inertial sample"),
        (lambda t: t - t[0] + 5_000_300_000_000, "found by the motion"),
    ],
)
def test_the_motion_ties_unknown_clocks(drive, clock, how):
    """Any clock: an explained one exactly, another within .2 s (fixes of .3 m over two minutes)."""
    fixes = drive.replace(imu=None, static=None, reference=None)
    theirs = dataclasses.replace(fixes.gnss, t_ns=clock(fixes.gnss.t_ns))
    found = tie(drive, fixes.replace(gnss=theirs, clock_epoch="unknown"), "fixes.csv")
    assert found.confirmed
    pytest.importorskip("re").search(how, found.how) or pytest.fail(found.how)
    limit = 0.2 * NS if "found" in how else 0
    assert np.abs(theirs.t_ns + found.shift_ns - drive.gnss.t_ns).max() <= limit


def test_without_motion_a_plain_clock_is_taken_and_said_to_be_unconfirmed(drive):
    few = drive.replace(imu=None, static=None, reference=None, gnss=drive.gnss.take(slice(0, 3)))
    few = few.replace(gnss=dataclasses.replace(few.gnss, t_ns=few.gnss.t_ns % (86_400 * NS)), clock_epoch="unknown")
    found = tie(drive, few, "few.csv")
    assert not found.confirmed and "not confirmed" in str(found)
    later = shifted(few, 40_000 * NS).replace(clock_epoch="unknown")
    with pytest.raises(SessionError, match=r"few.csv: runs from .* does not tie the clocks.*--shift few.csv=S"):
        tie(drive, shifted(later, 10**15), "few.csv")


def test_shift_on_request(parts, drive, tmp_path):
    log, fixes = parts
    source = fix_list(fixes, tmp_path / "fixes.csv", shift_ns=-1000 * NS)
    joined = join([log, source], shifts={"fixes.csv": 1000.0})
    np.testing.assert_array_equal(joined.session.gnss.t_ns, drive.gnss.t_ns)
    with pytest.raises(SessionError, match=r"--shift: names 'other.csv'"):
        join([log, source], shifts={"other.csv": 1.0})


def test_a_second_receiver_becomes_pose_fixes(parts, drive, tmp_path):
    log, fixes = parts
    other = drive.gnss.lla + np.array([1e-6, 0.0, 0.0])
    first = fix_list(fixes, tmp_path / "fixes.csv")
    second = fix_list(fixes.replace(gnss=dataclasses.replace(drive.gnss, lla=other)), tmp_path / "rtk.csv")
    session = join([log, first, second]).session
    np.testing.assert_allclose(session.pose_fixes.lla, other)
    assert set(session.pose_fixes.source) == {"rtk.csv"}
    with pytest.raises(SessionError, match="holds the same fixes that another file holds too"):
        join([log, first, fix_list(fixes, tmp_path / "copy.csv")])


def test_one_inertial_log(parts, tmp_path):
    log, fixes = parts
    source = fix_list(fixes, tmp_path / "fixes.csv")
    with pytest.raises(SessionError, match="no inertial data"):
        join([source, fix_list(fixes, tmp_path / "more.csv")])
    with pytest.raises(SessionError, match="inertial data in "):
        join([log, f"{log}/.", source])


def surveyed(drive, rows, epsg=32632):
    """Lines of a list: the device's own places at these fixes, in UTM."""
    to = pyproj.Transformer.from_crs("EPSG:4326", f"EPSG:{epsg}", always_xy=True)
    lla = drive.gnss.lla[rows]
    e, n = to.transform(lla[:, 1], lla[:, 0])
    places = np.stack([drive.gnss.t_ns[rows] / NS, e, n, lla[:, 2]], axis=1).tolist()
    return [f"P{i},{t!r},{e!r},{n!r},{h!r},{epsg}" for i, (t, e, n, h) in enumerate(places)]


def test_control_points_in_utm_beside_fixes(parts, drive, tmp_path):
    log, fixes = parts
    source, rows = fix_list(fixes, tmp_path / "fixes.csv"), [10, 60, 110]
    (tmp_path / "points.csv").write_text("\n".join(["id,time,E,N,H,EPSG", *surveyed(drive, rows)]))
    session = join([log, source, str(tmp_path / "points.csv")]).session
    apart = session.nav_position(session.control) - session.nav_position(session.gnss)[rows]
    assert np.abs(apart).max() < 0.01  # m


def test_control_points_of_the_wrong_zone_are_named(parts, drive, tmp_path):
    log, fixes = parts
    source = fix_list(fixes, tmp_path / "fixes.csv")
    lines = [line.replace(",32632", ",32602") for line in surveyed(drive, [10, 60])]
    (tmp_path / "points.csv").write_text("\n".join(["id,time,E,N,H,EPSG", *lines]))
    with pytest.raises(SessionError, match=r"point P0 lies \d{4,5} km from the fixes by EPSG 32602; .*EPSG 32632 puts"):
        join([log, source, str(tmp_path / "points.csv")])


def test_stops_are_found_for_points_in_order(tmp_path):
    """A trolley that rests ten seconds on points that are only listed in order, with and without fixes."""
    session = sn.simulate("trolley-loop", 1)
    control = session.control
    session_folder.save(session.replace(control=None, static=None, reference=None), tmp_path / "log")
    names = zip(control.point_id, *control.lla.T.tolist(), strict=True)
    lines = [f"{name},{lat!r},{lon!r},{height!r}" for name, lat, lon, height in names]
    (tmp_path / "points.csv").write_text("\n".join(["id,lat,lon,h", *lines]))
    joined = join([str(tmp_path / "log"), str(tmp_path / "points.csv")])
    found = joined.session
    assert found.control.point_id.tolist() == control.point_id.tolist()
    assert np.abs(found.control.t_ns - control.t_ns).max() < 3 * NS  # within the stop of 10 s
    (tmp_path / "points.csv").write_text("\n".join(["id,lat,lon,h", *lines, "X,52,11,100"]))
    with pytest.raises(SessionError, match=r"points in order, but \d+ stops of 5 s or more \("):
        join([str(tmp_path / "log"), str(tmp_path / "points.csv")])


def test_fixes_choose_among_more_stops_than_points(tmp_path):
    """Three points at four stops of a walk, with fixes of 2 m; without fixes nothing chooses."""
    session = sn.simulate("walk-all-2min", 1)
    session = session.replace(static=None, reference=None, pose_fixes=None)
    session_folder.save(session.replace(control=None), tmp_path / "log")
    session_folder.save(session.replace(control=None, gnss=None), tmp_path / "bare")
    control = session.control.take([0, 2, 3])
    names = zip(control.point_id, *control.lla.T.tolist(), strict=True)
    lines = [f"{name},{lat!r},{lon!r},{height!r}" for name, lat, lon, height in names]
    (tmp_path / "points.csv").write_text("\n".join(["id,lat,lon,h", *lines]))
    found = join([str(tmp_path / "log"), str(tmp_path / "points.csv")]).session.control
    assert np.abs(found.t_ns - control.t_ns).max() < 3 * NS
    others = [line.replace(",52.0", ",52.1").replace(",51.9", ",52.0") for line in lines]  # kilometres away
    (tmp_path / "points.csv").write_text("\n".join(["id,lat,lon,h", *others]))
    with pytest.raises(SessionError, match=r"point P\d lies \d+ m from the fixes at the stop at \d+ s"):
        join([str(tmp_path / "log"), str(tmp_path / "points.csv")])
    (tmp_path / "points.csv").write_text("\n".join(["id,lat,lon,h", *lines[:2]]))
    with pytest.raises(SessionError, match=r"2 points in order, but \d stops"):
        join([str(tmp_path / "bare"), str(tmp_path / "points.csv")])


def test_import_of_several_files(parts, tmp_path, capsys):
    log, fixes = parts
    source = fix_list(fixes, tmp_path / "fixes.csv", shift_ns=-1000 * NS)
    command = ["import", log, source, "--out", str(tmp_path / "S"), "--quiet"]
    assert main([*command, "--shift", "fixes.csv=1000"]) == 0
    assert "clock: " in capsys.readouterr().out and (tmp_path / "S" / "gnss.parquet").is_file()
    assert main([*command, "--force", "--shift", "fixes.csv"]) == 1
    assert "--shift: 'fixes.csv'; expected FILE=SECONDS" in capsys.readouterr().err


def test_a_phone_and_the_receiver_of_the_car(dataset):
    """SensorLog's own fixes stay, those of the car's receiver become pose fixes, on one Unix clock."""
    logs = dataset("phone_logs") / "sensorlog_ios"
    joined = join([str(logs / "drive_phone.csv"), str(logs / "drive_reference_gps.csv")])
    session = joined.session
    assert "both have one clock" in joined.ties[0].how
    assert len(session.pose_fixes) > 1000 and len(session.gnss) > 300
    assert abs(session.pose_fixes.t_ns[0] - session.gnss.t_ns[0]) < 60 * NS
