"""ROS 1 and ROS 2 bags and MCAP: golden values, choice of topics, clocks, axes, images; damaged bags."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from bags import KINDS, ORIGIN, SPEED, T0, Bag, drive, motion

from smartnav_graph import readers
from smartnav_graph.core.errors import SessionError
from smartnav_graph.session import folder


@pytest.fixture(scope="module", params=KINDS)
def session(request, tmp_path_factory):
    return readers.read(drive(request.param).write(tmp_path_factory.mktemp(request.param)))


def test_every_row_arrives_with_its_stamp(session):
    counts = {name: len(stream) for name, stream in session.streams().items()}
    assert counts == {"imu": 3000, "gnss": 300, "magnetometer": 600, "barometer": 600}
    assert session.imu.t_ns[[0, 1]].tolist() == [T0, T0 + 20_000_000]  # of the header, not of the recorder
    assert session.gnss.t_ns[0] == T0 + 5_000_000
    assert session.clock_epoch == "unix"


def test_units_and_variances(session):
    rate, force = motion(0.14)
    np.testing.assert_allclose(session.imu.gyro[7], rate, rtol=1e-15)
    np.testing.assert_allclose(session.imu.accel[7], force, rtol=1e-15)
    np.testing.assert_allclose(session.magnetometer.field_ut[0], [10.0, -40.0, 20.0], rtol=1e-12)  # T -> uT
    assert session.barometer.pressure_hpa[0] == 978.125
    np.testing.assert_allclose(session.gnss.sigma[0], [0.2, 0.3, 1.2], rtol=1e-12)  # covariance is variance
    assert session.gnss.lla[0].tolist() == list(ORIGIN)
    assert (session.origin.lat_deg, session.origin.lon_deg, session.origin.height_m) == ORIGIN


def test_a_velocity_of_the_receiver_is_that_of_the_fixes(session):
    np.testing.assert_allclose(session.gnss.velocity[0], [SPEED, 0.0, 0.125], atol=1e-9)
    assert session.wheel is None and session.velocity is None


def test_up_is_where_gravity_is_felt_and_forward_where_the_drive_goes(session):
    assert (session.device.up, session.device.forward) == ("+y", "+z")


def test_of_two_imus_the_faster_is_read_and_the_other_named(tmp_path, warned):
    path = drive("ros1", 20).write(tmp_path)
    assert len(readers.read(path).imu) == 1000
    assert "imu of /imu/data (50 Hz)" in warned() and "/slow/imu (10 Hz)" in warned()
    assert "#" in warned()
    other = readers.read(f"{path}#/slow/imu")
    assert len(other.imu) == 200 and other.device.up == "+z"
    with pytest.raises(SessionError, match=r"log.bag#/imu9: is not in the log; expected one of /imu/data"):
        readers.read(f"{path}#/imu9")


def test_gyro_and_accelerometer_on_topics_of_their_own_are_put_together(tmp_path):
    bag = Bag("mcap")
    for i in range(400):
        bag.imu(T0 + i * 5_000_000, force=(0, 0, 0), topic="/camera/gyro", unknown=(0.0, -1.0))
        if i % 2 == 0:
            bag.imu(T0 + i * 5_000_000 + 1_000_000, (0, 0, 0), (0, -9.8, i / 100), "/camera/accel", (-1.0, 0.0))
    session = readers.read(bag.write(tmp_path))
    assert len(session.imu) == 398  # two of the gyro lie outside the accelerometer's span
    np.testing.assert_allclose(session.imu.accel[0], [0.0, -9.8, 0.008], atol=1e-9)  # 4 ms of 10 ms between 0 and .02
    assert session.device.up == "-y"
    assert session.dropped["imu"]["of the gyro outside the accelerometer's span dropped"] == 2


def test_no_fix_is_no_row_and_unknown_covariance_no_sigma(tmp_path):
    bag = drive("ros1", 10)
    bag.fix(T0 + 20_000_000_000, 0.0, 0.0, 0.0, status=-1)
    bag.fix(T0 + 21_000_000_000, 48.0, 9.0, 300.0, known=0)
    gnss = readers.read(bag.write(tmp_path)).gnss
    assert len(gnss) == 51 and np.isnan(gnss.sigma[-1]).all()


def test_a_topic_on_another_clock_is_carried_over_by_the_recorder(tmp_path, warned):
    bag = Bag("sqlite")
    for i in range(500):
        bag.imu(T0 + i * 20_000_000)
        if i % 50 == 0:  # stamped since its own start, 40 ms later in the recorder than a row of the IMU
            t_ns = 3_000_000_000 + i * 20_000_000
            bag.fix(t_ns, 48.0, 9.0, 300.0 + i, log_ns=T0 + i * 20_000_000 + 42_000_000)
    session = readers.read(bag.write(tmp_path))
    assert session.gnss.t_ns[0] - T0 == 40_000_000
    assert "on another clock" not in warned() and "stamps of /fix are" in warned()


def test_a_velocity_in_axes_of_the_imu_and_one_in_unknown_axes(tmp_path, warned):
    bag = Bag("ros1")
    for i in range(500):
        bag.imu(T0 + i * 20_000_000)
        bag.twist(T0 + i * 20_000_000, (1.5, 0.0, 0.0), "imu_link", "/body_velocity")
        bag.twist(T0 + i * 20_000_000, (2.5, 0.0, 0.0), "odom", "/cmd")
    session = readers.read(bag.write(tmp_path))
    assert session.velocity.velocity[0].tolist() == [1.5, 0.0, 0.0] and session.wheel is None
    assert "/cmd is not used" in warned()


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_images_are_written_when_the_session_is_saved(tmp_path, kind):
    bag = Bag(kind)
    grey = np.arange(12, dtype=np.uint8).reshape(3, 4) * 20
    jpeg = cv2.imencode(".jpg", np.full((8, 8, 3), 128, dtype=np.uint8))[1]
    for i in range(10):
        bag.imu(T0 + i * 20_000_000)
    padded = np.pad(grey, ((0, 0), (0, 2))).ravel()
    size = {"height": 3, "width": 4, "is_bigendian": 0}
    bag.add("/cam0/image", "sensor_msgs/msg/Image", T0, "c", encoding="mono8", step=6, data=padded, **size)
    bag.add("/cam0/image", "sensor_msgs/msg/Image", T0 + 1, "c", encoding="mono8", step=6, data=padded[:5], **size)
    bag.add("/cam0/image", "sensor_msgs/msg/Image", T0 + 2, "c", encoding="32FC1", step=6, data=padded, **size)
    bag.add("/../cam1", "sensor_msgs/msg/CompressedImage", T0 + 3, "c", format="bgr8; jpeg compressed", data=jpeg)
    session = readers.read(bag.write(tmp_path))
    assert list(session.images.camera) == ["cam0_image"] * 3 + ["___cam1"]
    folder.save(session, tmp_path / "out")
    saved = folder.load(tmp_path / "out")
    files = [str(file) for file in saved.images.file]
    np.testing.assert_array_equal(cv2.imread(str(saved.pictures / files[0]), cv2.IMREAD_UNCHANGED), grey)
    assert not (saved.pictures / files[1]).exists()  # its data are shorter than its size says
    assert files[2] == ""  # depth is no picture
    assert (saved.pictures / files[3]).read_bytes() == jpeg.tobytes()
    assert all(path.is_relative_to(tmp_path / "out") for path in (tmp_path / "out").rglob("*"))


def test_a_bag_without_sensors_names_its_topics(tmp_path):
    bag = Bag("mcap")
    bag.add("/sun", "sensor_msgs/msg/Illuminance", T0, illuminance=1.0, variance=0.0)
    with pytest.raises(SessionError, match=r"holds no messages that can be used; it has /sun \(sensor_msgs"):
        readers.read(bag.write(tmp_path))


@pytest.mark.parametrize("kind", KINDS)
def test_a_torn_bag_is_an_error_that_names_it(tmp_path, kind):
    path = drive(kind, 2).write(tmp_path)
    file = path if path.is_file() else next(p for p in Path(path).iterdir() if p.suffix in (".mcap", ".db3"))
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 3])
    with pytest.raises(SessionError, match=r"cannot be read .*; expected a whole ROS bag; copy it again"):
        readers.read(path)


def test_a_bag_is_known_by_its_content(tmp_path):
    path = drive("mcap", 2).write(tmp_path)
    mcap = next(path.glob("*.mcap"))
    other = tmp_path / "renamed.dat"
    other.write_bytes(mcap.read_bytes())
    assert readers.find(mcap).name == readers.find(path).name == readers.find(other).name == "ros"
    assert len(readers.read(other).imu) == len(readers.read(path).imu) == 100


def test_the_recording_of_a_husky(dataset):
    session = readers.read(dataset("phone_logs") / "ros1" / "test1.bag")
    assert (len(session.imu), session.device.up, session.clock_epoch) == (11865, "+y", "unix")
    rate = (len(session.imu) - 1) / ((session.imu.t_ns[-1] - session.imu.t_ns[0]) / 1e9)
    assert rate == pytest.approx(30.0, abs=0.1)
    at_rest = np.median(np.linalg.norm(session.imu.accel, axis=1))
    assert at_rest == pytest.approx(9.80, abs=0.3)
    assert session.gnss.sigma[0].tolist() == pytest.approx([0.9, 0.9, 1.8])
