"""SensorLog (Bernd Thomas; iOS): CSV or JSON, one row of all sensors at a time, with up to three clocks.

JSON is a list of rows, one row a line, or one list a column.

Each sensor has its stamp in seconds since the phone was booted, fixes theirs since 1970, and each row the local time
at which it was logged, often without zone. The zone is that, to a quarter of an hour, which puts the rows just after
the fixes in them; the clock since boot is tied by the median of the rows. Acceleration is in g with the opposite sign
of specific force, or motionUserAcceleration + motionGravity alike; -1 and -9999 mark unknown values.
"""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from smartnav_graph.core.arrays import Floats, Times
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.timebase import NS, ns_from_seconds
from smartnav_graph.readers.apps.channels import (
    Channels,
    channels_of,
    fixes_of,
    force_of,
    read_vector,
)
from smartnav_graph.readers.log_session import LogParts, log_session
from smartnav_graph.readers.samples import Samples, clock_offset
from smartnav_graph.readers.source import Reader
from smartnav_graph.readers.stamps import has_zone
from smartnav_graph.readers.text import TextTable, read_bytes, read_text
from smartnav_graph.readers.text_lines import head_of, heading_of
from smartnav_graph.readers.units import quantity_in
from smartnav_graph.session.session import Session

_QUARTER_NS = 900 * NS
_MARKS = {"loggingtime", "locationlatitude", "motionuseraccelerationx", "accelerometeraccelerationx", "gyrorotationx"}


def _matches(source: str) -> bool:
    try:
        path = Path(source)
        if not path.is_file() or path.suffix.lower() not in (".csv", ".txt", ".tsv", ".json"):
            return False
        head = re.findall(r'"([^"]+)"\s*:', head_of(path)) if path.suffix.lower() == ".json" else heading_of(path)
        names = {quantity_in(name) for name in head}
        return len(names & _MARKS) >= 2 and names.isdisjoint({"timesincestartinms"})
    except (OSError, ValueError):  # ValueError: a zero byte in the name
        return False


def _of_json(path: Path) -> TextTable:
    """The rows of a JSON file; a cell that a row lacks is empty.

    Raises
    ------
    SessionError
        No JSON, or rows that are no objects.
    """
    text = read_bytes(path).decode("utf-8-sig", errors="replace").strip()
    try:
        try:
            found = json.loads(text)
        except ValueError:
            found = [json.loads(line.rstrip(",")) for line in text.splitlines() if line.strip(" ,[]")]
    except (ValueError, RecursionError) as error:
        raise SessionError(path, f"is no JSON ({error})", "a whole JSON file", "export the recording again") from error
    if isinstance(found, dict):
        columns = {name: cells for name, cells in found.items() if isinstance(cells, list)}
        if len({len(cells) for cells in columns.values()}) != 1:
            lengths = ", ".join(f"{name} {len(cells)}" for name, cells in columns.items()) or "none"
            raise SessionError(
                path, f"has lists of different length ({lengths})"[:300], "one list a column", "export it again"
            )
        return TextTable.of(path, {name: [_cell(cell) for cell in cells] for name, cells in columns.items()})
    if not isinstance(found, list) or not found or not all(isinstance(row, dict) for row in found):
        raise SessionError(
            path, "is no list of rows", "[{loggingTime: ..., ...}, ...]", "export it as JSON or CSV again"
        )
    names = dict.fromkeys(name for row in found for name in row)
    return TextTable.of(path, {name: [_cell(row.get(name)) for row in found] for name in names})


def _cell(value: object) -> str:
    return "" if value is None else str(value).strip()


def _column(table: TextTable, *starts: str) -> str | None:
    """The first column whose name starts so, and that holds something."""
    for start in starts:
        for name in table.cells:
            if quantity_in(name).startswith(start) and not table.is_empty(name):
                return name
    return None


class _Clock:
    """Unix nanoseconds of the rows and of stamps since boot; of the boot clock where no clock of the log is Unix."""

    def __init__(self, table: TextTable) -> None:
        self.table = table
        logged = _column(table, "loggingtime")
        self.logged: Times | None = None
        self.epoch = "unix"
        if logged is not None:
            self.logged = table.times(logged)
            if not has_zone(str(table.cells[logged][0].as_py())):
                self.logged = self.logged - self._zone_ns(self.logged)
        self.offset: int | None = None

    def _zone_ns(self, logged: Times) -> int:
        """How far the local time is ahead of UTC, to a quarter of an hour, by the fixes."""
        found = _column(self.table, "locationtimestampsince1970")
        if found is None:
            self.epoch = "unknown"
            return 0
        fix = ns_from_seconds(_marked(self.table.floats(found)))
        behind = (logged - fix)[fix > 0]
        if not len(behind):
            self.epoch = "unknown"
            return 0
        # a fix is at most some seconds old when it is new, and never of the future
        return round(float(np.min(behind)) / _QUARTER_NS) * _QUARTER_NS

    def of(self, sensor: str) -> tuple[Times, TextTable]:
        """Stamps of a sensor, and the rows that have one."""
        name = _column(self.table, f"{sensor}timestampsincereboot", f"{sensor}timestamp")
        if name is None:
            if self.logged is None:
                raise SessionError(self.table.path, f"has no stamps of {sensor}", f"{sensor}Timestamp or loggingTime")
            return self.logged, self.table
        known = self.table.known(name) & (_marked(self.table.floats(name)) > 0)
        rows = self.table.rows(known)
        if not len(rows):
            raise SessionError(self.table.path, f"{name} has no stamp", "seconds", f"switch {sensor} on")
        t_ns = rows.times(name)
        if self.logged is None:
            self.epoch = "boot"
            return t_ns, rows
        if self.offset is None:
            self.offset = clock_offset(t_ns, self.logged[known])
        return t_ns + self.offset, rows


