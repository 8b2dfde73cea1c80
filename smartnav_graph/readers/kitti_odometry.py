"""KITTI odometry folders: the left grey pictures, ``calib.txt``, ``poses.txt`` and, if there, ``times.txt``; no IMU.

Geiger et al. (2013), Vision meets robotics: the KITTI dataset, IJRR 32(11). Pictures are rectified: no distortion. The
body is the camera itself (x right, y down, z forward), and nav is level with the first picture: its x axis is east, its
viewing direction north. Without times.txt pictures count as 0.1 s apart, from zero.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from smartnav_graph.core.arrays import Table, Times
from smartnav_graph.core.errors import CalibrationError, SessionError
from smartnav_graph.core.timebase import NS
from smartnav_graph.readers.reference import pose_columns
from smartnav_graph.readers.source import Reader, build_session, mount, only_folder
from smartnav_graph.readers.text import read_text
from smartnav_graph.session.calibration.camera import Camera
from smartnav_graph.session.calibration.model import Calibration
from smartnav_graph.session.session import Device, Session

PICTURES = ("image_0", "image_l")
CAMERA = "left"
PERIOD_NS = NS // 10

# nav (east, north, up) of the first camera's axes: right is east, forward north, down the opposite of up.
NAV_R_CAMERA = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def _root(source: str) -> Path | None:
    """The folder with calib.txt and pictures: `source`, or the only one in it."""
    return only_folder(source, lambda f: (f / "calib.txt").is_file() and any((f / p).is_dir() for p in PICTURES))


def _read(source: str, repairs: tuple[str, ...]) -> Session:
    root = _root(source)
    if root is None:
        expected = f"one folder with calib.txt and {' or '.join(PICTURES)}"
        raise SessionError(source, "is no KITTI odometry sequence, or several", expected, "give the sequence's folder")
    folder = next(root / name for name in PICTURES if (root / name).is_dir())
    files = sorted(file.name for file in folder.glob("*.png"))
    if not files:
        raise SessionError(folder, "holds no pictures", "files *.png", "give the whole sequence")
    t_ns = _times(root / "times.txt", len(files))
    names = np.array(files, dtype=object)
    images = {"t_ns": t_ns, "image_id": np.arange(len(files)), "file": names, "camera": np.full_like(names, CAMERA)}
    tables = {"images": (folder, images)}
    if (root / "poses.txt").is_file():
        tables["reference"] = (root / "poses.txt", {"t_ns": t_ns} | _poses(root / "poses.txt", len(files)))
    camera = _camera(root / "calib.txt", folder / files[0])
    return build_session(
        tables,
        repairs,
        device=Device(name="KITTI left camera", forward="+z", up="-y"),
        sensors={CAMERA: mount(np.zeros(3), np.eye(3))},
        calibration=Calibration(device="KITTI left camera", cameras={CAMERA: camera}),
        pictures=folder,
    )


def _times(path: Path, count: int) -> Times:
    if not path.is_file():
        return np.arange(count, dtype=np.int64) * PERIOD_NS
    t_ns = read_text(path, names=["t"]).times("t")
    _check_count(path, len(t_ns), count)
    return t_ns


def _poses(path: Path, count: int) -> Table:
    table = read_text(path, names=[f"p{i}" for i in range(12)])
    _check_count(path, len(table), count)
    return pose_columns(path, NAV_R_CAMERA @ table.floats(*table.cells).reshape(-1, 3, 4))


def _check_count(path: Path, rows: int, count: int) -> None:
    if rows != count:
        raise SessionError(path, f"has {rows} rows", f"{count}, one per picture", "give the whole sequence")


def _camera(path: Path, picture: Path) -> Camera:
    """Of the first projection matrix; the size is that of the first picture."""
    text = path.read_text(encoding="utf-8", errors="replace").splitlines()
    cells = text[0].removeprefix("P0:").split() if text else []
    try:
        P = np.array(cells, dtype=np.float64).reshape(3, 4)
    except ValueError as error:
        raise SessionError(path, f"row 0 is no matrix ({error})", "12 numbers, perhaps after P0:", row=0) from error
    if P[0, 1] or P[1, 0] or P[2].tolist() != [0.0, 0.0, 1.0, 0.0]:
        found = f"row 0 is {' '.join(cells)}: no projection of rectified pictures"
        raise SessionError(path, found[:400], "fx 0 cx x, 0 fy cy y, 0 0 1 0", "copy the file again", row=0)
    width, height = _size(picture)
    fx, fy, cx, cy = (float(P[place]) for place in ((0, 0), (1, 1), (0, 2), (1, 2)))
    try:
        return Camera(width, height, fx, fy, cx, cy)
    except CalibrationError as error:
        raise SessionError(path, f"row 0: {error.found}", error.expected, "copy the file again", row=0) from error


def _size(picture: Path) -> tuple[int, int]:
    """Width and height from the heading of a PNG."""
    with picture.open("rb") as file:
        data = file.read(24)
    if data[12:16] != b"IHDR":
        raise SessionError(picture, "is no PNG", "a picture", "copy the file again")
    return int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")


READER = Reader(
    name="kitti-odometry",
    summary="KITTI odometry sequence: left grey pictures, calibration, poses; no IMU",
    recognised_by="a folder with calib.txt and image_0 or image_l (or the only such folder in it)",
    matches=lambda source: _root(source) is not None,
    read_source=_read,
)
