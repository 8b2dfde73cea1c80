"""comma2k19: a small synthetic segment with known truth, and the public example."""

import numpy as np
import pyproj
import pytest
from scipy.spatial.transform import Rotation

from smartnav_graph import readers
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.frames import heading_pitch_roll_deg
from smartnav_graph.core.timebase import interpolate

LAT, LON, HEIGHT = 37.72, -122.47, 33.0
TO_ECEF = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978")


def put(root, path, array):
    file = root / path
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("wb") as out:
        np.save(out, np.asarray(array))


def nav_R_ecef():
    """From differences of pyproj positions: independent of the package."""
    origin = np.array(TO_ECEF.transform(LAT, LON, HEIGHT))
    east = np.array(TO_ECEF.transform(LAT, LON + 1e-6, HEIGHT)) - origin
    up = np.array(TO_ECEF.transform(LAT, LON, HEIGHT + 1.0)) - origin
    east, up = east / np.linalg.norm(east), up / np.linalg.norm(up)
    return np.stack([east, np.cross(up, east), up])


@pytest.fixture
def segment(tmp_path):
    """One second northwards at 10 m/s, level, at the first fix."""
    t = 46408.5 + 0.01 * np.arange(100)
    put(tmp_path, "processed_log/IMU/accelerometer/t", t)
    put(tmp_path, "processed_log/IMU/accelerometer/value", np.tile([0.0, 0.0, -9.8], (100, 1)))
    put(tmp_path, "processed_log/IMU/gyro/t", t)
    put(tmp_path, "processed_log/IMU/gyro/value", np.tile([0.1, 0.2, 0.3], (100, 1)))
    put(tmp_path, "processed_log/GNSS/live_gnss_ublox/t", t[::10])
    fixes = np.tile([LAT, LON, 10.0, 1.533226488299e12, HEIGHT, 0.0], (10, 1))
    fixes[:, 0] += np.arange(10) / 111e3
    put(tmp_path, "processed_log/GNSS/live_gnss_ublox/value", fixes)
    put(tmp_path, "processed_log/CAN/speed/t", t)
    put(tmp_path, "processed_log/CAN/speed/value", np.full((100, 1), 10.0))
    pose_t = np.array([46408.5, 46409.4])
    ecef = np.stack(TO_ECEF.transform(LAT + np.array([0.0, 9 / 111e3]), [LON, LON], [HEIGHT, HEIGHT]), axis=-1)
    ned = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])  # nav axes of a car that heads north: forward, right, down
    x, y, z, w = Rotation.from_matrix(nav_R_ecef().T @ ned).as_quat()
    put(tmp_path, "global_pose/frame_times", pose_t)
    put(tmp_path, "global_pose/frame_positions", ecef)
    put(tmp_path, "global_pose/frame_velocities", np.tile(nav_R_ecef().T @ [0.0, 10, 0], (2, 1)))
    put(tmp_path, "global_pose/frame_orientations", np.tile([w, x, y, z], (2, 1)))
    return tmp_path


def test_segment(segment):
    assert readers.find(segment).name == "comma2k19"
    session = readers.read(segment)
    assert (session.device.forward, session.device.up, session.clock_epoch) == ("+x", "-z", "boot")
    assert (session.origin.lat_deg, session.origin.lon_deg, session.origin.height_m) == (LAT, LON, HEIGHT)
    assert session.imu.t_ns[[0, 1, -1]].tolist() == [46408500000000, 46408510000000, 46409490000000]
    assert session.imu.accel[0].tolist() == [0, 0, -9.8] and session.imu.gyro[0].tolist() == [0.1, 0.2, 0.3]
    assert session.wheel.speed.tolist() == [10.0] * 100
    assert session.gnss.sigma is None and set(session.gnss.extra) == {"speed_m_s", "utc_ms", "bearing_deg"}
    np.testing.assert_allclose(session.nav_position(session.gnss)[0], 0, atol=1e-9)


