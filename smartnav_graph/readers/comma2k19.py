"""comma2k19 segments: car phone IMU, u-blox fixes, wheel speed and a global pose, as numpy arrays without suffix.

Schafer et al. (2018), A commute in data: the comma2k19 dataset. IMU axes are forward, right, down; all stamps count
seconds since the device was booted. The global pose is the set's own optimised INS / GNSS / vision solution of the
camera (ECEF metres, quaternion w first, ECEF <- forward-right-down).
"""

from __future__ import annotations

from pathlib import Path
from tokenize import TokenError

import numpy as np

from smartnav_graph.core.arrays import Floats, Table, Times
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.frames import LocalFrame, Origin
from smartnav_graph.core.so3 import from_quaternion, quaternion
from smartnav_graph.core.timebase import ns_from_texts
from smartnav_graph.readers.source import Reader, build_session, inertial_columns, vector_columns
from smartnav_graph.session.session import Device, Session

IMU = Path("processed_log", "IMU")
FIXES = Path("processed_log", "GNSS", "live_gnss_ublox")
SPEED = Path("processed_log", "CAN", "speed")
POSE = Path("global_pose")


def _matches(source: str) -> bool:
    return (Path(source) / IMU / "accelerometer" / "t").is_file() and (Path(source) / IMU / "gyro" / "t").is_file()


def _read(source: str, repairs: tuple[str, ...]) -> Session:
    root = Path(source)
    tables = {"imu": (root / IMU, _imu_columns(root))}
    origin = None
    if (root / FIXES).is_dir():
        tables["gnss"] = (root / FIXES, _fix_columns(root))
        first = tables["gnss"][1]
        origin = Origin(*(float(first[name][0]) for name in ("lat_deg", "lon_deg", "height_m")))
    if (root / SPEED).is_dir():
        speed = _values(root / SPEED / "value", 1)[:, 0]
        tables["wheel"] = (root / SPEED, {"t_ns": _times(root / SPEED / "t", len(speed)), "speed_m_s": speed})
    if origin is not None and (root / POSE).is_dir():
        tables["reference"] = (root / POSE, _reference_columns(root / POSE, LocalFrame(origin)))
    device = Device(name="comma EON", forward="+x", up="-z")
    return build_session(tables, repairs, device=device, clock_epoch="boot", origin=origin)


def _imu_columns(root: Path) -> Table:
    accel, gyro = (_values(root / IMU / name / "value", 3) for name in ("accelerometer", "gyro"))
    t_ns = _times(root / IMU / "accelerometer" / "t", len(accel))
    if not np.array_equal(t_ns, _times(root / IMU / "gyro" / "t", len(gyro))):
        raise SessionError(root / IMU, "accelerometer and gyro have different stamps", "one stamp for both")
    return inertial_columns(t_ns, gyro, accel)


def _fix_columns(root: Path) -> Table:
    """Columns of the log: latitude, longitude deg, speed m/s, UTC ms, ellipsoidal height m, bearing deg.

    Speed, bearing and UTC stay beside the fix; a horizontal speed is no velocity vector.
    """
    rows = _values(root / FIXES / "value", 6)
    names = ("lat_deg", "lon_deg", "speed_m_s", "utc_ms", "height_m", "bearing_deg")
    return {"t_ns": _times(root / FIXES / "t", len(rows))} | dict(zip(names, rows.T, strict=True))


def _reference_columns(folder: Path, frame: LocalFrame) -> Table:
    ecef, velocity = (_values(folder / name, 3) for name in ("frame_positions", "frame_velocities"))
    ecef_R_body = from_quaternion(_values(folder / "frame_orientations", 4))
    quat = quaternion(frame.nav_R_ecef @ ecef_R_body)
    columns: Table = {"t_ns": _times(folder / "frame_times", len(ecef))}
    columns |= vector_columns("{}_m", frame.nav_from_ecef(ecef), "enu")
    columns |= vector_columns("q{}", quat, "wxyz")
    return columns | vector_columns("v{}_m_s", velocity @ frame.nav_R_ecef.T, "enu")


def _load(path: Path) -> Floats:
    try:
        rows = np.lib.format.open_memmap(path, mode="r")  # a header that claims more than the file holds is refused
        if rows.dtype.kind not in "fiu":
            raise ValueError(f"it holds {rows.dtype}")
        return np.array(rows, dtype=np.float64)
    except FileNotFoundError as error:
        raise SessionError(path, "is missing", "a numpy array", "fetch the whole segment") from error
    except (OSError, ValueError, EOFError, SyntaxError, TypeError, MemoryError, RecursionError, TokenError) as error:
        raise SessionError(path, f"cannot be read ({error})", "a numpy array of numbers") from error


def _values(path: Path, width: int) -> Floats:
    rows = _load(path)
    if rows.ndim != 2 or rows.shape[1] != width:
        raise SessionError(path, f"has shape {rows.shape}", f"(n, {width})", "check the format of the segment")
    return rows


def _times(path: Path, count: int) -> Times:
    """Stamps as exact as the floats that hold them: through their shortest decimal text."""
    seconds = _load(path)
    if seconds.shape != (count,):
        raise SessionError(path, f"has shape {seconds.shape}", f"({count},), one stamp per value")
    bad = np.flatnonzero(~np.isfinite(seconds))
    if len(bad):
        row = int(bad[0])
        raise SessionError(path, f"is {seconds[row]} at row {row}", "finite seconds", row=row)
    return ns_from_texts([repr(value) for value in seconds.tolist()])


READER = Reader(
    name="comma2k19",
    summary="comma2k19 segment: IMU 104 Hz, u-blox fixes, wheel speed, global pose",
    recognised_by="a folder with processed_log/IMU/accelerometer/t",
    matches=_matches,
    read_source=_read,
)
