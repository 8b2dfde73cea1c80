"""Text files by a description of their columns: ``time=t_ms:ms, ax=accel_x:g, gz=-rate_z:deg/s, lat=latitude``.

Every item is ``quantity = column[:unit]``; a minus before the column turns its sign, ``#3`` is the third column of a
file without headings, quotes enclose a heading that has a comma. The unit is that of the heading's brackets, else SI,
where none is given. Several files share one description; each takes what it has, and needs one of the columns given as
``time``. A description is kept under a name with `save_profile`.
"""

from __future__ import annotations

import os
import re
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tomli_w

from smartnav_graph.core.arrays import Floats, Times
from smartnav_graph.core.errors import ConfigError, SessionError
from smartnav_graph.core.files import replacing
from smartnav_graph.core.timebase import NS
from smartnav_graph.readers.fixes import LoggedFixes
from smartnav_graph.readers.log_session import LogParts, log_session
from smartnav_graph.readers.samples import in_time_order
from smartnav_graph.readers.stamps import has_zone, is_date
from smartnav_graph.readers.text import TextTable, read_text
from smartnav_graph.readers.text_lines import heading_of
from smartnav_graph.readers.units import (
    ACCELERATION,
    ANGULAR_RATE,
    FLUX_DENSITY,
    LENGTH,
    PRESSURE,
    SPEED,
    TEMPERATURE,
    TIME_NS,
    plain_heading,
    unit_in,
)
from smartnav_graph.session.session import EPOCHS, Session

ANGLE = {"deg": 1.0, "°": 1.0, "rad": float(np.degrees(1.0)), "1e-7deg": 1e-7}
_DATE = {"date": NS, "iso": NS}

# What a column may be -> its units.
QUANTITIES: dict[str, dict[str, float]] = {
    "time": {**TIME_NS, **_DATE},
    **dict.fromkeys(("ax", "ay", "az"), ACCELERATION),
    **dict.fromkeys(("gx", "gy", "gz"), ANGULAR_RATE),
    **dict.fromkeys(("mx", "my", "mz"), FLUX_DENSITY),
    "pressure": PRESSURE,
    "temperature": TEMPERATURE,
    **dict.fromkeys(("lat", "lon", "course"), ANGLE),
    **dict.fromkeys(("height", "accuracy", "accuracy_v"), LENGTH),
    **dict.fromkeys(("speed", "ve", "vn", "vu", "wheel"), SPEED),
}
_SETTINGS = ("epoch", "device", "forward", "up", "vehicle")
_VECTORS = {"gyro": ("gx", "gy", "gz"), "accel": ("ax", "ay", "az"), "magnetometer": ("mx", "my", "mz")}
_SINGLE = {
    "pressure": ("barometer", "pressure_hpa"),
    "temperature": ("temperature", "temperature_c"),
    "wheel": ("wheel", "speed_m_s"),
}
_BETWEEN_ITEMS = re.compile(r',(?=(?:[^"]*"[^"]*")*[^"]*$)')  # commas outside quotes
_UNIX_NS = 10**17  # stamps from here on (1973) are dates


@dataclass(frozen=True)
class ColumnRole:
    """A column that holds `quantity`, times `sign`, in `unit` (empty: that of the heading, else SI)."""

    quantity: str
    column: str
    unit: str
    sign: float


@dataclass(frozen=True)
class ColumnMap:
    """A description of columns, and what it says about the device and its clock."""

    roles: tuple[ColumnRole, ...]
    settings: dict[str, str]

    def in_file(self, headings: Sequence[str]) -> dict[str, ColumnRole]:
        """Quantity -> its column among these headings."""
        found: dict[str, ColumnRole] = {}
        for role in self.roles:
            if role.column in headings or re.fullmatch(r"#\d+", role.column):
                found.setdefault(role.quantity, role)
        return found

    def without_headings(self) -> bool:
        """Whether columns are given by their number."""
        return any(role.column.startswith("#") for role in self.roles)

    def describes(self, source: str) -> bool:
        """Whether a file has the time and something else."""
        if not Path(source).is_file():
            return False
        found = self.in_file(heading_of(Path(source), "#%@"))
        return "time" in found and len(found) > 1


