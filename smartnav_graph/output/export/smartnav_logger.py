"""A session as a folder of the SmartNav logger of 2012; see `readers.smartnav_logger` for its files.

Stamps of the processor are whole milliseconds of the session's clock; those of the sensors nanoseconds since an hour
before time zero, tied by a pair every second. What the format has no file for is not written, and counted.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import tomli_w

from smartnav_graph.core.arrays import Times
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.files import file_inside, replacing
from smartnav_graph.core.timebase import NS
from smartnav_graph.readers.fixes import RADIUS_68
from smartnav_graph.readers.match_file import on_sensor, write_match_file
from smartnav_graph.readers.smartnav_logger import COLUMNS, HEADER
from smartnav_graph.session.calibration.model import calibration_toml
from smartnav_graph.session.folder import header_of
from smartnav_graph.session.session import Session
from smartnav_graph.session.streams import ControlPoint, GnssFix, Images, Imu, Magnetometer

WRITTEN = ("imu", "gnss", "magnetometer", "images", "control", "matches")
_BEFORE_NS = 3600 * NS  # from the start of the sensors' clock to time zero
_MS = 10**6
_NAMES = {"imu": "IMU", "compass": "Compass", "sync": "Sync", "gps": "GPS", "camera": "Camera"}


def write_smartnav(session: Session, path: str | Path, *, force: bool = False) -> dict[str, int]:
    """Write a folder of the SmartNav logger.

    Parameters
    ----------
    session : with inertial data
    force : replace an existing folder

    Returns
    -------
    Rows of the streams that the format has no file for, by stream.

    Raises
    ------
    SessionError
        No inertial data; the folder exists; the system refuses to write.
    """
    imu = session.require_imu()
    with replacing(path, force=force) as folder:
        folder.mkdir()
        zero = session.t0_ns - _BEFORE_NS
        _write(folder, "imu", _imu_lines(imu, zero))
        _write(folder, "sync", _sync_lines(imu.t_ns, zero))
        if session.magnetometer is not None:
            _write(folder, "compass", _compass_lines(session.magnetometer, zero))
        if session.gnss is not None:
            _write(folder, "gps", _fix_lines(session, session.gnss))
        if session.images is not None:
            _write(folder, "camera", (f"{n},{_ms(t)}" for n, t in _numbered(session.images)))
            _pictures(session, session.images, folder)
        if session.control is not None:
            (folder / "ControlPoints.csv").write_text("\n".join(_point_lines(session, session.control)) + "\n")
        _header(session, folder)
        unwritten = _matches(session, folder)
    others = {name: len(stream) for name, stream in session.streams().items() if name not in WRITTEN}
    return others | unwritten


def _write(folder: Path, word: str, lines: Iterable[str]) -> None:
    with open(folder / f"{_NAMES[word]}.txt", "w", encoding="ascii") as file:
        file.write(f"# {','.join(COLUMNS[word])}\n")
        file.writelines(f"{line}\n" for line in lines)


def _ms(t_ns: int) -> int:
    return round(t_ns / _MS) if abs(t_ns) < 2**53 else (t_ns + _MS // 2) // _MS


def _imu_lines(imu: Imu, zero: int) -> Iterable[str]:
    rows = zip((imu.t_ns - zero).tolist(), imu.gyro.tolist(), imu.accel.tolist(), strict=True)
    return (f"{t},{a:.8f},{b:.8f},{c:.8f},{x:.7f},{y:.7f},{z:.7f}" for t, (a, b, c), (x, y, z) in rows)


def _compass_lines(field: Magnetometer, zero: int) -> Iterable[str]:
    rows = zip((field.t_ns - zero).tolist(), field.field_ut.tolist(), strict=True)
    return (f"{t},{x:.5f},{y:.5f},{z:.5f}" for t, (x, y, z) in rows)


def _sync_lines(t_ns: Times, zero: int) -> Iterable[str]:
    """A pair every second, at inertial samples."""
    second = (t_ns - t_ns[0]) // NS
    first = np.flatnonzero(np.diff(second, prepend=-1))
    return (f"{_ms(t)},{t - zero}" for t in t_ns[first].tolist())


def _fix_lines(session: Session, fixes: GnssFix) -> Iterable[str]:
    lla = fixes.lla
    if lla is None:
        if session.frame is None:
            raise SessionError("gnss", "local positions without an origin", "latitude and longitude", "give [origin]")
        lla = session.frame.lla_from_nav(session.nav_position(fixes))
    sigma = np.full(len(fixes), np.nan) if fixes.sigma is None else np.sqrt((fixes.sigma[:, :2] ** 2).mean(axis=1))
    accuracy = np.nan_to_num(sigma * RADIUS_68)  # 0: none
    rows = zip(fixes.t_ns.tolist(), lla.tolist(), accuracy.tolist(), strict=True)
    return (
        f"{_ms(t)},{_ms(t)},{lat:.10f},{lon:.10f},{'' if np.isnan(h) else f'{h:.4f}'},{radius:.3f}"
        for t, (lat, lon, h), radius in rows
    )


def _numbered(images: Images) -> list[tuple[int, int]]:
    """Number and stamp of every image."""
    return list(zip(images.image_id.tolist(), images.t_ns.tolist(), strict=True))


def _pictures(session: Session, images: Images, folder: Path) -> None:
    """Pictures under the names of the logger; those of another kind become JPEG."""
    from PIL import Image

    for (number, t), file in zip(_numbered(images), map(str, images.file), strict=True):
        source = None if session.pictures is None else file_inside(session.pictures, file)
        if source is None:
            continue
        target = folder / f"Image_{number}_{_ms(t)}.jpg"
        if source.suffix.lower() in (".jpg", ".jpeg"):
            shutil.copy2(source, target)
        else:
            with Image.open(source) as picture:
                picture.convert("L" if picture.mode in ("1", "L", "I;16") else "RGB").save(target, quality=95)


def _point_lines(session: Session, control: ControlPoint) -> Iterable[str]:
    """A list of control points; those at a listed standstill with its start and end."""
    places = control.lla if control.lla is not None else control.enu
    assert places is not None  # checked when the stream was built
    start, end = control.t_ns.copy(), control.t_ns.copy()
    static = session.static
    if static is not None and len(static):
        of = np.clip(np.searchsorted(static.t_ns, control.t_ns, side="right") - 1, 0, None)
        inside = (static.t_ns[of] <= control.t_ns) & (control.t_ns <= static.t_end_ns[of])
        reach = np.minimum(control.t_ns - static.t_ns[of], static.t_end_ns[of] - control.t_ns)
        start, end = np.where(inside, control.t_ns - reach, start), np.where(inside, control.t_ns + reach, end)
    stops = bool((end > start).all())
    sigma = np.full((len(control), 3), np.nan) if control.sigma is None else control.sigma
    sensors = np.full(len(control), "", dtype=object) if control.sensor is None else control.sensor
    names = "lat,lon,height" if control.lla is not None else "E,N,H"
    yield f"id,{'start_ns,end_ns' if stops else 't_ns'},{names},sigma_e,sigma_n,sigma_u,sensor"
    for i, name in enumerate(control.point_id):
        when = f"{start[i]},{end[i]}" if stops else f"{control.t_ns[i]}"
        numbers = ",".join("" if np.isnan(value) else f"{value:.10f}" for value in (*places[i], *sigma[i]))
        yield f"{name},{when},{numbers},{sensors[i]}"


def _header(session: Session, folder: Path) -> None:
    """What the logger's files do not hold: device, mounts, origin, calibration."""
    header = {name: value for name, value in header_of(session).items() if name not in ("repair", "clock")}
    if session.calibration is not None:
        (folder / "calibration.toml").write_text(calibration_toml(session.calibration), encoding="utf-8")
    (folder / HEADER).write_text(tomli_w.dumps(header), encoding="utf-8")


def _matches(session: Session, folder: Path) -> dict[str, int]:
    """Matches of the only calibrated camera; the rows that cannot be written."""
    if session.matches is None:
        return {}
    cameras = session.calibration.cameras if session.calibration is not None else {}
    if len(cameras) != 1:
        return {"matches": len(session.matches)}
    camera = next(iter(cameras.values()))
    inside = on_sensor(session.matches, camera)
    write_match_file(session.matches.take(inside), folder / "Matches.txt", camera)
    return {} if inside.all() else {"matches beyond the edge of the sensor": int((~inside).sum())}
