"""Simulated cameras: projection by hand, correct noise, declared faults, and errors unknown to the session."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import smartnav_graph as sn
from smartnav_graph.core.errors import ConfigError
from smartnav_graph.core.timebase import NS
from smartnav_graph.session.calibration.camera import Camera
from smartnav_graph.simulation import cameras, motions
from smartnav_graph.simulation.cameras import Faults, SimulatedCamera
from smartnav_graph.simulation.scenarios import SCENARIOS
from smartnav_graph.simulation.scenes import FurnishedRoom

ROOM = SCENARIOS["room-30s"]
EXACT = replace(ROOM.camera, pairs=(1, 2), faults=Faults())


def recorded(seed: int = 0, seconds: float = 12.0, **changes: object) -> sn.Session:
    """The first seconds of the room with another camera."""
    return replace(ROOM, seconds=seconds, camera=replace(EXACT, **changes))(seed)


def relative(session: sn.Session, model: SimulatedCamera, matches: object) -> tuple[np.ndarray, np.ndarray]:
    """True c0_R_c1 and c0_t_c1 of each match, by the exact motion."""
    trajectory = motions.in_a_room(12.0, np.random.default_rng(0))
    pose = [model.poses(trajectory, session.seconds(t) + model.offset_s) for t in (matches.t_ns, matches.t_1_ns)]
    (R0, p0), (R1, p1) = pose
    back = np.swapaxes(R0, 1, 2)
    return back @ R1, np.einsum("nij,nj->ni", back, p1 - p0)


def misses(session: sn.Session, model: SimulatedCamera = EXACT) -> tuple[np.ndarray, np.ndarray]:
    """Whitened distance (n,) of every match from the true epipolar geometry, and the length of the baseline."""
    found = session.matches
    R, t = relative(session, model, found)
    one, other = (np.column_stack([xy, np.ones(len(xy))]) for xy in (found.xy0_n, found.xy1_n))
    ahead = np.cross(t, np.einsum("nij,nj->ni", R, other))  # E x1
    back = np.einsum("nji,nj->ni", R, np.cross(one, t))  # E^T x0
    slope = np.sqrt((ahead[:, :2] ** 2).sum(axis=1) + (back[:, :2] ** 2).sum(axis=1))
    r = (one * ahead).sum(axis=1) / np.maximum(slope, 1e-12)
    return r / model.camera.noise, np.linalg.norm(t, axis=1)


def test_the_camera_sees_what_projection_by_hand_says():
    """A point two metres ahead, one to the right and half a metre up of a level camera with a lever arm."""
    session, model = recorded(), EXACT
    trajectory = motions.in_a_room(12.0, np.random.default_rng(0))
    scene = model.scene(np.random.default_rng(0))
    truth = trajectory.sample([7.0])
    nav_R_body, p = truth.nav_R_body[0], truth.nav_t_body[0]
    body_point = np.array([1.0, 2.0, 0.5]) + model.mount.body_t
    alone = replace(
        scene, points=(p + nav_R_body @ body_point)[None], face=np.zeros(1, dtype=int), visible_m=np.array([9.0])
    )
    alone = replace(
        alone, corner=p[None] + nav_R_body @ [0, 9.0, 0], u=nav_R_body[None, :, 0], v=nav_R_body[None, :, 2]
    )
    shown = cameras.project(model, trajectory, alone, 7.0)
    flat = np.array([[1.0 / 2.0, -0.5 / 2.0]])
    np.testing.assert_allclose(shown.xy_px, model.camera.pixels(flat), atol=1e-9)
    assert session.sensors["cam0"] == model.mount and session.calibration.cameras == {"cam0": model.camera}


def test_inliers_miss_the_epipolar_geometry_by_the_noise():
    session = recorded()
    r, baseline = misses(session)
    moved = r[baseline > 0.04]
    # distortion stretches the pixel by a few percent from place to place, and the noise of one pixel with it
    assert (moved**2).mean() == pytest.approx(1.0, abs=0.1)
    assert len(moved) > 2000 and session.matches.extra["truth_inlier"].all()
    spans = np.unique(session.matches.image_id_1 - session.matches.image_id_0)
    np.testing.assert_array_equal(spans, [1, 2])


def test_outliers_are_marked_and_as_many_as_reported():
    session = recorded(faults=Faults(outliers=(0.2, 0.2)))
    bad = session.matches.extra["truth_inlier"] == 0
    assert bad.mean() == pytest.approx(0.2, abs=0.01)
    r, baseline = misses(session)
    assert np.median(np.abs(r[bad & (baseline > 0.04)])) > 20.0
    assert np.abs(r[~bad & (baseline > 0.04)]).max() < 5.0


def test_a_glitch_moves_one_frame_and_spoils_its_matches():
    session = recorded(faults=Faults(glitches=((7.52, 17.0),)))
    bad = session.tracks.extra["truth_inlier"] == 0
    np.testing.assert_array_equal(bad, session.tracks.image_id == 75)
    found = session.matches
    np.testing.assert_array_equal(found.extra["truth_inlier"] == 0, (found.image_id_0 == 75) | (found.image_id_1 == 75))
    r, _ = misses(session)
    assert np.median(np.abs(r[found.extra["truth_inlier"] == 0])) > 10.0  # 17 px of 0.5, across the epipolar lines


def test_in_the_dark_there_are_images_but_no_features():
    session = recorded(faults=Faults(blind=((4.0, 1.0),)))
    t = session.seconds(session.tracks.t_ns)
    assert not ((t >= 4.0) & (t < 5.0)).any() and len(session.images) == 120


def test_tracks_follow_one_point_and_end_when_lost():
    session = recorded(faults=Faults(lost=0.1))
    tracks = session.tracks
    count = np.bincount(tracks.image_id)
    assert count.min() >= 20 and count.max() <= 60
    length = np.bincount(tracks.track_id)
    assert 3.0 < length.mean() < 10.0  # out of sight, or one frame in ten
    last = np.maximum.reduceat(
        tracks.image_id[np.argsort(tracks.track_id, kind="stable")], np.cumsum([0, *length[:-1]])
    )
    first = np.minimum.reduceat(
        tracks.image_id[np.argsort(tracks.track_id, kind="stable")], np.cumsum([0, *length[:-1]])
    )
    np.testing.assert_array_equal(last - first + 1, length)
    np.testing.assert_allclose(EXACT.camera.normalised(tracks.xy_px), tracks.xy_n, atol=1e-12)


def test_a_wrong_boresight_and_clock_are_in_the_images_and_not_in_the_session():
    wrong = replace(EXACT, boresight_deg=(0.0, 0.5, 0.0), clock_s=0.02)
    session, straight = recorded(boresight_deg=(0.0, 0.5, 0.0), clock_s=0.02), recorded()
    assert session.sensors == straight.sensors and session.calibration == straight.calibration
    np.testing.assert_array_equal(session.images.t_ns, straight.images.t_ns)
    r, baseline = misses(session, wrong)
    moved = baseline > 0.04
    assert (r[moved] ** 2).mean() == pytest.approx(1.0, abs=0.1)
    assumed, _ = misses(session, EXACT)
    assert (assumed[moved] ** 2).mean() > 1.5
    R, _ = wrong.poses(motions.in_a_room(12.0, np.random.default_rng(0)), np.array([5.0]))
    R0, _ = EXACT.poses(motions.in_a_room(12.0, np.random.default_rng(0)), np.array([5.0]))
    np.testing.assert_allclose(Rotation.from_matrix(R0[0].T @ R[0]).as_rotvec(degrees=True), [0.0, 0.5, 0.0], atol=1e-9)


def test_a_known_offset_is_reported():
    camera = replace(EXACT.camera, time_offset_s=0.05)
    session = recorded(camera=camera)
    r, baseline = misses(session, replace(EXACT, camera=camera))
    assert (r[baseline > 0.04] ** 2).mean() == pytest.approx(1.0, abs=0.1)
    assert session.calibration.cameras["cam0"].time_offset_s == 0.05


def test_rows_of_a_rolling_shutter_show_their_own_time():
    """Each point is where a global shutter would show it at the time of its row."""
    rolling = replace(EXACT, camera=replace(EXACT.camera, readout_s=0.03))
    trajectory = motions.in_a_room(12.0, np.random.default_rng(0))
    scene = EXACT.scene(np.random.default_rng(3))
    shown = cameras.project(rolling, trajectory, scene, 8.0)
    moved = []
    for row, xy in list(zip(shown.rows, shown.xy_px, strict=True))[::40]:
        at = 8.0 + 0.03 * xy[1] / (EXACT.camera.height - 1)
        still = cameras.project(EXACT, trajectory, scene, at)
        there = still.xy_px[still.rows == row]
        if len(there):
            np.testing.assert_allclose(there[0], xy, atol=0.01)  # px
            first = cameras.project(EXACT, trajectory, scene, 8.0)
            moved += [np.linalg.norm(first.xy_px[first.rows == row][0] - xy)] if (first.rows == row).any() else []
    assert max(moved) > 2.0


def test_features_do_not_change_the_rest_of_a_recording():
    with_camera, without = replace(ROOM, seconds=5.0)(4), replace(ROOM, seconds=5.0, camera=None)(4)
    np.testing.assert_array_equal(with_camera.imu.gyro, without.imu.gyro)
    assert without.images is None and "cam0" not in without.sensors


def test_the_same_seed_gives_the_same_features_and_another_others():
    one, again, other = (replace(ROOM, seconds=5.0)(seed) for seed in (4, 4, 5))
    np.testing.assert_array_equal(one.tracks.xy_n, again.tracks.xy_n)
    assert len(one.tracks) != len(other.tracks) or not np.array_equal(one.tracks.xy_n, other.tracks.xy_n)


def test_the_room_has_tracks_in_every_image():
    session = ROOM(0)
    count = np.bincount(session.tracks.image_id)
    assert len(session.images) == len(count) == 300 and count.min() >= 20 and count.max() <= 60
    np.testing.assert_array_equal(np.diff(session.images.t_ns), NS // 10)
    assert np.isin(session.images.t_ns, session.reference.t_ns).all()
    np.testing.assert_allclose(session.reference.enu[0], 0.0, atol=1e-12)


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: Faults(outliers=(0.3, 0.1)), "expected shares from 0 to below 1"),
        (lambda: replace(EXACT, count=(5, 2)), "expected 0 < fewest <= most"),
        (lambda: replace(EXACT, pairs=(0,)), "expected spans of at least one image"),
    ],
)
def test_nonsense_is_refused(make, text):
    with pytest.raises(ConfigError, match=text):
        make()


def test_a_camera_before_a_bare_wall_sees_nothing_behind_it():
    small = SimulatedCamera(
        camera=Camera(width=640, height=480, fx=500.0, fy=500.0, cx=320.0, cy=240.0),
        scene=FurnishedRoom((2.0, 2.0, 2.0), per_m2=1.0),
        tracked=True,
        range_m=(0.3, 0.4),
    )
    session = replace(ROOM, seconds=2.0, camera=small)(0)
    assert session.tracks is None and len(session.images) == 20
