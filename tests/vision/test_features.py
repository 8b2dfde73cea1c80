"""Points of interest on a plane seen twice: where they are found again, and how they cover the picture."""

import cv2
import numpy as np
import pytest
from scenes2d import CAMERA, centred, moved, seen, texture
from scipy.spatial.transform import Rotation

from smartnav_graph.core.errors import ConfigError
from smartnav_graph.session.calibration.camera import Camera
from smartnav_graph.vision import features, matching

PLANE = texture()
FIRST = centred(PLANE)
# ten degrees about the viewing direction, 12 px aside, 8 % nearer, and a little perspective
MOTION = np.array([[1.064, -0.188, -10.0], [0.188, 1.064, -20.0], [4e-5, -2e-5, 1.0]])


@pytest.mark.parametrize("name", features.available())
def test_matches_agree_with_the_homography_to_a_pixel(name):
    one, other = (features.extract(seen(PLANE, H), CAMERA, name, 600) for H in (FIRST, MOTION @ FIRST))
    found = matching.pair(one.descriptors, other.descriptors)
    miss = np.linalg.norm(moved(MOTION, one.xy_px[found.first]) - other.xy_px[found.second], axis=1)
    assert len(miss) > 60
    assert np.median(miss) < 1.0  # px
    assert (miss < 2.0).mean() > 0.9
    # MOTION read the other way round is no better than chance
    wrong = np.linalg.norm(moved(np.linalg.inv(MOTION), one.xy_px[found.first]) - other.xy_px[found.second], axis=1)
    assert (wrong < 2.0).mean() < 0.05


@pytest.mark.parametrize("name", features.available())
def test_normalised_coordinates_are_those_of_the_camera(name):
    bent = Camera(320, 240, 300.0, 300.0, 159.5, 119.5, distortion=(-0.25, 0.06, 1e-3, -5e-4))
    found = features.extract(seen(PLANE, FIRST), bent, name, 200)
    assert 0 < len(found) <= 200
    np.testing.assert_allclose(bent.pixels(found.xy_n), found.xy_px, atol=1e-6)


@pytest.mark.parametrize("name", features.available())
def test_a_picture_without_texture_has_no_points(name):
    found = features.extract(np.full((240, 320), 90, np.uint8), CAMERA, name, 100)
    assert len(found) == 0 and found.xy_n.shape == (0, 2)
    assert len(matching.pair(found.descriptors, found.descriptors).first) == 0


def test_the_count_is_kept():
    for count in (50, 400):
        assert len(features.extract(seen(PLANE, FIRST), CAMERA, "orb", count)) == count


def test_points_cover_the_picture_though_one_corner_is_strongest():
    rng = np.random.default_rng(0)
    xy = np.concatenate([rng.uniform(0, 60, (500, 2)), rng.uniform([0, 0], [320, 240], (500, 2))])
    strength = np.concatenate([rng.uniform(10, 20, 500), rng.uniform(0, 1, 500)])
    chosen = features.spread(xy, strength, (240, 320), 300)
    assert len(np.unique(chosen)) == 300
    inside = (xy[chosen] < 60).all(axis=1)
    assert inside.mean() < 0.25  # all 300 would be there by strength alone
    # of each cell the strongest come first
    cell = (xy // 20).astype(int) @ [1, 100]
    for c in np.unique(cell[chosen]):
        mine = np.flatnonzero(cell == c)
        kept = np.intersect1d(mine, chosen)
        left = np.setdiff1d(mine, chosen)
        assert not len(left) or strength[kept].min() >= strength[left].max()


def test_fewer_points_than_wanted_are_all_kept():
    xy = np.random.default_rng(0).uniform(0, 100, (30, 2))
    assert sorted(features.spread(xy, np.ones(30), (100, 100), 300)) == list(range(30))


@pytest.mark.skipif(hasattr(cv2, "xfeatures2d"), reason="this OpenCV has the contrib modules")
@pytest.mark.parametrize("name", ["fast+freak", "star+brief", "gftt+freak", "mser+freak"])
def test_a_build_without_contrib_is_named_with_the_remedy(name):
    with pytest.raises(ConfigError) as caught:
        features.require(name)
    for part in (
        f"{name} is not in the installed build of OpenCV ({cv2.__version__}",
        "expected one of orb, sift, akaze, brisk",
        "opencv-contrib-python-headless",
        "scripts/reproduce_features",
    ):
        assert part in str(caught.value)


def test_an_unknown_name():
    with pytest.raises(ConfigError, match="unknown features 'surf'; expected klt or one of orb, sift"):
        features.require("surf")


def test_matches_follow_a_turn_of_the_camera_in_normalised_coordinates():
    """Rays seen before and after a turn are the same rays: no pixel convention is lost on the way."""
    R = Rotation.from_euler("yx", [6, -4], degrees=True).as_matrix()  # c1_R_c0
    H = CAMERA.matrix @ R @ np.linalg.inv(CAMERA.matrix)
    one, other = (features.extract(seen(PLANE, H_), CAMERA, "sift", 400) for H_ in (FIRST, H @ FIRST))
    found = matching.pair(one.descriptors, other.descriptors)
    rays = [np.c_[f.xy_n[rows], np.ones(len(rows))] for f, rows in ((one, found.first), (other, found.second))]
    turned = rays[0] @ R.T
    miss = np.linalg.norm(turned[:, :2] / turned[:, 2:] - rays[1][:, :2], axis=1) * CAMERA.focal
    assert len(miss) > 60 and np.median(miss) < 0.3  # px
