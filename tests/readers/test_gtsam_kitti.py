"""The KITTI drive of the gtsam wheel: counts, golden rows, axes, units, clock."""

import shutil
import time

import numpy as np
import pytest

from smartnav_graph import readers
from smartnav_graph.core.errors import SessionError
from smartnav_graph.readers.gtsam_kitti import GNSS_FILE, IMU_FILE
from smartnav_graph.readers.source import example_file


@pytest.fixture(scope="module")
def session():
    return readers.read("gtsam-kitti")


def test_counts_and_header(session):
    assert {name: len(stream) for name, stream in session.streams().items()} == {"imu": 46968, "gnss": 470}
    assert (session.device.forward, session.device.up, session.device.vehicle) == ("+x", "+z", "none")
    assert (session.clock_epoch, session.gravity, session.origin) == ("unknown", 9.81, None)
    assert session.calibration is None  # the noise that ships beside it is 3 to 10 times too small
    assert session.dropped == {} and session.repairs == ()


def test_golden_imu_rows(session):
    imu = session.imu
    assert imu.t_ns[[0, 1, -1]].tolist() == [46534478375790, 46536397971133, 47006014548089]
    assert imu.accel[0].tolist() == [1.7114864219577, 0.1717911743144, 9.80533438749]
    assert imu.gyro[0].tolist() == [-0.0032006241515747, 0.031231284764596, -0.0063569265706488]
    assert imu.accel[-1].tolist() == [-0.063600096127999, 0.53114241235277, 9.5775278361954]
    assert imu.gyro[-1].tolist() == [-0.01768420513271, 0.023696133792545, 0.0042086586778123]


def test_golden_fixes_are_local_metres_without_sigmas(session):
    gnss = session.gnss
    assert gnss.t_ns[[0, 1, -1]].tolist() == [46534478375790, 46537387955333, 47005344607182]
    assert gnss.enu[0].tolist() == [-6.8269361350059405424, -11.868164241239471224, 0.040306091310000624617]
    assert gnss.enu[-1].tolist() == [37.900393030289734497, 73.834494369159585858, 0.62051391600999750153]
    assert gnss.lla is None and gnss.sigma is None and gnss.velocity is None


def test_up_is_plus_z_and_turns_to_the_left_are_positive(session):
    assert np.mean(session.imu.accel, axis=0) == pytest.approx([0, 0, 9.81], abs=0.4)  # m/s^2, mean over the drive
    # course change from the positions of two seconds apart against the integrated vertical rate, while moving
    east, north = session.gnss.enu[:, 0], session.gnss.enu[:, 1]
    course = np.unwrap(np.arctan2(np.diff(north), np.diff(east)))
    t = (session.gnss.t_ns[1:] + session.gnss.t_ns[:-1]) / 2e9
    t_imu = session.imu.t_ns / 1e9
    turned = np.concatenate([[0.0], np.cumsum(session.imu.gyro[1:, 2] * np.diff(t_imu))])
    fast = np.hypot(np.diff(east), np.diff(north)) > 4.0
    rates = [np.diff(values[fast]) for values in (course, np.interp(t, t_imu, turned))]
    assert np.corrcoef(*rates)[0, 1] > 0.9


def test_a_folder_with_the_two_files_is_recognised(session, tmp_path):
    for name in (IMU_FILE, GNSS_FILE):
        shutil.copy(example_file(name), tmp_path)
    assert readers.find(tmp_path).name == "gtsam-kitti"
    np.testing.assert_array_equal(readers.read(tmp_path).imu.accel, session.imu.accel)


def test_fast_enough():
    start = time.process_time()
    readers.read("gtsam-kitti")
    assert time.process_time() - start < 2.0  # s; 0.3 on one idle core


@pytest.fixture
def short(tmp_path):
    """A small copy that tests may break."""
    for name, rows in ((IMU_FILE, 6), (GNSS_FILE, 4)):
        lines = example_file(name).read_text().splitlines()[:rows]
        (tmp_path / name).write_text("\n".join(lines) + "\n")
    return tmp_path


def edit(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def test_a_wrong_heading_is_reported(short):
    edit(short / IMU_FILE, "omegaX", "wx")
    with pytest.raises(SessionError, match="no known format"):
        readers.read(short)
    with pytest.raises(SessionError) as caught:
        readers.read(short, "gtsam-kitti")
    for part in (f"{short / IMU_FILE}: column omegaX is missing", "the file has Time, dt, accelX"):
        assert part in str(caught.value)


def test_a_missing_file_is_reported(short):
    (short / GNSS_FILE).unlink()
    with pytest.raises(SessionError, match=rf"{GNSS_FILE}: is missing"):
        readers.read(short, "gtsam-kitti")


def test_bad_rows_name_the_file_and_are_repaired_and_counted_on_request(short):
    lines = (short / IMU_FILE).read_text().splitlines()
    lines[2], lines[3] = lines[3], lines[2]
    lines[4] = lines[4].replace(lines[4].split()[2], "nan")
    (short / IMU_FILE).write_text("\n".join(lines))
    with pytest.raises(SessionError) as caught:
        readers.read(short)
    for part in (str(short / IMU_FILE), "accel_x_m_s2 is nan at row 3", "--repair nan"):
        assert part in str(caught.value)
    repaired = readers.read(short, repairs=("nan", "order"))
    assert repaired.dropped == {"imu": {"non-finite rows dropped": 1, "disordered rows sorted": 1}}
    assert len(repaired.imu) == 4 and (np.diff(repaired.imu.t_ns) > 0).all()
