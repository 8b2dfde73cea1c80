"""KITTI raw drives: ``oxts/data`` (OXTS RT3003: inertial data, fused position and attitude) and pictures.

Geiger et al. (2013), Vision meets robotics: the KITTI dataset, IJRR 32(11); dataformat.txt of the development kit.
Axes of the unit are forward, left, up. Position, velocity and attitude are of the unit's own filter: the fixes are
practically free of noise, and the reference is the same solution. Yaw is zero towards east, and counts to the left.
Stamps are dates, of local time and without a zone: they are kept as if they were UTC.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from smartnav_graph.core.arrays import Floats, Table, Times
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.frames import LocalFrame, Origin
from smartnav_graph.core.so3 import quaternion
from smartnav_graph.readers.source import Reader, build_session, inertial_columns, mount, only_folder, vector_columns
from smartnav_graph.readers.stamps import ns_from_date
from smartnav_graph.session.calibration.camera import Camera
from smartnav_graph.session.calibration.model import Calibration
from smartnav_graph.session.session import Device, Mount, Session

GRAVITY = 9.81
DEVICE = "KITTI OXTS RT3003"
_LEAST_COLUMNS = 25  # up to vel_accuracy
_CALIBRATION = ("calib_imu_to_velo.txt", "calib_velo_to_cam.txt", "calib_cam_to_cam.txt")


def _root(source: str) -> Path | None:
    """The folder of the drive: `source`, or the only such folder in it or one level below."""

    def holds(folder: Path) -> bool:
        return (folder / "oxts" / "timestamps.txt").is_file() and (folder / "oxts" / "data").is_dir()

    return only_folder(source, holds, depth=2)


def _read(source: str, repairs: tuple[str, ...]) -> Session:
    root = _root(source)
    if root is None:
        raise SessionError(source, "is no KITTI raw drive, or several", "one folder with oxts/data", "give the drive")
    rows, t_ns = _oxts(root / "oxts")
    origin = Origin(*(float(value) for value in rows[0, :3]))
    velocity = np.stack([rows[:, 7], rows[:, 6], rows[:, 10]], axis=-1)  # columns vn, ve, vf, vl, vu
    position = np.where(rows[:, 23:24] > 0.0, rows[:, 23:24], np.nan)
    gnss: Table = {"t_ns": t_ns, "lat_deg": rows[:, 0], "lon_deg": rows[:, 1], "height_m": rows[:, 2]}
    gnss |= vector_columns("sigma_{}_m", np.repeat(position, 3, axis=1), "enu")
    gnss |= vector_columns("v{}_m_s", velocity, "enu")
    enu = LocalFrame(origin).nav_from_lla(rows[:, :3])
    reference = {"t_ns": t_ns} | vector_columns("{}_m", enu, "enu")
    reference |= vector_columns("q{}", quaternion(_attitude(rows[:, 3:6])), "wxyz")
    reference |= vector_columns("v{}_m_s", velocity, "enu")
    where = root / "oxts"
    tables: dict[str, tuple[Path, Table]] = {
        "imu": (where, inertial_columns(t_ns, rows[:, 17:20], rows[:, 11:14])),
        "gnss": (where, gnss),
        "reference": (where, reference),
    }
    cameras = sorted(folder.name for folder in root.glob("image_0[0-3]") if any((folder / "data").glob("*.png")))
    if cameras:
        tables["images"] = (root, _images(root, cameras))
    mounts, known = _cameras(root, cameras)
    return build_session(
        tables,
        repairs,
        device=Device(name=DEVICE, forward="+x", up="+z", vehicle="car"),
        clock_epoch="unix",
        origin=origin,
        gravity_m_s2=GRAVITY,
        sensors=mounts,
        calibration=Calibration(device=DEVICE, cameras=known) if known else None,
        pictures=root if cameras else None,
    )


def _oxts(folder: Path) -> tuple[Floats, Times]:
    """Rows (n, 30) of all files and their stamps; files without a stamp, and stamps without a file, are an error."""
    t_ns = _stamps(folder / "timestamps.txt")
    files = sorted((folder / "data").glob("*.txt"))
    if len(files) != len(t_ns) or not files:
        raise SessionError(
            folder, f"has {len(files)} files and {len(t_ns)} stamps", "one stamp a file", "copy it again"
        )
    rows = []
    for file in files:
        try:
            cells = [float(cell) for cell in file.read_text(encoding="ascii", errors="replace").split()]
            if len(cells) < _LEAST_COLUMNS:
                raise ValueError(f"{len(cells)} numbers")
            if not np.isfinite(cells[:_LEAST_COLUMNS]).all() or abs(cells[0]) > 90.0 or abs(cells[1]) > 360.0:
                raise ValueError("a number is out of range")
        except (OSError, ValueError) as error:
            raise SessionError(file, f"cannot be read ({error})", "30 numbers of OXTS", "copy it again") from error
        rows.append(cells[:_LEAST_COLUMNS])
    return np.array(rows), t_ns


def _stamps(path: Path) -> Times:
    try:
        lines = path.read_text(encoding="ascii", errors="replace").split("\n")
    except OSError as error:
        raise SessionError(path, f"cannot be read ({error.strerror})", "dates, one a row", "copy it again") from error
    found = []
    for row, line in enumerate(line for line in lines if line.strip()):
        try:
            found.append(ns_from_date(line.strip()))
        except SessionError as error:
            raise SessionError(path, f"{error.found} at row {row}", error.expected, "copy it again", row=row) from error
    return np.array(found, dtype=np.int64)


def _attitude(angles: Floats) -> Floats:
    """nav_R_body (n, 3, 3) of roll, pitch, yaw (n, 3): Rz(yaw) Ry(pitch) Rx(roll)."""
    (sr, sp, sy), (cr, cp, cy) = np.sin(angles).T, np.cos(angles).T
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def _images(root: Path, cameras: list[str]) -> Table:
    """One row a picture of any camera, by time."""
    t_ns: list[Times] = []
    files: list[str] = []
    names: list[str] = []
    for camera in cameras:
        found = sorted(file.name for file in (root / camera / "data").glob("*.png"))
        stamps = _stamps(root / camera / "timestamps.txt")
        rows = [int(name.partition(".")[0]) for name in found if name.partition(".")[0].isdecimal()]
        if len(rows) != len(found) or max(rows) >= len(stamps):
            found_text = f"has {len(found)} pictures, and {len(stamps)} stamps"
            raise SessionError(root / camera, found_text, "pictures named by the row of their stamp", "copy it again")
        t_ns.append(stamps[rows])
        files += [f"{camera}/data/{name}" for name in found]
        names += [camera] * len(found)
    times = np.concatenate(t_ns)
    order = np.argsort(times, kind="stable")
    columns: Table = {"t_ns": times[order], "image_id": np.arange(len(times))}
    columns |= {"file": np.array(files, dtype=object)[order], "camera": np.array(names, dtype=object)[order]}
    return columns


def _cameras(root: Path, names: list[str]) -> tuple[dict[str, Mount], dict[str, Camera]]:
    """Mounts and interior orientation of rectified pictures, where the day's calibration is there or one level up."""
    folder = next((f for f in (root, root.parent) if all((f / name).is_file() for name in _CALIBRATION)), None)
    if folder is None:
        return {}, {}
    velo_T_imu, cam_T_velo = (_rigid(folder / name, "R", "T") for name in _CALIBRATION[:2])
    texts = _entries(folder / _CALIBRATION[2])
    rectify = np.eye(4)
    rectify[:3, :3] = _matrix(folder / _CALIBRATION[2], texts, "R_rect_00", 9).reshape(3, 3)
    mounts, cameras = {}, {}
    for name in names:
        number = name[-2:]
        P = _matrix(folder / _CALIBRATION[2], texts, f"P_rect_{number}", 12).reshape(3, 4)
        width, height = _matrix(folder / _CALIBRATION[2], texts, f"S_rect_{number}", 2)
        shifted = np.eye(4)
        shifted[:3, 3] = np.linalg.solve(P[:, :3], P[:, 3])
        body_T_cam = np.linalg.inv(shifted @ rectify @ cam_T_velo @ velo_T_imu)
        mounts[name] = mount(body_T_cam[:3, 3], body_T_cam[:3, :3])
        fx, fy, cx, cy = (float(P[place]) for place in ((0, 0), (1, 1), (0, 2), (1, 2)))
        cameras[name] = Camera(int(width), int(height), fx, fy, cx, cy)
    return mounts, cameras


