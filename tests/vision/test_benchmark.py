"""True matches by known poses: exact points, wrong poses, no baseline; and the table over pictures."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scenes2d import CAMERA, PERIOD_NS, seen, session_of, texture
from scipy.spatial.transform import Rotation

import smartnav_graph as sn
from smartnav_graph.cli import main
from smartnav_graph.cli.match_tasks import print_scores
from smartnav_graph.core.errors import ConfigError, SessionError
from smartnav_graph.session.session import Mount
from smartnav_graph.session.streams import Reference
from smartnav_graph.vision import benchmark
from smartnav_graph.vision.benchmark import CameraPoses, score_features, true_matches
from smartnav_graph.vision.front_end import FrontEndConfig

R = Rotation.from_euler("yxz", [6, -3, 10], degrees=True).as_matrix()  # c0_R_c1
T = np.array([0.3, -0.1, 0.05])
F = 500.0
RATE = np.array([0.1, 0.05, 0.2])  # rad/s


def points(t: np.ndarray, count: int = 400, noise_px: float = 0.0, seed: int = 0) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(seed)
    X0 = np.stack([*rng.uniform(-1, 1, (2, count)), rng.uniform(2, 6, count)], axis=1)
    X1 = (X0 - t) @ R  # R^T (X0 - t)
    return tuple(X[:, :2] / X[:, 2:] + rng.normal(0, noise_px / F, (count, 2)) for X in (X0, X1))


def classified(t: np.ndarray, *xy: np.ndarray, turn: np.ndarray = R) -> tuple[np.ndarray, np.ndarray]:
    m = len(xy[0])
    return true_matches(np.tile(turn, (m, 1, 1)), np.tile(t, (m, 1)), *xy, F)


@pytest.mark.parametrize("t", [T, np.zeros(3), 1e-4 * T])
def test_exact_matches_are_true_and_swapped_ones_are_not(t):
    x0, x1 = points(t)
    good, weak = classified(t, x0, x1)
    assert good.all() and weak.all() == (np.linalg.norm(t) < 0.01) and weak.all() == weak.any()
    assert classified(t, x0, np.roll(x1, 7, axis=0))[0].mean() < 0.05


def test_pixel_noise_of_half_a_pixel_passes_and_of_five_does_not():
    good, _ = classified(T, *points(T, noise_px=0.5))
    assert good.mean() > 0.97  # Sampson distance: sigma 0.5 px
    good, _ = classified(T, *points(T, noise_px=5.0))
    assert good.mean() < 0.35


@pytest.mark.parametrize(
    ("t", "turn"),
    [
        (T * [-1, 1, 1], R),
        (T, R.T),
        (T, np.eye(3)),
        (-R.T @ T, R),  # the other camera's axes
    ],
)
def test_a_wrong_pose_finds_few_true_matches(t, turn):
    assert classified(t, *points(T), turn=turn)[0].mean() < 0.3


def test_without_a_baseline_the_epipolar_test_would_accept_a_whole_line():
    x0, x1 = points(np.zeros(3))
    slid = x1 + np.array([30 / F, 0])
    good, weak = classified(np.zeros(3), x0, slid)
    assert weak.all() and not good.any()
    good, weak = classified(np.array([0.02, 0.0, 0.0]), *points(np.array([0.02, 0.0, 0.0])))
    assert good.all() and not weak.any()  # 3 px of parallax at 3 m


def walked(seconds: float = 4.0) -> tuple[Reference, Mount]:
    t_ns = np.arange(int(seconds * 20) + 1) * 50_000_000
    s = t_ns / 1e9
    turn = Rotation.from_rotvec(np.outer(s, RATE))
    enu = np.stack([0.4 * s, np.zeros_like(s), np.zeros_like(s)], axis=1)
    reference = Reference(t_ns=t_ns, enu=enu, quat=turn.as_quat()[:, [3, 0, 1, 2]])
    # looks along the body's y
    return reference, Mount(body_t=(0.1, 0.2, 0.3), body_R=((1, 0, 0), (0, 0, 1), (0, -1, 0)))


@pytest.mark.parametrize("offset_s", [0.0, 0.05])
def test_camera_poses_have_lever_arm_mount_and_clock(tmp_path, offset_s):
    reference, mount = walked()
    session = session_of([None], tmp_path / "s", replace(CAMERA, time_offset_s=offset_s))
    session = session.replace(reference=reference, sensors={"cam0": mount})
    poses = CameraPoses.at(session, "cam0", np.array([-(10**9), 1_012_000_000, 3_000_000_000, 10**10]))
    assert poses.known.tolist() == [False, True, True, False]
    s = 1.012 + offset_s
    nav_R_body = Rotation.from_rotvec(RATE * s).as_matrix()
    np.testing.assert_allclose(poses.nav_t_cam[1], [0.4 * s, 0, 0] + nav_R_body @ [0.1, 0.2, 0.3], atol=1e-12)
    np.testing.assert_allclose(poses.nav_R_cam[1], nav_R_body @ np.array(mount.body_R), atol=1e-12)


def wall(folder, sign: float = 1.0) -> sn.Session:
    """A camera that walks along a wall 2 m ahead, and turns; `sign` -1 gives the reference the wrong turn."""
    reference, mount = walked()
    plane = texture(seed=2, size=1400)
    pictures = []
    for k in range(6):
        poses = CameraPoses.at(
            sn.Session(reference=reference, sensors={"cam0": mount}), "cam0", np.array([k * PERIOD_NS])
        )
        cam_R_nav = poses.nav_R_cam[0].T
        # wall points: nav (x, 2, z); texture pixel (u, v) at x = (u - 500) / 250, z = (700 - v) / 250
        nav_of = np.array([[1 / 250, 0, -2.0], [0, 0, 2.2], [0, -1 / 250, 2.8]])
        nav_of[:, 2] -= poses.nav_t_cam[0]
        pictures.append(seen(plane, CAMERA.matrix @ cam_R_nav @ nav_of))
    session = session_of(pictures, folder, sensors={"cam0": mount})
    quat = reference.quat * [1, sign, sign, sign]
    return session.replace(reference=replace(reference, quat=quat))


def test_the_score_of_a_wall(tmp_path):
    config = FrontEndConfig(count=300, spans=(1,), rate_hz=0.0)
    found = score_features(wall(tmp_path / "s"), config)
    assert (found.pairs, found.unscored_pairs, found.rotation_pairs) == (5, 0, 0)
    assert found.true_rate > 0.97 and found.useful_pairs == 1.0
    assert 60 < found.median_true <= found.median_matches <= 300
    assert found.ms_picture > 0 and found.ms_pair > 0
    reported = found.to_dict()
    assert reported["thesis"] == {"true_rate": 0.8499, "useful_pairs": 0.6111, "seconds": 1.0}
    wrong = score_features(wall(tmp_path / "wrong", sign=-1.0), config)
    assert wrong.matches == found.matches and wrong.true_rate < 0.5


def test_pairs_outside_the_reference_are_reported(tmp_path):
    session = wall(tmp_path / "s")
    short = session.replace(reference=session.reference.take(slice(0, 13)))  # 0.6 s
    found = score_features(short, FrontEndConfig(count=200, spans=(1,), rate_hz=0.0))
    assert (found.pairs, found.unscored_pairs) == (2, 3)
    late = replace(session.reference, t_ns=session.reference.t_ns + 10**12)
    with pytest.raises(SessionError, match="no pair of pictures has a reference"):
        score_features(session.replace(reference=late), FrontEndConfig(count=200, spans=(1,)))


def test_what_a_benchmark_needs(tmp_path):
    session = wall(tmp_path / "s")
    with pytest.raises(SessionError, match="has no reference with attitude"):
        score_features(session.replace(reference=None), FrontEndConfig())
    with pytest.raises(SessionError, match="no calibrated camera took its images"):
        score_features(session.replace(calibration=None), FrontEndConfig())
    with pytest.raises(SessionError, match="has no images"):
        score_features(session.replace(images=None), FrontEndConfig())
    with pytest.raises(ConfigError, match="klt in a benchmark"):
        score_features(session, FrontEndConfig(features="klt"))


def test_public_recordings(dataset):
    """ORB on neighbours of KITTI odometry 06 and of the Lund door."""
    for name, pairs, true_rate, matches in (("kitti_odometry06", 50, 0.959, 395), ("lund_door", 11, 0.985, 699)):
        found = score_features(sn.load(dataset(name)), FrontEndConfig(spans=(1,), rate_hz=0.0))
        assert found.pairs == pairs and found.useful_pairs == 1.0
        assert found.true_rate == pytest.approx(true_rate, abs=0.015)
        assert found.median_matches == pytest.approx(matches, rel=0.1)


def test_a_standstill_is_evaluated_by_rotation(dataset):
    """The robot on its stand: hardly any baseline, and nearly every match stays in its place."""
    folder = dataset("euroc_v101")
    session = sn.load(folder)
    truth = sn.load_reference(folder / "groundtruth_openvins" / "V1_01_easy.csv")
    found = score_features(session.replace(reference=truth), FrontEndConfig(spans=(1,), rate_hz=0.0))
    assert found.pairs == found.rotation_pairs == 5 and found.skipped == {"missing file": 89}
    assert found.true_rate > 0.8  # the truth's own attitude wavers by a pixel


def test_true_poses_may_stand_beside_the_session(dataset, capsys):
    folder = dataset("euroc_v101")
    asked = ["match", str(folder), "--benchmark", "--features", "orb", "--json", "--quiet"]
    assert main(asked) == 1
    assert "give --reference FILE" in capsys.readouterr().err
    truth = folder / "groundtruth_openvins" / "V1_01_easy.csv"
    assert main([*asked, "--reference", str(truth)]) == 0
    (found,) = json.loads(capsys.readouterr().out)
    assert found["pairs"] == 5 and found["true_rate"] > 0.8 and found["thesis"]["true_rate"] == 0.8499
    assert main(["match", str(folder), "--reference", str(truth)]) == 1
    assert "--reference: is given without --benchmark" in capsys.readouterr().err


def test_the_table_names_what_this_build_lacks(tmp_path, capsys):
    found = benchmark.compare_features(
        wall(tmp_path / "s"), ["orb"], FrontEndConfig(count=200, spans=(1,), rate_hz=0.0)
    )
    print_scores(found, all_known=True)
    out = capsys.readouterr().out
    assert "policy ratio, 5 pairs" in out and "84.99%" in out and "97.82%" in out
    assert "-: not in the installed build of OpenCV (see scripts/reproduce_features)" in out
