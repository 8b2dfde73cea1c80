"""Cameras: pixels to normalised coordinates and back, against the projection equations written out."""

import numpy as np
import pytest

from smartnav_graph.core.errors import CalibrationError
from smartnav_graph.session.calibration import model
from smartnav_graph.session.calibration.camera import Camera

EUROC = Camera(
    752, 480, 458.654, 457.296, 367.215, 248.375, distortion=(-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05)
)
FISHEYE = Camera(640, 480, 300.0, 301.0, 319.5, 239.5, model="fisheye", distortion=(0.02, -0.01, 0.003, -0.001))


def grid(camera, count=7):
    x, y = np.meshgrid(np.linspace(5, camera.width - 5, count), np.linspace(5, camera.height - 5, count))
    return np.column_stack([x.ravel(), y.ravel()])


@pytest.mark.parametrize("camera", [EUROC, FISHEYE, Camera(640, 480, 500.0, 500.0, 320.0, 240.0)])
def test_pixels_survive_the_round_trip(camera):
    xy = grid(camera)
    np.testing.assert_allclose(camera.pixels(camera.normalised(xy)), xy, atol=1e-4)  # px


def test_brown_distortion_is_the_published_polynomial():
    x, y = np.array([0.31, -0.22])
    k1, k2, p1, p2 = EUROC.distortion
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2
    u = EUROC.fx * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + EUROC.cx
    v = EUROC.fy * (y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y) + EUROC.cy
    np.testing.assert_allclose(EUROC.pixels(np.array([[x, y]]))[0], [u, v], atol=1e-9)


def test_fisheye_bends_the_angle_from_the_axis():
    angle = 0.6
    k = np.array(FISHEYE.distortion)
    bent = angle * (1 + k @ angle ** np.array([2, 4, 6, 8]))
    found = FISHEYE.pixels(np.array([[np.tan(angle), 0.0]]))[0]
    np.testing.assert_allclose(found, [FISHEYE.fx * bent + FISHEYE.cx, FISHEYE.cy], atol=1e-6)


def test_half_the_resolution_sees_the_same_directions():
    half = EUROC.resized(376, 240)
    xy = grid(EUROC)
    np.testing.assert_allclose(half.normalised((xy + 0.5) / 2 - 0.5), EUROC.normalised(xy), atol=1e-7)
    with pytest.raises(CalibrationError, match="images of 376 x 480 px for a camera of 752 x 480"):
        EUROC.resized(376, 480)


def test_no_points_no_rows():
    assert EUROC.normalised(np.zeros((0, 2))).shape == EUROC.pixels(np.zeros((0, 2))).shape == (0, 2)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"model": "pinhole"}, "model = 'pinhole'; expected one of brown, fisheye"),
        ({"distortion": (0.1, 0.2, 0.3)}, "3 distortion coefficients for model 'brown'; expected 0 or 4 or 5 or 8"),
        ({"fx": 0.0}, "expected 0 to 100000 px"),
        ({"cx": float("nan")}, "finite numbers"),
    ],
)
def test_a_camera_that_cannot_be_is_refused(changes, text):
    values = {"width": 640, "height": 480, "fx": 500.0, "fy": 500.0, "cx": 320.0, "cy": 240.0} | changes
    with pytest.raises(CalibrationError, match=text):
        Camera(**values)


def test_cameras_live_in_the_calibration_file(tmp_path):
    made = model.Calibration(cameras={"cam0": EUROC, "wide": FISHEYE})
    path = tmp_path / "calibration.toml"
    path.write_text(model.calibration_toml(made))
    assert model.load_calibration(path) == made
    path.write_text(model.calibration_toml(made).replace("fy = 457.296", "fyy = 457.296"))
    with pytest.raises(CalibrationError, match="fyy"):
        model.load_calibration(path)