def _entries(path: Path) -> dict[str, str]:
    text = path.read_text(encoding="ascii", errors="replace")
    return {match[1]: match[2] for match in re.finditer(r"(?m)^(\w+):[ \t]*(.*)$", text)}


def _matrix(path: Path, entries: dict[str, str], name: str, count: int) -> Floats:
    try:
        numbers = np.array(entries.get(name, "").split(), dtype=np.float64)
    except ValueError:
        numbers = np.zeros(0)
    if numbers.shape != (count,) or not np.isfinite(numbers).all():
        raise SessionError(path, f"{name} is missing or no list of {count} numbers", f"{name}: ...", "copy it again")
    return numbers


def _rigid(path: Path, rotation: str, translation: str) -> Floats:
    entries, out = _entries(path), np.eye(4)
    out[:3, :3] = _matrix(path, entries, rotation, 9).reshape(3, 3)
    out[:3, 3] = _matrix(path, entries, translation, 3)
    return out


READER = Reader(
    name="kitti-raw",
    summary="KITTI raw drive: OXTS inertial data, fused position and attitude, pictures, calibration",
    recognised_by="a folder (or the only such folder in it) with oxts/timestamps.txt and oxts/data",
    matches=lambda source: _root(source) is not None,
    read_source=_read,
)
