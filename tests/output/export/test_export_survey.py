"""SBET, NMEA, GeoPackage and coordinates in a system by its EPSG code, each read back by somebody else's parser."""

from __future__ import annotations

import csv
from dataclasses import replace

import fiona
import numpy as np
import pytest
from fiona.transform import transform
from pynmeagps import NMEAReader
from scipy.spatial.transform import Rotation
from test_export import T0, lla, make_solution, solution  # noqa: F401

from smartnav_graph import readers
from smartnav_graph.core.errors import SessionError, SmartnavWarning
from smartnav_graph.core.frames import ABOVE_SEA
from smartnav_graph.core.so3 import rotate_back
from smartnav_graph.core.timebase import gps_from_utc, utc_from_gps
from smartnav_graph.output.export import export
from smartnav_graph.output.export.coordinates import refuse_elsewhere
from smartnav_graph.session.streams import Imu

UTM = "EPSG:25832"
# Sunday 2025-06-01 10:00:00 UTC is 10 h and 18 leap seconds after the GPS week began.
WEEK_S = 36_018.123456789


def sbet(path):
    return np.fromfile(path, "<f8").reshape(-1, 17)


def test_sbet_has_its_17_columns(solution, lla, tmp_path):  # noqa: F811
    export(solution, "sbet", tmp_path / "a.sbet", clock_epoch="unix")
    rows = sbet(tmp_path / "a.sbet")
    assert rows[0, 0] == pytest.approx(WEEK_S, abs=1e-9)
    assert np.degrees(rows[:, 1:3]) == pytest.approx(lla[:, :2], abs=1e-12)
    assert rows[:, 3] == pytest.approx(lla[:, 2], abs=1e-9)
    assert rows[:, [5, 4]] == pytest.approx(solution.nav_v_body[:, :2]) and (-rows[:, 6]).tolist() == pytest.approx(
        solution.nav_v_body[:, 2].tolist()
    )
    heading, pitch, roll = solution.heading_pitch_roll_deg.T
    assert np.degrees(rows[:, 7]) == pytest.approx(roll) and np.degrees(rows[:, 8]) == pytest.approx(pitch)
    assert np.degrees(rows[:, 9]) % 360 == pytest.approx(heading) and (np.abs(rows[:, 9]) <= np.pi).all()
    assert not rows[:, 10:].any()  # no inertial data


def test_sbet_acceleration_is_without_gravity_and_forward_right_down(solution, tmp_path):  # noqa: F811
    """At rest: no acceleration. A turn to the left (up axis of the device) is negative about down."""
    gravity = np.broadcast_to([0.0, 0.0, solution.gravity], (len(solution), 3))
    ahead = np.array([0.0, 2.0, 0.0])  # m/s^2, forward is +y
    force = rotate_back(solution.nav_R_body, gravity) + ahead
    turning = np.tile([0.0, 0.0, 0.1], (len(solution), 1))
    at_rest = replace(solution, imu=Imu(t_ns=solution.t_ns, gyro=turning, accel=force))
    export(at_rest, "sbet", tmp_path / "a.sbet", clock_epoch="gps")
    rows = sbet(tmp_path / "a.sbet")
    assert rows[:, 11:] == pytest.approx(np.tile([2.0, 0, 0, 0, 0, -0.1], (len(solution), 1)), abs=1e-12)


@pytest.mark.parametrize("epoch", ["unix", "gps"])
def test_sbet_time_rises_beyond_the_end_of_the_week(solution, tmp_path, epoch):  # noqa: F811
    week = 604_800 * 10**9
    end = 2300 * week if epoch == "gps" else int(utc_from_gps(np.array([2300 * week]))[0])
    shifted = replace(solution, t_ns=solution.t_ns - solution.t_ns[0] + end - 10**9)
    export(shifted, "sbet", tmp_path / "a.sbet", clock_epoch=epoch)
    expected = 604_799 + (solution.t_ns - solution.t_ns[0]) / 1e9
    assert sbet(tmp_path / "a.sbet")[:, 0] == pytest.approx(expected, abs=1e-6)


def test_nmea_rounds_times_and_full_turns(solution, tmp_path):  # noqa: F811
    """Just west of north, 0.4 ms before a full second."""
    t_ns = T0 - T0 % 10**9 + np.arange(len(solution)) * 10**9 - 400_000
    north = np.tile([-1e-6, 1.0, 0.0], (len(solution), 1))
    pose = np.broadcast_to(Rotation.from_euler("z", 1e-4, degrees=True).as_matrix(), (len(solution), 3, 3))
    path = tmp_path / "a.nmea"
    export(replace(solution, t_ns=t_ns, nav_v_body=north, nav_R_body=pose), "nmea", path, clock_epoch="unix")
    gga, rmc, _, ths = (line.split(",") for line in path.read_text().splitlines()[:4])
    assert (gga[1], rmc[8], ths[1]) == ("100000.000", "0.00", "0.000")


def test_nmea_reads_back(solution, lla, tmp_path):  # noqa: F811
    path = tmp_path / "a.nmea"
    export(solution, "nmea", path, clock_epoch="unix")
    with open(path, "rb") as file:
        messages = [parsed for _, parsed in NMEAReader(file, validate=1, quitonerror=2)]
    assert [m.msgID for m in messages[:4]] == ["GGA", "RMC", "GST", "THS"]
    gga = messages[0::4]
    assert [[m.lat, m.lon] for m in gga] == pytest.approx(lla[:, :2], abs=2e-9)  # deg, 0.2 mm
    assert [m.alt for m in gga] == pytest.approx(lla[:, 2], abs=1e-4)
    assert (str(messages[1].date), str(messages[1].time)) == ("2025-06-01", "10:00:00.123000")
    assert {(m.stdLat, m.stdLong, m.stdAlt) for m in messages[2::4]} == {(0.4, 0.3, 2.0)}
    found = readers.load(path).gnss
    assert len(found) == len(solution) and np.abs(found.t_ns - solution.t_ns).max() < 500_001
    assert found.lla == pytest.approx(lla, abs=1e-4) and found.sigma[0] == pytest.approx([0.3, 0.4, 2.0])


