"""Uncertainty of projections against Monte Carlo; differences of cameras."""

from dataclasses import replace

import numpy as np
import pytest
from boards import PHONE, exact_views, noisy, poses

from smartnav_graph.calibrate.interior import calibrate_camera
from smartnav_graph.calibrate.projection import cropped, distortion, invertible, projection_difference, projection_sigma
from smartnav_graph.core.errors import CalibrationError
from smartnav_graph.core.so3 import exp
from smartnav_graph.session.calibration.camera import Camera

SIZE = (PHONE.width, PHONE.height)
COUNT = (9, 7)


def spread(seeds, views, distance_m=np.inf):
    """Predicted sigma, and root mean square of the errors over the seeds, at every pixel of a grid."""
    predicted, errors = [], []
    found_poses = poses(views, np.random.default_rng(100))
    exact = exact_views(found_poses)
    for seed in range(seeds):
        found = calibrate_camera(noisy(exact, 0.2, np.random.default_rng(seed)), SIZE)
        sigma = projection_sigma(found, distance_m, COUNT).values.ravel()
        predicted.append(sigma)
        errors.append(projection_difference(PHONE, found.camera, distance_m, COUNT, sigma)[1])
    return np.sqrt(np.mean(np.square(predicted), axis=0)), np.sqrt(np.mean(np.square(errors), axis=(0, 2)))


@pytest.mark.slow
@pytest.mark.parametrize("distance_m", [np.inf, 0.5])
def test_sigma_over_the_image_is_that_of_monte_carlo(distance_m):
    """Within 15 % everywhere; 200 seeds know it to 4 %."""
    predicted, seen = spread(200, 20, distance_m)
    assert np.abs(predicted / seen - 1.0).max() < 0.15


def test_sigma_over_the_image_in_a_few_seeds():
    predicted, seen = spread(16, 12)
    assert 0.75 < np.median(predicted / seen) < 1.3
    assert predicted.max() > 3 * predicted.min()  # corners of the picture are extrapolated


def test_a_rotation_of_the_camera_is_no_difference():
    """cx moved by 0.1 px is a rotation of 0.1 / f, but for its second order; the rest is far below 0.1 px."""
    narrow = Camera(640, 480, 2000.0, 2000.0, 319.5, 239.5)
    _, apart, move = projection_difference(narrow, replace(narrow, cx=narrow.cx + 0.1), count=COUNT)
    assert np.abs(apart).max() < 0.005  # px: 0.1 (320 / 2000)^2
    assert np.allclose(move, [0.0, -0.1 / 2000, 0.0], atol=2e-6)
    assert np.abs(projection_difference(PHONE, PHONE)[1]).max() < 1e-6


def test_a_focal_length_is_a_difference_at_infinity_only():
    """At a finite distance a shift along the axis has the same effect, without distortion exactly so."""
    plain = Camera(640, 480, 500.0, 500.0, 319.5, 239.5)
    longer = replace(plain, fx=505.0, fy=505.0)
    assert np.nanmax(np.linalg.norm(projection_difference(plain, longer)[1], axis=1)) > 1.0
    _, apart, move = projection_difference(plain, longer, 2.0)
    assert np.abs(apart).max() < 1e-6 and move[3] == pytest.approx(0.02, abs=1e-6)  # m: 1 % of 2 m


def test_cut_pictures_show_the_same():
    part = cropped(PHONE, 100, 50, 300, 200)
    xy = np.array([[10.0, 20.0], [299.0, 199.0]])
    assert np.allclose(part.normalised(xy), PHONE.normalised(xy + np.array([100.0, 50.0])))
    with pytest.raises(CalibrationError, match="a part of 640 x 480"):
        cropped(PHONE, 500, 0, 300, 200)
    with pytest.raises(CalibrationError, match="one size"):
        projection_difference(PHONE, part)


def test_distortion_splits_into_its_parts():
    xy, radial, tangential = distortion(PHONE)
    flat = (xy - [PHONE.cx, PHONE.cy]) / [PHONE.fx, PHONE.fy]
    assert np.allclose(radial + tangential, PHONE.pixels(flat) - xy)
    along = (radial[:, 0] / PHONE.fx * flat[:, 1]) - (radial[:, 1] / PHONE.fy * flat[:, 0])
    assert np.abs(along).max() < 1e-12  # towards the centre
    assert np.abs(distortion(replace(PHONE, distortion=()))[1]).max() < 1e-9


def test_folded_distortion_has_no_direction():
    folds = Camera(640, 480, 400.0, 400.0, 319.5, 239.5, distortion=(-0.5, 0.0, 0.0, 0.0))
    corners = np.array([[319.5, 239.5], [0.0, 0.0]])
    assert invertible(folds, corners).tolist() == [True, False]
    assert invertible(PHONE, corners).all()
    assert exp(np.zeros(3)).shape == (3, 3)
