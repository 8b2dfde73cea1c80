"""COLMAP text models: ``cameras.txt`` and ``images.txt`` with the pictures; no IMU, no times.

Schönberger, Frahm (2016), Structure-from-motion revisited, CVPR; colmap.github.io/format.html. The body is the camera
itself (x right, y down, z forward), and nav is level with the first picture: its x axis is east, its viewing direction
north, its centre the origin. The scale of a model is arbitrary, and a picture's time is its place in the order of
names, one second each. COLMAP's first pixel has its centre at (0.5, 0.5), ours at (0, 0).
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.errors import CalibrationError, SessionError
from smartnav_graph.core.so3 import from_quaternion
from smartnav_graph.core.timebase import NS
from smartnav_graph.readers.kitti_odometry import NAV_R_CAMERA
from smartnav_graph.readers.reference import pose_columns
from smartnav_graph.readers.source import Reader, build_session, mount
from smartnav_graph.readers.text import read_bytes
from smartnav_graph.session.calibration.camera import Camera
from smartnav_graph.session.calibration.model import Calibration
from smartnav_graph.session.session import Device, Session

# Camera model -> (indices of fx, fy, cx, cy among the parameters, indices of the distortion, our model).
_MODELS: dict[str, tuple[tuple[int, int, int, int], tuple[int, ...], str]] = {
    "SIMPLE_PINHOLE": ((0, 0, 1, 2), (), "brown"),
    "PINHOLE": ((0, 1, 2, 3), (), "brown"),
    "SIMPLE_RADIAL": ((0, 0, 1, 2), (3,), "brown"),
    "RADIAL": ((0, 0, 1, 2), (3, 4), "brown"),
    "OPENCV": ((0, 1, 2, 3), (4, 5, 6, 7), "brown"),
    "FULL_OPENCV": ((0, 1, 2, 3), tuple(range(4, 12)), "brown"),
    "OPENCV_FISHEYE": ((0, 1, 2, 3), (4, 5, 6, 7), "fisheye"),
}


def _model(source: str) -> Path | None:
    """The folder with cameras.txt and images.txt: `source`, or the only one up to two levels below it."""
    try:
        files = [file for depth in ("", "*/", "*/*/") for file in Path(source).glob(f"{depth}cameras.txt")]
        found = [file.parent for file in files if (file.parent / "images.txt").is_file()]
    except (OSError, ValueError):  # ValueError: a zero byte in the name
        return None
    return found[0] if len(found) == 1 else None


def _pictures(model: Path) -> Path:
    """The folder of the pictures: ``images`` beside the model, or one or two levels above it."""
    folders = [folder / "images" for folder in (model, *list(model.resolve().parents)[:2])]
    return next((folder for folder in folders if folder.is_dir()), model)


def _read(source: str, repairs: tuple[str, ...]) -> Session:
    model = _model(source)
    if model is None:
        expected = "one folder with cameras.txt and images.txt"
        raise SessionError(source, "holds no COLMAP text model, or several", expected, "give the model's folder")
    path = model / "images.txt"
    cameras = dict(_cameras(model / "cameras.txt"))
    rows = sorted(_images(path), key=lambda row: row[2])
    if not rows:
        raise SessionError(path, "has no rows", "at least one image", "export the model again")
    unknown = sorted({camera for _, camera, _ in rows} - set(cameras))
    if unknown:
        raise SessionError(path, f"camera {', '.join(unknown)} is missing in cameras.txt", "every camera named")
    t_ns = np.arange(len(rows), dtype=np.int64) * NS
    images = {
        "t_ns": t_ns,
        "image_id": np.arange(len(rows)),
        "file": np.array([name for _, _, name in rows], dtype=object),
        "camera": np.array([f"camera{camera}" for _, camera, _ in rows], dtype=object),
    }
    poses = _nav_poses(np.array([pose for pose, _, _ in rows]))
    known = {f"camera{key}": camera for key, camera in cameras.items()}
    return build_session(
        {"images": (path, images), "reference": (path, {"t_ns": t_ns} | pose_columns(path, poses))},
        repairs,
        device=Device(name="COLMAP model, scale arbitrary", forward="+z", up="-y"),
        sensors={name: mount(np.zeros(3), np.eye(3)) for name in known},
        calibration=Calibration(device="COLMAP model", cameras=known),
        pictures=_pictures(model),
    )


def _nav_poses(cam_from_world: Floats) -> Floats:
    """nav_T_camera (n, 4, 4) of rows qw qx qy qz tx ty tz."""
    cam_T_world = np.tile(np.eye(4), (len(cam_from_world), 1, 1))
    cam_T_world[:, :3, :3] = from_quaternion(cam_from_world[:, :4])
    cam_T_world[:, :3, 3] = cam_from_world[:, 4:]
    nav_T_first = np.eye(4)
    nav_T_first[:3, :3] = NAV_R_CAMERA
    return np.asarray(nav_T_first @ cam_T_world[0] @ np.linalg.inv(cam_T_world))


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Number (from 1) and text of the lines that are no comment."""
    text = read_bytes(path).decode("utf-8", errors="replace")
    for number, line in enumerate(text.splitlines(), 1):
        if not line.startswith("#"):
            yield number, line


def _cameras(path: Path) -> Iterator[tuple[str, Camera]]:
    for number, line in _lines(path):
        key, name, *cells = [*line.split(), "", ""]
        where = f"{path}, line {number}"
        if not key:
            continue
        if name not in _MODELS:
            raise SessionError(where, f"camera model {name}", f"one of {', '.join(_MODELS)}", "undistort the images")
        places, distortion, model = _MODELS[name]
        try:
            width, height, *numbers = (float(cell) for cell in cells if cell)
            fx, fy, cx, cy = (numbers[i] for i in places)
            coefficients = [numbers[i] for i in distortion]
            padded = (*coefficients, *[0.0] * (-len(coefficients) % 4))
            yield key, Camera(int(width), int(height), fx, fy, cx - 0.5, cy - 0.5, model, padded)
        except (ValueError, IndexError) as error:
            raise SessionError(where, f"is no camera ({error})", f"size and parameters of {name}") from error
        except CalibrationError as error:
            raise error.located(where) from error


def _images(path: Path) -> Iterator[tuple[list[float], str, str]]:
    """Pose (qw qx qy qz tx ty tz), camera and name of every image; its points fill every second line."""
    for number, line in list(_lines(path))[::2]:
        cells = line.split(maxsplit=9)
        try:
            pose = [float(cell) for cell in cells[1:8]]
            camera, name = cells[8], cells[9].strip()
        except (ValueError, IndexError) as error:
            expected = "IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME"
            raise SessionError(f"{path}, line {number}", f"is no image ({error})", expected) from error
        if not np.isfinite(pose).all() or abs(np.linalg.norm(pose[:4]) - 1.0) > 1e-2:
            raise SessionError(f"{path}, line {number}", f"pose {pose}", "a unit quaternion and a finite position")
        yield pose, camera, name


READER = Reader(
    name="colmap",
    summary="COLMAP text model: pictures, cameras, poses of arbitrary scale; no IMU, no times",
    recognised_by="one cameras.txt beside images.txt, in the folder or up to two levels below",
    matches=lambda source: _model(source) is not None,
    read_source=_read,
)
