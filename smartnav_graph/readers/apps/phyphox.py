"""phyphox (RWTH Aachen; Android and iOS): CSV files of one experiment, in a folder or archive, or an Excel file.

One table a sensor, stamps in seconds since the start of the experiment; ``meta/time.csv`` (sheet Metadata Time) ties
them to Unix time, ``meta/device.csv`` names the phone. Units are those of Android on both systems. Names follow the
language of the phone, units do not: m/s^2 is the accelerometer, rad/s the gyroscope, uT the magnetometer, hPa the
barometer, two columns in degrees the location. A table named Linear is without gravity. -1 marks unknown values.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from smartnav_graph.core.arrays import Floats, Times
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.timebase import NS, ns_from_text
from smartnav_graph.readers.apps.channels import read_vector
from smartnav_graph.readers.apps.excel import is_excel, read_sheets, sheet_names
from smartnav_graph.readers.fixes import LoggedFixes
from smartnav_graph.readers.log_session import LogParts, log_session
from smartnav_graph.readers.samples import Samples, summed
from smartnav_graph.readers.source import Reader
from smartnav_graph.readers.text import TextTable, read_text
from smartnav_graph.readers.text_lines import heading_of
from smartnav_graph.readers.units import ACCELERATION, ANGULAR_RATE, FLUX_DENSITY, PRESSURE, quantity_in, unit_in
from smartnav_graph.session.session import Session

_TIME_UNIT = re.compile(r"^\w+ ?\(s\)$")
_LINEAR = re.compile(r"linear|ohne g|without g|\(without", re.IGNORECASE)
_DEGREES = "°"
_TEXT = (".csv", ".txt", ".tsv")


def _is_ours(names: list[str]) -> bool:
    """Whether columns are those of a table: stamps in seconds, then quantities with units in brackets."""
    if len(names) < 2 or not _TIME_UNIT.match(names[0]):
        return False
    units = [unit_in(name) for name in names[1:]]
    known = [unit in ACCELERATION or unit in ANGULAR_RATE or unit in FLUX_DENSITY or unit in PRESSURE for unit in units]
    return bool(known) and (known[0] or units[:2] == [_DEGREES, _DEGREES])


def _files(path: Path) -> dict[str, Path]:
    """Tables of an experiment by name."""
    if path.is_file():
        return {path.stem: path} if path.suffix.lower() in _TEXT else {}
    files = sorted(
        file for file in path.iterdir() if file.suffix.lower() in (".csv", ".txt", ".tsv") and file.is_file()
    )
    return {file.stem: file for file in files}


def _matches(source: str) -> bool:
    try:
        path = Path(source)
        if is_excel(path):
            sheets = sheet_names(path)
            return "Metadata Device" in sheets or any(_is_ours(list(head)) for head in sheets.values())
        if not path.exists():
            return False
        headings = [heading_of(file) for file in _files(path).values()]
        plain = [names for names in headings if names and not _is_ours(names)]
        others = any(names[0].lower() == "time" for names in plain)  # Physics Toolbox, beside a table alike
        return any(_is_ours(names) for names in headings) and not others
    except (OSError, ValueError):  # ValueError: a zero byte in the name
        return False


def _tables(path: Path) -> tuple[dict[str, TextTable], dict[str, TextTable]]:
    """Tables of sensors by name, and those about time and device."""
    if is_excel(path):
        sheets = read_sheets(path)
        about = {name.split()[-1].lower(): table for name, table in sheets.items() if name.startswith("Metadata")}
        return {name: table for name, table in sheets.items() if not name.startswith("Metadata")}, about
    files = {name: file for name, file in _files(path).items() if _is_ours(heading_of(file))}
    folder = (path if path.is_dir() else path.parent) / "meta"
    about = {
        name: read_text(folder / f"{name}.csv") for name in ("time", "device") if (folder / f"{name}.csv").is_file()
    }
    return {name: read_text(file, whole=True) for name, file in files.items()}, about


def _start_ns(about: Mapping[str, TextTable]) -> int | None:
    """Unix nanoseconds of the start of the experiment's clock; None where it is not written."""
    table = about.get("time")
    if table is None:
        return None
    names = {quantity_in(name): name for name in table.cells}
    if not {"event", "experimenttime", "systemtime"} <= set(names) or not len(table):
        return None
    event, *texts = (table.texts(names[quantity])[0] for quantity in ("event", "systemtime", "experimenttime"))
    try:
        system, experiment = (ns_from_text(text.replace(",", ".")) for text in texts)
    except SessionError:
        return None
    return system if event.strip().upper() == "START" and experiment == 0 else None


