"""The half minute of EuRoC V1_01_easy that every gtsam installation ships: IMU and feature tracks in one CSV.

Burri et al. (2016), The EuRoC micro aerial vehicle datasets. The IMU's x axis points up and the camera looks along
its z axis. The ``T_ci_*`` rows hold the camera's pose in the body (body_T_cam), despite their name: they equal the
T_BS of the set's cam0. Stamps carry 17 digits, so they differ from the original's by up to 0.25 us.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from smartnav_graph.core.arrays import Table
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.so3 import from_quaternion
from smartnav_graph.readers.euroc import calibrated
from smartnav_graph.readers.source import Reader, build_session, example_file, inertial_columns, mount
from smartnav_graph.readers.text import TextTable, first_lines, read_text
from smartnav_graph.session.calibration.camera import Camera
from smartnav_graph.session.calibration.model import Calibration
from smartnav_graph.session.session import Device, Session

NAME = "gtsam-euroc"
FILE = "eqvio_processed_30s.csv"
CAMERA = "cam0"
DEVICE = "EuRoC VI-Sensor ADIS16448"
SIZE = (752, 480)
GRAVITY = 9.81

_HEADING = "row_type,t_abs,t_rel,seq,frame_idx,landmark_id,"


def _matches(source: str) -> bool:
    return source == NAME or "".join(first_lines(Path(source), 1)).startswith(_HEADING)


def _read(source: str, repairs: tuple[str, ...]) -> Session:
    path = example_file(FILE) if source == NAME else Path(source)
    table = read_text(path)
    table.require(("row_type", "t_abs", "frame_idx", "landmark_id", "u_norm", "v_norm", "key", "value"))
    features = table.where("row_type", "vision_feature")
    tracks: Table = {
        "t_ns": features.times("t_abs"),
        "image_id": features.ints("frame_idx"),
        "track_id": features.ints("landmark_id"),
        "x_n": features.floats("u_norm"),
        "y_n": features.floats("v_norm"),
    }
    tables = {
        "imu": (path, _imu_columns(table.where("row_type", "imu"))),
        "images": (path, _image_columns(features)),
        "tracks": (path, tracks),
    }
    camera = _camera(table)
    pose = np.array(_meta(table, [f"T_ci_{name}" for name in ("tx", "ty", "tz", "qw", "qx", "qy", "qz")]))
    return build_session(
        tables,
        repairs,
        calibration=Calibration(device=DEVICE, cameras={CAMERA: camera}),
        device=Device(name=DEVICE, forward="+z", up="+x"),
        clock_epoch="unix",
        gravity_m_s2=GRAVITY,
        sensors={CAMERA: mount(pose[:3], from_quaternion(pose[None, 3:])[0])},
    )


def _imu_columns(table: TextTable) -> Table:
    table.require(("gx", "gy", "gz", "ax", "ay", "az"))
    return inertial_columns(table.times("t_abs"), table.floats("gx", "gy", "gz"), table.floats("ax", "ay", "az"))


def _image_columns(features: TextTable) -> Table:
    """One row per frame. There are tracks but no pictures: the file name stays empty."""
    frames, first = np.unique(features.ints("frame_idx"), return_index=True)
    return {
        "t_ns": features.times("t_abs")[first],
        "image_id": frames,
        "file": np.full(len(frames), "", dtype=object),
        "camera": np.full(len(frames), CAMERA, dtype=object),
    }


def _meta(table: TextTable, names: Sequence[str]) -> list[float]:
    """Numbers of the meta rows."""
    rows = table.where("row_type", "meta")
    values = dict(zip(rows.texts("key"), rows.texts("value"), strict=True))
    try:
        return [float(values[name]) for name in names]
    except (KeyError, ValueError) as error:
        raise SessionError(rows.path, f"camera: {error}", f"meta rows {', '.join(names)}") from error


def _camera(table: TextTable) -> Camera:
    """The points are undistorted already."""
    fx, fy, cx, cy = _meta(table, [f"camera_{name}" for name in ("fx", "fy", "cx", "cy")])
    return calibrated(*SIZE, fx, fy, cx, cy)


READER = Reader(
    name=NAME,
    summary="EuRoC V1_01_easy, the 30 s shipped with gtsam: IMU 200 Hz, feature tracks 20 Hz",
    recognised_by=f"the name {NAME!r}, or a CSV that begins with row_type,t_abs,t_rel",
    matches=_matches,
    read_source=_read,
)
