"""Pictures -> matches and tracks: which pairs, what is skipped and reported, the same for any number of threads."""

import threading
import time
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scenes2d import CAMERA, PERIOD_NS, centred, moved, png, seen, session_of, texture, turning
from scipy.spatial.transform import Rotation

from smartnav_graph import readers
from smartnav_graph.core.errors import ConfigError, SessionError
from smartnav_graph.session.session import Mount
from smartnav_graph.session.streams import Imu
from smartnav_graph.vision.front_end import FrontEndConfig, run_front_end
from smartnav_graph.vision.parallel import ordered, threads

PLANE = texture(seed=5, size=1200)
# each picture is the one before, turned and shifted
STEP = np.array([[0.999, -0.035, 9.0], [0.035, 0.999, -3.0], [1e-5, 0, 1.0]])
HOMOGRAPHIES = [np.linalg.matrix_power(STEP, k) @ centred(PLANE) for k in range(10)]
PICTURES = [seen(PLANE, H) for H in HOMOGRAPHIES]


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    return session_of(PICTURES, tmp_path_factory.mktemp("plain") / "s")


def test_matches_of_a_plane_agree_with_its_homographies(plain):
    found = run_front_end(plain, FrontEndConfig(count=300, spans=(1, 3)))
    matches, report = found.matches, found.report
    assert (report.pictures, report.used, report.pairs, report.empty_pairs) == (10, 10, 9 + 7, 0)
    assert report.matches == len(matches) > 16 * 60
    first, second = matches.image_id_0 - 10, matches.image_id_1 - 10
    np.testing.assert_array_equal(matches.t_ns, first * PERIOD_NS)
    np.testing.assert_array_equal(matches.t_1_ns, second * PERIOD_NS)
    assert set((second - first).tolist()) == {1, 3}
    for span in (1, 3):
        rows = second - first == span
        there = moved(np.linalg.matrix_power(STEP, span), CAMERA.pixels(matches.xy0_n[rows]))
        miss = np.linalg.norm(there - CAMERA.pixels(matches.xy1_n[rows]), axis=1)
        assert np.median(miss) < 1.0 and (miss < 2.0).mean() > 0.9  # px
    assert (matches.score <= 0.8).all()


def test_the_number_of_threads_changes_nothing(plain):
    one, other = (run_front_end(plain, FrontEndConfig(count=200), workers=n).matches for n in (1, 3))
    for name, column in one.columns().items():
        np.testing.assert_array_equal(column, other.columns()[name])


def test_neighbours_always_match_and_wider_pairs_within_the_time(plain):
    matches = run_front_end(plain, FrontEndConfig(count=200, spans=(1, 2, 4), longest_s=0.5)).matches
    spans = np.unique(matches.image_id_1 - matches.image_id_0)
    assert spans.tolist() == [1, 2]
    slow = plain.replace(images=plain.images.take(slice(None, None, 5)))  # 1.25 s apart
    matches = run_front_end(slow, FrontEndConfig(count=200, spans=(1, 2), longest_s=0.5)).matches
    assert set(zip(matches.image_id_0.tolist(), matches.image_id_1.tolist(), strict=True)) == {(10, 15)}


def test_the_rate_thins_and_is_reported(plain):
    report = run_front_end(plain, FrontEndConfig(count=200, rate_hz=2.0)).report
    assert (report.used, report.thinned) == (5, 5)
    assert "5 of 10 used, 5 left out to keep the rate; longest break 0.50 s" in report.to_text()


def test_the_policy_of_the_thesis_keeps_fifteen(plain):
    matches = run_front_end(plain, FrontEndConfig(count=300, policy="thesis", spans=(1,))).matches
    _, counts = np.unique(matches.image_id_0, return_counts=True)
    assert counts.max() == 15 and len(counts) == 9
    assert matches.score.min() == 1.0 and matches.score.max() <= 3.0


