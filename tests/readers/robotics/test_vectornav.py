"""VectorNav CSV: units, axes, GPS time of week, fixes at the time of their measurement."""

import numpy as np
import pytest

from smartnav_graph import readers
from smartnav_graph.core.errors import SessionError

WEEK, TOW = 2303, 403_575_847_626_925  # ns
IMU = (
    "Time [s],Time::TimeStartup [ns],Time::GpsTow [ns],Time::GpsWeek,Time::TimeStatus::timeOk,"
    "IMU::UncompMag::X [Gauss],IMU::UncompMag::Y [Gauss],IMU::UncompMag::Z [Gauss],"
    "IMU::UncompAccel::X [m/s^2],IMU::UncompAccel::Y [m/s^2],IMU::UncompAccel::Z [m/s^2],"
    "IMU::UncompGyro::X,IMU::UncompGyro::Y [rad/s],IMU::UncompGyro::Z [rad/s],IMU::Temp [Celsius],IMU::Pres [kPa],"
    "IMU::Mag::X [Gauss],IMU::Mag::Y [Gauss],IMU::Mag::Z [Gauss]"
)
GNSS = (
    "Time [s],Time::TimeStartup [ns],Time::GpsTow [ns],Time::GpsWeek,GNSS1::Tow [ns],GNSS1::Week,GNSS1::Fix,"
    "GNSS1::PosLla::latitude [deg],GNSS1::PosLla::longitude [deg],GNSS1::PosLla::altitude [m],"
    "GNSS1::VelNed::N [m/s],GNSS1::VelNed::E [m/s],GNSS1::VelNed::D [m/s],"
    "GNSS1::PosU::N [m],GNSS1::PosU::E [m],GNSS1::PosU::D [m],GNSS1::VelU [m/s]"
)


def write(folder, ok=lambda row: 1, rows=50, heading=IMU):
    lines = [heading]
    for i in range(rows):
        startup, step = 214_036_258_000 + i * 20_000_000, i * 20_000_000
        gps = (TOW + step, WEEK, 1) if ok(i) else (0, 0, 0)
        lines.append(
            f"{i * 0.02},{startup},{gps[0]},{gps[1]},{gps[2]},3,3,3,0.098,0.3,-9.8,0.01,0.02,{i},35,97.82,0.25,-0.1,0.4"
        )
    (folder / "vn-imu.csv").write_text("\n".join(lines))
    lines = [GNSS]
    for i, fix in enumerate((4, 4, 1)):
        measured = TOW - 47_626_925 + i * 200_000_000
        lines.append(
            f"{i},{214_058_756_000 + i * 200_000_000},{measured + 70_000_000},{WEEK},{measured},{WEEK},{fix},"
            f"48.78,9.17,{327 + i},1,2,-3,1.5,1.25,3.5,0.25"
        )
    (folder / "vn-gnss.csv").write_text("\n".join(lines))
    return folder


def test_units_axes_and_gps_time(tmp_path):
    session = readers.read(write(tmp_path))
    assert (session.clock_epoch, session.device.forward, session.device.up) == ("gps", "+x", "-z")
    assert session.imu.t_ns[0] == WEEK * 604_800 * 10**9 + TOW
    assert session.imu.accel[0].tolist() == [0.098, 0.3, -9.8]
    assert session.imu.gyro[3].tolist() == [0.01, 0.02, 3.0]
    np.testing.assert_allclose(session.magnetometer.field_ut[0], [25.0, -10.0, 40.0])  # gauss; without hard iron
    assert session.barometer.pressure_hpa[0] == pytest.approx(978.2)
    assert session.temperature.temperature_c[0] == 35.0


def test_a_fix_has_the_time_of_its_measurement_and_axes_east_north_up(tmp_path):
    gnss = readers.read(write(tmp_path)).gnss
    assert gnss.t_ns[0] - WEEK * 604_800 * 10**9 == TOW - 47_626_925  # not that of the message, 70 ms later
    assert len(gnss) == 2  # the third is of time only
    assert gnss.lla[1].tolist() == [48.78, 9.17, 328.0]
    assert gnss.velocity[0].tolist() == [2.0, 1.0, 3.0]
    assert gnss.sigma[0].tolist() == [1.25, 1.5, 3.5] and gnss.sigma_velocity[0].tolist() == [0.25] * 3


def test_rows_before_the_first_fix_get_gps_time_by_the_clock_since_startup(tmp_path):
    session = readers.read(write(tmp_path, ok=lambda row: row >= 10))
    assert session.imu.t_ns[0] == WEEK * 604_800 * 10**9 + TOW


def test_without_gps_time_the_clock_counts_since_startup(tmp_path):
    write(tmp_path, ok=lambda row: 0)
    session = readers.read(tmp_path / "vn-imu.csv")
    assert (session.clock_epoch, session.imu.t_ns[0]) == ("boot", 214_036_258_000)
    assert len(readers.read(tmp_path).gnss) == 2


def test_a_heading_of_unknown_unit_is_refused(tmp_path):
    write(tmp_path, heading=IMU.replace("UncompAccel::Y [m/s^2]", "UncompAccel::Y [ft/s^2]"))
    with pytest.raises(SessionError, match=r"vn-imu.csv: headings IMU::UncompAccel::X .* have no known unit"):
        readers.read(tmp_path)


def test_the_recording_of_a_vn310(dataset):
    session = readers.read(dataset("phone_logs") / "instinct_vn310")
    counts = {name: len(stream) for name, stream in session.streams().items()}
    assert counts == {"imu": 1612, "gnss": 163, "magnetometer": 1612, "barometer": 1612, "temperature": 1612}
    assert 1611e9 / (session.imu.t_ns[-1] - session.imu.t_ns[0]) == pytest.approx(50.0, abs=0.1)
    assert np.linalg.norm(np.median(session.imu.accel, axis=0)) == pytest.approx(9.81, abs=0.3)
    assert session.device.up == "-z"
    assert abs(session.gnss.t_ns[0] - session.imu.t_ns[0]) < 10**9  # one clock, without leap seconds in between