def parse_columns(text: str) -> ColumnMap:
    """The description of a text, or of the profile of this name.

    Raises
    ------
    ConfigError
        Another form, an unknown quantity, unit or profile.
    """
    if "=" not in text:
        text = _profile(text)
    roles, settings = [], {}
    for item in filter(None, (part.strip() for part in _BETWEEN_ITEMS.split(text))):
        name, equals, column = (part.strip() for part in item.partition("="))
        if not equals or not column or (name not in QUANTITIES and name not in _SETTINGS):
            known = ", ".join((*QUANTITIES, *_SETTINGS))
            raise ConfigError("--columns", f"{item!r}", f"QUANTITY=COLUMN[:UNIT] with {known}", "correct it")
        if name in _SETTINGS:
            settings[name] = column
            continue
        column, _, unit = column.rpartition(":") if _is_unit(name, column.rpartition(":")[2]) else (column, "", "")
        sign = -1.0 if column.startswith("-") else 1.0
        roles.append(ColumnRole(name, column.removeprefix("-").strip().strip('"'), plain_heading(unit), sign))
    if not any(role.quantity == "time" for role in roles):
        raise ConfigError("--columns", "no time", "time=COLUMN[:UNIT]", "say which column is the time")
    if settings.get("epoch", "unknown") not in EPOCHS:
        raise ConfigError("--columns", f"epoch={settings['epoch']}", f"one of {', '.join(EPOCHS)}")
    return ColumnMap(tuple(roles), settings)


def _is_unit(quantity: str, unit: str) -> bool:
    return plain_heading(unit) in QUANTITIES[quantity]


def profiles_file() -> Path:
    """Where descriptions are kept: columns.toml in the user's configuration folder."""
    return Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config") / "smartnav" / "columns.toml"


def _profiles() -> dict[str, str]:
    try:
        return {name: str(text) for name, text in tomllib.loads(profiles_file().read_text(encoding="utf-8")).items()}
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise ConfigError(
            profiles_file(), f"cannot be read ({error})", 'NAME = "time=..., ax=..."', "mend it"
        ) from error


def _profile(name: str) -> str:
    known = _profiles()
    if name not in known:
        kept = f"one of {', '.join(known)}" if known else "a description such as time=t_ms:ms, ax=accel_x:g"
        found = f"no profile {name!r} in {profiles_file()}"
        raise ConfigError("--columns", found, kept, "keep one with --save-columns")
    return known[name]


def save_profile(name: str, text: str) -> Path:
    """Keep a description under a name; an older one of the same name is replaced."""
    if "=" in name:
        raise ConfigError("--save-columns", f"{name!r}", "a name without =", "choose another")
    path = profiles_file()
    kept = {**_profiles(), name: text}
    with replacing(path) as new:
        new.write_text(tomli_w.dumps(kept), encoding="utf-8")
    return path


