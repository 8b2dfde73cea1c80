"""Apps that write one row of all sensors at a time: AndroSensor, Physics Toolbox, HyperIMU, and alike ones.

A row repeats the last fix until there is a new one; where a fix has no stamp of its own, it has that of the first row
it is in. Units are those of the heading; without one, m/s^2 or g by the size of the acceleration, rad/s and uT.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from smartnav_graph.core.arrays import Mask, Times
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.timebase import NS
from smartnav_graph.readers.apps.channels import (
    Channels,
    channels_of,
    fixes_of,
    force_of,
    read_vector,
)
from smartnav_graph.readers.log_session import LogParts, log_session
from smartnav_graph.readers.source import Reader
from smartnav_graph.readers.stamps import has_zone, is_date
from smartnav_graph.readers.text import TextTable, first_lines, read_text
from smartnav_graph.readers.text_lines import heading_of
from smartnav_graph.readers.units import TIME_NS, quantity_in, unit_in
from smartnav_graph.session.session import Session

_TIME = re.compile(
    r"(?:time|timestamp|timesincestart(?:inms)?|elapsedtime|secondselapsed|t|utc|unixtime|epoch)(ns|us|ms|s)?"
)
_UNIX_S = 1e9  # seconds: later than 2001, a clock of this size counts from 1970
_DAY_S = 86_400
_CLOCK = re.compile(r"\s*(\d{1,2}):(\d\d):(\d\d)[:.,](\d{1,9})\s*")


@dataclass(frozen=True)
class WideApp:
    """One app. comments : characters that start its lines of remarks; is_ours : of the columns' names, plain."""

    name: str
    device: str
    is_ours: Callable[[list[str]], bool]
    comments: str = "#"


def _names(path: Path, comments: str = "#") -> list[str]:
    return [quantity_in(name) for name in heading_of(path, comments)]


def _androsensor(names: list[str]) -> bool:
    return any(name.startswith("timesincestart") for name in names) and any("accelerometer" in n for n in names)


def _physics_toolbox(names: list[str]) -> bool:
    vectors = ({"gfx", "gfy", "gfz"}, {"ax", "ay", "az", "at"}, {"wx", "wy", "wz"}, {"bx", "by", "bz", "bt"})
    return names[:1] == ["time"] and any(vector <= set(names) for vector in vectors)


def _hyperimu(path: Path) -> bool:
    return any(line.startswith("@") and "hyperimu" in line.lower() for line in first_lines(path, 4))


ANDROSENSOR = WideApp("androsensor", "AndroSensor", _androsensor)
PHYSICS_TOOLBOX = WideApp("physics-toolbox", "Physics Toolbox", _physics_toolbox)
HYPERIMU = WideApp("hyperimu", "HyperIMU", lambda _: True, comments="#@")
OTHER = WideApp("wide-csv", "unknown phone", lambda _: True)


def _csv_files(path: Path) -> list[Path]:
    """The file, or the text files of a folder."""
    if path.is_dir():
        return sorted(f for f in path.iterdir() if f.suffix.lower() in (".csv", ".txt") and f.is_file())
    return [path] if path.is_file() and path.suffix.lower() in (".csv", ".txt") else []


def _files_of(app: WideApp, source: str) -> list[Path]:
    """The files of an app in a source; never raises."""
    try:
        files = _csv_files(Path(source))
        if app is HYPERIMU:
            return [file for file in files if _hyperimu(file)]
        if app is OTHER:
            return files if len(files) == 1 and Path(source).is_file() and _is_other(files[0]) else []
        return [file for file in files if app.is_ours(_names(file))]
    except (OSError, ValueError):  # ValueError: a zero byte in the name
        return []


def _is_other(path: Path) -> bool:
    """Whether a file of no known app has inertial columns and stamps."""
    names = heading_of(path)
    if not any(_TIME.fullmatch(quantity_in(name)) for name in names) or _hyperimu(path):
        return False
    plain = [quantity_in(name) for name in names]
    if _androsensor(plain) or _physics_toolbox(plain) or "secondselapsed" in plain or len(set(names)) < len(names):
        return False
    if any("gyroscopexis" in name or name.endswith(("uncompgyrox", "imugyrox")) for name in plain):
        return False
    known = channels_of(TextTable(path, dict.fromkeys(names)))
    return known.has("gyro") and (known.has("accel") or known.has("gforce") or known.has("linear", "gravity"))


def row_stamps(table: TextTable, path: Path) -> tuple[Times, Mask, str]:
    """Stamps of the rows that have one, which rows these are, and the epoch of the clock.

    Raises
    ------
    SessionError
        No column of stamps, one that is no clock, or whose unit cannot be known.
    """
    columns = [name for name in table.cells if _TIME.fullmatch(quantity_in(name))]
    columns.sort(key=lambda name: not unit_in(name) and "ms" not in quantity_in(name))
    columns += [name for name in table.cells if is_date(str(table.cells[name][0].as_py()))]
    column = next((name for name in columns if not table.is_empty(name)), None)
    if column is None:
        remedy = "name the column with --columns"
        raise SessionError(path, f"has no column of stamps among {', '.join(table.cells)}", "time", remedy)
    known = table.known(column)
    rows = table if known.all() else table.rows(known)
    first = str(rows.cells[column][0].as_py())
    if _CLOCK.fullmatch(first):
        return _times_of_day(rows, column), known, "unknown"
    if is_date(first):
        return rows.times(column), known, "unix" if has_zone(first) else "unknown"
    unit = _time_unit(column) or _likely_unit(path, column, rows)
    t_ns = rows.times(column, unit)
    return t_ns, known, "unix" if t_ns[0] > _UNIX_S * NS else "unknown"


