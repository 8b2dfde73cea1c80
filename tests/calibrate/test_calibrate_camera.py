"""Camera calibration from pictures: which are used, what is refused, the recording of OpenCV."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from boards import PHONE, poses, render, theta_of

from smartnav_graph.calibrate import calibrate_into
from smartnav_graph.calibrate.board import Board
from smartnav_graph.calibrate.camera import CameraOptions, fit
from smartnav_graph.core.errors import CalibrationError, ConfigError, SessionError
from smartnav_graph.session.calibration.model import load_calibration


def write(folder: Path, board: Board, count: int, seed: int = 0, tilt: float = 35.0) -> Path:
    folder.mkdir()
    rng = np.random.default_rng(seed)
    for i, pose in enumerate(poses(count, rng, board=board, tilt=tilt)):
        assert cv2.imwrite(str(folder / f"{i:02d}.png"), render(pose, board=board, rng=rng))
    return folder


@pytest.fixture(scope="module")
def chessboard(tmp_path_factory):
    return write(tmp_path_factory.mktemp("pictures") / "chess", Board.parse("chessboard:9x6:0.03"), 9)


@pytest.mark.parametrize("text", ["chessboard:9x6:0.03", "circles:4x11:0.02", "charuco:8x6:0.03:0.021"])
def test_rendered_pictures_give_the_camera(text, chessboard, tmp_path):
    """All nine parameters within 3.3 sigmas: 99.9 % each."""
    board = Board.parse(text)
    folder = chessboard if board.kind == "chessboard" else write(tmp_path / board.kind, board, 9, seed=1)
    result = fit([folder], CameraOptions(board=text))
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    values = [result.values[f"cam0_{name}"] for name in names]
    off = (np.array([v.value for v in values]) - theta_of(PHONE)) / [v.sigma for v in values]
    assert np.abs(off).max() < 3.3, off
    assert result.values["cam0_rms"].value < 0.15  # px
    assert result.order == tuple(f"cam0_{name}" for name in names)
    covariance = np.reshape(result.covariance, (9, 9))
    assert np.allclose(np.sqrt(np.diag(covariance)), [v.sigma for v in values])


def test_calibration_file_holds_the_camera(chessboard, tmp_path):
    out = tmp_path / "calibration.toml"
    options = CameraOptions(board="chessboard:9x6:0.03", camera="back")
    result, piece = calibrate_into(out, "camera", [str(chessboard)], options)
    camera = load_calibration(out).cameras["back"]
    assert (camera.width, camera.height, camera.model) == (640, 480, "brown")
    assert camera.fx == result.values["back_fx"].value and piece.sources == ("chess",)
    assert len(result.charts) == 6 and {chart.title for chart in result.charts} >= {"Radial distortion"}
    known = load_calibration(out)
    turned = replace(camera, body_R=(0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0), time_offset_s=0.04)
    again = result.change(replace(known, cameras={"back": turned})).cameras["back"]
    assert again == turned  # pictures of a board say nothing of axes and clock


def test_pictures_without_the_board_are_left_out_by_name(chessboard, tmp_path):
    folder = tmp_path / "mixed"
    folder.mkdir()
    for path in sorted(chessboard.iterdir())[:6]:
        (folder / path.name).write_bytes(path.read_bytes())
    (folder / "00b.png").write_bytes((folder / "00.png").read_bytes())
    cv2.imwrite(str(folder / "wall.png"), np.full((480, 640), 90, np.uint8))
    (folder / "cut.png").write_bytes((folder / "00.png").read_bytes()[:2000])
    found = " ".join(fit([folder], CameraOptions(board="chessboard:9x6:0.03")).warnings)
    assert "board not found: wall.png." in found and "broken file: cut.png." in found
    assert "like the one before it: 00b.png." in found


def test_faults_are_named(chessboard, tmp_path):
    with pytest.raises(ConfigError, match="--board: is missing"):
        fit([chessboard], CameraOptions())
    with pytest.raises(CalibrationError, match=r"in none of 4 pictures.*the pictures show 9 x 6.*chessboard:9x6"):
        fit(sorted(chessboard.iterdir())[:4], CameraOptions(board="chessboard:10x7:0.03"))
    folder = tmp_path / "sizes"
    folder.mkdir()
    for i, path in enumerate(sorted(chessboard.iterdir())[:4]):
        gray = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        cv2.imwrite(str(folder / path.name), cv2.resize(gray, (960, 720)) if i == 3 else gray)
    with pytest.raises(CalibrationError, match=r"3 of 640 x 480 px, 1 of 960 x 720 px.*one resolution"):
        fit([folder], CameraOptions(board="chessboard:9x6:0.03"))
    (tmp_path / "empty").mkdir()
    with pytest.raises((CalibrationError, SessionError)):
        fit([tmp_path / "empty"], CameraOptions(board="chessboard:9x6:0.03"))


@pytest.mark.parametrize(("side", "fx", "rms"), [("left", 533.1, 0.18), ("right", 537.4, 0.19)])
def test_pictures_of_opencv(side, fx, rms, dataset):
    """Thirteen views. With windows of 11 px, which take in neighbouring corners, and all views kept: RMS and focal
    length of OpenCV's tutorial, 0.4087 px and 536.07 px on the left, moved by one view of 1.2 px."""
    folder = dataset("chessboard_opencv")
    files = sorted(folder.glob(f"{side}[0-9][0-9].jpg"))
    options = CameraOptions(board="chessboard:9x6:0.025")
    found = fit(files, options).values
    assert found["cam0_rms"].value <= rms and abs(found["cam0_fx"].value - fx) <= 2 * found["cam0_fx"].sigma
    if side == "left":
        smaller = fit(files, CameraOptions(board="chessboard:8x6:0.025"))
        assert any("show a board of 9 x 6" in text for text in smaller.warnings)
        wide = CameraOptions(board="chessboard:9x6:0.025", corner_window=11, keep_views=True)
        tutorial = fit(files, wide).values
        assert tutorial["cam0_rms"].value == pytest.approx(0.4087, abs=2e-3)
        assert tutorial["cam0_fx"].value == pytest.approx(536.07, abs=0.3)