def read_columns(sources: Sequence[str], columns: ColumnMap, repairs: tuple[str, ...] = ()) -> Session:
    """The session of text files by a description of their columns.

    Raises
    ------
    SessionError
        A column of the description is in no file, a cell is no number, or a unit is unknown.
    """
    files = [Path(source) for source in sources]
    headings = {file: [] if columns.without_headings() else heading_of(file, "#%@") for file in files}
    _check_all_found(columns, headings)
    parts = LogParts()
    epoch = columns.settings.get("epoch", "")
    vectors = {}
    for file in files:
        found = columns.in_file(headings[file])
        if "time" not in found:
            expected = f"one of {', '.join(role.column for role in columns.roles if role.quantity == 'time')}"
            raise SessionError(file, "has no column of times", expected, f"it has {', '.join(headings[file])}")
        table = _table(file, columns)
        t_ns, clock = _times(table, found["time"])
        epoch = epoch or clock
        for name, axes in _VECTORS.items():
            if set(axes) <= found.keys():
                values = np.stack([_values(table, found[axis]) for axis in axes], axis=-1)
                vectors[name] = in_time_order(file, t_ns, values, repairs)
        for quantity, (stream, column) in _SINGLE.items():
            if quantity in found:
                parts.add_single(stream, column, in_time_order(file, t_ns, _values(table, found[quantity]), repairs))
        if {"lat", "lon"} <= found.keys():
            parts.add_fixes(file, _fixes(table, found, t_ns))
    if ("gyro" in vectors) != ("accel" in vectors):
        there, missing = ("gyro", "ax, ay, az") if "gyro" in vectors else ("accelerometer", "gx, gy, gz")
        raise SessionError(", ".join(sources), f"has a {there} alone", "gx, gy, gz and ax, ay, az", f"add {missing}")
    if "gyro" in vectors:
        parts.add_imu(vectors["gyro"], vectors["accel"])
    if "magnetometer" in vectors:
        parts.add_magnetometer(vectors["magnetometer"])
    settings = {name: text for name, text in columns.settings.items() if name in ("forward", "up", "vehicle")}
    return log_session(parts, repairs, name=columns.settings.get("device", files[0].stem), epoch=epoch, **settings)


def _check_all_found(columns: ColumnMap, headings: dict[Path, list[str]]) -> None:
    there = {name for names in headings.values() for name in names}
    times = [role.column for role in columns.roles if role.quantity == "time"]
    for role in columns.roles:
        if role.column not in there and not role.column.startswith("#") and role.column not in times:
            where, remedy = ", ".join(map(str, headings)), f"the headings are {', '.join(sorted(there))}"
            found = f"has no column {role.column!r} for {role.quantity}"
            raise SessionError(where, found, "a heading of the file", remedy)


def _table(file: Path, columns: ColumnMap) -> TextTable:
    if not columns.without_headings():
        return read_text(file, comments="#%@")
    count = len(heading_of(file, "#%@"))
    return read_text(file, names=[f"#{i + 1}" for i in range(count)], comments="#%@")


def _values(table: TextTable, role: ColumnRole) -> Floats:
    """A column in the unit of the session."""
    units = QUANTITIES[role.quantity]
    table.require([role.column])
    named = role.unit or unit_in(role.column)
    if named and named not in units:
        found = f"{role.column} is in {named!r}"
        remedy = f"give it: {role.quantity}={role.column}:UNIT"
        raise SessionError(table.path, found, f"one of {', '.join(units)}", remedy)
    return np.asarray(table.floats(role.column) * (role.sign * units.get(named, 1.0)))


def _times(table: TextTable, role: ColumnRole) -> tuple[Times, str]:
    """Stamps, and the epoch that they show."""
    table.require([role.column])
    unit = role.unit or unit_in(role.column)
    t_ns = table.times(role.column, round(QUANTITIES["time"].get(unit, NS)))
    texts = table.texts(role.column)
    if len(texts) and is_date(str(texts[0])):
        return t_ns, "unix" if all(has_zone(str(text)) for text in texts[:100]) else "unknown"
    return t_ns, "unix" if len(t_ns) and t_ns[0] > _UNIX_NS else "unknown"


def _fixes(table: TextTable, found: dict[str, ColumnRole], t_ns: Times) -> LoggedFixes:
    columns = {name: _values(table, role) for name, role in found.items() if name not in ("time", *_SINGLE)}
    velocity = None
    if {"ve", "vn"} <= columns.keys():
        up = columns.get("vu", np.full(len(t_ns), np.nan))
        velocity = np.stack([columns["ve"], columns["vn"], up], axis=-1)
    return LoggedFixes(
        *(t_ns, columns["lat"], columns["lon"], columns.get("height")),
        horizontal=columns.get("accuracy"),
        vertical=columns.get("accuracy_v"),
        speed=columns.get("speed"),
        course=columns.get("course"),
        velocity=velocity,
    )
