"""The KITTI drive that every gtsam installation ships: 471 s of car IMU and 1 Hz positions.

It is drive 2011_10_03_0027 (odometry sequence 00) of Geiger et al. (2013), Vision meets robotics. IMU axes are
forward, left, up; positions are metres in a local ENU-like frame without stated origin, and carry no sigmas.
"""

from __future__ import annotations

from pathlib import Path

from smartnav_graph.core.arrays import Table
from smartnav_graph.readers.source import Reader, build_session, example_file, vector_columns
from smartnav_graph.readers.text import TextTable, first_lines, read_text
from smartnav_graph.session.session import Device, Session

NAME = "gtsam-kitti"
IMU_FILE = "KittiEquivBiasedImu.txt"
GNSS_FILE = "KittiGps_converted.txt"
GRAVITY = 9.81

_ACCEL = ("accelX", "accelY", "accelZ")
_GYRO = ("omegaX", "omegaY", "omegaZ")


def _folder(source: str) -> Path:
    return example_file(IMU_FILE).parent if source == NAME else Path(source)


def _matches(source: str) -> bool:
    if source == NAME:
        return True
    folder = Path(source)
    return (folder / GNSS_FILE).is_file() and first_lines(folder / IMU_FILE, 1) == [
        " ".join(("Time", "dt", *_ACCEL, *_GYRO))
    ]


def _read(source: str, repairs: tuple[str, ...]) -> Session:
    folder = _folder(source)
    tables = {
        "imu": (folder / IMU_FILE, _imu_columns(read_text(folder / IMU_FILE))),
        "gnss": (folder / GNSS_FILE, _fix_columns(read_text(folder / GNSS_FILE))),
    }
    device = Device(name="KITTI OXTS RT3003", forward="+x", up="+z")
    return build_session(tables, repairs, device=device, gravity_m_s2=GRAVITY)


def _imu_columns(table: TextTable) -> Table:
    table.require(("Time", *_GYRO, *_ACCEL))
    gyro = vector_columns("gyro_{}_rad_s", table.floats(*_GYRO))
    return {"t_ns": table.times("Time")} | gyro | vector_columns("accel_{}_m_s2", table.floats(*_ACCEL))


def _fix_columns(table: TextTable) -> Table:
    table.require(("Time", "X", "Y", "Z"))
    return {"t_ns": table.times("Time")} | vector_columns("{}_m", table.floats("X", "Y", "Z"), "enu")


READER = Reader(
    name=NAME,
    summary="KITTI drive shipped with gtsam: IMU 100 Hz, positions 1 Hz, 471 s",
    recognised_by=f"the name {NAME!r}, or a folder with {IMU_FILE} and {GNSS_FILE}",
    matches=_matches,
    read_source=_read,
)