def test_every_fault_is_skipped_counted_and_reported(tmp_path):
    faulty = list(PICTURES)
    faulty[2] = None
    faulty[3] = png(PICTURES[3])[:2000]
    faulty[4] = PICTURES[4] // 40
    faulty[5] = PICTURES[5][:200]
    faulty[7] = PICTURES[6]
    session = session_of(faulty, tmp_path / "s")
    report = run_front_end(session, FrontEndConfig(count=200, spans=(1,))).report
    assert report.skipped == {
        "missing file": 1,
        "broken file": 1,
        "other size than calibrated": 1,
        "dark or without contrast": 1,
        "repeated": 1,
    }
    assert report.first["missing file"] == "002.png" and report.first["repeated"] == "007.png"
    assert (report.pictures, report.used, report.pairs) == (10, 5, 4)
    assert report.longest_break_s == 5 * 0.25  # from picture 1 to picture 6
    assert "1 missing file (first: 002.png); 1 broken file (first: 003.png)" in report.to_text()


def test_a_long_blur_is_skipped(tmp_path):
    kernel = np.eye(41, dtype=np.float32) / 41
    smeared = [cv2.filter2D(picture, -1, kernel) for picture in PICTURES]
    session = session_of([*PICTURES, *smeared[:8], *PICTURES[:2]], tmp_path / "s")
    report = run_front_end(session, FrontEndConfig(count=200, spans=(1,))).report
    assert report.skipped == {"blurred": 8}
    assert report.longest_break_s == 9 * 0.25


def test_pictures_of_an_unknown_camera_are_counted(plain):
    names = np.where(np.arange(10) % 2, "cam0", "cam1").astype(object)
    object.__setattr__(images := plain.images.take(slice(None)), "camera", names)
    report = run_front_end(plain.replace(images=images), FrontEndConfig(count=200, spans=(1,))).report
    assert report.skipped == {"camera without calibration": 5} and report.pairs == 4


def test_cameras_are_not_matched_with_each_other(plain):
    names = np.where(np.arange(10) % 2, "cam0", "cam1").astype(object)
    object.__setattr__(images := plain.images.take(slice(None)), "camera", names)
    both = replace(plain.calibration, cameras={"cam0": CAMERA, "cam1": CAMERA})
    matches = run_front_end(
        plain.replace(images=images, calibration=both), FrontEndConfig(count=200, spans=(1,))
    ).matches
    assert np.unique(matches.image_id_1 - matches.image_id_0).tolist() == [2]


def test_nothing_usable_is_an_error_that_counts(plain, tmp_path):
    with pytest.raises(SessionError) as caught:
        run_front_end(plain.replace(calibration=None))
    for part in ("no picture can be used of 10", "10 camera without calibration (first: 000.png)", "[cameras]"):
        assert part in str(caught.value)
    gone = plain.replace(pictures=tmp_path / "nowhere")
    with pytest.raises(SessionError, match="no picture can be used of 10; skipped: 10 missing file"):
        run_front_end(gone)
    alone = session_of(PICTURES[:1], tmp_path / "alone")
    with pytest.raises(SessionError, match="no match in 0 pairs of pictures of 1"):
        run_front_end(alone)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"features": "surf"}, "unknown features 'surf'"),
        ({"policy": "best"}, "--policy: 'best'"),
        ({"features": "klt", "policy": "thesis"}, "'thesis' with tracks"),
        ({"spans": ()}, "--spans"),
        ({"spans": (0, 1)}, "--spans"),
        ({"count": -1}, "--count: -1"),
        ({"longest_s": float("nan")}, "--longest: nan"),
        ({"rate_hz": -1.0}, "--rate: -1"),
    ],
)
def test_options_are_checked(options, message):
    with pytest.raises(ConfigError) as caught:
        FrontEndConfig(**options)
    assert message in str(caught.value)


