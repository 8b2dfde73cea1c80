"""Indoor traces: a synthetic one with known values, its faults, and the two public walks."""

import numpy as np
import pytest

from smartnav_graph import readers
from smartnav_graph.core.errors import SessionError
from smartnav_graph.readers.indoor_waypoints import polled_noise
from smartnav_graph.session.calibration.model import DEVICE_CLASSES
from smartnav_graph.session.streams import Imu

HEADING = """#\tstartTime:1574668577059
#\tSiteID:5dd3\tSiteName:\u897f\u6eaa\tFloorId:5dd4\tFloorName:B1
#\tBrand:OPPO\tModel:PBCM10\tAndroidName:8.1.0
"""
RECORDS = [
    "1574668577066\tTYPE_WAYPOINT\t90.556076\t230.0948",
    "1574668577126\tTYPE_SENSOR_MAGNETIC_FIELD_ACCURACY_CHANGED\t3",
    "1574668577179\tTYPE_ACCELEROMETER\t0.5\t-0.25\t9.75\t2",
    "1574668577179\tTYPE_MAGNETIC_FIELD\t-25.5\t-17.0\t-25.5\t3",
    "1574668577179\tTYPE_GYROSCOPE\t0.125\t-0.0625\t0.5\t3",
    "1574668577199\tTYPE_GYROSCOPE\t0.25\t0.0\t0.0\t3",
    "1574668577199\tTYPE_ACCELEROMETER\t0.0\t0.0\t10.0\t2",
    "1574668577220\tTYPE_ACCELEROMETER\t0.0\t1.0\t9.5\t2",
    "1574668577220\tTYPE_GYROSCOPE\t0.0\t0.0\t-0.5\t3",
    "1574668577205\tTYPE_WAYPOINT\t91.25\t231.5",
]


@pytest.fixture
def trace(tmp_path):
    def write(records=RECORDS, heading=HEADING, end="#\tendTime:1574668577300\n"):
        path = tmp_path / "trace.txt"
        path.write_text(heading + "\n".join(records) + "\n" + end, encoding="utf-8")
        return path

    return write


def test_values_axes_and_clock(trace):
    path = trace()
    assert readers.find(path).name == "indoor-waypoints"
    session = readers.read(path)
    assert session.imu.t_ns.tolist() == [1574668577179000000, 1574668577199000000, 1574668577220000000]
    assert session.imu.accel.tolist() == [[0.5, -0.25, 9.75], [0, 0, 10], [0, 1, 9.5]]  # m/s^2, upwards when flat
    assert session.imu.gyro.tolist() == [[0.125, -0.0625, 0.5], [0.25, 0, 0], [0, 0, -0.5]]  # rad/s
    assert session.control.enu.tolist() == [[90.556076, 230.0948, 0], [91.25, 231.5, 0]]  # m, x right, y up
    assert session.control.point_id.tolist() == ["W0", "W1"]
    assert (session.device.name, session.device.forward, session.device.up) == ("OPPO PBCM10", "+y", "+z")
    assert (session.device.vehicle, session.clock_epoch, session.origin) == ("foot", "unix", None)
    assert set(session.streams()) == {"imu", "control"}


def test_labels_say_how_good_they_are(trace):
    sigma = readers.read(trace()).control.sigma
    assert (sigma[:, :2] >= 0.5).all() and (sigma[:, :2] <= 1.0).all()  # m
    assert (sigma[:, 2] <= 0.3).all()  # a floor is flat


def test_readings_of_any_age_are_noisy_where_the_phone_shakes(trace):
    """A triangle wave read at random ages within the period: its error about the samples' mean age is the noise."""
    rng, h, n = np.random.default_rng(0), 0.02, 20_000
    wave = np.where(np.arange(n) % 2, 1.0, -1.0)  # rad/s; between samples the rate rises or falls by 2
    late = wave[:-1] + rng.random(n - 1) * np.diff(wave)
    error = late - 0.5 * (wave[1:] + wave[:-1])
    imu = Imu(t_ns=np.arange(n) * 20_000_000, gyro=np.tile(wave, (3, 1)).T, accel=np.zeros((n, 3)))
    noise = polled_noise(imu)
    assert noise.gyro_noise_density == pytest.approx(error.std() * np.sqrt(h), rel=0.02)
    assert noise.accel_noise_density == DEVICE_CLASSES["mems"].accel_noise_density  # at rest that of the class
    assert readers.read(trace()).calibration.imu_noise.gyro_noise_density > 0.01  # two samples that leap


