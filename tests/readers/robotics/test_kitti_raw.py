"""KITTI raw drives: axes, attitude, stamps of every digit, pictures, calibration."""

import numpy as np
import pytest
from PIL import Image

from smartnav_graph import readers
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.so3 import from_quaternion

CAMERA = """S_rect_00: 1.242e+03 3.75e+02
R_rect_00: 1 0 0 0 1 0 0 0 1
P_rect_00: 721.5 0 609.5 0 0 721.5 172.8 0 0 0 1 0
S_rect_02: 1.242e+03 3.75e+02
P_rect_02: 721.5 0 609.5 43.29 0 721.5 172.8 0 0 0 1 0
"""


def write(folder, rows=20):
    drive = folder / "2011_09_26" / "2011_09_26_drive_0001_sync"
    (drive / "oxts" / "data").mkdir(parents=True)
    stamps = [f"2011-09-26 13:02:{25 + i // 10}.{i % 10}64389445" for i in range(rows)]
    (drive / "oxts" / "timestamps.txt").write_text("\n".join(stamps) + "\n")
    for i in range(rows):
        lla, angles = [49.015, 8.4343, 116.4], [0.0, 0.0, np.pi / 2]  # yaw from east to the left: heading north
        velocity, accel = [2.0, 0.5, 2.0, -0.5, 0.25], [0.5, -0.25, 9.81, 0, 0, 0]
        cells = [*lla, *angles, *velocity, *accel, 0.01, -0.02, 0.03, 0, 0, 0, 0.05, 0.01, 4, 10, 4, 4, 4]
        (drive / "oxts" / "data" / f"{i:010d}.txt").write_text(" ".join(map(repr, map(float, cells))))
    for camera in ("image_00", "image_02"):
        (drive / camera / "data").mkdir(parents=True)
        (drive / camera / "timestamps.txt").write_text("\n".join(stamps[:5]) + "\n")
        for i in (0, 1, 3):  # the third picture was lost
            Image.new("L", (4, 3)).save(drive / camera / "data" / f"{i:010d}.png")
    up = drive.parent
    # cameras look along x of the unit: right is -y, down is -z
    (up / "calib_imu_to_velo.txt").write_text("R: 1 0 0 0 1 0 0 0 1\nT: -0.8 0.25 -0.75\n")
    (up / "calib_velo_to_cam.txt").write_text("R: 0 -1 0 0 0 -1 1 0 0\nT: 0 0 -0.25\n")
    (up / "calib_cam_to_cam.txt").write_text(CAMERA)
    return drive


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    return readers.read(write(tmp_path_factory.mktemp("raw")))


def test_rows_and_stamps_of_every_digit(session):
    assert {name: len(stream) for name, stream in session.streams().items()} == {
        "imu": 20, "gnss": 20, "images": 6, "reference": 20}  # fmt: skip
    assert session.imu.t_ns[1] == int(np.datetime64("2011-09-26T13:02:25.164389445", "ns").astype(np.int64))
    assert session.images.t_ns[-1] - session.images.t_ns[0] == 3 * 10**8  # the fourth stamp, not the third


def test_axes_and_values(session):
    assert session.imu.accel[0].tolist() == [0.5, -0.25, 9.81] and session.imu.gyro[0].tolist() == [0.01, -0.02, 0.03]
    assert (session.device.forward, session.device.up, session.device.vehicle) == ("+x", "+z", "car")
    assert session.gnss.velocity[0].tolist() == [0.5, 2.0, 0.25]  # east, north, up of north, east
    assert session.gnss.sigma[0].tolist() == [0.05] * 3
    nav_R_body = from_quaternion(session.reference.quat)[0]
    np.testing.assert_allclose(nav_R_body @ [1, 0, 0], [0, 1, 0], atol=1e-12)  # heading north
    np.testing.assert_allclose(nav_R_body @ [0, 0, 1], [0, 0, 1], atol=1e-12)


def test_cameras_lie_where_the_calibration_says(session):
    left = session.mount("image_00")
    np.testing.assert_allclose(np.array(left.body_R)[:, 2], [1, 0, 0], atol=1e-12)  # looks ahead
    np.testing.assert_allclose(left.body_t, [0.8 + 0.25, -0.25, 0.75], atol=1e-12)
    colour = session.mount("image_02")
    np.testing.assert_allclose(np.subtract(colour.body_t, left.body_t), [0, 43.29 / 721.5, 0], atol=1e-9)  # to the left
    assert session.calibration.cameras["image_02"].fx == 721.5


def test_a_lost_file_is_named(tmp_path):
    drive = write(tmp_path)
    (drive / "oxts" / "data" / f"{7:010d}.txt").write_text("1 2 3")
    with pytest.raises(SessionError, match=r"0000000007.txt: cannot be read \(3 numbers\); expected 30 numbers"):
        readers.read(drive)
    (drive / "oxts" / "data" / f"{7:010d}.txt").unlink()
    with pytest.raises(SessionError, match=r"oxts: has 19 files and 20 stamps"):
        readers.read(drive)


def test_the_folder_of_a_day_with_one_drive_is_that_drive(tmp_path):
    drive = write(tmp_path)
    assert readers.find(drive.parent).name == "kitti-raw"
    assert len(readers.read(drive.parent).imu) == 20
