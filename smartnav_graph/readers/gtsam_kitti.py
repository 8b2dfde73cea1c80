"""The KITTI drive that every gtsam installation ships: 471 s of car IMU and 1 Hz positions.

It is drive 2011_10_03_0027 (odometry sequence 00) of Geiger et al. (2013), Vision meets robotics. IMU axes are
forward, left, up; positions are metres in a local ENU-like frame without stated origin, and carry no sigmas.
"""

from __future__ import annotations

from pathlib import Path

from smartnav_graph.readers.source import Reader, build_session, example_file, inertial_columns, vector_columns
from smartnav_graph.readers.text import first_lines, read_text
from smartnav_graph.session.session import Device, Session

NAME = "gtsam-kitti"
IMU_FILE = "KittiEquivBiasedImu.txt"
GNSS_FILE = "KittiGps_converted.txt"
GRAVITY = 9.81

_ACCEL = ("accelX", "accelY", "accelZ")
_GYRO = ("omegaX", "omegaY", "omegaZ")


def _matches(source: str) -> bool:
    if source == NAME:
        return True
    folder = Path(source)
    return (folder / GNSS_FILE).is_file() and first_lines(folder / IMU_FILE, 1) == [
        " ".join(("Time", "dt", *_ACCEL, *_GYRO))
    ]


def _read(source: str, repairs: tuple[str, ...]) -> Session:
    folder = example_file(IMU_FILE).parent if source == NAME else Path(source)
    inertial, fixes = read_text(folder / IMU_FILE), read_text(folder / GNSS_FILE)
    inertial.require(("Time", *_GYRO, *_ACCEL))
    fixes.require(("Time", "X", "Y", "Z"))
    imu = inertial_columns(inertial.times("Time"), inertial.floats(*_GYRO), inertial.floats(*_ACCEL))
    gnss = {"t_ns": fixes.times("Time")} | vector_columns("{}_m", fixes.floats("X", "Y", "Z"), "enu")
    tables = {"imu": (folder / IMU_FILE, imu), "gnss": (folder / GNSS_FILE, gnss)}
    device = Device(name="KITTI OXTS RT3003", forward="+x", up="+z")
    return build_session(tables, repairs, device=device, gravity_m_s2=GRAVITY)


READER = Reader(
    name=NAME,
    summary="KITTI drive shipped with gtsam: IMU 100 Hz, positions 1 Hz, 471 s",
    recognised_by=f"the name {NAME!r}, or a folder with {IMU_FILE} and {GNSS_FILE}",
    matches=_matches,
    read_source=_read,
)
