"""PX4 logs: golden values, marks, several inertial sensors, damaged logs."""

import numpy as np
import pytest
from ulogs import ulog

from smartnav_graph import readers
from smartnav_graph.core.errors import SessionError

FORMATS = {
    "sensor_combined": [
        *(("uint64_t", "timestamp"), ("float[3]", "gyro_rad"), ("uint32_t", "gyro_integral_dt")),
        *(("int32_t", "accelerometer_timestamp_relative"), ("float[3]", "accelerometer_m_s2")),
    ],
    "vehicle_imu": [
        *(("uint64_t", "timestamp"), ("uint64_t", "timestamp_sample"), ("float[3]", "delta_angle")),
        *(("float[3]", "delta_velocity"), ("uint32_t", "delta_angle_dt"), ("uint32_t", "delta_velocity_dt")),
    ],
    "vehicle_gps_position": [
        *(("uint64_t", "timestamp"), ("int32_t", "lat"), ("int32_t", "lon"), ("int32_t", "alt")),
        *(("int32_t", "alt_ellipsoid"), ("float", "s_variance_m_s"), ("float", "eph"), ("float", "epv")),
        *(("float", "vel_n_m_s"), ("float", "vel_e_m_s"), ("float", "vel_d_m_s")),
        *(("uint8_t", "fix_type"), ("bool", "vel_ned_valid")),
    ],
    "vehicle_magnetometer": [("uint64_t", "timestamp"), ("float[3]", "magnetometer_ga")],
    "vehicle_air_data": [("uint64_t", "timestamp"), ("float", "baro_pressure_pa")],
    "sensor_baro": [("uint64_t", "timestamp"), ("float", "pressure")],
}
T0 = 20_000_000  # us
FIX = (634170622, 107512345, 66814, 106766, 0.5, 2.5, 4.0, 3.0, -1.0, 0.25, 3, True)


def flight():
    rows = []
    for i in range(200):
        t = T0 + i * 5000
        rows.append(("sensor_combined", 0, (t, 0.01, -0.02, 0.5 + i, 5000, 0, 0.125, -0.25, -9.75)))
        if i % 10 == 0:
            angle, speed = (0.001, 0.0, 0.002), (0.0, 0.0, -0.049)
            rows += [("vehicle_imu", n, (t + 300, t, *angle, *speed, 5000, 5000)) for n in (0, 1)]
            rows.append(("vehicle_magnetometer", 0, (t, 0.25, -0.125, 0.5)))
            rows.append(("vehicle_air_data", 0, (t, 100_296.0)))
        if i % 40 == 0:
            rows.append(("vehicle_gps_position", 0, (t, *FIX)))
    return rows


def write(tmp_path, rows, name="flight.ulg", formats=FORMATS):
    path = tmp_path / name
    path.write_bytes(ulog(formats, rows))
    return path


@pytest.fixture
def session(tmp_path):
    return readers.read(write(tmp_path, flight()))


def test_rows_stamps_and_axes(session):
    counts = {name: len(stream) for name, stream in session.streams().items()}
    assert counts == {"imu": 200, "gnss": 5, "magnetometer": 20, "barometer": 20}
    assert session.imu.t_ns[[0, 1]].tolist() == [20_000_000_000, 20_005_000_000]
    assert (session.clock_epoch, session.device.forward, session.device.up) == ("boot", "+x", "-z")
    assert session.device.name == "PX4 TESTED_V5"


def test_units(session):
    np.testing.assert_allclose(session.imu.gyro[3], [0.01, -0.02, 3.5], rtol=1e-6)
    assert session.imu.accel[3].tolist() == [0.125, -0.25, -9.75]  # down is +z: gravity is felt on -z
    assert session.magnetometer.field_ut[0].tolist() == [25.0, -12.5, 50.0]  # gauss -> uT
    assert session.barometer.pressure_hpa[0] == pytest.approx(1002.96)


def test_fixes_have_ellipsoidal_heights_sigmas_and_velocities_east_north_up(session):
    gnss = session.gnss
    np.testing.assert_allclose(gnss.lla[0], [63.4170622, 10.7512345, 106.766], rtol=1e-12)
    assert gnss.sigma[0].tolist() == [2.5, 2.5, 4.0]
    assert gnss.velocity[0].tolist() == [-1.0, 3.0, -0.25]
    assert gnss.sigma_velocity[0].tolist() == [0.5, 0.5, 0.5]
    assert gnss.fix_type.tolist() == [3] * 5


