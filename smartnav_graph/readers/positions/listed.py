"""Lists of positions as delimited text with headings: fixes of a receiver, and surveyed control points.

Fixes: a time, and latitude and longitude, or east and north with EPSG. Control points have an id as well; their time is
one epoch, the start and end of a stop (which is then a standstill, too), or left out where `join` finds the stops.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from smartnav_graph.core.arrays import Floats, Table, Texts, Times
from smartnav_graph.core.errors import SessionError
from smartnav_graph.readers.fixes import LoggedFixes, first_fix
from smartnav_graph.readers.positions.headings import (
    COMMENTS,
    PositionTable,
    clock_readings,
    has_positions,
    read_positions,
    roles_in,
)
from smartnav_graph.readers.positions.places import geodetic
from smartnav_graph.readers.positions.track import session_of_fixes
from smartnav_graph.readers.source import Reader, build_session, first_bytes, vector_columns
from smartnav_graph.readers.text_lines import heading_of
from smartnav_graph.readers.units import plain_heading
from smartnav_graph.session.session import Mount, Session

_EPSG = re.compile(rb"(?m)^[#%].*?EPSG\W{0,3}(\d{4,5})", re.IGNORECASE)
_STOP_SIGMA_M_S = 0.01  # of a stop that is given by its start and end
_LOCAL_M = 20_000.0  # coordinates without EPSG up to here are of a local frame


@dataclass(frozen=True)
class SurveyedPoints:
    """Control points of a list, in its order: `rows` (n, 3) lat deg, lon deg, height m, or local east, north, up m.

    t_ns, t_end_ns : when the device was there, and until when; None where the list does not say
    epsg : with the coordinates (n, 3) as they were given
    """

    path: Path
    ids: Texts
    rows: Floats
    is_local: bool
    columns: Table
    mount: Mount
    t_ns: Times | None = None
    t_end_ns: Times | None = None
    clock_epoch: str = "unknown"
    epsg: int | None = None
    given: Floats | None = None

    def session(self, repairs: tuple[str, ...] = ()) -> Session:
        """The points as the streams ``control`` and, where they are stops, ``static``.

        Raises
        ------
        SessionError
            The list has no times.
        """
        if self.t_ns is None:
            remedy = f"join them to the inertial log (`smartnav import LOG {self.path.name} --out S`) or add times"
            raise SessionError(self.path, "holds points without times", "a column time, or start and end", remedy)
        t_ns = self.t_ns if self.t_end_ns is None else self.t_ns + (self.t_end_ns - self.t_ns) // 2
        names = ("e_m", "n_m", "u_m") if self.is_local else ("lat_deg", "lon_deg", "height_m")
        order = np.argsort(t_ns, kind="stable")
        places: Table = dict(zip(names, self.rows.T, strict=True))
        table = {"t_ns": t_ns, "point_id": self.ids} | places | self.columns
        tables = {"control": (self.path, {name: np.asarray(column)[order] for name, column in table.items()})}
        if self.t_end_ns is not None:
            stops: Table = {"t_ns": self.t_ns[order], "t_end_ns": self.t_end_ns[order]}
            stops["sigma_v_m_s"] = np.full(len(order), _STOP_SIGMA_M_S)
            stops["source"] = np.full(len(order), "control points", dtype=object)
            tables["static"] = (self.path, stops)
        origin = None if self.is_local else first_fix(tables["control"][1])
        mounts = {"control": self.mount} if self.mount != Mount() else {}
        return build_session(tables, repairs, clock_epoch=self.clock_epoch, origin=origin, sensors=mounts)


def is_control(source: str) -> bool:
    """Whether a file is a list of control points."""
    headings = heading_of(Path(source), COMMENTS)
    roles = roles_in(headings)
    return has_positions(headings) and "id" in roles and not {"speed", "course"} & roles.keys()


def is_fixes(source: str) -> bool:
    """Whether a file is a list of fixes with times."""
    headings = heading_of(Path(source), COMMENTS)
    roles = roles_in(headings)
    # x, y, z alone may be anything, such as the axes of a sensor
    placed = (
        {"lat", "lon"} <= roles.keys() or "epsg" in roles or plain_heading(roles.get("east", "x")) not in ("x", "x_m")
    )
    return has_positions(headings) and placed and "time" in roles and not is_control(source)


def read_points(path: Path) -> SurveyedPoints:
    """The control points of a list.

    Raises
    ------
    SessionError
        A column is missing, a cell is no number, or a place lies outside its coordinate reference system.
    """
    found = read_positions(path)
    ids = found.texts("id")
    if ids is None:
        raise SessionError(path, "has no column of point names", "a column id", "name the points")
    rows, epsg, given = _places(found)
    mount = Mount()
    if "up" not in found.columns and "msl" in found.columns:
        geoid = found.floats("geoid")
        mount = Mount(frame="msl", geoid_m=float("nan") if geoid is None else float(np.nanmedian(geoid)))
    t_ns, t_end_ns, epoch = _when(found)
    columns = _sigma_columns(found)
    if (sensor := found.texts("sensor")) is not None:
        columns["sensor"] = sensor
    is_local = epsg is None and "lat" not in found.columns
    return SurveyedPoints(path, ids, rows, is_local, columns, mount, t_ns, t_end_ns, epoch, epsg, given)


def _places(found: PositionTable) -> tuple[Floats, int | None, Floats | None]:
    """Places (n, 3), and the system and the coordinates as they were given where there is one."""
    unknown = np.full(len(found.table), np.nan)
    up = next((column for role in ("up", "msl") if (column := found.floats(role)) is not None), unknown)
    lat, lon, east, north = (found.floats(role) for role in ("lat", "lon", "east", "north"))
    if lat is not None and lon is not None:
        return np.stack([lat, lon, up], axis=1), None, None
    if east is None or north is None:
        raise SessionError(found.path, "has no columns of positions", "E, N, H and EPSG, or lat, lon", "name them so")
    given = np.stack([east, north, up], axis=1)
    for row in np.flatnonzero(~np.isfinite(given[:, :2]).all(axis=1))[:1].tolist():
        raise SessionError(found.path, f"row {row} has no position", "E and N", "complete or delete it", row=row)
    codes = _codes(found)
    if codes is None:
        if np.abs(given[:, :2]).max() > _LOCAL_M:
            text = f"E {given[0, 0]:.10g}, N {given[0, 1]:.10g} without a coordinate reference system"
            raise SessionError(found.path, text, "a column EPSG", "add it (32633: UTM zone 33 north), or lat and lon")
        return given, None, None
    rows = np.empty_like(given)
    for epsg in np.unique(codes).tolist():
        of = codes == epsg
        rows[of] = geodetic(found.path, epsg, *given[of].T)
    return rows, int(codes[0]), given


def _codes(found: PositionTable) -> Times | None:
    """EPSG code (n,) of every row: of its column, else of a comment line."""
    if "epsg" not in found.columns:
        named = _EPSG.search(first_bytes(str(found.path)))
        return None if named is None else np.full(len(found.table), int(named[1]), dtype=np.int64)
    name = found.columns["epsg"]
    codes = []
    for row, text in enumerate(map(str, found.table.texts(name))):
        digits = re.fullmatch(r"(?:EPSG\W*)?(\d{4,5})", text.strip(), re.IGNORECASE)
        if digits is None:
            text = f"{name} is {text!r} at row {row}"
            raise SessionError(found.path, text, "a code such as 32633", "correct it", row=row)
        codes.append(int(digits[1]))
    return np.array(codes, dtype=np.int64)


def _when(found: PositionTable) -> tuple[Times | None, Times | None, str]:
    """Stamps, ends of stops and epoch; nothing where no row has a time."""
    if {"start", "end"} <= found.columns.keys():
        (start, epoch), (end, _) = found.stamps("start"), found.stamps("end")
        wrong = np.flatnonzero(end <= start)
        if len(wrong):
            row = int(wrong[0])
            text = f"row {row} ends before it starts"
            raise SessionError(found.path, text, "start before end", "correct it", row=row)
        return start, end, epoch
    if "time" not in found.columns or found.table.is_empty(found.columns["time"]):
        return None, None, "unknown"
    name = found.columns["time"]
    texts = list(map(str, found.table.texts(name)))
    if all("/" in text and not re.match(r"\d{4}/\d", text) for text in texts):  # an interval of ISO 8601
        start, epoch = clock_readings(found.path, name, [text.partition("/")[0] for text in texts])
        end, _ = clock_readings(found.path, name, [text.partition("/")[2] for text in texts])
        return start, end, epoch
    t_ns, epoch = found.stamps("time")
    return t_ns, None, epoch


def _sigma(found: PositionTable) -> Floats | None:
    """Sigma (n, 3) m of each axis; None where the list has none. A single one counts for every axis."""
    axes = [found.floats(role) for role in ("sigma_e", "sigma_n", "sigma_u")]
    each = found.floats("sigma")
    columns = [each if axis is None else axis for axis in axes]
    if all(column is None for column in columns):
        return None
    unknown = np.full(len(found.table), np.nan)
    return np.stack([unknown if column is None else column for column in columns], axis=1)


def _sigma_columns(found: PositionTable) -> Table:
    sigma = _sigma(found)
    return {} if sigma is None else vector_columns("sigma_{}_m", np.where(sigma > 0.0, sigma, np.nan), "enu")


def _read_fixes(source: str, repairs: tuple[str, ...]) -> Session:
    path = Path(source)
    found = read_positions(path)
    rows, epsg, _ = _places(found)
    if epsg is None and "lat" not in found.columns:
        t_ns, epoch = found.stamps("time")
        table = {"t_ns": t_ns} | vector_columns("{}_m", rows, "enu") | _sigma_columns(found)
        return build_session({"gnss": (path, table)}, repairs, clock_epoch=epoch)
    t_ns, epoch = found.stamps("time")
    radius, stated = found.floats("sigma"), {"sigma_e", "sigma_n"} & found.columns.keys()
    fixes = LoggedFixes(
        *(t_ns, rows[:, 0], rows[:, 1], rows[:, 2]),
        horizontal=radius,
        vertical=found.floats("sigma_u"),
        speed=found.speed(),
        course=found.floats("course"),
        sigma=_sigma(found) if stated else None,
    )
    return session_of_fixes(path, fixes, epoch, repairs)


FIXES = Reader(
    name="positions",
    summary="text with columns of time and position: latitude, longitude, or E, N and EPSG",
    recognised_by="headings such as time, lat, lon, height, accuracy, speed, course; nothing inertial",
    matches=is_fixes,
    read_source=_read_fixes,
    general=True,
)
CONTROL = Reader(
    name="control",
    summary="surveyed points: id, time (or start, end), E, N, H, EPSG or lat, lon, height, sigmas",
    recognised_by="headings with a point id and coordinates",
    matches=is_control,
    read_source=lambda source, repairs: read_points(Path(source)).session(repairs),
    general=True,
)