def _device(about: Mapping[str, TextTable]) -> str:
    table = about.get("device")
    if table is None or len(table.cells) < 2:
        return "phyphox"
    keys, values = (table.texts(name) for name in list(table.cells)[:2])
    known = {str(key).strip().lower(): str(value).strip() for key, value in zip(keys, values, strict=True)}
    words = [known.get("devicemanufacturer", known.get("devicebrand", "")), known.get("devicemodel", "")]
    return " ".join(word for word in words if word) or "phyphox"


def _read(source: str, repairs: tuple[str, ...]) -> Session:
    path = Path(source)
    tables, about = _tables(path)
    start_ns = _start_ns(about)
    parts, vectors = LogParts(), dict[str, Samples]()
    if "time" in about and start_ns is None:
        parts.count("clock", {"START with its Unix time missing in meta/time.csv; stamps are since the start": 1})
    if path.is_dir():
        left_out = [name for name in _files(path) if name not in tables]
        parts.count("session", {f"table {name}, which has no known quantity, left out": 1 for name in left_out})
    for name, table in tables.items():
        if not _is_ours(list(table.cells)) or not len(table):
            continue
        t_ns = _stamps(table) + (start_ns or 0)
        rows = table.rows(table.known(next(iter(table.cells))))
        role, values = _readings(name, rows)
        if role == "location":
            parts.add_fixes(table.path, _fixes(rows, t_ns), table.skipped)
        elif role == "barometer":
            parts.add_single("barometer", "pressure_hpa", read_vector(rows, t_ns, values, repairs))
        elif role and np.isfinite(values).all(axis=1).any():
            vectors.setdefault(role, read_vector(rows, t_ns, values, repairs))
    if "field" in vectors:
        parts.add_magnetometer(vectors["field"])
    accel, gyro = vectors.get("accel"), vectors.get("gyro")
    if accel is None and "linear" in vectors and "gravity" in vectors:
        accel = summed(vectors["linear"], vectors["gravity"])
    parts.add_inertial(path, gyro, accel, tables, wanted="linear" in vectors or not parts.tables)
    return log_session(parts, repairs, name=_device(about), epoch="unix" if start_ns is not None else "unknown")


def _stamps(table: TextTable) -> Times:
    name = next(iter(table.cells))
    return table.rows(table.known(name)).times(name, NS)


def _readings(name: str, table: TextTable) -> tuple[str, Floats]:
    """What a table holds by its units, and its readings (n, k) in the session's units."""
    columns = list(table.cells)[1:]
    units = {column: unit_in(column) for column in columns}
    if [units[column] for column in columns[:2]] == [_DEGREES, _DEGREES]:
        return "location", np.zeros((0, 0))
    for role, known in (("accel", ACCELERATION), ("gyro", ANGULAR_RATE), ("field", FLUX_DENSITY)):
        xyz = [c for axis in "xyz" for c in columns if quantity_in(c).endswith(axis) and units[c] in known][:3]
        if len(xyz) == 3 and quantity_in(xyz[2]).endswith("z"):
            kind = role
            if role == "accel" and (_LINEAR.search(name) or "linear" in quantity_in(xyz[0])):
                kind = "linear"
            elif role == "accel" and "gravity" in (name + xyz[0]).lower():
                kind = "gravity"
            return kind, table.floats(*xyz) * [known[units[c]] for c in xyz]
    if units[columns[0]] in PRESSURE:
        return "barometer", table.floats(columns[0]) * PRESSURE[units[columns[0]]]
    return "", np.zeros((0, 0))


def _fixes(table: TextTable, t_ns: Times) -> LoggedFixes:
    """Columns by name; in another language by order and unit: latitude, longitude, height, speed, direction."""
    columns = list(table.cells)[1:]
    names = {quantity_in(column): column for column in columns}

    def column(*words: str) -> Floats | None:
        found = next((name for word in words for quantity, name in names.items() if quantity.startswith(word)), None)
        return None if found is None else table.floats(found)

    english = "latitude" in names
    degrees = [c for c in columns if unit_in(c) == _DEGREES]
    metres = [c for c in columns if unit_in(c) == "m"]
    speeds = [c for c in columns if unit_in(c) == "m/s"]
    height = column("height", "altitudewgs84", "altitude") if english else table.floats(metres[0]) if metres else None
    return LoggedFixes(
        t_ns,
        table.floats(degrees[0]),
        table.floats(degrees[1]),
        height=height,
        horizontal=column("horizontalaccuracy", "accuracy", "horizontale"),
        vertical=column("verticalaccuracy", "vertikale"),
        speed=table.floats(speeds[0]) if speeds else None,
        course=table.floats(degrees[2]) if len(degrees) > 2 else None,
    )


READER = Reader(
    name="phyphox",
    summary="phyphox app (Android, iOS): CSV folder, zip or Excel",
    recognised_by='CSV files or Excel sheets whose first column is "Time (s)", units in brackets',
    matches=_matches,
    read_source=_read,
)
