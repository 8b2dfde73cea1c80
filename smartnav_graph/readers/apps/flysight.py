"""FlySight 2: SENSOR.CSV (inertial, magnetometer, barometer) and TRACK.CSV (fixes) of one recording.

Lines ``$COL`` and ``$UNIT`` name the columns of each kind of record. SENSOR.CSV counts seconds since the device was
switched on; its ``$TIME`` records tie that clock to week and seconds of week. Firmware writes these in UTC or in GPS
time: that of the two is taken in which the sensors overlap with the fixes of TRACK.CSV, which are in UTC.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from smartnav_graph.core.arrays import Times
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.timebase import NS, utc_from_gps
from smartnav_graph.readers.apps.channels import read_vector
from smartnav_graph.readers.fixes import LoggedFixes
from smartnav_graph.readers.log_session import LogParts, log_session
from smartnav_graph.readers.samples import Samples
from smartnav_graph.readers.source import Reader
from smartnav_graph.readers.text import TextTable, read_bytes
from smartnav_graph.readers.text_lines import NO_TEXT, head_of, in_utf8
from smartnav_graph.readers.units import ACCELERATION, ANGULAR_RATE, FLUX_DENSITY, PRESSURE, plain_heading
from smartnav_graph.session.session import Session

_SENSORS, _FIXES = "sensor.csv", "track.csv"
_EPOCH_NS = int(np.datetime64("1980-01-06", "ns").astype(np.int64))
_WEEK_S = 604_800


@dataclass
class _Records:
    """Records of a file by kind: columns with their units, and rows."""

    path: Path
    names: dict[str, list[str]] = field(default_factory=dict)
    units: dict[str, dict[str, str]] = field(default_factory=dict)
    rows: dict[str, list[list[str]]] = field(default_factory=dict)
    about: dict[str, str] = field(default_factory=dict)
    torn: int = 0
    damaged: int = 0

    def table(self, kind: str) -> TextTable:
        """Records of one kind.

        Raises
        ------
        SessionError
            Rows have fewer cells than columns, or there is no ``$COL`` line.
        """
        names, rows = self.names.get(kind), self.rows[kind]
        if names is None:
            raise SessionError(self.path, f"has no line $COL,{kind}", "names of the columns", "export it again")
        short = next((i for i, row in enumerate(rows) if len(row) != len(names)), None)
        if short is not None:
            found = f"record {short} of ${kind} has {len(rows[short])} cells"
            raise SessionError(self.path, found, f"{len(names)}: {', '.join(names)}", "complete it", row=short)
        return TextTable.of(self.path, {name: [row[i] for row in rows] for i, name in enumerate(names)})

    def factor(self, kind: str, column: str, known: dict[str, float], default: str) -> float:
        """Factor of a column to the session's unit."""
        unit = plain_heading(self.units.get(kind, {}).get(column, "") or default)
        if unit not in known:
            raise SessionError(self.path, f"{column} of ${kind} is in {unit!r}", f"one of {', '.join(known)}")
        return known[unit]


def _files(source: str) -> tuple[Path | None, Path | None]:
    """SENSOR.CSV and TRACK.CSV of a folder, or beside one of them."""
    path = Path(source)
    folder = path if path.is_dir() else path.parent
    if path.is_file() and path.name.lower() not in (_SENSORS, _FIXES):
        return None, None
    if not folder.is_dir() or not path.exists():
        return None, None
    found = {file.name.lower(): file for file in folder.iterdir() if file.name.lower() in (_SENSORS, _FIXES)}
    return found.get(_SENSORS), found.get(_FIXES)


def _matches(source: str) -> bool:
    try:
        return any(file is not None and head_of(file).lstrip().startswith("$FLYS") for file in _files(source))
    except (OSError, ValueError):  # ValueError: a zero byte in the name
        return False


def _parse(path: Path) -> _Records:
    found = _Records(path)
    lines = in_utf8(read_bytes(path)).decode("utf-8", errors="replace").split("\n")
    if lines and lines[-1].strip():
        found.torn, lines = 1, lines[:-1]
    for line in lines:
        kind, *cells = line.strip().lstrip("$").split(",")
        if kind == "COL" and cells:
            found.names[cells[0]] = cells[1:]
            found.damaged += NO_TEXT.search(line) is not None
        elif kind == "UNIT" and cells:
            found.units[cells[0]] = dict(zip(found.names.get(cells[0], ()), cells[1:], strict=False))
        elif kind == "VAR" and len(cells) > 1:
            found.about[cells[0]] = cells[1]
        elif kind in found.names:
            found.rows.setdefault(kind, []).append(cells)
        elif kind not in ("", "FLYS", "DATA"):
            found.damaged += 1
    return found


