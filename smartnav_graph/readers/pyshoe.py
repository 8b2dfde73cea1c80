"""Foot-mounted IMU walks as the LLIO-aided PyShoe files hold them: under VICON, or over marked points.

Processed copies of the University of Toronto foot-mounted inertial navigation dataset (Wagstaff, Peretroukhin, Kelly;
IEEE DataPort 10.21227/v1z6-9z84) and walks of the copy's authors. The IMU's axes are kept, its z points down;
horizontal positions are right-handed with z down, so that (x, -y) is the navigation frame. Neither family measures
heights: the reference's is zero, that of a marked point is unknown (`UNKNOWN_HEIGHT`).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from smartnav_graph.core.arrays import Floats, Table, Times
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.timebase import ns_from_seconds
from smartnav_graph.readers.matlab import matrix, names_in, read_mat
from smartnav_graph.readers.source import Reader, build_session, inertial_columns, vector_columns
from smartnav_graph.session.session import Device, Session

# Sigmas, metres: a foot's IMU is a shoe's width away from the marked point; heights of the floor were not measured.
ON_THE_POINT = 0.1
UNKNOWN_HEIGHT = 100.0


def _matches(source: str) -> bool:
    return "\0" not in source and {"imu_data", "strideIndex", "GCP"} <= names_in(Path(source))


def _read(source: str, repairs: tuple[str, ...]) -> Session:
    path = Path(source)
    variables = read_mat(path)
    rows = matrix(path, variables, "imu_data", 6)
    vicon = "gt" in variables
    t_ns = _times(path, variables, "timestamps_all" if vicon else "timestamps", len(rows))
    tables = {"imu": (path, inertial_columns(t_ns, rows[:, 3:], rows[:, :3]))}
    if vicon:
        position = _level(matrix(path, variables, "gt", 2, len(rows)))
        tables["reference"] = (path, {"t_ns": t_ns} | vector_columns("{}_m", position, "enu"))
    else:
        tables["control"] = (path, _points(path, variables, t_ns))
    device = Device(name="foot-mounted MicroStrain 3DM-GX5-25", forward="+x", up="-z", vehicle="foot", mounting="foot")
    return build_session(tables, repairs, device=device, clock_epoch="unknown")


def _times(path: Path, variables: Table, name: str, count: int) -> Times:
    """Stamps of seconds since the recording's start."""
    seconds = np.ravel(variables[name]) if name in variables else np.zeros(0)
    if seconds.shape != (count,):
        raise SessionError(path, f"{name} has {len(seconds)} stamps", f"{count}, one per inertial row")
    return ns_from_seconds(seconds)


def _level(position: Floats) -> Floats:
    """Navigation positions (n, 3) at height zero of file positions (n, 2)."""
    return np.column_stack([position[:, 0], -position[:, 1], np.zeros(len(position))])


def _points(path: Path, variables: Table, t_ns: Times) -> Table:
    """Marked points at the middle of the strides' stances."""
    stride = np.ravel(variables["strideIndex"]).astype(np.int64)
    if len(stride) and not (stride.min() >= 0 and stride.max() < len(t_ns)):
        raise SessionError(path, f"strideIndex up to {stride.max()}", f"row numbers below {len(t_ns)}")
    points = _level(matrix(path, variables, "GCP", 2, len(stride)))
    sigma = np.tile([ON_THE_POINT, ON_THE_POINT, UNKNOWN_HEIGHT], (len(stride), 1))
    names = np.array([f"stride {i}" for i in range(len(stride))], dtype=object)
    columns: Table = {"t_ns": t_ns[stride], "point_id": names}
    return columns | vector_columns("{}_m", points, "enu") | vector_columns("sigma_{}_m", sigma, "enu")


READER = Reader(
    name="pyshoe",
    summary="foot-mounted IMU 200 Hz, VICON positions or marked points (LLIO-aided PyShoe .mat)",
    recognised_by="a .mat file with imu_data, strideIndex and GCP",
    matches=_matches,
    read_source=_read,
)