def _marked(values: Floats) -> Floats:
    return np.where(np.isfinite(values), values, -1.0)


def _read(source: str, repairs: tuple[str, ...]) -> Session:
    path = Path(source)
    table = _of_json(path) if path.suffix.lower() == ".json" else read_text(path, whole=True)
    clock, parts = _Clock(table), LogParts()
    channels = channels_of(table)
    force, gyro = _force(channels, clock, repairs), _gyro(channels, clock, repairs)
    parts.add_inertial(path, gyro, force, [*channels.vectors, *channels.scalars])
    _add_field(channels, clock, parts, repairs)
    if channels.has("pressure"):
        t_ns, rows = clock.of("altimeter")
        pressure = channels_of(rows).scalar("pressure", 10.0)  # kPa
        if pressure is not None and np.isfinite(pressure).any():
            parts.add_single("barometer", "pressure_hpa", read_vector(rows, t_ns, _positive(pressure), repairs))
    if channels.has("lat", "lon"):
        _add_fixes(channels, clock, parts)
    device = _column(table, "deviceid")
    name = str(table.cells[device][0].as_py()) if device is not None else "iPhone"
    name = name if re.search(r"[A-Za-z]{3}", name) else "iPhone"
    return log_session(parts, repairs, name=name, epoch=clock.epoch)


def _positive(values: Floats) -> Floats:
    return np.where(values > 0, values, np.nan)


def _force(channels: Channels, clock: _Clock, repairs: tuple[str, ...]) -> Samples | None:
    """Of the accelerometer, else of device motion: gravity and the acceleration of the user."""
    if channels.has("accel") and not channels.table.is_empty(channels.vectors["accel"][0]):
        t_ns, rows = clock.of("accelerometer")
    elif channels.has("linear", "gravity"):
        t_ns, rows = clock.of("motion")
    else:
        return None
    found = channels_of(rows)
    values = force_of(found, sign=-1.0)
    return None if values is None else read_vector(rows, t_ns, values, repairs)


def _gyro(channels: Channels, clock: _Clock, repairs: tuple[str, ...]) -> Samples | None:
    for role, sensor in (("gyro", "gyro"), ("motion_gyro", "motion")):
        if channels.has(role) and not channels.table.is_empty(channels.vectors[role][0]):
            t_ns, rows = clock.of(sensor)
            return read_vector(rows, t_ns, channels_of(rows).vector(role), repairs)
    return None


def _add_field(channels: Channels, clock: _Clock, parts: LogParts, repairs: tuple[str, ...]) -> None:
    """The calibrated field of device motion, where it is known; the raw one has the phone's own field in it."""
    if channels.has("motion_field"):
        t_ns, rows = clock.of("motion")
        field = channels_of(rows).vector("motion_field")
        known = np.isfinite(field).all(axis=1) & (np.linalg.norm(field, axis=1) > 0.0)
        if known.any():
            parts.add_magnetometer(read_vector(rows, t_ns, np.where(known[:, None], field, np.nan), repairs))
            return
    raw = sum(not channels.table.is_empty(n) for n in channels.table.cells if "locationheadingx" in quantity_in(n))
    parts.count("magnetometer", {"uncalibrated left out": len(channels.table) * raw})


def _add_fixes(channels: Channels, clock: _Clock, parts: LogParts) -> None:
    table = channels.table
    name = _column(table, "locationtimestampsince1970")
    if name is not None and clock.epoch == "unix":
        known = table.known(name) & (_marked(table.floats(name)) > 0)
        t_ns = table.rows(known).times(name)
    elif clock.logged is not None:
        known, t_ns = np.ones(len(table), dtype=bool), clock.logged
    else:
        raise SessionError(table.path, "has fixes on another clock than the sensors", "loggingTime", "log it too")
    if known.any():
        fixes = replace(fixes_of(channels_of(table.rows(known)), t_ns), above_sea=True)  # CLLocation.altitude
        parts.add_fixes(table.path, fixes, table.skipped)


READER = Reader(
    name="sensorlog",
    summary="SensorLog app (iOS): one row of all sensors",
    recognised_by="CSV or JSON with columns such as loggingTime, accelerometerAccelerationX, motionUserAccelerationX",
    matches=_matches,
    read_source=_read,
)
