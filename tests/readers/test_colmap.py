"""COLMAP models: the public photographs, pixel centres, axes, and faulty files."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smartnav_graph import readers
from smartnav_graph.core.errors import SmartnavError

CAMERAS = "# cameras\n1 SIMPLE_RADIAL 100 80 90 50 40 -0.1\n2 OPENCV_FISHEYE 100 80 90 91 50 40 1 2 3 4\n"
TURN = Rotation.from_euler("y", 30, degrees=True)
IMAGES = """# two lines an image
7 1 0 0 0 1 2 3 1 b.jpg

9 {q[3]} {q[0]} {q[1]} {q[2]} 0 0 -2 2 a folder/a.jpg
1.0 2.0 -1
"""


@pytest.fixture
def model(tmp_path):
    folder = tmp_path / "scene" / "sparse" / "0"
    folder.mkdir(parents=True)
    (tmp_path / "scene" / "images").mkdir()
    (folder / "cameras.txt").write_text(CAMERAS)
    (folder / "images.txt").write_text(IMAGES.format(q=TURN.as_quat()))
    return folder


def test_the_public_photographs(dataset):
    session = readers.read(dataset("lund_door"))
    assert readers.find(dataset("lund_door")).name == "colmap"
    assert len(session.images) == len(session.reference) == 12
    assert session.images.file[[0, 11]].tolist() == ["DSC_0001.JPG", "DSC_0012.JPG"]
    camera = session.calibration.cameras["camera1"]
    assert (camera.fx, camera.cx, camera.cy, camera.distortion[0]) == (2435.38, 647.5, 967.5, -0.0336422)
    assert all((session.pictures / file).is_file() for file in session.images.file)
    quat = session.reference.quat[:, [1, 2, 3, 0]]
    turn = (Rotation.from_quat(quat[:-1]).inv() * Rotation.from_quat(quat[1:])).magnitude()
    assert np.degrees(np.median(turn)) == pytest.approx(3.7, abs=0.3)
    assert "scale arbitrary" in session.device.name


def test_poses_are_inverted_and_begin_level(model):
    session = readers.read(model.parents[1])
    assert session.images.file.tolist() == ["a folder/a.jpg", "b.jpg"]  # by name
    assert session.images.t_ns.tolist() == [0, 1_000_000_000]
    assert session.images.camera.tolist() == ["camera2", "camera1"]
    assert session.pictures.resolve() == (model.parents[1] / "images").resolve()
    R = Rotation.from_quat(session.reference.quat[:, [1, 2, 3, 0]]).as_matrix()
    np.testing.assert_allclose(R[0], [[1, 0, 0], [0, 0, 1], [0, -1, 0]], atol=1e-12)
    # the centre of b, (-1, -2, -3) of the world, in the first camera's axes: turn (c) + (0, 0, -2)
    x, y, z = TURN.as_matrix() @ [-1, -2, -3] + [0, 0, -2]
    np.testing.assert_allclose(session.reference.enu, [[0, 0, 0], [x, z, -y]], atol=1e-12)


def test_cameras_have_their_first_pixel_at_zero(model):
    cameras = readers.read(model).calibration.cameras
    assert (cameras["camera1"].cx, cameras["camera1"].cy) == (49.5, 39.5)
    assert cameras["camera1"].distortion == (-0.1, 0, 0, 0)
    assert (cameras["camera2"].model, cameras["camera2"].fy, cameras["camera2"].distortion) == (
        *("fisheye", 91.0),
        (1, 2, 3, 4),
    )


@pytest.mark.parametrize(
    ("file", "text", "parts"),
    [
        ("cameras.txt", "1 FOV 100 80 90 50 40 1\n", ("cameras.txt, line 1: camera model FOV", "SIMPLE_PINHOLE")),
        ("cameras.txt", "1 PINHOLE 100 80 90\n", ("line 1: is no camera", "size and parameters of PINHOLE")),
        ("cameras.txt", "1 PINHOLE 100 80 -9 90 50 40\n", ("line 1", "expected 0 to 100000 px")),
        ("images.txt", "7 1 0 0 0 1 2 x 1 b.jpg\n\n", ("images.txt, line 1: is no image",)),
        ("images.txt", "7 1 0 1 0 1 2 3 1 b.jpg\n\n", ("images.txt, line 1: pose", "a unit quaternion")),
        ("images.txt", "7 1 0 0 0 1 2 3 5 b.jpg\n\n", ("camera 5 is missing in cameras.txt",)),
        ("images.txt", "# nothing\n", ("images.txt: has no rows",)),
    ],
)
def test_faults(model, file, text, parts):
    (model / file).write_text(text)
    with pytest.raises(SmartnavError) as caught:
        readers.read(model)
    for part in parts:
        assert part in str(caught.value)
