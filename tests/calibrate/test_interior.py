"""Interior orientation: exact on exact corners, its sigmas by Monte Carlo, refusals by name."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from boards import PHONE, exact_views, noisy, poses, theta_of
from simulated import Coverage

from smartnav_graph.calibrate.interior import MODELS, BoardView, calibrate_camera, project_board
from smartnav_graph.core.errors import CalibrationError
from smartnav_graph.session.calibration.camera import Camera
from smartnav_graph.session.calibration.pieces import Value

SIZE = (PHONE.width, PHONE.height)
WIDE = replace(PHONE, model="fisheye", fx=350.0, fy=351.0, distortion=(0.05, -0.02, 0.01, -0.003))


@pytest.mark.parametrize(("model", "camera"), [("brown", PHONE), ("fisheye", WIDE)])
def test_exact_corners_give_the_exact_camera(model, camera):
    views = exact_views(poses(10, np.random.default_rng(0), camera, model=model), camera, model=model)
    found = calibrate_camera(views, SIZE, model)
    assert np.allclose(found.theta, theta_of(camera), rtol=1e-5, atol=1e-5)
    assert found.rms_px < 1e-6 and found.camera == replace(found.camera, width=640, height=480)


@pytest.mark.parametrize("model", MODELS)
def test_derivatives(model):
    """By theta and by the pose, against differences."""
    theta = np.concatenate([[400.0, 410.0, 320.0, 240.0], np.linspace(0.05, -0.04, len(MODELS[model]))])
    pose = np.array([0.2, -0.3, 0.1, -0.1, -0.05, 0.5])
    points = np.column_stack([np.random.default_rng(0).uniform(-0.1, 0.2, (6, 2)), np.zeros(6)])
    xy, A, B = project_board(model, theta, pose, points)
    for i, column in enumerate([*A.T, *B.T]):
        step = np.zeros(len(theta) + 6)
        step[i] = 1e-6
        moved, _, _ = project_board(model, theta + step[: len(theta)], pose + step[len(theta) :], points)
        assert np.allclose((moved - xy).ravel() / 1e-6, column, rtol=1e-3, atol=1e-3)


def covered(seeds, views=12):
    """By parameter."""
    count = Coverage()
    for seed in seeds:
        rng = np.random.default_rng(seed)
        found = calibrate_camera(noisy(exact_views(poses(views, rng)), 0.2, rng), SIZE)
        for name, value, sigma, true in zip(found.names, found.theta, found.sigmas, theta_of(PHONE), strict=True):
            count.add(name, Value(value, sigma, ""), true)
    return count


def deviations(seeds, views=12, sigma=0.2, smooth=0.0):
    """Errors of theta over their sigmas (n, 9)."""
    out = []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        found = calibrate_camera(noisy(exact_views(poses(views, rng)), sigma, rng, smooth), SIZE)
        out.append((found.theta - theta_of(PHONE)) / found.sigmas)
    return np.array(out)


@pytest.mark.slow
def test_distortion_is_inside_its_interval_in_95_of_100():
    """Five parameters of the thesis' camera over 100 seeds."""
    inside = np.abs(deviations(100)) < 1.96
    assert 0.92 <= inside[:, 4:].mean() <= 0.98
    assert 0.92 <= inside.mean() <= 0.98
    assert (inside.mean(axis=0) >= 0.88).all()  # one parameter alone: 95 % within three of its binomial sigmas


@pytest.mark.slow
def test_alike_errors_within_a_view_widen_the_sigmas():
    """Corners of a view err together: twice the white noise over a third of the board."""
    inside = np.abs(deviations(100, sigma=0.1, smooth=0.2)) < 1.96
    assert 0.92 <= inside.mean() <= 0.98
    assert (inside.mean(axis=0) >= 0.85).all()


def test_sigmas_cover_in_a_few_seeds():
    """Root mean square of errors over sigmas: 1; too small by two would be seen."""
    spread = np.sqrt((deviations(12) ** 2).mean())
    assert 0.7 < spread < 1.4
    spread = np.sqrt((deviations(12, sigma=0.1, smooth=0.2) ** 2).mean())
    assert 0.6 < spread < 1.4


def test_noise_and_independence_are_estimated():
    rng = np.random.default_rng(3)
    exact = exact_views(poses(15, rng))
    white, smooth = (calibrate_camera(noisy(exact, 0.2, rng, s), SIZE) for s in (0.0, 0.4))
    assert white.noise_px == pytest.approx(0.2, rel=0.1)
    assert white.inflation < 1.6 and smooth.inflation > 3.0


def test_an_outlier_is_left_out_with_its_reason():
    rng = np.random.default_rng(4)
    views = noisy(exact_views(poses(12, rng)), 0.2, rng)
    bad = views[5]
    views[5] = replace(bad, xy=bad.xy + 3.0 * rng.standard_normal(bad.xy.shape))
    found = calibrate_camera(views, SIZE)
    assert [name for name, _ in found.left_out] == ["5"] and "times the median" in found.left_out[0][1]
    assert np.abs((found.theta - theta_of(PHONE)) / found.sigmas).max() < 4.0
    kept = calibrate_camera(views, SIZE, keep=True)
    assert not kept.left_out and len(kept.views) == 12
    assert not calibrate_camera(noisy(exact_views(poses(12, rng)), 0.2, rng), SIZE).left_out


def test_too_few_or_alike_views_are_refused():
    rng = np.random.default_rng(5)
    views = noisy(exact_views(poses(8, rng)), 0.1, rng)
    with pytest.raises(CalibrationError, match=r"board in 3 pictures.*15 to 30"):
        calibrate_camera(views[:3], SIZE)
    alike = noisy([views[0]] * 6, 0.1, rng)
    with pytest.raises(CalibrationError, match=r"6 views, of which 1 differ.*move and tilt"):
        calibrate_camera(alike, SIZE)


def test_one_orientation_of_the_board_is_refused():
    """Parallel to the picture, at many places and distances, turned within its plane: the focal length is open."""
    rng = np.random.default_rng(6)
    found = poses(15, rng, tilt=2.0)
    with pytest.raises(
        CalibrationError, match=r"one orientation of the board.*tilt the board|f[xy] of model brown.*tilt the board"
    ):
        calibrate_camera(noisy(exact_views(found), 0.1, rng), SIZE)


def test_terms_that_the_views_do_not_determine_are_named():
    """A narrow lens: the eight terms of the rational model replace each other."""
    rng = np.random.default_rng(7)
    views = noisy(exact_views(poses(15, rng)), 0.2, rng)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(CalibrationError, match=r"k\d of model rational .*fewer terms"):
            calibrate_camera(views, SIZE, "rational")


def test_a_camera_is_as_calibration_toml_holds_it():
    views = exact_views(poses(8, np.random.default_rng(8)))
    found = calibrate_camera(views, SIZE)
    assert isinstance(found.camera, Camera)
    pose = found.poses[0]
    seen, _, _ = project_board("brown", found.theta, pose, views[0].points)
    R = pose[:3]
    assert isinstance(views[0], BoardView) and R.shape == (3,) and np.allclose(seen, views[0].xy, atol=1e-5)
