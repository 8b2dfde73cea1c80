"""The two foot-mounted IMUs of Constrained-ZUPT-FGO: one foot becomes one session.

Hu, Hu (2025), Constrained factor graph optimization for robust networked pedestrian inertial navigation, IEEE/ION
PLANS. 60 Hz, the clock is the row's index / 60 s. The positions are given with z down: (x, -y, -z) is the navigation
frame. ``FOLDER#left`` and ``FOLDER#right`` are the whole recording of a foot, measData/imuMeasLeft.csv and
imuMeasRight.csv its walk of 120 s.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from smartnav_graph.core.arrays import Column, Floats, Table, Times
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.timebase import NS
from smartnav_graph.readers.matlab import matrix, read_mat
from smartnav_graph.readers.source import Reader, build_session, inertial_columns, vector_columns
from smartnav_graph.readers.text import first_lines, read_text
from smartnav_graph.session.session import Device, Session

RATE_HZ = 60
NAV_FROM_FILE = np.array([1.0, -1.0, -1.0])
FEET = ("left", "right")
MATLAB = Path("dataPreparation")
# In the whole recording: first inertial column of a foot, and file and variable of its positions.
FIRST_COLUMN = {"right": 0, "left": 6}
POSITIONS = {"right": ("posFoot.mat", "posFoot"), "left": ("posLeft.mat", "posLeft")}
HEADING = "time_index,acc_x,acc_y,acc_z,gyro_x,gyro_y,gyro_z"
WALKS = {"imuMeasLeft.csv": "left", "imuMeasRight.csv": "right"}


def _matches(source: str) -> bool:
    if "\0" in source:
        return False
    path = Path(source.partition("#")[0])
    if path.name in WALKS:
        return any(line.startswith(HEADING) for line in first_lines(path, 1))
    return (path / MATLAB / "ImuFootLeft.mat").is_file()


def _read(source: str, repairs: tuple[str, ...]) -> Session:
    name, _, foot = source.partition("#")
    path = Path(name)
    if path.name in WALKS:
        foot, tables = WALKS[path.name], _walk(path)
    elif foot in FEET:
        tables = _whole(path / MATLAB, foot)
    else:
        found = f"names the foot {foot!r}" if foot else "holds two feet"
        raise SessionError(source, found, "one foot", f"give {path}#left or {path}#right")
    device = Device(name=f"foot-mounted IMU, {foot}", forward="+x", up="+z", vehicle="foot", mounting="foot")
    return build_session(tables, repairs, device=device, clock_epoch="unknown")


def _whole(folder: Path, foot: str) -> dict[str, tuple[Path, Table]]:
    """The recording of 290 s."""
    inertial, (name, variable) = folder / "ImuFootLeft.mat", POSITIONS[foot]
    first = FIRST_COLUMN[foot]
    rows = matrix(inertial, read_mat(inertial), "ImuFootLeft", first + 6)[:, first:]
    position = matrix(folder / name, read_mat(folder / name), variable, 3, len(rows))
    index = np.arange(len(rows))
    samples = inertial_columns(_times(index), rows[:, 3:], rows[:, :3])
    return {"imu": (inertial, samples), "reference": (folder / name, _reference(index, position))}


def _walk(path: Path) -> dict[str, tuple[Path, Table]]:
    """The evaluated walk of 120 s; its clock starts anew."""
    table = read_text(path)
    table.require(HEADING.split(","))
    rows = table.floats(*HEADING.split(",")[1:])
    tables = {"imu": (path, inertial_columns(_times(table.floats("time_index")), rows[:, 3:], rows[:, :3]))}
    truth = path.with_name("positionGt.csv")
    if truth.is_file():
        positions = read_text(truth)
        names = [f"pos_{WALKS[path.name]}_{axis}" for axis in "xyz"]
        positions.require(["time_index", *names])
        columns = _reference(positions.floats("time_index"), positions.floats(*names))
        tables["reference"] = (truth, columns)
    return tables


def _times(index: Column) -> Times:
    """Nanoseconds of row numbers."""
    return np.rint(np.asarray(index, dtype=np.float64) * (NS / RATE_HZ)).astype(np.int64)


def _reference(index: Column, position: Floats) -> Table:
    return {"t_ns": _times(index)} | vector_columns("{}_m", position * NAV_FROM_FILE, "enu")


READER = Reader(
    name="foot-dual-zupt",
    summary="two foot-mounted IMUs, 60 Hz, foot positions; FOLDER#left, FOLDER#right",
    recognised_by="a folder with dataPreparation/ImuFootLeft.mat, or imuMeasLeft.csv, imuMeasRight.csv",
    matches=_matches,
    read_source=_read,
)
