"""The same exports in other layouts: one file of all sensors, JSON, no metadata, headings of old encodings."""

import csv
import json

import numpy as np
import pytest
from exports import ACCEL, FIXES, GYRO, UNIX, androsensor, flysight, lat, phyphox, sensor_logger, sensorlog, times

from smartnav_graph import readers
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.timebase import NS, ns_from_seconds
from smartnav_graph.readers.axes import sign_by_turn
from smartnav_graph.readers.fixes import LoggedFixes
from smartnav_graph.readers.samples import Samples

STAMPED = "time,seconds_elapsed"


def check(session):
    np.testing.assert_allclose(session.imu.accel.mean(axis=0), ACCEL, atol=1e-6)
    np.testing.assert_allclose(session.imu.gyro.mean(axis=0), GYRO, atol=1e-9)
    assert session.imu.t_ns[0] == UNIX * NS and len(session.gnss) == FIXES and session.device.up == "+z"
    np.testing.assert_allclose(session.gnss.lla[0], [48.0, 11.0, 500.0])


def read_by(name, path):
    assert readers.find(path).name == name
    return readers.read(path)


@pytest.mark.parametrize("mark", ["_", ".", " "])
@pytest.mark.parametrize("total", [True, False])
def test_sensor_logger_in_one_table_of_columns(tmp_path, mark, total):
    linear, gravity = (ACCEL[0], ACCEL[1], ACCEL[2] - 9.7), (0.0, 0.0, 9.7)
    vectors = {"TotalAcceleration": ACCEL} if total else {"Accelerometer": linear, "Gravity": gravity}
    vectors["Gyroscope"] = GYRO
    heading = [f"{name}{mark}{axis}" for name in vectors for axis in "zyx"]
    heading += [f"Location{mark}{name}" for name in ("longitude", "latitude", "altitude", "horizontalAccuracy")]
    rows = [",".join([STAMPED, *heading])]
    for i, t in enumerate(times()):
        fix = [11.0, lat(i // 50), 500.0, 3.0] if i % 50 == 0 else [""] * 4
        cells = [round((UNIX + t) * 1000) * 10**6, t, *(v for vector in vectors.values() for v in vector[::-1]), *fix]
        rows.append(",".join(map(str, cells)))
    path = tmp_path / "combined.csv"
    path.write_text("\n".join(rows) + "\n")
    check(read_by("sensor-logger", path))


def test_sensor_logger_in_one_table_of_rows(tmp_path):
    rows = [f"{STAMPED},sensor,x,y,z,latitude,longitude,altitude,horizontalAccuracy"]
    for i, t in enumerate(times()):
        stamp = f"{round((UNIX + t) * 1000)}000000,{t}"
        for name, vector in (("TotalAcceleration", ACCEL), ("Gyroscope", GYRO)):
            rows.append(f"{stamp},{name},{','.join(map(str, vector))},,,,")
        if i % 50 == 0:
            rows.append(f"{stamp},Location,,,,{lat(i // 50)},11,500,3")
    path = tmp_path / "all.csv"
    path.write_text("\n".join(rows) + "\n")
    check(read_by("sensor-logger", path))


@pytest.mark.parametrize("layout", ["rows", "lines", "columns", "units"])
def test_sensorlog_json(tmp_path, layout):
    with sensorlog(tmp_path / "x.csv", zone=" -0500").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    if layout != "units":  # the app gives names without units
        rows = [{name.partition("(")[0]: value for name, value in row.items()} for row in rows]
    text = "\n".join(map(json.dumps, rows)) if layout == "lines" else json.dumps(rows)
    if layout == "columns":
        text = json.dumps({name: [row[name] for row in rows] for name in rows[0]})
    path = tmp_path / "x.json"
    path.write_text(text)
    check(read_by("sensorlog", path))


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ('{"loggingTime": ["a"], "accelerometerAccelerationX": [1, 2]}', "lists of different length"),
        ('[{"loggingTime": "a", "accelerometerAccelerationX": 1}, 3]', "no list of rows"),
        ('[{"loggingTime": "a", "accelerometerAccelerationX": 1', "no JSON"),
    ],
)
def test_sensorlog_json_that_is_broken(tmp_path, text, found):
    path = tmp_path / "x.json"
    path.write_text(text)
    with pytest.raises(SessionError, match=f"x.json: .*{found}"):
        readers.read(path)