def test_reference_in_nav_axes(segment):
    reference = readers.read(segment).reference
    np.testing.assert_allclose(reference.enu, [[0, 0, 0], [0, 9.0, 0]], atol=0.01)  # m, 111 km a degree is rounded
    np.testing.assert_allclose(reference.velocity, [[0, 10, 0]] * 2, atol=1e-6)
    R = Rotation.from_quat(reference.quat[:, [1, 2, 3, 0]]).as_matrix()
    np.testing.assert_allclose(R[0], [[0, 1, 0], [1, 0, 0], [0, 0, -1]], atol=1e-6)
    # heading north, level: 0 deg in the definitions' own words
    angles = (heading_pitch_roll_deg(R, "+x", "-z") + 180) % 360 - 180
    np.testing.assert_allclose(angles, 0, atol=1e-4)


def test_streams_that_are_absent_stay_absent(segment):
    for path in segment.glob("processed_log/CAN/speed/*"):
        path.unlink()
    (segment / "processed_log/CAN/speed").rmdir()
    assert readers.read(segment).wheel is None


@pytest.mark.parametrize(
    ("path", "array", "parts"),
    [
        ("processed_log/IMU/gyro/value", np.zeros((99, 3)), ("gyro/t", "has shape (100,); expected (99,)")),
        ("processed_log/IMU/gyro/value", np.zeros(100), ("gyro/value", "has shape (100,); expected (n, 3)")),
        ("processed_log/IMU/gyro/t", np.arange(100.0), ("accelerometer and gyro have different stamps",)),
        ("processed_log/IMU/gyro/t", np.full(100, np.nan), ("gyro/t: is nan at row 0",)),
        ("processed_log/IMU/gyro/value", np.full((100, 3), np.nan), ("IMU: gyro_x_rad_s is nan at row 0",)),
        ("global_pose/frame_times", np.array(["a", "b"]), ("frame_times: cannot be read",)),
        ("global_pose/frame_orientations", np.zeros((2, 3)), ("frame_orientations: has shape (2, 3)",)),
    ],
)
def test_faults(segment, path, array, parts):
    put(segment, path, array)
    with pytest.raises(SessionError) as caught:
        readers.read(segment)
    for part in parts:
        assert part in str(caught.value)


def test_truncated_and_missing_files(segment):
    file = segment / "processed_log/IMU/gyro/value"
    file.write_bytes(file.read_bytes()[:500])
    with pytest.raises(SessionError, match="gyro/value: cannot be read"):
        readers.read(segment)
    file.unlink()
    with pytest.raises(SessionError, match="gyro/value: is missing"):
        readers.read(segment)


def test_public_example(dataset):
    session = readers.read(dataset("car_comma2k19"))
    counts = {name: len(stream) for name, stream in session.streams().items()}
    assert counts == {"imu": 6256, "gnss": 579, "wheel": 4974, "reference": 1200}
    assert session.imu.t_ns[[0, -1]].tolist() == [46408580034294, 46468571920945]
    assert session.imu.accel[0].tolist() == [1.074371337890625, -0.12921142578125, -9.544967651367188]
    assert session.gnss.lla[0].tolist() == [37.7209977, -122.47230529999999, 33.37]
    # the fixes lie within metres of the reference, and the wheel agrees with its speed
    rows = session.gnss.t_ns < session.reference.t_ns[-1]
    at = interpolate(session.gnss.t_ns[rows], session.reference.t_ns, session.reference.enu)
    offset = session.nav_position(session.gnss)[rows] - at
    np.testing.assert_allclose(offset.mean(axis=0), [-0.45, -1.38, 1.06], atol=0.02)  # m
    speed = interpolate(session.reference.t_ns, session.wheel.t_ns, session.wheel.speed)
    assert np.median(np.linalg.norm(session.reference.velocity, axis=1) - speed) == pytest.approx(0.14, abs=0.1)
    # the camera's forward axis follows the velocity, but for the tilt of the mount
    R = Rotation.from_quat(session.reference.quat[:, [1, 2, 3, 0]]).as_matrix()
    heading, _, roll = heading_pitch_roll_deg(R, session.device.forward, session.device.up).T
    course = np.degrees(np.arctan2(session.reference.velocity[:, 0], session.reference.velocity[:, 1]))
    assert np.abs(heading - course).max() < 3 and np.abs(roll).max() < 5
