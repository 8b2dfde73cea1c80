"""Lists of fixes and of control points: headings, units, clocks, coordinate reference systems."""

import numpy as np
import pyproj
import pytest

import smartnav_graph as sn
from smartnav_graph import readers
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.timebase import NS
from smartnav_graph.readers.positions.headings import clock_readings
from smartnav_graph.readers.positions.listed import read_points

NOON = int(np.datetime64("2025-06-01T12:00:00", "ns").astype(np.int64))
UTM = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32632", always_xy=True)


def read(tmp_path, text):
    (tmp_path / "list.csv").write_text(text)
    return readers.read(tmp_path / "list.csv")


def points(tmp_path, text):
    (tmp_path / "points.csv").write_text(text)
    return read_points(tmp_path / "points.csv")


def test_fixes_with_accuracy_speed_and_course(tmp_path):
    head = "timestamp,Latitude,Longitude,Altitude (m),Accuracy (m),Speed (km/h),Bearing\n"
    rows = "1748779200.25,52.5,11.5,100,3.0192,36,90\n1748779201.25,52.5,11.501,101,,-1,-1\n"
    fixes = read(tmp_path, head + rows)
    assert fixes.clock_epoch == "unix" and fixes.gnss.t_ns.tolist() == [NOON + NS // 4, NOON + NS * 5 // 4]
    np.testing.assert_allclose(fixes.gnss.sigma[0, :2], 2.0, atol=1e-3)  # radius of 68 % / 1.5096
    np.testing.assert_allclose(fixes.gnss.velocity[0, :2], [10.0, 0.0], atol=1e-9)
    assert np.isnan(fixes.gnss.sigma[1]).all() and np.isnan(fixes.gnss.velocity[1]).all()  # -1 is no value


def test_projected_fixes(tmp_path):
    e, n = UTM.transform(11.5, 52.5)
    fixes = read(tmp_path, f"time,E,N,H,EPSG\n10,{e},{n},50,32632\n11,{e + 1},{n},50,32632\n")
    np.testing.assert_allclose(fixes.gnss.lla[0], [52.5, 11.5, 50.0], atol=1e-9)
    assert fixes.clock_epoch == "unknown"


@pytest.mark.parametrize(
    ("name", "text", "t_ns", "epoch"),
    [
        ("t_ns", "1748779200000000001", NOON + 1, "unix"),
        ("time", "1748779200123", NOON + 123_000_000, "unix"),
        ("gps_time", "1432814418", 1_432_814_418 * NS, "gps"),
        ("time (ms)", "1500.5", 1_500_500_000, "unknown"),
        ("t_ns", "5000000000000", 5_000_000_000_000, "unknown"),  # of a clock since the start of a phone
        ("t", "12.5", 12_500_000_000, "unknown"),
        ("time", "2025-06-01T12:00:00.5Z", NOON + NS // 2, "unix"),
        ("time", "2025/06/01 14:00:00+02:00", NOON, "unix"),
        ("time", "2025-06-01 12:00:00", NOON, "unknown"),  # of some time zone
    ],
)
def test_clock_readings(tmp_path, name, text, t_ns, epoch):
    found, its_epoch = clock_readings(tmp_path, name, [text])
    assert (found.tolist(), its_epoch) == ([t_ns], epoch)


def test_a_clock_reading_that_is_none(tmp_path):
    with pytest.raises(SessionError, match="t is 'noon' at row 0; expected seconds"):
        clock_readings(tmp_path, "t", ["noon"])
    with pytest.raises(SessionError, match="t is 'x' at row 1; expected a number"):
        clock_readings(tmp_path, "t", ["1.0", "x"])


def test_control_points_are_where_pyproj_puts_them(tmp_path):
    """Within 1 cm: UTM, Gauss-Krueger on another datum, geocentric."""
    geod = pyproj.Geod(ellps="WGS84")
    for epsg in (32632, 25832, 31468):
        to = pyproj.Transformer.from_crs("EPSG:4326", f"EPSG:{epsg}", always_xy=True)
        e, n = to.transform(11.5, 52.5)
        found = points(tmp_path, f"id;time;E;N;H;EPSG;sigma\nP1;10;{e:.4f};{n:.4f};100.5;{epsg};0.01\n")
        assert geod.inv(found.rows[0, 1], found.rows[0, 0], 11.5, 52.5)[2] < 0.01
        assert found.rows[0, 2] == 100.5
        np.testing.assert_allclose(found.session().control.sigma, 0.01)
    x, y, z = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True).transform(11.5, 52.5, 100.5)
    found = points(tmp_path, f"id,time,X,Y,Z,EPSG\nP1,10,{x:.4f},{y:.4f},{z:.4f},4978\n")
    np.testing.assert_allclose(found.rows[0, 2], 100.5, atol=0.01)


def test_intervals_are_stops(tmp_path):
    head = "# total station, EPSG: 32632\nname\tstart\tend\tE\tN\tH\n"
    session = points(tmp_path, head + "A\t100\t110\t680000\t5820000\t80\n").session()
    assert session.control.t_ns.tolist() == [105 * NS] and session.control.point_id.tolist() == ["A"]
    assert session.static.t_ns.tolist() == [100 * NS] and session.static.t_end_ns.tolist() == [110 * NS]
    text = "id,time,lat,lon\nA,2025-06-01T12:00:00Z/2025-06-01T12:00:10Z,52.5,11.5\n"
    assert points(tmp_path, text).session().control.t_ns.tolist() == [NOON + 5 * NS]


def test_heights_above_the_sea_need_the_geoid(tmp_path):
    session = points(tmp_path, "id,time,lat,lon,H_msl,geoid\nA,1,52.5,11.5,60,40.2\n").session()
    assert session.mount("control").frame == "msl" and session.mount("control").geoid_m == 40.2
    assert session.nav_position(session.control)[0, 2] == pytest.approx(40.2)


def test_local_points(tmp_path):
    session = points(tmp_path, "id,time,E,N,H\nA,1,10,20,1.5\n").session()
    assert session.origin is None and session.control.enu.tolist() == [[10.0, 20.0, 1.5]]


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("id,time,E,N,H\nA,1,680000,5820000,80\n", "without a coordinate reference system"),
        ("id,time,E,N,H,EPSG\nA,1,5820000000,680000,80,31468\n", "lie outside EPSG 31468"),
        ("id,time,E,N,H,EPSG\nA,1,680000,5820000,80,99999\n", "EPSG 99999 is not known"),
        ("id,time,E,N,H,EPSG\nA,1,680000,5820000,80,UTM 32\n", "EPSG is 'UTM 32' at row 0"),
        ("id,time,E,N,H,EPSG\nA,1,680000,,80,32632\n", "row 0 has no position"),
        ("id,start,end,lat,lon\nA,20,10,52,11\n", "row 0 ends before it starts"),
        ("id,lat,lon\nA,52,11\n", "holds points without times"),
    ],
)
def test_faults_are_named(tmp_path, text, found):
    with pytest.raises(SessionError) as caught:
        points(tmp_path, text).session()
    assert found in str(caught.value)


def test_columns_of_a_sensor_are_no_positions(tmp_path):
    (tmp_path / "accelerometer.csv").write_text("time,x,y,z\n0,0.1,0.2,9.8\n")
    with pytest.raises(SessionError, match="of no known format"):
        readers.read(tmp_path / "accelerometer.csv")


def test_real_reference_of_a_car(dataset):
    fixes = sn.load(dataset("phone_logs") / "sensorlog_ios" / "drive_reference_gps.csv")
    assert fixes.clock_epoch == "unix" and fixes.gnss.t_ns[0] == 1_523_201_497_005_628_000
    np.testing.assert_allclose(fixes.gnss.lla[0, :2], [30.327356, -90.505968])