@pytest.mark.parametrize("crs", [None, UTM])
def test_geopackage_is_read_by_ogr(solution, lla, crs, tmp_path):  # noqa: F811
    path = tmp_path / "a.gpkg"
    export(solution, "gpkg", path, clock_epoch="unix", crs=crs)
    assert set(fiona.listlayers(path)) == {"trajectory", "epochs"}
    x, y = (lla[:, 1], lla[:, 0]) if crs is None else transform("EPSG:4326", UTM, lla[:, 1], lla[:, 0])
    with fiona.open(path, layer="epochs") as layer:
        assert layer.crs.to_epsg() == (4326 if crs is None else 25832)
        found = list(layer)
    places = np.array([one.geometry.coordinates for one in found])
    assert places == pytest.approx(np.column_stack([x, y, lla[:, 2]]), abs=1e-4)
    about = found[0].properties
    assert about["t_ns"] == T0 and about["time_utc"].startswith("2025-06-01T10:00:00.123")
    assert about["sigma_n_m"] == pytest.approx(0.4)
    with fiona.open(path, layer="trajectory") as layer:
        (line,) = layer
    assert len(line.geometry.coordinates) == len(solution)


def test_geopackage_of_a_gps_clock_has_utc(solution, tmp_path):  # noqa: F811
    gps = replace(solution, t_ns=np.asarray(gps_from_utc(solution.t_ns)))
    export(gps, "gpkg", tmp_path / "a.gpkg", clock_epoch="gps")
    with fiona.open(tmp_path / "a.gpkg", layer="epochs") as layer:
        assert next(iter(layer)).properties["time_utc"].startswith("2025-06-01T10:00:00.123")


def test_csv_has_coordinates_of_any_system(solution, lla, tmp_path):  # noqa: F811
    export(solution, "csv", tmp_path / "a.csv", crs=UTM)
    with open(tmp_path / "a.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    expected = np.column_stack([*transform("EPSG:4326", UTM, lla[:, 1], lla[:, 0]), lla[:, 2]])
    found = [[float(row[f"epsg25832_{name}_m"]) for name in ("east", "north", "height")] for row in rows]
    assert found == pytest.approx(expected, abs=1e-4)  # m
    assert float(rows[0]["e_m"]) == solution.nav_t_body[0, 0]


@pytest.mark.parametrize(
    ("format", "epoch", "crs", "says"),
    [
        ("sbet", "boot", None, "no date"),
        ("nmea", "unknown", None, "no date"),
        ("csv", "unix", "EPSG:1", "cannot be used"),
        ("csv", "unix", "EPSG:32616", "such as EPSG:32632, its UTM zone"),
        ("csv", "unix", "EPSG:5555", "geoid grid"),  # heights above the sea, without their grid
        ("gpkg", "unix", None, "is no name of a GeoPackage"),
        ("kml", "unix", UTM, "cannot be written as kml"),
    ],
)
def test_what_cannot_be_written_is_refused(solution, tmp_path, format, epoch, crs, says):  # noqa: F811
    with pytest.raises(SessionError, match=says):
        export(solution, format, tmp_path / "a", clock_epoch=epoch, crs=crs)
    assert not (tmp_path / "a").exists()


def test_coordinates_need_an_origin(tmp_path):
    with pytest.raises(SessionError, match="no origin"):
        export(make_solution(origin=None), "csv", tmp_path / "a.csv", crs=UTM)


def test_heights_above_the_sea_are_named_by_every_format(solution, tmp_path):  # noqa: F811
    sea = replace(solution, heights=ABOVE_SEA)
    for name in ("kml", "gpx", "geojson"):
        export(sea, name, tmp_path / name)
        assert "heights are above mean sea level (geoid not known)" in (tmp_path / name).read_text()
    for name, crs, where in (("sbet", None, "--format sbet"), ("csv", UTM, f"--crs {UTM}")):
        with pytest.warns(SmartnavWarning, match=f"{where}: heights are above mean sea level"):
            export(sea, name, tmp_path / name, clock_epoch="unix", crs=crs)
    export(sea, "nmea", tmp_path / "a.nmea", clock_epoch="unix")
    again = readers.load(tmp_path / "a.nmea")
    assert (again.heights, again.mount("gnss").above_sea) == (ABOVE_SEA, True)


def test_a_system_holds_in_its_area_and_a_few_degrees_around():
    """Norway uses zone 33 from coast to coast; zones 1 and 60 touch; the whole Earth is an area, too."""
    place = np.array([[70.0, 31.0, 0.0]])
    for crs, lat, lon in (("EPSG:32633", 70, 31), ("EPSG:32601", 9, 179), ("EPSG:3832", 0, -99), ("EPSG:4326", 0, 99)):
        place[0, :2] = lat, lon
        refuse_elsewhere(place, crs)
    for crs, lat, lon in (("EPSG:32632", 40, -90), ("EPSG:32632", -20, 9), ("EPSG:3832", 0, 10)):
        place[0, :2] = lat, lon
        with pytest.raises(SessionError, match="such as EPSG:32"):
            refuse_elsewhere(place, crs)
