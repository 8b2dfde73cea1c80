"""VectorNav CSV with the headings of its binary groups, ``IMU::Accel::X [m/s^2]`` or ``Accel [m/s^2]``: as INSTINCT
(University of Stuttgart) writes them; one file, or a folder of them.

VectorNav VN-310 interface control document. Body axes of the unit are forward, right, down. Stamps are GPS time, of the
clock since startup where the receiver had none yet; a fix has the time of its measurement, not that of the message.
Raw ("uncompensated") rates and forces are read: the others have the bias of the unit's own filter taken off.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from smartnav_graph.core.arrays import Floats, Times
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.timebase import NS
from smartnav_graph.readers.fixes import LoggedFixes
from smartnav_graph.readers.log_session import LogParts, log_session
from smartnav_graph.readers.robotics.device_axes import device_axes
from smartnav_graph.readers.samples import Samples, clock_offset, in_time_order
from smartnav_graph.readers.source import Reader
from smartnav_graph.readers.text import TextTable, first_lines, read_text
from smartnav_graph.readers.units import ACCELERATION, ANGULAR_RATE, FLUX_DENSITY, PRESSURE, unit_in
from smartnav_graph.session.session import Session

WEEK_NS = 604_800 * NS
_NO_POSITION = (0, 1)  # GNSS fix: none, or of time only
_GROUPS = ("IMU::", "GNSS1::PosLla::")
_VECTORS = {  # stream -> headings without unit, the first that is there; units
    "gyro": (("IMU::UncompGyro::{}", "IMU::AngularRate::{}"), ANGULAR_RATE),
    "accel": (("IMU::UncompAccel::{}", "IMU::Accel::{}"), ACCELERATION),
    "magnetometer": (("IMU::Mag::{}", "IMU::UncompMag::{}"), FLUX_DENSITY),
}


def _is_log(path: Path) -> bool:
    heading = "".join(first_lines(path, 1))
    return "Time::" in heading and any(group in heading for group in _GROUPS)


def _files(source: str) -> list[Path]:
    """The files of a log: itself, or those in a folder. Never raises."""
    try:
        path = Path(source)
        return [file for file in (sorted(path.glob("*.csv")) if path.is_dir() else [path]) if _is_log(file)]
    except (OSError, ValueError):  # ValueError: a zero byte in the name
        return []


def _read(source: str, repairs: tuple[str, ...]) -> Session:
    files = _files(source)
    if not files:
        raise SessionError(source, "has no headings of VectorNav", "such as IMU::Accel::X [m/s^2]", "check the format")
    tables = [_Table(read_text(file)) for file in files]
    on_gps = all(table.knows_gps_time for table in tables)
    parts = LogParts()
    for table in tables:
        _add(parts, table, on_gps, repairs)
    axes = device_axes(Path(source), parts)
    epoch = "gps" if on_gps else "boot"
    return log_session(parts, repairs, name="VectorNav", epoch=epoch, forward=axes.forward, up=axes.up)


class _Table:
    """One file: its columns by heading without unit."""

    def __init__(self, text: TextTable) -> None:
        self.text, self.path = text, text.path
        self.names = {name.partition(" [")[0].strip(): name for name in text.cells}
        self.startup_ns = self._whole("Time::TimeStartup")
        self.gps_ns = self.gps("Time::GpsTow", "Time::GpsWeek")
        self.valid = self.gps_ns > 0
        for flag in ("Time::TimeStatus::timeOk", "Time::TimeStatus::dateOk"):
            if flag in self.names:
                self.valid &= text.floats(self.names[flag]) == 1.0

    @property
    def knows_gps_time(self) -> bool:
        """Whether some row has GPS time, which the clock since startup carries to the others."""
        return bool(self.valid.all() or (self.valid.any() and self.startup_ns.any()))

    def _whole(self, name: str) -> Times:
        if name not in self.names:
            return np.zeros(len(self.text), dtype=np.int64)
        return self.text.times(self.names[name], unit_ns=1)

    def gps(self, tow: str, week: str) -> Times:
        """GPS time (n,) ns; zero where the week is not known."""
        weeks = self._whole(week)
        return np.where(weeks > 0, weeks * WEEK_NS + self._whole(tow), 0)

    def clock(self, on_gps: bool) -> Times:
        """Stamps (n,) of the rows."""
        if on_gps and self.valid.all():
            return self.gps_ns
        if not self.startup_ns.any():
            raise SessionError(self.path, "has no Time::TimeStartup [ns]", "a clock of every row", "log it, too")
        offset = clock_offset(self.startup_ns[self.valid], self.gps_ns[self.valid]) if on_gps else 0
        return self.startup_ns + offset

    def vector(
        self, template: str, axes: Sequence[str] = "XYZ", units: dict[str, float] | None = None
    ) -> Floats | None:
        """Columns (n, 3) in the session's unit; None where they are not there."""
        names = [template.format(axis) for axis in axes]
        if not set(names) <= set(self.names):
            return None
        factor = 1.0
        if units is not None:
            # the unit of one axis may be missing in the heading
            found = {unit for name in names if (unit := unit_in(self.names[name]))}
            known = [units[unit] for unit in found if unit in units]
            if len(known) != 1 or len(found) != 1:
                seen = ", ".join(self.names[name] for name in names)
                raise SessionError(self.path, f"headings {seen} have no known unit", f"one of {', '.join(units)}")
            factor = known[0]
        return factor * self.text.floats(*(self.names[name] for name in names))

    def first(self, name: str) -> Floats | None:
        """A column (n,) as numbers; None where it is not there."""
        return self.text.floats(self.names[name]) if name in self.names else None


