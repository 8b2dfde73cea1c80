"""Rendered pictures: where points are, what a detector finds in them, rolling shutter, blur, noise."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smartnav_graph.core.errors import ConfigError
from smartnav_graph.session import folder as session_folder
from smartnav_graph.session.calibration.camera import Camera
from smartnav_graph.simulation import cameras, recording, render
from smartnav_graph.simulation.cameras import PictureModel, SimulatedCamera
from smartnav_graph.simulation.scenarios import SCENARIOS
from smartnav_graph.simulation.scenes import Box, Scene, make_scene
from smartnav_graph.simulation.trajectory import Leg, Legs, Trajectory

SCENARIO = SCENARIOS["rendered-room-10s"]
MODEL = SCENARIO.camera
TRAJECTORY = SCENARIO.motion(12.0, np.random.default_rng(0))
SCENE = MODEL.scene(np.random.default_rng(0))
CLEAN = PictureModel(noise=0.0)


@pytest.fixture(scope="module")
def painted():
    return render.Painted.of(SCENE, CLEAN, np.random.default_rng(1))


@pytest.fixture(scope="module")
def ray():
    return render.pixel_rays(MODEL.camera)


def shot(painted, ray, t, model=MODEL, how=CLEAN):
    return (255 * render.picture(model, TRAJECTORY, painted, ray, t, how)).astype(np.uint8)


def detected(one, other, make):
    """Normalised coordinates of ratio-tested matches of two pictures."""
    detector = make()
    norm = cv2.NORM_L2 if make is cv2.SIFT_create else cv2.NORM_HAMMING
    (k0, d0), (k1, d1) = (detector.detectAndCompute(picture, None) for picture in (one, other))
    pairs = [p for p in cv2.BFMatcher(norm).knnMatch(d0, d1, k=2) if p[0].distance < 0.7 * p[1].distance]
    px = [[k0[p[0].queryIdx].pt for p in pairs], [k1[p[0].trainIdx].pt for p in pairs]]
    return [MODEL.camera.normalised(np.array(points)) for points in px]


@pytest.mark.parametrize("make", [cv2.SIFT_create, lambda: cv2.ORB_create(1500)], ids=["sift", "orb"])
def test_what_detectors_match_agrees_with_the_true_motion(painted, ray, make):
    """Two frames 0.4 s and 0.2 m apart, of two walls, the floor and a cupboard."""
    t = np.array([9.0, 9.4])
    x0, x1 = detected(*(shot(painted, ray, at) for at in t), make)
    assert len(x0) > 150
    (R0, R1), (p0, p1) = MODEL.poses(TRAJECTORY, t)
    R, baseline = R0.T @ R1, R0.T @ (p1 - p0)
    assert np.linalg.norm(baseline) > 0.15
    one, other = (np.column_stack([x, np.ones(len(x))]) for x in (x0, x1))
    ahead, back = np.cross(baseline, other @ R.T), np.cross(one, baseline) @ R
    miss = (one * ahead).sum(axis=1) / np.sqrt((ahead[:, :2] ** 2).sum(axis=1) + (back[:, :2] ** 2).sum(axis=1))
    assert np.median(np.abs(miss)) * MODEL.camera.focal < 0.5  # px
    E, mask = cv2.findEssentialMat(x0, x1, np.eye(3), cv2.USAC_MAGSAC, 0.999, 1.5 / MODEL.camera.focal)
    _, found, direction, _ = cv2.recoverPose(E, x0, x1, np.eye(3), mask=mask)
    assert np.degrees(Rotation.from_matrix(found @ R).magnitude()) < 0.2  # cv2 gives c1_R_c0
    angle = np.degrees(np.arccos(np.clip(-(found.T @ direction)[:, 0] @ baseline / np.linalg.norm(baseline), -1, 1)))
    assert angle < 3.0


def test_pixels_and_points_agree(painted, ray):
    """A point of the cloud lies on the face, and at the place of it, that its pixel sees."""
    shown = cameras.project(MODEL, TRAJECTORY, SCENE, 7.0)
    R, centre = MODEL.poses(TRAJECTORY, np.full(480, 7.0))
    hit = render._cast(SCENE, centre, ray @ np.swapaxes(R, 1, 2))
    x, y = np.rint(shown.xy_px).astype(int).T
    face, a, b = hit.face[y, x], hit.a[y, x], hit.b[y, x]
    place = SCENE.corner[face] + a[:, None] * SCENE.u[face] + b[:, None] * SCENE.v[face]
    away = np.linalg.norm(place - SCENE.points[shown.rows], axis=1)
    assert (face == SCENE.face[shown.rows]).mean() > 0.98
    assert np.median(away) < 0.01 and np.percentile(away, 95) < 0.06  # m; half a pixel, on slanting faces more


def test_each_row_of_a_rolling_shutter_has_its_own_time(painted, ray):
    rolling = replace(MODEL, camera=replace(MODEL.camera, readout_s=0.03))
    bent = shot(painted, ray, 8.0, rolling)
    for row in (0, 240, 479):
        at = 8.0 + 0.03 * row / 479
        np.testing.assert_array_equal(bent[row], shot(painted, ray, at)[row])
    assert np.abs(bent[479].astype(int) - shot(painted, ray, 8.0)[479]).mean() > 10.0


def turning(rate_deg_s: float) -> Trajectory:
    """On the spot, at its highest rate after half a second."""
    return Trajectory(Legs([Leg(1.0, 0.0, rate_deg_s / 1.875)]))


def wall(ray_model: SimulatedCamera) -> tuple[Scene, render.Painted]:
    scene = make_scene([Box((-3.0, -3.0, -2.0), (3.0, 3.0, 2.0), inward=True)], 1.0, np.random.default_rng(0))
    return scene, render.Painted.of(scene, CLEAN, np.random.default_rng(5))


def test_blur_smears_along_the_turn_and_only_along_it():
    """40 deg/s to the left over 50 ms: 2 deg, or 17 px of 500 px focal length, sideways."""
    camera = Camera(width=320, height=240, fx=500.0, fy=500.0, cx=159.5, cy=119.5)
    model = SimulatedCamera(camera=camera, scene=MODEL.scene)
    _, painted = wall(model)
    ray = render.pixel_rays(camera)
    still, blurred = (
        render.picture(model, turning(40.0), painted, ray, 0.5, replace(CLEAN, exposure_s=s, blur_steps=16))
        for s in (0.0, 0.05)
    )
    across, down = (np.abs(np.diff(blurred, axis=k)).mean() / np.abs(np.diff(still, axis=k)).mean() for k in (1, 0))
    assert across < 0.35 and across < 0.7 * down
    smeared = cv2.blur(still, (17, 1))[:, 20:-20]
    alike = [np.corrcoef(smeared.ravel(), np.roll(blurred, k, axis=1)[:, 20:-20].ravel())[0, 1] for k in (-4, 0, 4)]
    assert alike[1] > 0.99 and alike[1] > max(alike[0], alike[2])


def test_noise_is_white_and_as_reported(painted, ray):
    how = replace(CLEAN, noise=3.0)
    exact = 255 * render.picture(MODEL, TRAJECTORY, painted, ray, 7.0, how)
    (noisy,) = render.render_pictures(MODEL, TRAJECTORY, painted, np.array([7.0]), how, np.random.default_rng(2))
    inside = (exact > 15) & (exact < 240)
    off = (noisy - exact)[inside]
    assert off.std() == pytest.approx(np.hypot(3.0, np.sqrt(1 / 12)), rel=0.01) and abs(off.mean()) < 0.05


def test_textures_use_the_grey_levels_and_differ_by_seed():
    one, again, other = (render.Painted.of(SCENE, CLEAN, np.random.default_rng(s)).textures[0] for s in (1, 1, 2))
    np.testing.assert_array_equal(one, again)
    assert one.min() == 0.0 and one.max() == 1.0 and 0.15 < one.std() < 0.25
    assert abs(np.corrcoef(one.ravel(), other.ravel())[0, 1]) < 0.2


def test_a_written_scenario_has_its_pictures(tmp_path):
    short = replace(SCENARIO, seconds=0.4)
    made = recording.simulate_to_folder(short, 0, tmp_path / "s")
    back = session_folder.load(tmp_path / "s")
    assert back.images.file.tolist() == made.images.file.tolist() == [f"{i:06d}.png" for i in range(4)]
    pictures = [cv2.imread(str(tmp_path / "s" / "images" / name), cv2.IMREAD_UNCHANGED) for name in back.images.file]
    for picture, shown in zip(pictures, recording.shots(short, 0), strict=True):
        np.testing.assert_array_equal(picture, shown)
    assert pictures[0].shape == (480, 640) and back.tracks is None


def test_exposure_and_readout_stand_in_the_images():
    model = replace(MODEL, camera=replace(MODEL.camera, readout_s=0.02), pictures=PictureModel(exposure_s=0.01))
    images = replace(SCENARIO, seconds=0.5, camera=model)(0).images
    assert set(images.exposure_ns) == {10_000_000} and set(images.readout_ns) == {20_000_000}


def test_a_scenario_without_pictures_has_none_to_show():
    with pytest.raises(ConfigError, match="room-30s renders no pictures; expected a scenario whose camera does"):
        next(recording.shots(SCENARIOS["room-30s"], 0))
    with pytest.raises(ConfigError, match="blur_steps = 1; expected at least 2"):
        PictureModel(blur_steps=1)
    with pytest.raises(ConfigError, match="expected texels and contrast"):
        PictureModel(contrast=1.5)