def test_headings_of_another_code_page(tmp_path):
    """Where micro, a square and degrees could not be written, a question mark is in their place."""
    path = androsensor(tmp_path / "x.csv")
    text = path.read_text(encoding="utf-8")
    path.write_bytes(text.encode("ascii", errors="replace"))
    session = readers.read(path)
    np.testing.assert_allclose(session.imu.accel.mean(axis=0), ACCEL, atol=1e-6)
    assert session.magnetometer is not None


def turning(sign, up):
    """A car that turns left, then right, at 5 m/s, its phone with axis `up` (3,) upwards."""
    t = np.arange(0.0, 60.0, 0.02)
    rate = 0.2 * np.sin(0.2 * t)
    course = -np.degrees(np.cumsum(rate) * 0.02) % 360.0
    t_ns = ns_from_seconds(t)
    every = slice(0, None, 50)
    fixes = LoggedFixes(t_ns[every], t[every], t[every], speed=np.full(60, 5.0), course=course[every])
    up = np.array(up)
    return Samples(None, t_ns, np.tile(sign * 9.8 * up, (len(t), 1))), Samples(None, t_ns, rate[:, None] * up), fixes


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.0, 0.0, -1.0), (0.0, -1.0, 0.0)])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_turns_show_the_sign_of_the_force(up, sign):
    force, gyro, fixes = turning(sign, up)
    assert sign_by_turn(force, gyro, fixes) == sign


def test_straight_on_nothing_shows_it():
    force, gyro, fixes = turning(1.0, (0.0, 0.0, 1.0))
    straight = LoggedFixes(fixes.t_ns, fixes.lat, fixes.lon, speed=fixes.speed, course=np.full(60, 90.0))
    assert sign_by_turn(force, gyro, straight) == 0.0
    slow = LoggedFixes(fixes.t_ns, fixes.lat, fixes.lon, speed=np.full(60, 0.5), course=fixes.course)
    assert sign_by_turn(force, gyro, slow) == 0.0


def test_without_metadata_the_system_is_guessed_and_said(tmp_path, warned):
    folder = sensor_logger(tmp_path / "x", system="ios", total=False)
    (folder / "Metadata.csv").unlink()
    check(readers.read(folder))
    assert "no Metadata: taken as of iOS (opposite sign): a phone mostly lies on its back" in warned()


def test_tables_and_columns_that_are_not_read_are_said(tmp_path):
    folder = sensor_logger(tmp_path / "drive")
    changes = ("Barometer", "pressure", "p"), ("Location", "bearing,", "x7,"), ("Location", "speedAccuracy", "s\x01y")
    for name, old, new in changes:
        file = folder / f"{name}.csv"
        file.write_text(file.read_text().replace(old, new))
    session = readers.read(folder)
    assert session.dropped["session"] == {"of Barometer left out: no columns x, y, z or pressure": 2}
    assert session.dropped["gnss"] == {
        "line with column names damaged": 1,
        "column x7 not used": 1,
        "column s\x01y not used": 1,
    }
    assert session.barometer is None
    assert "session" not in readers.read(sensor_logger(tmp_path / "whole")).dropped
    file.write_bytes(file.read_bytes().replace(b"\x01", b"\0"))
    with pytest.raises(SessionError, match=r"Location\.csv: is no text"):
        readers.read(folder)


@pytest.mark.parametrize(
    "row", ['"PAUSE",0.0,1700000000.5,x', '"START",5.0,1700000000.5,x', '"START",1e300,1700000000.5,x']
)
def test_a_phyphox_log_without_the_time_of_its_start_says_so(tmp_path, row):
    folder = phyphox(tmp_path / "walk")
    assert readers.read(folder).clock_epoch == "unix" and "clock" not in readers.read(folder).dropped
    file = folder / "meta" / "time.csv"
    file.write_text(f"{file.read_text().splitlines()[0]}\n{row}\n")
    (folder / "Gyroscope uncalibrated.csv").write_text("a,b\n1,2\n3,4\n")
    session = readers.read(folder)
    assert session.clock_epoch == "unknown" and sum(session.dropped["clock"].values()) == 1
    assert session.dropped["session"] == {"table Gyroscope uncalibrated, which has no known quantity, left out": 1}


def test_damaged_records_of_flysight_are_counted(tmp_path):
    folder = flysight(tmp_path / "23-11-14")
    assert "session" not in readers.read(folder).dropped
    file = folder / "TRACK.CSV"
    file.write_text(file.read_text().replace("$GNSS,2023-11-14T22:13:21", "$GNS7,2023").replace("sAcc", "s\x01"))
    session = readers.read(folder)
    assert session.dropped["session"] == {"lines of TRACK.CSV damaged, or of an unknown kind": 2}
    assert len(session.gnss) == FIXES - 1
