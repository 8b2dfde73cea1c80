"""Two cameras by pairs of pictures: the relative pose within its sigmas, pairs that do not belong together by name."""

import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
from boards import BOARD, PHONE, exact_views, noisy, poses, render, theta_of
from simulated import DATASETS, Coverage, real

from smartnav_graph.calibrate.interior import calibrate_camera
from smartnav_graph.calibrate.stereo import StereoOptions, calibrate_stereo, fit, pair_numbers, paired
from smartnav_graph.core.errors import CalibrationError
from smartnav_graph.core.so3 import exp, log
from smartnav_graph.session.calibration.model import Calibration
from smartnav_graph.session.calibration.pieces import Value

SIZE = (PHONE.width, PHONE.height)
TURN, SHIFT = np.radians([1.0, -2.0, 0.5]), np.array([-0.08, 0.002, 0.001])
RIGHT = replace(PHONE, fx=590.0, fy=591.0, cx=330.0)


def rig(seed, count=12, noise_px=0.2):
    """Views of one board in both cameras."""
    rng = np.random.default_rng(seed)
    left, right = [], []
    for pose in poses(4 * count, rng):
        R = exp(TURN) @ exp(pose[:3])
        (view,) = exact_views([np.concatenate([log(R), exp(TURN) @ pose[3:] + SHIFT])], RIGHT)
        if ((view.xy > 3) & (view.xy < [636, 476])).all() and len(left) < count:
            name = str(len(left))
            left.append(replace(exact_views([pose])[0], name=f"l{name}.png"))
            right.append(replace(view, name=f"r{name}.png"))
    return (noisy(views, noise_px, rng) if noise_px else views for views in (left, right))


def fitted(seed, **options):
    left, right = rig(seed, **options)
    return calibrate_stereo(calibrate_camera(left, SIZE), calibrate_camera(right, SIZE), paired(left, right)[0])


def test_exact_corners_give_the_exact_pose():
    found = fitted(0, noise_px=0.0)
    assert np.allclose(found.theta[-6:], np.concatenate([TURN, SHIFT]), atol=1e-6)
    assert np.allclose(found.theta[:9], theta_of(PHONE), rtol=1e-4, atol=1e-4)


def covered(seeds):
    count = Coverage()
    names = ["turn"] * 3 + ["shift"] * 3
    for seed in seeds:
        found = fitted(seed)
        sigmas = np.sqrt(np.diag(found.covariance))[-6:]
        rows = zip(names, found.theta[-6:], sigmas, np.concatenate([TURN, SHIFT]), strict=True)
        for name, value, sigma, true in rows:
            count.add(name, Value(value, sigma, ""), true)
    return count


@pytest.mark.slow
def test_sigmas_cover_the_truth():
    covered(range(60)).check()


def test_pairs_that_do_not_belong_together():
    left, right = map(list, rig(1))
    right[4] = replace(right[5], name=right[4].name)  # a picture of another moment
    found = calibrate_stereo(calibrate_camera(left, SIZE), calibrate_camera(right, SIZE), paired(left, right)[0])
    assert [name for name, _ in found.left_out] == ["l4.png"] and "times the median of all pairs" in found.left_out[0][
        1
    ]
    with pytest.raises(CalibrationError, match="3 pairs of 3 and 12 views"):
        paired(left[:3], right)
    with pytest.raises(CalibrationError, match=r"12 pictures as l0\.png with 11 numbers"):
        paired([*left[:-1], replace(left[0], name="again_0.png")], right)
    both, alone = paired(left[:5], right)
    assert len(both) == 5 and [name for name, _ in alone] == [f"r{i}.png" for i in range(5, 12)]


@pytest.mark.parametrize(
    ("left", "right"),
    [
        (["left01.jpg", "left2.jpg"], ["Right_1.png", "Right_2.png"]),
        (["cam0_0001.png", "cam0_0002.png"], ["cam1_0001.png", "cam1_0002.png"]),
        (["2026_cam0_1.png", "2026_cam0_2.png"], ["2026_cam1_1.png", "2026_cam1_2.png"]),
        (["10-59-58.png", "10-59-59.png"], ["10-59-59.png", "11-00-00.png"]),  # times of two hours
    ],
)
def test_pictures_are_paired_by_numbers_that_differ_in_a_folder(left, right):
    one, two = pair_numbers(left, right)
    assert one == two or set(one) & set(two) == {"10_59_59"}


def test_pictures_of_two_cameras(tmp_path):
    """Rendered pictures: the pose within four sigmas, and the axes of the right camera by those of the left one."""
    rng, folders = np.random.default_rng(3), (tmp_path / "left", tmp_path / "right")
    for folder in folders:
        folder.mkdir()
    for i, pose in enumerate(poses(9, rng, tilt=35.0)):
        R = exp(TURN) @ exp(pose[:3])
        there = np.concatenate([log(R), exp(TURN) @ pose[3:] + SHIFT])
        for folder, at, camera in zip(folders, (pose, there), (PHONE, RIGHT), strict=True):
            cv2.imwrite(str(folder / f"{folder.name}{i:02d}.png"), render(at, camera, rng=rng))
    result = fit(folders, StereoOptions(board=str(BOARD)))
    for axis, turn, shift in zip("xyz", np.degrees(TURN), SHIFT, strict=True):
        for name, true in ((f"turn_{axis}", turn), (f"shift_{axis}", shift)):
            value = result.values[name]
            assert abs(value.value - true) < 4.0 * value.sigma, name
    assert result.values["baseline"].value == pytest.approx(0.08, abs=1e-3)
    ahead, place = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.array([1.0, 2.0, 3.0])
    known = Calibration(cameras={"cam0": replace(PHONE, body_R=tuple(ahead.ravel()), body_t=tuple(place))})
    other = result.change(known).cameras["cam1"]
    assert np.allclose(np.reshape(other.body_R, (3, 3)), ahead @ exp(TURN).T, atol=0.01)
    body_x = place + ahead @ [0.3, -0.2, 2.0]  # of a point seen by both
    seen = np.reshape(other.body_R, (3, 3)).T @ (body_x - other.body_t)
    assert np.allclose(seen, exp(TURN) @ [0.3, -0.2, 2.0] + SHIFT, atol=0.01)
    assert other.body_t[1] == pytest.approx(1.92, abs=0.01)  # 8 cm to the right
    with pytest.raises(CalibrationError, match="1 sources; expected two folders"):
        fit(folders[:1], StereoOptions(board=str(BOARD)))


@real("chessboard_opencv")
def test_the_stereo_head_of_opencv(tmp_path):
    """Against OpenCV's stereoCalibrate on the same corners: RMS .1954 px, baseline 83.166 mm for squares of 25 mm."""
    for side in ("left", "right"):
        (tmp_path / side).mkdir()
        for path in (DATASETS / "chessboard_opencv").glob(f"{side}[0-9]*.jpg"):
            shutil.copy(path, tmp_path / side)
    result = fit([tmp_path / "left", tmp_path / "right"], StereoOptions(board="chessboard:9x6:0.025"))
    assert result.values["rms"].value == pytest.approx(0.1954, abs=5e-4)
    assert result.values["baseline"].value == pytest.approx(0.083166, abs=2e-5)
    assert result.values["baseline"].sigma < 2e-4 and len(result.residuals) == 13
