"""Copies of a session's images with position, direction, time and one sigma in their EXIF.

The pose of the camera follows from that of the body at the time of the image, with clock offset and lever arm:

    nav_t_cam = nav_t_body + nav_R_body body_t_cam,    nav_R_cam = nav_R_body body_R_cam Exp(boresight)

GPSImgDirection is the azimuth of the optical axis from true north at the camera, left out where the axis points
within `STEEP_DEG` of the vertical. Altitudes are ellipsoidal, as in Exif 3.0. GPSHPositioningError is one sigma
horizontal, sqrt(var_e + var_n), of the body. Between the rows of the solution, position is interpolated by a cubic
Hermite spline with the velocities, attitude by slerp: smooth with ``--rate imu`` where rows are far apart.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, Slerp

from smartnav_graph.core.arrays import Floats, Times
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.files import refuse_existing, refuse_foreign, replacing
from smartnav_graph.core.frames import LocalFrame
from smartnav_graph.core.progress import Progress, silent, watched
from smartnav_graph.core.so3 import exp, rotate
from smartnav_graph.core.timebase import interpolate, ns_from_seconds, seconds_since
from smartnav_graph.factors.context import camera_name
from smartnav_graph.graph.solution import POS, Solution
from smartnav_graph.output.export.exif import with_exif
from smartnav_graph.output.export.geographic import warn_of_heights
from smartnav_graph.output.summary_json import Summary, list_of, table_of
from smartnav_graph.session.calibration.model import Calibration
from smartnav_graph.session.session import Session
from smartnav_graph.vision.images import Picture, pictures

if TYPE_CHECKING:
    from PIL.TiffImagePlugin import IFDRational

TABLE = "geotags.csv"
STEEP_DEG = 5.0
AHEAD_M = 100.0  # the azimuth is that of a point at this distance on the optical axis
GPS_IFD = 0x8825
# Tags of the GPS part, Exif 3.0 table 15.
VERSION, DATUM, ERROR = 0, 18, 31
LAT_REF, LAT, LON_REF, LON, ALT_REF, ALT = range(1, 7)
TIME, DIRECTION_REF, DIRECTION, DATE = 7, 16, 17, 29


@dataclass(frozen=True)
class Place:
    """Position and direction of one image: lat, lon deg, ellipsoidal height m; direction deg or NaN; sigmas m."""

    t_ns: int
    lat_deg: float
    lon_deg: float
    height_m: float
    direction_deg: float
    sigma_horizontal_m: float
    sigma_u_m: float


@dataclass(frozen=True)
class Geotags:
    """Number of images written, and of those left out by reason."""

    written: int
    left_out: Mapping[str, int]


def export_pictures(
    solution: Solution,
    session: Session,
    path: str | Path,
    *,
    calibration: Calibration | None = None,
    states: Summary | None = None,
    force: bool = False,
    progress: Progress = silent,
) -> Geotags:
    """Write a folder of copies with EXIF position and direction, and a table of the same; originals stay unchanged.

    Parameters
    ----------
    session : with images (JPEG or PNG files); all bytes but the EXIF are copied unchanged
    path : the new folder
    calibration : of the run, for the clock offset of the camera; the session's own by default
    states : of the run's summary: estimated clock offset and boresight
    force : replace an older folder of the same kind
    progress : called for every image

    Raises
    ------
    SessionError
        No origin, no images, none of them inside the run; the path is taken.
    """
    if solution.origin is None:
        raise SessionError(
            "--format images",
            "the solution has no origin, only local metres",
            "an [origin] in session.toml",
            "add lat_deg, lon_deg, height_m and smooth again",
        )
    path, known = Path(path), calibration or session.calibration
    refuse_existing(path, force)
    refuse_foreign(path, TABLE)
    found = pictures(session)
    stamps = np.array([picture.t_ns for picture in found], dtype=np.int64) + clock_offsets_ns(session, known, states)
    inside = (stamps >= solution.t_ns[0]) & (stamps <= solution.t_ns[-1])
    taken = [picture for picture, there in zip(found, inside, strict=True) if there]
    if not taken:
        raise SessionError(path, f"none of {len(found)} pictures lies inside the run", "pictures of the same session")
    boresight = _state(states, "camera_boresight_rad", 3)
    where = places(solution, session, taken, stamps[inside], boresight)
    absolute = session.clock_epoch == "unix"
    with replacing(path, force=force) as folder:
        folder.mkdir()
        left_out = {"outside the run": int((~inside).sum())}
        rows = []
        for picture, place in watched("copying pictures", list(zip(taken, where, strict=True)), progress):
            fault = _copy(picture, place, folder, absolute)
            if fault:
                left_out[fault] = left_out.get(fault, 0) + 1
            else:
                rows.append((picture, place))
        _table(rows, folder / TABLE)
    warn_of_heights(solution, "--format images")
    return Geotags(len(rows), {reason: n for reason, n in left_out.items() if n})


def clock_offsets_ns(session: Session, calibration: Calibration | None, states: Summary | None) -> Times:
    """Clock offsets (n,) of the images: of each camera's calibration, and as estimated by the run."""
    assert session.images is not None  # `pictures` found some
    cameras = {} if calibration is None else calibration.cameras
    main, estimated = camera_name(session, calibration), float(_state(states, "images_time_offset_s", 1)[0])
    offsets = [
        (cameras[name].time_offset_s if name in cameras else 0.0) + (estimated if name == main else 0.0)
        for name in map(str, session.images.camera)
    ]
    return ns_from_seconds(np.array(offsets))