def test_rows_without_a_fix_and_invalid_velocities_are_no_values(tmp_path):
    rows = [*flight(), ("vehicle_gps_position", 0, (T0 + 900_000, *FIX[:-2], 0, True))]
    rows += [("vehicle_gps_position", 0, (T0 + 950_000, 634170000, *FIX[1:-2], 2, False))]
    gnss = readers.read(write(tmp_path, rows)).gnss
    assert len(gnss) == 6 and gnss.fix_type[-1] == 2
    assert np.isnan(gnss.velocity[-1]).all() and np.isnan(gnss.lla[-1, 2])  # two dimensions: no height


def test_the_other_inertial_sensors_are_named_and_can_be_chosen(tmp_path, warned):
    path = write(tmp_path, flight())
    readers.read(path)
    assert "imu of sensor_combined (200 Hz)" in warned() and "vehicle_imu.1 (20 Hz)" in warned()
    other = readers.read(f"{path}#vehicle_imu.1").imu
    assert other.t_ns[0] == 20_000_000_000  # of the sample, not of the message
    np.testing.assert_allclose(other.gyro[0], [0.2, 0.0, 0.4], rtol=1e-6)  # increments over 5 ms
    np.testing.assert_allclose(other.accel[0], [0.0, 0.0, -9.8], rtol=1e-6)
    with pytest.raises(SessionError, match=r"#vehicle_imu.7: is not in the log; expected one of sensor_combined"):
        readers.read(f"{path}#vehicle_imu.7")


def test_an_accelerometer_with_stamps_of_its_own_is_carried_to_the_gyro(tmp_path):
    rows = [("sensor_combined", 0, (T0 + i * 5000, 0.0, 0.0, 0.1, 5000, 2500, float(i), 0.0, -9.8)) for i in range(100)]
    imu = readers.read(write(tmp_path, rows)).imu
    np.testing.assert_allclose(imu.accel[:, 0], np.arange(99) + 0.5, atol=1e-9)  # half a period before each


def test_old_barometers_in_millibars(tmp_path):
    rows = [*flight(), ("sensor_baro", 0, (T0, 1003.0))]
    rows = [row for row in rows if row[0] != "vehicle_air_data"]
    assert readers.read(write(tmp_path, rows)).barometer.pressure_hpa[0] == 1003.0


def test_faulty_logs(tmp_path):
    path = write(tmp_path, [("sensor_combined", 0, (0,) * 9)][:0])
    with pytest.raises(SessionError, match=r"flight.ulg: holds no message of what is read; expected some of sensor"):
        readers.read(path)
    path.write_bytes(path.read_bytes()[:10])
    with pytest.raises(SessionError, match=r"flight.ulg: cannot be read \(.*\); expected a whole log of PX4"):
        readers.read(path)
    bomb = {"sensor_combined": [("uint64_t", "timestamp"), ("float[99999999]", "x")]}
    path.write_bytes(ulog(bomb, []))
    with pytest.raises(SessionError, match="impossible size"):
        readers.read(path)


def test_the_flight_of_a_quadplane(dataset):
    session = readers.read(dataset("phone_logs") / "px4" / "small.ulg")
    assert (len(session.imu), len(session.gnss), len(session.magnetometer)) == (1298, 32, 319)
    assert 1297e9 / (session.imu.t_ns[-1] - session.imu.t_ns[0]) == pytest.approx(200.0, abs=1.0)
    rest = np.median(session.imu.accel, axis=0)
    assert np.linalg.norm(rest) == pytest.approx(9.82, abs=0.3)  # at 63 deg north
    assert rest[2] < -9.0 and session.device.up == "-z"
    # on the ground, in two minutes of arc of Trondheim; the field of the Earth there has about 52 uT
    assert np.median(np.linalg.norm(session.magnetometer.field_ut, axis=1)) == pytest.approx(52.0, abs=15.0)
    assert session.gnss.lla[0, 2] == pytest.approx(106.766)
