"""The scenario trolley-20min: its constants are frozen, and its figures are as declared."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smartnav_graph.core.timebase import NS
from smartnav_graph.simulation.recording import scenario_constants
from smartnav_graph.simulation.scenarios import SCENARIOS
from smartnav_graph.simulation.sensors import PROFILES

TROLLEY = SCENARIOS["trolley-20min"]

# Figures are compared with what was measured on these: a change makes another scenario, under another name.
FROZEN = {
    "seconds": 1200.0,
    "motion.turns": (
        *("LLRRRL", "LRLLRL", "LLRRRR", "RRLRLL", "LRRRRL"),
        *("RLRRLR", "RLRRLR", "RLRRRL", "RLLLLR", "RRLLRL"),
    ),
    "motion.spacing_m": 8.016,
    "motion.rest_s": 180.0,
    "motion.stop_s": 10.0,
    "motion.ramp_s": 2.0,
    "motion.turn_s": 3.9,
    "motion.halt_s": 0.8,
    "motion.speed_m_s": 1.0,
    "motion.corner_m_s": 0.6,
    "motion.fidget_m_s": 4e-4,
    "motion.creep_m_s": 1.5e-4,
    "motion.creep_rad_s": 3.5e-5,
    "vehicle": "none",
    "profile": "galaxy-s2-warming",
    "camera.camera.width": 640,
    "camera.camera.height": 480,
    "camera.camera.fx": pytest.approx(575.61569),
    "camera.camera.fy": pytest.approx(577.27059),
    "camera.camera.cx": pytest.approx(317.04902),
    "camera.camera.cy": pytest.approx(241.55882),
    "camera.camera.distortion": (0.228, -0.973, -2.32e-4, -1.29e-3, 0.951),
    "camera.camera.noise_px": 0.7,
    "camera.scene.nodes": (5, 5),
    "camera.scene.spacing_m": 8.016,
    "camera.scene.width_m": 3.0,
    "camera.scene.per_m2": 30.0,
    "camera.mount.body_t": (0.02, 0.05, -0.01),
    "camera.rate_hz": 1.25,
    "camera.count": (15, 60),
    "camera.pairs": (1, 2),
    "camera.range_m": (0.3, 40.0),
    "camera.faults.outliers": (0.1, 0.3),
    "camera.boresight_deg": (0.0, 0.0, 0.0),
    "camera.clock_s": 0.0,
    "rest_sigma_m_s": 5e-4,
    "noise.accel_noise_density": pytest.approx(3.77019e-3),
    "noise.gyro_noise_density": pytest.approx(2.625313e-4),
    "noise.accel_bias_walk": 3e-4,
    "noise.gyro_bias_walk": 1e-4,
    "noise.accel_bias_sigma": 0.24,
    "noise.gyro_bias_sigma": 3e-3,
}


@pytest.fixture(scope="module")
def session():
    return TROLLEY(0)


@pytest.fixture(scope="module")
def truth():
    return TROLLEY.motion(1200.0, np.random.default_rng((0, 0)))


def test_its_constants_are_frozen():
    found = scenario_constants(TROLLEY)
    assert {name: found[name] for name in FROZEN} == FROZEN


def test_the_phone_is_the_galaxy_s2_but_for_the_drift_of_its_gyro():
    usual, warming = PROFILES["galaxy-s2"], PROFILES["galaxy-s2-warming"]
    assert replace(warming, gyro_bias_walk=usual.gyro_bias_walk) == usual
    assert warming.gyro_bias_walk * np.sqrt(1200.0) < 4.9e-3  # rad/s, the bias that was published


def test_three_minutes_of_rest_and_ten_stops_of_ten_seconds(session):
    length = (session.static.t_end_ns - session.static.t_ns) / NS
    assert length[0] == pytest.approx(180.0, abs=0.02)
    assert np.sum(np.abs(length - 10.0) < 0.1) == 10 and np.sum(np.abs(length - 0.8) < 0.02) == 80
    assert len(length) == 91 and session.seconds(session.static.t_end_ns)[-1] == pytest.approx(1200.0, abs=0.02)
    at = np.searchsorted(session.reference.t_ns, session.static.t_ns + 1)
    speed = np.linalg.norm(session.reference.velocity[at], axis=1)
    assert 1e-4 < np.sqrt((speed**2).mean()) < 1e-3  # m/s: nothing that people lean on is quite at rest


def test_it_starts_at_the_origin_facing_north_and_is_reported_no_position(session):
    np.testing.assert_allclose(session.reference.enu[0], 0.0, atol=2e-3)
    start = Rotation.from_quat(session.reference.quat[0, [1, 2, 3, 0]]).magnitude()
    assert start < 1e-9 and not session.absolute()


def test_it_stays_in_its_corridors(session):
    """Within 0.3 m of the lines of the grid."""
    spacing = TROLLEY.motion.spacing_m
    off = np.abs(session.reference.enu[:, :2] - spacing * np.rint(session.reference.enu[:, :2] / spacing)).min(axis=1)
    assert off.max() < 0.3
    assert np.linalg.norm(np.diff(session.reference.enu, axis=0), axis=1).sum() == pytest.approx(553.0, rel=0.01)


def test_every_pair_has_its_matches_and_outliers(session):
    matches = session.matches
    images = np.column_stack([matches.image_id_0, matches.image_id_1])
    pairs, pair, count = np.unique(images, axis=0, return_inverse=True, return_counts=True)
    span = pairs[:, 1] - pairs[:, 0]
    assert len(session.images) == 1500 and count.max() <= 60
    np.testing.assert_array_equal(np.diff(session.images.t_ns), 800_000_000)
    np.testing.assert_array_equal(np.unique(span), [1, 2])
    assert (span == 1).sum() == 1499 and count[span == 1].min() >= 15
    assert (span == 2).sum() > 1400 and (count < 15).sum() < 20  # turned on the spot, little is seen by both
    wrong = 1.0 - np.bincount(pair.ravel(), weights=matches.extra["truth_inlier"]) / count
    assert wrong[count >= 15].min() >= 0.1 - 0.5 / 15 and wrong[count >= 15].max() <= 0.3 + 0.5 / 15
    assert wrong.mean() == pytest.approx(0.2, abs=0.01)


def test_its_inliers_are_off_by_their_noise(session, truth):
    matches, model = session.matches, TROLLEY.camera
    good = matches.take(matches.extra["truth_inlier"] == 1)
    (R0, p0), (R1, p1) = (model.poses(truth, session.seconds(t)) for t in (good.t_ns, good.t_1_ns))
    R, t = np.swapaxes(R0, 1, 2) @ R1, np.einsum("nji,nj->ni", R0, p1 - p0)
    one, other = (np.column_stack([xy, np.ones(len(xy))]) for xy in (good.xy0_n, good.xy1_n))
    ahead, back = np.cross(t, np.einsum("nij,nj->ni", R, other)), np.einsum("nji,nj->ni", R, np.cross(one, t))
    slope = np.sqrt((ahead[:, :2] ** 2).sum(axis=1) + (back[:, :2] ** 2).sum(axis=1))
    moved = np.linalg.norm(t, axis=1) > 0.3
    miss = ((one * ahead).sum(axis=1)[moved] / slope[moved]) * model.camera.focal
    assert np.sqrt((miss**2).mean()) == pytest.approx(0.7, rel=0.02)  # px


def test_a_wrong_boresight_and_clock_are_not_reported(session):
    wrong = replace(TROLLEY, seconds=230.0, camera=replace(TROLLEY.camera, boresight_deg=(0.0, 0.5, 0.0), clock_s=0.02))
    other = wrong(0)
    assert other.sensors == session.sensors and other.calibration == session.calibration
    assert not np.array_equal(other.matches.xy0_n[:100], session.matches.xy0_n[:100])
