"""MATLAB Mobile: a .mat file of timetables Acceleration, AngularVelocity, MagneticField and Position.

m/s^2 with gravity, rad/s, uT, degrees; row times are dates in milliseconds, mostly without zone. Variables of the
tables: X, Y, Z; latitude, longitude, altitude, speed, course, hacc.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from smartnav_graph.core.arrays import Floats, Times
from smartnav_graph.core.errors import SessionError
from smartnav_graph.readers.fixes import LoggedFixes
from smartnav_graph.readers.log_session import LogParts, log_session
from smartnav_graph.readers.mat5 import Matrix, ObjectFile, read_objects, variable_names
from smartnav_graph.readers.samples import Samples, in_time_order
from smartnav_graph.readers.source import Reader
from smartnav_graph.session.session import Session

_TABLES = ("Acceleration", "AngularVelocity", "MagneticField", "Position")


def _matches(source: str) -> bool:
    try:
        classes = variable_names(Path(source))
        return any(classes.get(name) == "timetable" for name in (*_TABLES, "Orientation"))
    except (OSError, ValueError):  # ValueError: a zero byte in the name
        return False


def _timetable(path: Path, file: ObjectFile, name: str) -> tuple[Times, dict[str, Floats], bool]:
    """Stamps (n,), columns (n,) by name in small letters, and whether the dates have a zone."""
    found = file.object_of(file.variables[name]).get("any")
    fields = found.values if found is not None and isinstance(found.values, dict) else {}
    names, data = fields.get("varNames"), fields.get("data")
    if names is None or data is None or not isinstance(names.values, list) or not isinstance(data.values, list):
        raise SessionError(path, f"{name} holds no table", "a timetable of MATLAB Mobile", "save it again")
    t_ns, zoned = _row_times(path, file, name, fields.get("rowTimes"))
    columns = {}
    for title, column in zip(names.values, data.values, strict=True):
        if title is not None and column is not None and isinstance(column.values, np.ndarray):
            values = np.asarray(column.values.real, dtype=np.float64).ravel()
            if len(values) != len(t_ns):
                found_rows = f"{name}.{title.values} has {len(values)} rows"
                raise SessionError(path, found_rows, f"{len(t_ns)}, one for each time", "save it again")
            columns[str(title.values).lower()] = values
    return t_ns, columns, zoned


def _row_times(path: Path, file: ObjectFile, name: str, reference: Matrix | None) -> tuple[Times, bool]:
    date = file.object_of(reference)
    data, zone = date.get("data"), date.get("tz")
    if data is None or not isinstance(data.values, np.ndarray):
        raise SessionError(path, f"{name} has no row times of dates", "datetime row times", "save it again")
    milliseconds = np.asarray(data.values).ravel()
    whole = np.floor(milliseconds.real)
    rest = milliseconds.real - whole + (milliseconds.imag if np.iscomplexobj(milliseconds) else 0.0)
    if not np.isfinite(whole).all() or (np.abs(whole) > 9e12).any():
        raise SessionError(path, f"{name} has a row without a time", "dates", "delete the row in MATLAB")
    t_ns = whole.astype(np.int64) * 1_000_000 + np.rint(rest * 1e6).astype(np.int64)
    return t_ns, zone is not None and bool(zone.values)


def _read(source: str, repairs: tuple[str, ...]) -> Session:
    path = Path(source)
    file = read_objects(path)
    tables = {name: _timetable(path, file, name) for name in _TABLES if name in file.variables}
    vectors: dict[str, Samples] = {}
    for name in ("Acceleration", "AngularVelocity", "MagneticField"):
        if name in tables:
            t_ns, columns, _ = tables[name]
            if not {"x", "y", "z"} <= set(columns):
                raise SessionError(path, f"{name} has {', '.join(columns)}", "X, Y, Z", "save it again")
            vectors[name] = in_time_order(path, t_ns, np.stack([columns[axis] for axis in "xyz"], axis=-1), repairs)
    parts = LogParts()
    accel, gyro = vectors.get("Acceleration"), vectors.get("AngularVelocity")
    parts.add_inertial(path, gyro, accel, file.variables)
    if "MagneticField" in vectors:
        parts.add_magnetometer(vectors["MagneticField"])
    if "Position" in tables:
        t_ns, columns, _ = tables["Position"]
        if not {"latitude", "longitude"} <= set(columns):
            raise SessionError(path, f"Position has {', '.join(columns)}", "latitude, longitude", "save it again")
        fixes = LoggedFixes(
            t_ns,
            columns["latitude"],
            columns["longitude"],
            height=columns.get("altitude"),
            horizontal=columns.get("hacc"),
            speed=columns.get("speed"),
            course=columns.get("course"),
        )
        parts.add_fixes(path, fixes)
    zoned = all(zone for _, _, zone in tables.values())
    return log_session(parts, repairs, name="MATLAB Mobile", epoch="unix" if zoned else "unknown")


READER = Reader(
    name="matlab-mobile",
    summary="MATLAB Mobile app: timetables in a .mat file",
    recognised_by="a .mat file with a timetable Acceleration, AngularVelocity or Position",
    matches=_matches,
    read_source=_read,
)