def _time_unit(column: str) -> int | None:
    unit = unit_in(column)
    if unit in TIME_NS:
        return TIME_NS[unit]
    quantity = quantity_in(column)
    if quantity == "secondselapsed":
        return NS
    found = _TIME.fullmatch(quantity)
    return TIME_NS[found[1]] if found and found[1] else (TIME_NS["ms"] if quantity.endswith("inms") else None)


def _likely_unit(path: Path, column: str, rows: TextTable) -> int:
    """Nanoseconds of one unit: by the size of a clock that counts from 1970, else by decimals or the step."""
    texts = rows.texts(column)
    values = rows.floats(column)
    for unit in (NS, NS // 10**3, NS // 10**6, 1):
        if 1.0 <= values[0] * unit / NS / _UNIX_S < 5.0:
            return unit
    if any("." in text or "," in text for text in texts[:100]):
        return NS
    step = float(np.median(np.diff(values))) if len(values) > 1 else 0.0
    if 2.0 <= step < 2000.0:
        return TIME_NS["ms"]
    found = f"column {column!r} is in whole numbers, {step:g} apart on the median, without a unit"
    raise SessionError(
        path, found, "a unit in the heading", f"name it {column}_s, {column}_ms, {column}_us or {column}_ns"
    )


def _times_of_day(rows: TextTable, column: str) -> Times:
    """Nanoseconds since midnight of ``13:05:07:250``, past midnight counted on."""
    found = np.empty(len(rows), dtype=np.int64)
    for row, text in enumerate(rows.texts(column)):
        parts = _CLOCK.fullmatch(text)
        if parts is None:
            raise SessionError(rows.path, f"{column} is {text!r} at row {row}", "a time of day", "correct it", row=row)
        seconds = int(parts[1]) * 3600 + int(parts[2]) * 60 + int(parts[3])
        found[row] = seconds * NS + int(parts[4].ljust(9, "0"))
    days = np.concatenate([[0], np.cumsum(np.diff(found) < -_DAY_S // 2 * NS)])
    return np.asarray(found + days * _DAY_S * NS, dtype=np.int64)


def _read(app: WideApp, source: str, repairs: tuple[str, ...]) -> Session:
    path = Path(source)
    files = _files_of(app, source) or _csv_files(path)
    if not files:
        raise SessionError(path, f"holds no file of {app.device}", "its CSV export", "check the path")
    parts, seen = LogParts(), list[str]()
    logs = [_log_of(app, file) for file in files]
    epochs = {epoch for _, _, epoch in logs}
    gyro = next(((c, t) for c, t, _ in logs if c.has("gyro")), None)
    force = None
    for channels, t_ns, _ in logs:
        seen += [*channels.vectors, *channels.scalars]
        if force is None and any(channels.has(role) for role in ("accel", "gforce", "linear")):
            values = force_of(channels)
            force = None if values is None else read_vector(channels.table, t_ns, values, repairs)
        if channels.has("field"):
            parts.add_magnetometer(read_vector(channels.table, t_ns, channels.vector("field"), repairs))
        pressure = channels.scalar("pressure")
        if pressure is not None and np.isfinite(pressure).any():
            parts.add_single("barometer", "pressure_hpa", read_vector(channels.table, t_ns, pressure, repairs))
        if channels.has("lat", "lon"):
            parts.add_fixes(channels.table.path, fixes_of(channels, t_ns), channels.table.skipped)
    rate = None if gyro is None else read_vector(gyro[0].table, gyro[1], gyro[0].vector("gyro"), repairs)
    parts.add_inertial(path, rate, force, seen, wanted=not parts.tables)
    return log_session(parts, repairs, name=app.device, epoch=epochs.pop() if len(epochs) == 1 else "unknown")


def _log_of(app: WideApp, file: Path) -> tuple[Channels, Times, str]:
    table = read_text(file, comments=app.comments, whole=True)
    t_ns, known, epoch = row_stamps(table, file)
    return channels_of(table if known.all() else table.rows(known)), t_ns, epoch


def _reader(app: WideApp, summary: str, recognised_by: str) -> Reader:
    return Reader(
        name=app.name,
        summary=summary,
        recognised_by=recognised_by,
        matches=lambda source: bool(_files_of(app, source)),
        read_source=lambda source, repairs: _read(app, source, repairs),
    )


READERS: Mapping[str, Reader] = {
    reader.name: reader
    for reader in (
        _reader(ANDROSENSOR, "AndroSensor app: one row of all sensors", "CSV with a column Time since start in ms"),
        _reader(PHYSICS_TOOLBOX, "Physics Toolbox app: CSV files", "CSV with time, gFx, ax, wx or Bx"),
        _reader(HYPERIMU, "HyperIMU app: one row of all sensors", "CSV with a line @ HyperIMU"),
        _reader(OTHER, "one row of all sensors at a time, of another app", "CSV with a time, gyro and accelerometer"),
    )
}