def test_tracks_of_a_turning_camera(tmp_path):
    """30 deg/s and pictures every 0.25 s: the gyroscope leads, and the tracks are where the turn puts them."""
    rate = np.radians([0.0, 30.0, 0.0])
    turns = [Rotation.from_rotvec(-rate * 0.25 * k).as_matrix() for k in range(5)]  # ck_R_c0, body = camera
    pictures = [seen(PLANE, turning(R) @ centred(PLANE)) for R in turns]
    t_ns = np.arange(301) * 5_000_000
    imu = Imu(t_ns=t_ns, gyro=np.tile(rate, (301, 1)), accel=np.tile([0.0, -9.81, 0.0], (301, 1)))
    session = session_of(pictures, tmp_path / "s", imu=imu, sensors={"cam0": Mount()})
    found = run_front_end(session, FrontEndConfig(features="klt", count=100))
    tracks, report = found.tracks, found.report
    assert found.matches is None and report.blind == 0 and report.used == 5
    assert len(np.unique(tracks.track_id)) == report.tracks
    lengths = np.unique(tracks.track_id, return_counts=True)[1]
    assert lengths.min() == 2 and np.median(lengths) == report.median_track_length >= 3
    np.testing.assert_array_equal(tracks.t_ns, (tracks.image_id - 10) * PERIOD_NS)
    np.testing.assert_allclose(CAMERA.pixels(tracks.xy_n), tracks.xy_px, atol=1e-6)
    miss = []
    for k in range(4):
        a, b = (tracks.take(tracks.image_id == 10 + k + i) for i in (0, 1))
        _, ia, ib = np.intersect1d(a.track_id, b.track_id, return_indices=True)
        step = turning(turns[k + 1] @ turns[k].T)
        miss.append(np.linalg.norm(moved(step, a.xy_px[ia]) - b.xy_px[ib], axis=1))
    assert np.median(np.concatenate(miss)) < 0.15  # px
    blind = run_front_end(session.replace(imu=None), FrontEndConfig(features="klt", count=100)).report
    assert blind.blind == 4 and blind.lost_at_once > 2 * report.lost_at_once


def test_work_is_done_in_order_and_not_far_ahead():
    started, lock = [], threading.Lock()

    def work(i: int) -> int:
        with lock:
            started.append(i)
        time.sleep(0.001 * (i % 3))
        return i

    with threads(3) as pool:
        for i, result in enumerate(ordered(pool, work, iter(range(50)), ahead=5)):
            assert result == i and len(started) <= i + 5


def test_opencv_has_its_threads_back():
    def interrupted() -> None:
        with threads(2):
            assert cv2.getNumThreads() == 1
            raise KeyboardInterrupt

    cv2.setNumThreads(2)
    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert cv2.getNumThreads() == 2


@pytest.mark.parametrize(
    ("name", "pairs", "median", "skipped"),
    [("kitti_odometry06", 50, 395, 0), ("lund_door", 11, 699, 0), ("euroc_v101", 5, 1080, 89)],
)
def test_public_recordings(dataset, name, pairs, median, skipped):
    report = run_front_end(readers.read(dataset(name)), FrontEndConfig(spans=(1,), rate_hz=0.0)).report
    assert (report.pairs, report.empty_pairs, sum(report.skipped.values())) == (pairs, 0, skipped)
    assert report.median_matches == pytest.approx(median, rel=0.1)


def test_tracks_of_a_public_recording(dataset):
    found = run_front_end(readers.read(dataset("euroc_v101")), FrontEndConfig(features="klt"))
    assert found.report.used == 6 and found.report.blind == 0
    assert found.report.tracks == pytest.approx(300, abs=15)
    # it is still: corners stay within the shiver of the motors
    tracks = found.tracks
    for track in np.unique(tracks.track_id)[:50]:
        seen_at = tracks.xy_px[tracks.track_id == track]
        assert np.ptp(seen_at, axis=0).max() < 4.0  # px