def test_a_waypoint_just_before_the_sensors_is_used_and_reported(trace):
    session = readers.read(trace())
    assert session.control.t_ns.tolist() == [1574668577179000000, 1574668577205000000]
    assert session.dropped == {"control": {"moved by at most 0.5 s to the first or last inertial sample": 1}}


def test_a_waypoint_long_before_the_sensors_stays_where_it_is(trace):
    session = readers.read(trace(["1574668576678\tTYPE_WAYPOINT\t90\t230", *RECORDS[1:]]))
    assert session.control.t_ns[0] == 1574668576678000000 and session.dropped == {}


def test_a_phone_without_a_name_and_records_without_accuracy(trace):
    session = readers.read(trace(heading="#\tstartTime:1\n", records=[r.removesuffix("\t2") for r in RECORDS]))
    assert session.device.name == "phone" and session.imu.accel[1].tolist() == [0, 0, 10]


@pytest.mark.parametrize(
    ("old", "new", "parts"),
    [
        (RECORDS[8], RECORDS[8] + RECORDS[9], ("line 12 has 7 values behind TYPE_GYROSCOPE; expected 3",)),
        (RECORDS[2], "1574668577179\tTYPE_ACCELEROMETER\t0.5\tx\t9.75", ("TYPE_ACCELEROMETER y is 'x' at row 0",)),
        (RECORDS[2], "now\tTYPE_ACCELEROMETER\t0.5\t0\t9.75", ("t is 'now' at row 0; expected a decimal number",)),
        (RECORDS[8], "1574668577221\tTYPE_GYROSCOPE\t0\t0\t0", ("accelerometer and gyroscope have different stamps",)),
        (RECORDS[7], RECORDS[7].replace("9.5", "nan"), ("accel_z_m_s2 is nan at row 2",)),
        (RECORDS[9], RECORDS[9].replace("577205", "577066"), ("not strictly increasing at row 1",)),
    ],
)
def test_faults(trace, old, new, parts):
    with pytest.raises(SessionError) as caught:
        readers.read(trace([new if record == old else record for record in RECORDS]))
    for part in ("trace.txt", *parts):
        assert part in str(caught.value)


def test_a_trace_without_waypoints_or_sensors(trace):
    with pytest.raises(SessionError, match="holds no TYPE_WAYPOINT"):
        readers.read(trace(RECORDS[1:9]))
    with pytest.raises(SessionError, match="holds no TYPE_ACCELEROMETER, TYPE_GYROSCOPE"):
        readers.read(trace(RECORDS[:2]))


def test_bytes_that_are_no_text(trace):
    path = trace()
    path.write_bytes(path.read_bytes() + b"\xff\xfe")
    with pytest.raises(SessionError, match="is no UTF-8 text"):
        readers.read(path, "indoor-waypoints")


@pytest.mark.parametrize(
    ("file", "rows", "points", "seconds", "metres", "moved_s"),
    [
        ("site1/B1/5ddb8a07c5b77e0006b1797e.txt", 3192, 20, 64.386, 83.5, 0.113),
        ("site1/F2/5dda5b02c5b77e0006b17721.txt", 4014, 21, 79.716, 85.4, 0.117),
    ],
)
def test_public_walks(dataset, file, rows, points, seconds, metres, moved_s):
    session = readers.read(dataset("indoor_waypoints_ms") / file)
    assert (len(session.imu), len(session.control)) == (rows, points)
    assert session.seconds(session.imu.t_ns[-1]) == pytest.approx(seconds, abs=1e-9)
    assert session.control.t_ns[0] == session.imu.t_ns[0]
    assert sum(session.dropped["control"].values()) == 1
    assert np.linalg.norm(np.diff(session.control.enu, axis=0), axis=1).sum() == pytest.approx(metres, abs=0.05)
    assert np.linalg.norm(session.imu.accel, axis=1).mean() == pytest.approx(10.0, abs=0.01)  # m/s^2, 2 % too much