def _read(source: str, repairs: tuple[str, ...]) -> Session:
    sensors, fixes = _files(source)
    parts, epoch = LogParts(), "unix"
    track = None if fixes is None else _parse(fixes)
    fix_ns = None
    if track is not None and "GNSS" in track.rows:
        table = track.table("GNSS")
        fix_ns = table.times("time")
        parts.add_fixes(track.path, _fixes(table, fix_ns))
        parts.count("gnss", {"cut at the end of the file left out": track.torn})
    log = None if sensors is None else _parse(sensors)
    if log is not None:
        line = _clock(log, fix_ns)
        epoch = "unknown" if line is None and fix_ns is None else "unix"
        if line is None and fix_ns is not None:
            found, remedy = "has no $TIME records: its clock cannot be tied to that of the fixes", "record outdoors"
            raise SessionError(log.path, found, "at least one $TIME record", remedy)
        _add_sensors(log, line or (0, 1.0, 0), parts, repairs)
    for file in (track, log):
        if file is not None:
            parts.count("session", {f"lines of {file.path.name} damaged, or of an unknown kind": file.damaged})
    if not parts.tables:
        raise SessionError(source, "holds no records", "$IMU and $GNSS records", "check the card")
    return log_session(parts, repairs, name="FlySight 2", epoch=epoch)


def _clock(log: _Records, fix_ns: Times | None) -> tuple[int, float, int] | None:
    """Line from the device's clock to Unix time: t -> unix_0 + rate (t - t_0); None without ``$TIME``."""
    if "TIME" not in log.rows:
        return None
    table = log.table("TIME")
    at = table.times("time")
    gps = table.ints("week") * _WEEK_S * NS + table.times("tow")
    ties = {"UTC": gps + _EPOCH_NS, "GPS": utc_from_gps(gps)}
    name = "UTC"
    if fix_ns is not None and "IMU" in log.rows:
        span = log.table("IMU").times("time")[[0, -1]]
        common = {}
        for scale, unix in ties.items():
            begin, end = span + int(np.median(unix - at))
            common[scale] = min(end, fix_ns[-1]) - max(begin, fix_ns[0])
        name = max(common, key=lambda scale: common[scale])
    unix = ties[name]
    rate = 1.0
    if len(at) > 30 and at[-1] - at[0] > 60 * NS:
        rate = float(np.polyfit((at - at[0]) / NS, (unix - unix[0]) / NS, 1)[0])
    t_0 = int(np.median(at))
    return t_0, rate, t_0 + int(np.median(unix - at))


def _add_sensors(log: _Records, line: tuple[int, float, int], parts: LogParts, repairs: tuple[str, ...]) -> None:
    t_0, rate, unix_0 = line

    def stamps(table: TextTable) -> Times:
        since = table.times("time") - t_0
        return np.asarray(unix_0 + since + np.rint(since * (rate - 1.0)).astype(np.int64), dtype=np.int64)

    if "IMU" in log.rows:
        table = log.table("IMU")
        t_ns = stamps(table)

        def vector(letter: str, units: dict[str, float], unit: str) -> Samples | None:
            names = [f"{letter}{axis}" for axis in "xyz"]
            if not set(names) <= set(table.cells):
                return None
            values = table.floats(*names) * log.factor("IMU", names[0], units, unit)
            return read_vector(table, t_ns, values, repairs)

        gyro, accel = vector("w", ANGULAR_RATE, "deg/s"), vector("a", ACCELERATION, "g")
        parts.add_inertial(log.path, gyro, accel, table.cells)
        parts.count("imu", {"cut at the end of the file left out": log.torn})
        if "temperature" in table.cells:
            parts.add_single(
                "temperature", "temperature_c", read_vector(table, t_ns, table.floats("temperature"), repairs)
            )
    if "MAG" in log.rows:
        table = log.table("MAG")
        field_ut = table.floats("x", "y", "z") * log.factor("MAG", "x", FLUX_DENSITY, "gauss")
        parts.add_magnetometer(read_vector(table, stamps(table), field_ut, repairs))
    if "BARO" in log.rows:
        table = log.table("BARO")
        pressure = table.floats("pressure") * log.factor("BARO", "pressure", PRESSURE, "pa")
        parts.add_single("barometer", "pressure_hpa", read_vector(table, stamps(table), pressure, repairs))


def _fixes(table: TextTable, t_ns: Times) -> LoggedFixes:
    table.require(["lat", "lon"])
    north, east, down = (table.optional(f"vel{axis}") for axis in "NED")
    velocity = None if north is None or east is None or down is None else np.stack([east, north, -down], axis=-1)
    columns = {name: table.floats(name) for name in ("hMSL", "hAcc", "vAcc", "sAcc") if name in table.cells}
    return LoggedFixes(
        t_ns,
        table.floats("lat"),
        table.floats("lon"),
        height=columns.get("hMSL"),
        horizontal=columns.get("hAcc"),
        vertical=columns.get("vAcc"),
        velocity=velocity,
        velocity_sigma=columns.get("sAcc"),
        above_sea=True,
    )


READER = Reader(
    name="flysight",
    summary="FlySight 2: SENSOR.CSV and TRACK.CSV",
    recognised_by="SENSOR.CSV or TRACK.CSV that begins with $FLYS",
    matches=_matches,
    read_source=_read,
)
