"""Real exports of apps (SMARTNAV_DATASETS): one reader each, streams, rates, gravity, axes, stamps by known lengths."""

import numpy as np
import pytest

from smartnav_graph import readers
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.frames import STANDARD_GRAVITY
from smartnav_graph.core.timebase import NS

# file, reader, rows and rate (Hz) of the IMU, fixes, axis that points up
RECORDINGS = [
    ("sensor_logger", "sensor-logger", 12047, 59.4, 205, "+y"),
    ("phyphox", "phyphox", 10574, 100.7, 34, "+z"),
    ("androsensor/Sensor_record_20180803_212713_AndroSensor.csv", "androsensor", 0, 0, 4, "+z"),
    ("hyperimu/imu.csv", "hyperimu", 127, 1.76, 0, "+z"),
    ("sensorlog_ios/drive_phone.csv", "sensorlog", 3418, 10.0, 340, "-x"),
    ("gnsslogger_nmea_gsdc/pixel6.txt", "gnss-logger", 0, 0, 94, "+z"),
    ("gopro_gpmf/karma.raw", "gopro", 391, 391.6, 0, "+z"),
    ("gopro_gpmf/hero6.raw", "gopro", 204, 203.8, 0, "+z"),
    ("gopro_gpmf/hero7.raw", "gopro", 3369, 198.2, 308, "-z"),
    ("gopro_gpmf/hero11.raw", "gopro", 2192, 199.3, 110, "+z"),
    ("flysight", "flysight", 446, 13.3, 147, "+z"),
]
REFUSED = [
    ("physics_toolbox", "physics-toolbox", "gravity is missing"),
    ("matlab_mobile/cs_1.mat", "matlab-mobile", "holds no gyroscope"),
    ("matlab_mobile/ror2_2.mat", "matlab-mobile", "holds no gyroscope"),
    ("gnsslogger_nmea_gsdc/all_sensors.txt", "gnss-logger", "holds no fixes and no inertial data"),
    ("gnsslogger_nmea_gsdc/gnss_log.txt", "gnss-logger", "holds no fixes and no inertial data"),
]


def path_m(session):
    position = session.nav_position(session.gnss)
    return float(np.hypot(*np.diff(position[:, :2], axis=0).T).sum())


@pytest.mark.parametrize(("file", "reader"), [row[:2] for row in (*RECORDINGS, *REFUSED)])
def test_one_reader_recognises_it(dataset, file, reader):
    source = str(dataset("phone_logs") / file)
    assert [found.name for found in readers.READERS.values() if found.matches(source)] == [reader]


@pytest.mark.parametrize(("file", "reader", "rows", "rate", "fixes", "up"), RECORDINGS)
def test_streams_rates_gravity_and_up(dataset, file, reader, rows, rate, fixes, up):
    session = readers.read(dataset("phone_logs") / file)
    assert (0 if session.gnss is None else len(session.gnss)) == fixes
    if session.imu is None:
        assert rows == 0
        return
    assert len(session.imu) == rows and session.device.up == up
    step = np.diff(session.imu.t_ns)
    assert NS * (rows - 1) / step.sum() == pytest.approx(rate, rel=0.02)
    # the mean of a device that moves differs; the one that was waved about (hero7) and the runner's differ most
    size = np.median(np.linalg.norm(session.imu.accel, axis=1))
    assert size == pytest.approx(STANDARD_GRAVITY, abs=0.9)


def test_gravity_at_rest(dataset):
    """The quietest second of each lies within 0.3 m/s^2 of g."""
    for file, *_ in RECORDINGS:
        imu = readers.read(dataset("phone_logs") / file).imu
        # with gaps of seconds, and while it is waved about or lasts a second only, nothing is at rest
        if imu is None or file.startswith(("hyperimu", "gopro_gpmf/hero7", "gopro_gpmf/hero6")):
            continue
        if len(imu) < 400:
            continue
        n = max(int(NS / np.median(np.diff(imu.t_ns))), 2)
        windows = [imu.accel[i : i + n] for i in range(0, len(imu) - n + 1, n)]
        quiet = min(windows, key=lambda rows: rows.std(axis=0).max())
        assert np.linalg.norm(quiet.mean(axis=0)) == pytest.approx(STANDARD_GRAVITY, abs=0.3), file


def test_two_samples_a_second_are_no_inertial_data(dataset):
    session = readers.read(dataset("phone_logs") / RECORDINGS[2][0])
    assert session.dropped["imu"] == {"inertial, 0.5 s apart, left out: the motion between them is not known": 4800}
    with pytest.raises(SessionError, match=r"no imu stream \(4800 rows inertial, 0.5 s apart"):
        session.require_imu()


@pytest.mark.parametrize(("file", "reader", "reason"), REFUSED)
def test_refused_with_the_reason(dataset, file, reader, reason):
    with pytest.raises(SessionError, match=reason):
        readers.read(dataset("phone_logs") / file)


@pytest.mark.parametrize(
    ("file", "metres", "forward"),
    [("sensor_logger", 1044, "-z"), ("sensorlog_ios/drive_phone.csv", 3128, "-z"), ("flysight", 76, "+y")],
)
def test_stamps_by_length_and_forward_by_course(dataset, file, metres, forward):
    session = readers.read(dataset("phone_logs") / file)
    assert path_m(session) == pytest.approx(metres, rel=0.01)
    assert session.device.forward == forward
    overlap = min(session.imu.t_ns[-1], session.gnss.t_ns[-1]) - max(session.imu.t_ns[0], session.gnss.t_ns[0])
    span = session.gnss.t_ns[-1] - session.gnss.t_ns[0]
    assert overlap > 0.95 * span


@pytest.mark.parametrize("file", ["sensor_logger", "sensorlog_ios/drive_phone.csv"])
def test_gyro_turns_as_the_course_does(dataset, file):
    """Turn by the gyro about up against the course of the fixes, over 5 s: same sign, and nearly the same size."""
    session = readers.read(dataset("phone_logs") / file)
    imu, gnss = session.imu, session.gnss
    up = np.median(imu.accel, axis=0)
    turn = np.concatenate([[0.0], np.cumsum((imu.gyro[:-1] @ (up / np.linalg.norm(up))) * np.diff(imu.t_ns) / NS)])
    velocity = gnss.velocity[:, :2]
    fast = np.flatnonzero(np.hypot(*velocity.T) > 3.0)
    course = np.unwrap(np.arctan2(velocity[fast, 1], velocity[fast, 0]))
    at = gnss.t_ns[fast]
    by_gyro = np.interp(at.astype(float), imu.t_ns.astype(float), turn)
    near = at[5:] - at[:-5] < 8 * NS
    by_course, by_gyro = (course[5:] - course[:-5])[near], (by_gyro[5:] - by_gyro[:-5])[near]
    assert np.corrcoef(by_course, by_gyro)[0, 1] > 0.9
    assert 0.7 < np.median(by_course[np.abs(by_gyro) > 0.3] / by_gyro[np.abs(by_gyro) > 0.3]) < 1.3
