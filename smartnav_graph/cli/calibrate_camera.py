"""`smartnav calibrate board` and `undistort`: a printed board, pictures without distortion."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from smartnav_graph.cli.options import Command, Switch
from smartnav_graph.core.errors import CalibrationError
from smartnav_graph.session.calibration.model import Calibration


def camera_differences(one: Calibration, two: Calibration) -> list[str]:
    """How far the projections of the cameras of two calibrations are apart, a line for each camera in both."""
    from smartnav_graph.calibrate.projection import projection_difference

    lines = []
    for name in (name for name in one.cameras if name in two.cameras):
        first, second = one.cameras[name], two.cameras[name]
        if (first.width, first.height) != (second.width, second.height):
            second = second.resized(first.width, first.height)
        _, apart, turn = projection_difference(first, second)
        size, angle = np.linalg.norm(apart, axis=1), np.degrees(np.linalg.norm(turn))
        text = (
            f"projections {np.nanmedian(size):.3f} px apart (median over the image), {np.nanmax(size):.2f} px at most"
        )
        lines.append(f"{name}: {text}; a rotation of {angle:.3f} deg is taken out")
    return lines


@dataclass(frozen=True, kw_only=True)
class PrintBoard(Command):
    """Write a calibration board as a PDF in true size, with a line of 100 mm to check the print.

    Example: smartnav calibrate board chessboard:9x6:0.025 --out board.pdf
    """

    board: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="BOARD")]
    """As chessboard:9x6:0.025, circles:4x11:0.02 or charuco:8x6:0.03:0.021, as for `smartnav calibrate camera`."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")] = Path("board.pdf")
    """The PDF."""
    force: Switch = False
    """Replace an older file."""

    def run(self) -> None:
        from smartnav_graph.calibrate.board import Board
        from smartnav_graph.calibrate.board_pdf import write_board

        width, height = write_board(Board.parse(self.board), self.out, force=self.force)
        print(f"board: {self.out}, {width:.0f} x {height:.0f} mm; print at 100 %")


@dataclass(frozen=True, kw_only=True)
class Undistort(Command):
    """Write the pictures of a folder without distortion: ImageUndistorted_N_T.jpg of Image_N_T.jpg.

    Example: smartnav calibrate undistort pictures --calibration calibration.toml --out undistorted
    """

    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER")]
    """Folder of pictures."""
    calibration: Annotated[Path, tyro.conf.arg(metavar="FILE")] = Path("calibration.toml")
    """A calibration.toml with the camera."""
    camera: str = "cam0"
    """Name of the camera."""
    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = Path("undistorted")
    """New folder."""
    force: Switch = False
    """Replace an older folder of such pictures."""

    def run(self) -> None:
        from smartnav_graph.calibrate.undistort import undistort_folder
        from smartnav_graph.session.calibration.model import load_calibration

        cameras = load_calibration(self.calibration).cameras
        if self.camera not in cameras:
            expected = f"one of {', '.join(cameras) or 'none'}"
            raise CalibrationError(self.calibration, f"no camera {self.camera!r}", expected, "give --camera")
        done = undistort_folder(self.folder, cameras[self.camera], self.out, force=self.force)
        print(f"{done.written} pictures: {self.out}")
        for name, why in done.left_out.items():
            print(f"left out, {why}: {name}")
