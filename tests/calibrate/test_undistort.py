"""Pictures without distortion, and the commands beside `calibrate camera`."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from boards import BOARD, PHONE, poses, render

from smartnav_graph.calibrate.board import find_corners
from smartnav_graph.calibrate.undistort import undistort_folder, undistorted, undistorted_name
from smartnav_graph.cli import main
from smartnav_graph.cli.calibrate_camera import camera_differences
from smartnav_graph.core.errors import SessionError
from smartnav_graph.session.calibration.model import Calibration, calibration_toml


def test_straight_lines_are_straight():
    """Rows of the board in a picture without distortion lie on lines to 0.1 px."""
    bent = replace(PHONE, distortion=(-0.25, 0.05, 0.0, 0.0, 0.0))
    picture = render(poses(1, np.random.default_rng(0), bent, tilt=20.0)[0], bent)
    misses = []
    for gray in (picture, undistorted(picture, bent)):
        rows = find_corners(gray, BOARD).xy.reshape(6, 9, 2)
        misses.append(max(np.linalg.svd(row - row.mean(axis=0))[1][1] for row in rows))
    assert misses[1] < 0.35 < misses[0]  # px, root of the sum over nine corners


def test_folder_of_the_logger_of_2012(tmp_path):
    (tmp_path / "in").mkdir()
    for name in ("Image_1_2000.jpg", "Image_2_3000.jpg"):
        cv2.imwrite(str(tmp_path / "in" / name), np.full((480, 640, 3), 100, np.uint8))
    cv2.imwrite(str(tmp_path / "in" / "small.png"), np.full((48, 64, 3), 100, np.uint8))
    done = undistort_folder(tmp_path / "in", PHONE, tmp_path / "out")
    assert done.written == 2 and done.left_out == {"small.png": "other size than calibrated"}
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == [
        "ImageUndistorted_1_2000.jpg",
        "ImageUndistorted_2_3000.jpg",
    ]
    assert undistorted_name("a.png") == "ImageUndistorted_a.png"
    with pytest.raises(SessionError, match="exists already"):
        undistort_folder(tmp_path / "in", PHONE, tmp_path / "out")
    assert undistort_folder(tmp_path / "in", PHONE, tmp_path / "out", force=True).written == 2
    (tmp_path / "out" / "notes.txt").write_text("mine")
    with pytest.raises(SessionError, match=r"holds notes\.txt, so it is not replaced"):
        undistort_folder(tmp_path / "in", PHONE, tmp_path / "out", force=True)


def test_commands(tmp_path, capsys):
    """A board, pictures without distortion, and May against October."""
    assert main(["calibrate", "board", "chessboard:9x6:0.025", "--out", str(tmp_path / "b.pdf")]) == 0
    assert "274 x 213 mm" in capsys.readouterr().out and (tmp_path / "b.pdf").read_bytes().startswith(b"%PDF")
    may = Calibration(cameras={"cam0": PHONE})
    october = Calibration(cameras={"cam0": replace(PHONE, fx=PHONE.fx + 2.0, fy=PHONE.fy + 2.0)})
    (line,) = camera_differences(may, october)
    assert line.startswith("cam0: projections 0.") and ", 1." in line  # px: 2 of 575 at a radius of 400
    (tmp_path / "may.toml").write_text(calibration_toml(may))
    (tmp_path / "in").mkdir()
    cv2.imwrite(str(tmp_path / "in" / "Image_1_2.png"), np.full((480, 640), 100, np.uint8))
    given = [str(tmp_path / "in"), "--calibration", str(tmp_path / "may.toml"), "--out", str(tmp_path / "out")]
    assert main(["calibrate", "undistort", *given]) == 0
    assert main(["calibrate", "undistort", *given, "--camera", "back"]) == 1
    assert "no camera 'back'" in capsys.readouterr().err