def _state(states: Summary | None, name: str, size: int) -> Floats:
    value = list_of(table_of(states or {}, name), "value") or np.zeros(size)
    return np.asarray(value, dtype=np.float64).reshape(size)


def places(solution: Solution, session: Session, taken: list[Picture], t_ns: Times, boresight: Floats) -> list[Place]:
    """Positions of images (n,) taken at t_ns (n,) of the body's clock."""
    assert solution.origin is not None
    frame = LocalFrame(solution.origin)
    R, p = _poses(solution, t_ns)
    mounts = [session.mount(picture.camera) for picture in taken]
    arms, rotations = np.array([m.body_t for m in mounts]), np.array([m.body_R for m in mounts])
    main = np.array([picture.camera == camera_name(session, session.calibration) for picture in taken])
    rotations = rotations @ exp(main[:, None] * boresight)
    at = p + rotate(R, arms)
    axis = (R @ rotations)[:, :, 2]
    lla, variance = frame.lla_from_nav(at), interpolate(t_ns, solution.t_ns, solution.sigmas[:, POS] ** 2)
    direction = _azimuths(frame, at, axis)
    horizontal, up = np.sqrt(variance[:, :2].sum(axis=1)), np.sqrt(variance[:, 2])
    columns = np.column_stack([lla, direction, horizontal, up]).tolist()
    return [Place(int(t), *row) for t, row in zip(t_ns, columns, strict=True)]


def _poses(solution: Solution, t_ns: Times) -> tuple[Floats, Floats]:
    if len(solution) == 1:
        return np.tile(solution.nav_R_body, (len(t_ns), 1, 1)), np.tile(solution.nav_t_body, (len(t_ns), 1))
    knots, at = solution.seconds, seconds_since(t_ns, solution.t0_ns)
    R = Slerp(knots, Rotation.from_matrix(solution.nav_R_body))(at)
    return R.as_matrix(), np.asarray(CubicHermiteSpline(knots, solution.nav_t_body, solution.nav_v_body)(at))


def _azimuths(frame: LocalFrame, at: Floats, axis: Floats) -> Floats:
    """Azimuth (n,) deg in [0, 360) from true north at each camera of the optical axis (n, 3); NaN where it is steep."""
    import pyproj

    lat0, lon0, _ = frame.lla_from_nav(at).T
    lat1, lon1, _ = frame.lla_from_nav(at + AHEAD_M * axis).T
    azimuth, _, _ = pyproj.Geod(ellps="WGS84").inv(lon0, lat0, lon1, lat1)
    level = np.linalg.norm(axis[:, :2], axis=1)
    return np.where(level > np.sin(np.radians(STEEP_DEG)), np.asarray(azimuth) % 360.0, np.nan)


