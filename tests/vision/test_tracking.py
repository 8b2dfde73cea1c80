"""Corners followed through turns, by the gyroscope and without it."""

import itertools
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scenes2d import CAMERA, centred, moved, seen, texture, turning
from scipy.spatial.transform import Rotation

from smartnav_graph.session.calibration.camera import Camera
from smartnav_graph.session.streams import Imu
from smartnav_graph.vision import tracking
from smartnav_graph.vision.tracking import Gyro, Tracker

PLANE = texture(seed=3, size=1200, grain=1.0)
FIRST = centred(PLANE)
# camera axes in the body's: the phone's back camera, whose x is the body's y, and which looks along -z
BODY_R_CAM = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


def imu_of(rate: np.ndarray, seconds: float = 1.0, hz: int = 200) -> Imu:
    t_ns = np.arange(int(seconds * hz) + 1) * (10**9 // hz)
    return Imu(t_ns=t_ns, gyro=np.tile(rate, (len(t_ns), 1)), accel=np.tile([0, 0, 9.81], (len(t_ns), 1)))


def test_the_gyro_integrates_a_constant_rate_exactly():
    rate = np.array([0.3, -0.5, 0.9])
    gyro = Gyro.of(imu_of(rate))
    for t0, t1 in ((0, 1_000_000_000), (3_000_000, 411_700_000), (700_000_000, 200_000_000)):
        expected = Rotation.from_rotvec(rate * (t1 - t0) / 1e9).as_matrix()
        np.testing.assert_allclose(gyro.turn(t0, t1), expected, atol=1e-12)
    assert gyro.turn(-1, 5) is None and gyro.turn(5, 1_000_000_001) is None


def test_the_gyro_keeps_the_order_of_turns():
    first, second = np.array([0.0, 0.0, np.pi]), np.array([np.pi, 0.0, 0.0])
    imu = imu_of(first)
    rates = np.where(imu.t_ns[:, None] < 500_000_000, first, second)
    turn = Gyro.of(Imu(t_ns=imu.t_ns, gyro=rates, accel=imu.accel)).turn(0, 1_000_000_000)
    expected = Rotation.from_rotvec(first / 2) * Rotation.from_rotvec(second / 2)  # body axes: on the right
    off = (Rotation.from_matrix(turn).inv() * expected).magnitude()
    assert off < 0.03  # rad: the one step between the two, at pi rad/s


def follow(c1_R_c0: np.ndarray, known: bool, camera: Camera = CAMERA) -> tuple[np.ndarray, np.ndarray]:
    """Where 60 corners should be, and are found, after a turn."""
    before, now = (seen(PLANE, H, camera) for H in (FIRST, turning(c1_R_c0, camera) @ FIRST))
    px = cv2.goodFeaturesToTrack(before, 150, 0.01, 8)[:, 0].astype(float)
    truth = moved(turning(c1_R_c0, camera), px)
    stay = ((truth > 15) & (truth < [camera.width - 16, camera.height - 16])).all(axis=1)
    found, kept = tracking.follow(before, now, px[stay], camera, c1_R_c0 if known else None)
    return np.linalg.norm(found - truth[stay], axis=1), kept


@pytest.mark.parametrize("axis", ["y", "x", "z"])
def test_ten_degrees_between_pictures_need_the_gyroscope(axis):
    R = Rotation.from_euler(axis, 10, degrees=True).as_matrix()
    miss, kept = follow(R, known=True)
    assert len(miss) > 40 and kept.mean() > 0.8
    worst = (
        0.5 if axis == "z" else 0.2
    )  # px; about the viewing direction patches themselves turn, by a pixel at the rim
    assert np.median(miss[kept]) < worst and np.percentile(miss[kept], 90) < 2 * worst
    if axis == "z":  # about the viewing direction the middle hardly moves
        return
    miss, kept = follow(R, known=False)
    assert (kept & (miss < 1.0)).mean() < 0.1


def test_the_wrong_sense_of_the_turn_fails():
    R = Rotation.from_euler("y", 10, degrees=True).as_matrix()
    before, now = (seen(PLANE, H) for H in (FIRST, turning(R) @ FIRST))
    px = cv2.goodFeaturesToTrack(before, 150, 0.01, 8)[:, 0].astype(float)
    found, kept = tracking.follow(before, now, px, CAMERA, R.T)
    miss = np.linalg.norm(found - moved(turning(R), px), axis=1)
    assert (kept & (miss < 1.0)).mean() < 0.1


@pytest.mark.parametrize("offset_s", [0.0, 0.1])
def test_a_tracker_turns_the_gyroscope_into_the_cameras_axes(offset_s, monkeypatch):
    """A body that turns about its y at 40 deg/s, 0.25 s between pictures; its gyroscope's clock is ahead."""
    rate = np.radians([0.0, 40.0, 0.0])
    imu = imu_of(rate)
    still = imu.t_ns < round(offset_s * 1e9)
    imu = Imu(t_ns=imu.t_ns, gyro=np.where(still[:, None], 0.0, imu.gyro), accel=imu.accel)
    body = Rotation.from_rotvec(rate * 0.25).as_matrix()  # b0_R_b1
    c1_R_c0 = BODY_R_CAM.T @ body.T @ BODY_R_CAM
    camera = replace(CAMERA, time_offset_s=offset_s)
    reported = []
    real = tracking.follow
    monkeypatch.setattr(tracking, "follow", lambda *arguments: reported.append(arguments[-1]) or real(*arguments))
    tracker = Tracker(camera, BODY_R_CAM, Gyro.of(imu), 120, itertools.count(7))
    ids, px = tracker.step(seen(PLANE, FIRST), 0)
    assert ids.tolist() == list(range(7, 7 + len(ids))) and len(ids) > 60
    ids_1, px_1 = tracker.step(seen(PLANE, turning(c1_R_c0) @ FIRST), 250_000_000)
    np.testing.assert_allclose(reported, [c1_R_c0], atol=1e-12)
    both, at, at_1 = np.intersect1d(ids, ids_1, return_indices=True)
    miss = np.linalg.norm(moved(turning(c1_R_c0), px[at]) - px_1[at_1], axis=1)
    assert len(both) > 40 and np.median(miss) < 0.2
    assert (tracker.predicted, tracker.blind) == (1, 0)
    assert len(ids_1) > len(both) and ids_1.max() > ids.max()  # new corners where the picture is new


def test_new_corners_keep_their_distance():
    tracker = Tracker(CAMERA, np.eye(3), None, 100, itertools.count())
    _, px = tracker.step(seen(PLANE, FIRST), 0)
    apart = np.linalg.norm(px[:, None] - px[None], axis=2) + 1e9 * np.eye(len(px))
    assert apart.min() > 0.55 * np.sqrt(CAMERA.width * CAMERA.height / 100)
    _, again = tracker.step(seen(PLANE, FIRST), 1)
    np.testing.assert_allclose(again[: len(px)], px, atol=0.05)
    assert len(again) <= 100 and tracker.blind == 1


def test_points_turned_behind_the_camera_are_searched_where_they_were():
    px = np.array([[10.0, 20.0], [300.0, 200.0]])
    back = Rotation.from_euler("y", 170, degrees=True).as_matrix()
    np.testing.assert_array_equal(tracking.rotated(px, CAMERA, back), px)
    np.testing.assert_array_equal(tracking.rotated(px, CAMERA, None), px)
