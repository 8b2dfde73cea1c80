"""What the readers of apps make of small exports with known readings: values, signs, stamps, units, counts."""

import numpy as np
import pytest
from exports import (
    ACCEL,
    EXPORTS,
    FIELD,
    GYRO,
    UNIX,
    G,
    androsensor,
    excel,
    flysight,
    gnss_logger,
    gopro,
    gopro_film,
    matlab_mobile,
    phyphox,
    physics_toolbox,
    sensor_logger,
    sensor_logger_json,
    sensorlog,
    zipped,
)

from smartnav_graph import readers
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.timebase import NS

DATELESS = ("androsensor", "physics-toolbox", "matlab-mobile")
START = {"phyphox": UNIX * NS + NS // 2, "androsensor": 33_000_000, "physics-toolbox": 0}


def check(session, name="", fixes=4):
    """The readings that every export has."""
    # 16-bit integers of the camera resolve 1 / 418 m/s^2 and 1 / 1878 rad/s
    np.testing.assert_allclose(session.imu.accel.mean(axis=0), ACCEL, atol=0.0013 if name == "gopro" else 1e-6)
    np.testing.assert_allclose(session.imu.gyro.mean(axis=0), GYRO, atol=0.0003 if name == "gopro" else 1e-9)
    assert session.device.up == "+z"
    if fixes:
        assert len(session.gnss) == fixes
        np.testing.assert_allclose(session.gnss.lla[0], [48.0, 11.0, 500.0 if name != "physics-toolbox" else np.nan])
        assert session.gnss.lla[1, 0] > 48.0
        assert (session.origin.lat_deg, session.origin.lon_deg) == (48.0, 11.0)


@pytest.mark.parametrize("name", EXPORTS)
def test_each_export_is_recognised_by_one_reader_and_read(tmp_path, name):
    file, write = EXPORTS[name]
    source = write(tmp_path / file)
    assert [reader.name for reader in readers.READERS.values() if reader.matches(str(source))] == [name]
    session = readers.read(source)
    check(session, name, {"gopro": 32, "hyperimu": 0, "phyphox": 3}.get(name, 4))
    start = START.get(name, UNIX * NS)
    assert abs(session.imu.t_ns[0] - start) < (5_000_000 if name == "gopro" else 1000)  # ns
    assert session.clock_epoch == ("unknown" if name in DATELESS else "unix")
    if session.magnetometer is not None:
        np.testing.assert_allclose(session.magnetometer.field_ut[0], FIELD)
    if session.barometer is not None:
        np.testing.assert_allclose(session.barometer.pressure_hpa, 1013.25)
    if name not in ("gopro", "physics-toolbox", "hyperimu"):
        assert session.gnss.sigma[0, 0] == pytest.approx(3.0 / 1.5096, abs=0.001)
        velocity = session.gnss.velocity[0, :2]
        np.testing.assert_allclose(velocity, [0.0, 2.0], atol=1e-9)


def test_the_same_from_a_zip_file(tmp_path):
    for name in ("sensor-logger", "phyphox", "flysight"):
        file, write = EXPORTS[name]
        source = zipped(write(tmp_path / name / file), tmp_path / f"{name}.zip")
        check(readers.read(source), fixes=3 if name == "phyphox" else 4)


@pytest.mark.parametrize("standard", ["", "true"])
@pytest.mark.parametrize("system", ["android", "ios"])
@pytest.mark.parametrize("reverse", [True, False])
def test_sensor_logger_of_both_systems(tmp_path, system, standard, reverse):
    folder = sensor_logger(tmp_path / "x", system=system, standard=standard, reverse=reverse, total=system == "android")
    check(readers.read(folder))
    (folder / "Metadata.csv").unlink()
    check(readers.read(folder))  # by the axis that points up


@pytest.mark.parametrize("nested", [True, False])
def test_sensor_logger_json(tmp_path, nested):
    session = readers.read(sensor_logger_json(tmp_path / "x.json", nested))
    check(session)
    assert session.device.name == "Test phone"


def test_sensor_logger_without_gravity_or_gyro_says_so(tmp_path):
    """Refused where there is nothing else; with fixes these alone are read, and the rest is counted."""
    whole = (("x", "Gravity", "accelerometer with gravity", False), ("y", "Gyroscope", "gyroscope", True))
    for name, missing, found, total in whole:
        folder = sensor_logger(tmp_path / name, total=total)
        (folder / f"{missing}.csv").unlink()
        session = readers.read(folder)
        assert session.imu is None and len(session.gnss) == 4
        (reason,) = session.dropped["imu"]
        assert reason.endswith(f"left out: there is no {found}")
        (folder / "Location.csv").unlink()
        with pytest.raises(SessionError, match=f"holds no {found} .* switch"):
            readers.read(folder)


@pytest.mark.parametrize(("separator", "comma"), [(",", False), (";", True), ("\t", False), ("\t", True)])
@pytest.mark.parametrize("german", [False, True])
def test_phyphox_in_other_languages_and_with_decimal_commas(tmp_path, separator, comma, german):
    session = readers.read(phyphox(tmp_path / "x", separator=separator, comma=comma, german=german))
    check(session, fixes=3)  # the last row has no line end
    assert session.device.name == "Test Phone 1" and session.dropped["gnss"] == {
        "cut at the end of the file left out": 1
    }


def test_phyphox_without_gravity_is_refused(tmp_path):
    folder = phyphox(tmp_path / "x", gravity=False)
    assert "there is no accelerometer with gravity" in str(readers.read(folder).dropped["imu"])
    (folder / "Location.csv").unlink()
    with pytest.raises(SessionError, match="holds no accelerometer with gravity"):
        readers.read(folder)


def test_phyphox_excel(tmp_path):
    source = excel(phyphox(tmp_path / "x"), tmp_path / "x.xlsx")
    assert readers.find(source).name == "phyphox"
    session = readers.read(source)
    check(session)
    assert session.clock_epoch == "unknown"


@pytest.mark.parametrize("first", ["", "sep=,", ",,,,", "\ufeffsep=,,,"])
def test_androsensor_beginnings(tmp_path, first):
    session = readers.read(androsensor(tmp_path / "x.csv", first=first))
    check(session)
    assert session.dropped["gnss"] == {"that repeat the fix before left out": 196}
    assert session.gnss.t_ns.tolist() == [33_000_000 + i * NS for i in range(4)]


def test_physics_toolbox_refuses_linear_acceleration(tmp_path):
    path = physics_toolbox(tmp_path / "x.csv")
    first, *rows = path.read_text().replace("gFx,gFy,gFz", "ax,ay,az").splitlines()
    cut = [",".join([*row.split(",")[:3], "0.1", *row.split(",")[4:]]) for row in rows]
    path.write_text("\n".join([first, *cut]) + "\n")
    with pytest.raises(SessionError, match=r"median acceleration is 0.103 m/s\^2: gravity is missing"):
        readers.read(path)


@pytest.mark.parametrize(("zone", "hours"), [("", -5), ("", 5.5), ("-0500", -5), ("", 0)])
@pytest.mark.parametrize("motion", [False, True])
def test_sensorlog_clocks(tmp_path, zone, hours, motion):
    session = readers.read(sensorlog(tmp_path / "x.csv", zone=zone, hours=hours, motion=motion))
    check(session)
    assert abs(session.imu.t_ns[0] - UNIX * NS) < 1_000_000  # 1 ms: the time is logged to it
    assert session.gnss.t_ns.tolist() == [(UNIX + i) * NS for i in range(4)]


def test_sensorlog_with_semicolons(tmp_path):
    check(readers.read(sensorlog(tmp_path / "x.csv", separator=";")))


def test_gnss_logger_uses_one_provider_and_takes_off_biases(tmp_path):
    for uncalibrated in (True, False):
        session = readers.read(gnss_logger(tmp_path / "x.txt", uncalibrated=uncalibrated))
        check(session)
        assert session.dropped["gnss"] == {"of other providers left out": 4}
        assert session.device.name == "Test Phone 1"


@pytest.mark.parametrize("gps_time", [False, True])
def test_flysight_clock_in_utc_or_gps_time(tmp_path, gps_time):
    session = readers.read(flysight(tmp_path / "x", gps_time=gps_time))
    check(session)
    assert abs(session.imu.t_ns[0] - UNIX * NS) < 1000  # ns
    assert session.gnss.velocity[0].tolist() == [0.0, 2.0, 0.5]


@pytest.mark.parametrize(("order", "stamped"), [("", False), ("YxZ", True), ("ZXY", True), ("xyZ", False)])
def test_gopro_axes_and_stamps(tmp_path, order, stamped):
    session = readers.read(gopro(tmp_path / "x.raw", order=order, stamped=stamped))
    check(session, "gopro", 32)
    assert session.gnss.sigma[0].tolist() == [4.5, 4.5, 9.0]  # 3 m x dilution 1.5
    np.testing.assert_allclose(np.diff(session.imu.t_ns), NS / 50, atol=2)  # ns


def test_gopro_film(tmp_path):
    check(readers.read(gopro_film(tmp_path / "GX.mp4")), "gopro", 32)


def test_a_log_in_g_without_unit_is_known_by_its_size(tmp_path):
    path = tmp_path / "other.csv"
    rows = [",".join(map(str, [f"{0.02 * i:.2f}", *(a / G for a in ACCEL), *GYRO])) for i in range(200)]
    path.write_text("\n".join(["Time (sec),acc_x,acc_y,acc_z,gyro_x,gyro_y,gyro_z", *rows]) + "\n")
    assert readers.find(path).name == "wide-csv"
    check(readers.read(path), fixes=0)


def test_matlab_without_gyro_is_refused_and_foreign_files_are_not_recognised(tmp_path):
    with pytest.raises(SessionError, match=r"x.mat: holds no gyroscope \(it has Acceleration\)"):
        readers.read(matlab_mobile(tmp_path / "x.mat", tables=("Acceleration",)))
    fixes_only = readers.read(matlab_mobile(tmp_path / "x.mat", tables=("Acceleration", "Position")))
    assert fixes_only.imu is None and "there is no gyroscope" in str(fixes_only.dropped["imu"])
    good = (tmp_path / "x.mat").read_bytes()
    foreign = {"cut": good[:700], "hdf": b"MATLAB 7.3 MAT-file".ljust(600, b"\x89"), "zero": good[:128] + bytes(400)}
    for name, data in foreign.items():
        source = tmp_path / f"{name}.mat"
        source.write_bytes(data)
        assert sum(reader.matches(str(source)) for reader in readers.READERS.values()) <= 1


@pytest.mark.parametrize(
    ("heading", "stamp", "start", "epoch"),
    [
        ("time", lambda t: f"2023-11-14T22:13:{20 + t:06.3f}Z", UNIX * NS, "unix"),
        ("Timestamp", lambda t: f"2023-11-14 22:13:{20 + t:06.3f}", UNIX * NS, "unknown"),
        ("time", lambda t: f"13:05:{7 + t:06.3f}".replace(".", ":"), 47107 * NS, "unknown"),
        ("timestamp", lambda t: str(UNIX * 10**9 + round(t * 1e9)), UNIX * NS, "unix"),
        ("timestamp_us", lambda t: str(round(t * 1e6)), 0, "unknown"),
        ("t [ms]", lambda t: str(round(t * 1e3)), 0, "unknown"),
    ],
)
def test_stamps_of_other_apps(tmp_path, heading, stamp, start, epoch):
    path = tmp_path / "other.csv"
    rows = [",".join([stamp(0.02 * i), *map(str, (*ACCEL, *GYRO))]) for i in range(200)]
    names = "Accelerometer X (m/s^2),Accelerometer Y (m/s^2),Accelerometer Z (m/s^2)"
    path.write_text("\n".join([f"{heading},{names},Gyroscope X,Gyroscope Y,Gyroscope Z", *rows]) + "\n")
    session = readers.read(path)
    check(session, fixes=0)
    assert session.imu.t_ns[0] == start and session.clock_epoch == epoch
    np.testing.assert_allclose(np.diff(session.imu.t_ns), 20_000_000, atol=1000)  # ns


def test_gravity_and_linear_acceleration_where_there_is_no_other(tmp_path):
    path = androsensor(tmp_path / "x.csv")
    first, heading, *rows = path.read_text(encoding="utf-8").splitlines()
    heading = (
        heading.replace("ACCELEROMETER", "LINEAR ACCELERATION") + ",GRAVITY X (m/s²),GRAVITY Y (m/s²),GRAVITY Z (m/s²)"
    )
    cut = [",".join(["0.1", "-0.2", "0.0", *row.split(",")[3:], "0", "0", "9.8"]) for row in rows]
    path.write_text("\n".join([first, heading, *cut]) + "\n", encoding="utf-8")
    check(readers.read(path))