def _add(parts: LogParts, table: _Table, on_gps: bool, repairs: tuple[str, ...]) -> None:
    t_ns = table.clock(on_gps)
    found: dict[str, Samples] = {}
    for stream, (templates, units) in _VECTORS.items():
        rows = next((rows for name in templates if (rows := table.vector(name, units=units)) is not None), None)
        if rows is not None and np.isfinite(rows).any():
            found[stream] = in_time_order(table.path, t_ns, rows, repairs)
    if "gyro" in found and "accel" in found and "imu" not in parts.tables:
        parts.add_imu(found["gyro"], found["accel"])
    if "magnetometer" in found and "magnetometer" not in parts.tables:
        parts.add_magnetometer(found["magnetometer"])
    for stream, name, column in (
        ("barometer", "IMU::Pres", "pressure_hpa"),
        ("temperature", "IMU::Temp", "temperature_c"),
    ):
        values = table.first(name)
        if values is not None and np.isfinite(values).any() and stream not in parts.tables:
            factor = PRESSURE.get(unit_in(table.names[name]), 10.0) if stream == "barometer" else 1.0
            parts.add_single(stream, column, in_time_order(table.path, t_ns, values * factor, repairs))
    lla = table.vector("GNSS1::PosLla::{}", ("latitude", "longitude", "altitude"))
    if lla is not None and "gnss" not in parts.tables:
        parts.add_fixes(table.path, _fixes(table, lla, t_ns, on_gps), may_repeat=True)


def _fixes(table: _Table, lla: Floats, t_ns: Times, on_gps: bool) -> LoggedFixes:
    """Fixes at the time of their measurement; north, east, down -> east, north, up."""
    measured = table.gps("GNSS1::Tow", "GNSS1::Week")
    shift = 0 if on_gps or not table.valid.any() else clock_offset(table.gps_ns[table.valid], t_ns[table.valid])
    known = (measured > 0) & (on_gps or table.valid.any())
    kind = table.first("GNSS1::Fix")
    bad = np.zeros(len(lla), dtype=bool) if kind is None else np.isin(kind, _NO_POSITION)
    lat, lon, height = np.where(bad, np.nan, lla.T)
    ned = np.array([1.0, 1.0, -1.0])
    velocity, sigma = table.vector("GNSS1::VelNed::{}", "NED"), table.vector("GNSS1::PosU::{}", "NED")
    return LoggedFixes(
        *(np.where(known, measured + shift, t_ns), lat, lon, height),
        velocity=None if velocity is None else (velocity * ned)[:, [1, 0, 2]],
        velocity_sigma=table.first("GNSS1::VelU"),
        sigma=None if sigma is None else sigma[:, [1, 0, 2]],
        fix_type=None if kind is None else np.nan_to_num(kind).astype(np.int64),
    )


READER = Reader(
    name="vectornav",
    summary="VectorNav CSV (INSTINCT): IMU, magnetometer, pressure, temperature, fixes with velocity",
    recognised_by="a CSV file, or a folder of them, with headings Time:: and IMU:: or GNSS1::PosLla::",
    matches=lambda source: bool(_files(source)),
    read_source=_read,
)
