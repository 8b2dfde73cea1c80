"""KITTI odometry: golden rows of the public sequence, axes, and faulty folders."""

import shutil

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smartnav_graph import readers
from smartnav_graph.core.errors import SessionError
from smartnav_graph.session.folder import load, save

CALIB = "P0: 7.0e+02 0 6.0e+02 0 0 7.1e+02 1.8e+02 0 0 0 1 0\n"
# the second picture: a metre ahead, turned by 90 degrees to the right (about y, which points down)
POSES = "1 0 0 0 0 1 0 0 0 0 1 0\n0 0 1 0.5 0 1 0 -0.25 -1 0 0 1\n"


@pytest.fixture
def folder(tmp_path):
    root = tmp_path / "seq"
    (root / "image_0").mkdir(parents=True)
    for i in range(2):
        cv2.imwrite(str(root / "image_0" / f"{i:06d}.png"), np.full((40, 60), 100 + i, np.uint8))
    (root / "calib.txt").write_text(CALIB)
    (root / "poses.txt").write_text(POSES)
    return root


def test_golden_rows_of_the_public_sequence(dataset):
    session = readers.read(dataset("kitti_odometry06"))
    assert readers.find(dataset("kitti_odometry06")).name == "kitti-odometry"
    assert {name: len(stream) for name, stream in session.streams().items()} == {"images": 51, "reference": 51}
    assert session.images.t_ns[[0, 1, 50]].tolist() == [0, 100_000_000, 5_000_000_000]
    camera = session.calibration.cameras["left"]
    assert (camera.width, camera.height, camera.fx, camera.cx, camera.cy) == (1226, 370, 707.0912, 601.8873, 183.1104)
    # 1.198998 m ahead (north), 0.0282 m against "down", so upwards, 0.0140 m to the left
    np.testing.assert_allclose(session.reference.enu[1], [-1.401751e-02, 1.198998, 2.820321e-02], atol=1e-12)
    assert all((session.pictures / file).is_file() for file in session.images.file)


def test_nav_is_level_with_the_first_camera_and_heading_turns_right(folder):
    session = readers.read(folder)
    np.testing.assert_allclose(session.reference.enu, [[0, 0, 0], [0.5, 1.0, 0.25]], atol=1e-12)
    R = Rotation.from_quat(session.reference.quat[:, [1, 2, 3, 0]]).as_matrix()
    np.testing.assert_allclose(R[:, :, 2], [[0, 1, 0], [1, 0, 0]], atol=1e-12)  # looks north, then east
    np.testing.assert_allclose(R[:, :, 1], [[0, 0, -1], [0, 0, -1]], atol=1e-12)  # y points down
    assert (session.device.forward, session.device.up) == ("+z", "-y")


def test_times_are_read_where_they_are(folder):
    (folder / "times.txt").write_text("0.000000e+00\n1.036320e-01\n")
    assert readers.read(folder).images.t_ns.tolist() == [0, 103_632_000]


def test_a_saved_session_has_its_pictures(folder, tmp_path):
    save(readers.read(folder.parent), tmp_path / "session")
    again = load(tmp_path / "session")
    for file in again.images.file:
        assert (again.pictures / file).read_bytes() == (folder / "image_0" / file).read_bytes()


def test_pictures_in_an_archive_are_reported(folder):
    archive = shutil.make_archive(str(folder.parent / "packed"), "zip", folder.parent, "seq")
    session = readers.read(archive)
    assert session.pictures is None and len(session.images) == 2
    assert session.dropped == {"images": {"pictures left in the archive (unpack it, and import the folder)": 2}}


@pytest.mark.parametrize(
    ("file", "text", "parts"),
    [
        ("calib.txt", "1 2 3\n", ("calib.txt: row 0 is no matrix", "12 numbers")),
        ("poses.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n", ("poses.txt: has 1 rows; expected 2, one per picture",)),
        ("poses.txt", POSES.replace("0 0 1 0.5", "0 0 2 0.5"), ("3x3 part of row 1 is no rotation",)),
        ("times.txt", "0.0\nx\n", ("times.txt: t is 'x' at row 1",)),
        ("image_0/000000.png", "no picture", ("000000.png: is no PNG",)),
    ],
)
def test_faults(folder, file, text, parts):
    (folder / file).write_text(text)
    with pytest.raises(SessionError) as caught:
        readers.read(folder)
    for part in parts:
        assert part in str(caught.value)


def test_no_pictures(folder):
    for file in (folder / "image_0").iterdir():
        file.unlink()
    with pytest.raises(SessionError, match="image_0: holds no pictures"):
        readers.read(folder)


@pytest.mark.parametrize(
    "row",
    [
        "P0: nan 0 6 0 0 7 4 0 0 0 1 0",
        "P0: -7 0 6 0 0 7 4 0 0 0 1 0",
        "P0: 7 1 6 0 0 7 4 0 0 0 1 0",
        "P1: 1",
        "P0: 7 0 6 0 0 7 1e300 0 0 0 1 0",
    ],
)
def test_a_camera_that_is_none_is_named_with_its_row(folder, row):
    (folder / "calib.txt").write_text(row + "\n")
    with pytest.raises(SessionError, match=r"calib\.txt: row 0.*; expected "):
        readers.read(folder)
