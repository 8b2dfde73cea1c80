"""Columns of lists of positions, by their headings: what each is, in which unit, on which clock."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from smartnav_graph.core.arrays import Floats, Texts, Times
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.timebase import NS, ns_from_text
from smartnav_graph.readers.stamps import has_zone, is_date, ns_from_date
from smartnav_graph.readers.text import TextTable, read_text
from smartnav_graph.readers.units import SPEED, plain_heading, quantity_in, unit_in

# What a column is -> headings, small letters and digits only.
ROLES: dict[str, tuple[str, ...]] = {
    "id": ("id", "pointid", "point", "name", "pointname", "nr", "no", "number", "station", "target", "punkt"),
    "time": (
        *("t", "time", "tns", "tms", "ts", "timestamp", "timens", "timems", "times", "datetime", "date", "utc"),
        *("epoch", "unixtime", "utctime", "gpstime", "gpst", "timeutc", "timestampns", "timestampms", "timestamps"),
    ),
    "start": ("start", "begin", "from", "starttime", "tstart", "tstartns", "timestart", "startns"),
    "end": ("end", "to", "stop", "endtime", "tend", "tendns", "timeend", "endns"),
    "east": ("e", "east", "easting", "x", "em", "xm", "eastingm", "eastm", "rechtswert"),
    "north": ("n", "north", "northing", "y", "nm", "ym", "northingm", "northm", "hochwert"),
    "up": (
        *("h", "height", "u", "up", "z", "um", "zm", "heightm", "elevation", "ele", "altitude", "alt", "altitudem"),
        *("hell", "heightellipsoidal", "ellipsoidalheight", "altitudewgs84", "elevationm"),
    ),
    "msl": ("hmsl", "heightmsl", "mslheight", "altitudemsl", "horth", "orthometricheight", "normalheight"),
    "geoid": ("geoid", "geoidm", "undulation", "geoidheight", "geoidseparation"),
    "lat": ("lat", "latitude", "latdeg", "latitudedeg"),
    "lon": ("lon", "lng", "long", "longitude", "londeg", "longitudedeg"),
    "epsg": ("epsg", "epsgcode", "crs", "srid"),
    "sigma": ("sigma", "sigmam", "sigmah", "sigmahm", "accuracy", "horizontalaccuracy", "accuracym", "hacc", "sd"),
    "sigma_u": ("sigmau", "sigmaum", "sigmav", "sigmavm", "sigmaz", "sdu", "sdz", "verticalaccuracy", "vacc"),
    "sigma_e": ("sigmae", "sigmaem", "sigmax", "sde", "sdx"),
    "sigma_n": ("sigman", "sigmanm", "sigmay", "sdn", "sdy"),
    "speed": ("speed", "speedms", "velocity", "groundspeed", "speedmps", *SPEED, "speedkmh", "speedmph", "speedknots"),
    "course": ("course", "bearing", "heading", "direction", "track", "coursedeg", "bearingdeg", "cog"),
    "sensor": ("sensor", "instrument", "prism"),
}
COMMENTS = "#%@"  # characters that start a line of remarks in a list of positions
_INERTIAL = re.compile(r"accel|acc[xyz]|gyr|force|omega|^[aw][xyz]$|imu|rotation")
_ROLE_OF = {name: role for role, names in ROLES.items() for name in names}
# Numbers of at least so much are a clock since 1970 (1973 on), in this unit of ns.
_UNIX = ((1e17, 1), (1e14, 1000), (1e11, 10**6), (1e8, NS))


@dataclass(frozen=True)
class PositionTable:
    """A text file and which of its columns is what: role -> heading."""

    table: TextTable
    columns: dict[str, str]

    @property
    def path(self) -> Path:
        """The file."""
        return self.table.path

    def floats(self, role: str) -> Floats | None:
        """Numbers (n,) of a column; None where there is no such column."""
        return self.table.floats(self.columns[role]) if role in self.columns else None

    def texts(self, role: str) -> Texts | None:
        """Texts (n,) of a column; None where there is no such column."""
        return self.table.texts(self.columns[role]) if role in self.columns else None

    def stamps(self, role: str) -> tuple[Times, str]:
        """Stamps (n,) ns of a column and the epoch of their clock."""
        name = self.columns[role]
        return clock_readings(self.path, name, list(map(str, self.table.texts(name))))

    def speed(self) -> Floats | None:
        """Speed (n,) m/s by the unit that its heading names, m/s where it names none."""
        values = self.floats("speed")
        if values is None:
            return None
        name = plain_heading(self.columns["speed"]).replace("_", "")
        unit = unit_in(self.columns["speed"]) or next((unit for unit in SPEED if name.endswith(unit)), "m/s")
        return values * SPEED.get(unit, 1.0)


def roles_in(headings: list[str]) -> dict[str, str]:
    """Role -> the first heading that has it."""
    found: dict[str, str] = {}
    for heading in headings:
        role = _ROLE_OF.get(quantity_in(heading))
        if role is not None:
            found.setdefault(role, heading)
    return found


def has_positions(headings: list[str]) -> bool:
    """Whether the headings are those of places and of nothing that measures motion."""
    roles = roles_in(headings)
    placed = {"lat", "lon"} <= roles.keys() or {"east", "north"} <= roles.keys()
    return placed and not any(_INERTIAL.search(quantity_in(name)) for name in headings)


def read_positions(path: Path) -> PositionTable:
    """The table of a text file with headings, which may follow comments."""
    table = read_text(path, comments=COMMENTS)
    return PositionTable(table, roles_in(list(table.cells)))


def clock_readings(path: Path, name: str, texts: list[str]) -> tuple[Times, str]:
    """Stamps (n,) ns of clock readings, and their epoch.

    Dates with a time zone, and numbers since 1970, are Unix time; dates without one are read as UTC, of a clock that is
    ``unknown``, as are other numbers: seconds, or what the heading names (``t_ns``, ``time (ms)``).
    """
    first = next((text for text in texts if text), "")
    dated = is_date(first)
    if dated:
        epoch, unit = "unix" if all(map(has_zone, texts)) else "unknown", NS
    else:
        epoch, unit = _clock(path, name, first)
    found = np.empty(len(texts), dtype=np.int64)
    for row, text in enumerate(texts):
        try:
            found[row] = ns_from_date(text) if dated else ns_from_text(text, unit)
        except SessionError as error:
            what = "a date as in the first row" if dated else "a number"
            raise SessionError(path, f"{name} is {text!r} at row {row}", what, "correct it", row=row) from error
    return found, epoch


def _clock(path: Path, name: str, first: str) -> tuple[str, int]:
    """Epoch and unit of ns of clock readings that are numbers, by their heading and the first of them."""
    try:
        size = abs(float(first))
    except ValueError as error:
        expected = "seconds, nanoseconds or a date such as 2025-06-01T10:00:00Z"
        raise SessionError(path, f"{name} is {first!r} at row 0", expected, "write the times so", row=0) from error
    gps = quantity_in(name).startswith("gps")
    by_size = next((unit for least, unit in _UNIX if size >= least), None)
    unit = _unit_ns(name) or by_size or NS
    dated = size * unit >= _UNIX[0][0]
    return ("gps" if gps else "unix") if dated else "unknown", unit


def _unit_ns(name: str) -> int | None:
    """The unit that a heading names, such as ``t_ns`` or ``Time (ms)``."""
    units = {"ns": 1, "us": 1000, "ms": 10**6, "s": NS}
    found = unit_in(name) or (name.rpartition("_")[2].lower() if "_" in name else "")
    return units.get(found)