def _copy(picture: Picture, place: Place, folder: Path, absolute: bool) -> str:
    """Write one copy; returns why it cannot be written, else nothing."""
    from PIL import Image, UnidentifiedImageError

    if not picture.path.is_file():
        return "missing file"
    try:
        data = picture.path.read_bytes()
        with Image.open(picture.path) as opened:
            exif = opened.getexif()
        place_tags = exif.get_ifd(GPS_IFD)
        place_tags.clear()  # an older position with its attributes
        place_tags.update(gps_tags(place, absolute))
        new = with_exif(data, exif.tobytes().removeprefix(b"Exif\0\0"))
    except (UnidentifiedImageError, ValueError, Image.DecompressionBombError):
        return "damaged JPEG or PNG"
    (folder / picture.file).parent.mkdir(parents=True, exist_ok=True)
    (folder / picture.file).write_bytes(new)
    return ""


def gps_tags(place: Place, absolute: bool) -> dict[int, object]:
    """The GPS part of the EXIF by tag number; with the time where it is absolute."""
    tags: dict[int, object] = {
        VERSION: b"\x02\x03\x00\x00",
        LAT_REF: "N" if place.lat_deg >= 0 else "S",
        LAT: _dms(place.lat_deg),
        LON_REF: "E" if place.lon_deg >= 0 else "W",
        LON: _dms(place.lon_deg),
        ALT_REF: b"\x00" if place.height_m >= 0 else b"\x01",
        ALT: _ratio(abs(place.height_m), 1000),
        DATUM: "WGS-84",
    }
    if np.isfinite(place.direction_deg):
        tags |= {DIRECTION_REF: "T", DIRECTION: _ratio(place.direction_deg, 100)}
    if np.isfinite(place.sigma_horizontal_m):
        tags[ERROR] = _ratio(place.sigma_horizontal_m, 1000)
    if absolute:
        day, clock = str(np.datetime64(place.t_ns, "ns")).split("T")
        hours, minutes, seconds = clock.split(":")
        tags |= {
            DATE: day.replace("-", ":"),
            TIME: (_ratio(int(hours), 1), _ratio(int(minutes), 1), _ratio(float(seconds), 1_000_000)),
        }
    return tags


def _dms(degrees: float) -> tuple[IFDRational, IFDRational, IFDRational]:
    """Degrees, minutes, seconds to 1e-5'' (0.3 mm), with carry where they round to 60."""
    whole = round(abs(degrees) * 3600 * 100_000)
    minutes, seconds = divmod(whole, 60 * 100_000)
    return _ratio(minutes // 60, 1), _ratio(minutes % 60, 1), _ratio(seconds / 100_000, 100_000)


def _ratio(value: float, parts: int) -> IFDRational:
    from PIL.TiffImagePlugin import IFDRational

    return IFDRational(round(value * parts), parts)


def _table(rows: list[tuple[Picture, Place]], path: Path) -> None:
    """The same as a table for photogrammetry programs; an unknown direction is empty."""
    names = ("t_ns", "lat_deg", "lon_deg", "height_m", "direction_deg", "sigma_horizontal_m", "sigma_u_m")
    digits = (None, 10, 10, 4, 3, 4, 4)
    with open(path, "w", encoding="utf-8", newline="") as file:
        write = csv.writer(file, lineterminator="\n").writerow
        write(("file", *names))
        for picture, place in rows:
            values = [getattr(place, name) for name in names]
            cells = [v if d is None else f"{v:.{d}f}" for v, d in zip(values, digits, strict=True)]
            # a name that a spreadsheet would take for a formula
            name = f"./{picture.file}" if picture.file[0] in "=+-@" else picture.file
            write((name, *("" if cell == "nan" else cell for cell in cells)))
