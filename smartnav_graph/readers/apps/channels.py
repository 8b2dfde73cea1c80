"""Which column of an app's log holds what: names matched without case, blanks and signs; units from their brackets."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from smartnav_graph.core.arrays import Floats, Mask, Times
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.frames import STANDARD_GRAVITY
from smartnav_graph.readers.fixes import LoggedFixes
from smartnav_graph.readers.samples import Samples, in_time_order
from smartnav_graph.readers.text import TextTable
from smartnav_graph.readers.units import (
    ACCELERATION,
    ANGULAR_RATE,
    FLUX_DENSITY,
    LENGTH,
    PRESSURE,
    SPEED,
    quantity_in,
    unit_in,
)

# Vectors: names without their axis, as they are looked for in turn. Names of chips may stay around the longer ones.
_AXIS = r"(?:axis|value)?([xyz])(?:axis|value)?"
VECTORS = {
    "linear": r"\w*linear_?acc\w*?|linacc|motionuseracceleration|useracceleration",
    "gravity": r"\w*gravity|grav",
    "motion_gyro": r"motionrotationrate",
    "motion_field": r"motionmagneticfield",
    "gyro": r"\w*gyro\w*?|gyr|rotationrate|angularvelocity|angularrate|w|omega|rotrate",
    "field": r"\w*magnetic\w*?|\w*magnetometer\w*?|akmakm\w*?|mag|b",
    "gforce": r"gf|gforce",
    "accel": r"\w*accelerometer\w*?|totalacceleration|acceleration|accel|acc|a|force",
}
# Names of one number.
SCALARS = {
    "lat": r"(?:location|gps|gnss)?lat(?:itude)?(?:wgs84|deg)?",
    "lon": r"(?:location|gps|gnss)?(?:lon|lng|long)(?:gitude|itude)?(?:wgs84|deg)?",
    "height": r"(?:location|gps|gnss)?(?:altitude|alt|height|elevation)(?:wgs84)?",
    "speed": r"(?:location|gps|gnss)?(?:speed|velocity)",
    "course": r"(?:location|gps|gnss)?(?:orientation|course|bearing|direction|heading)",
    "horizontal": r"(?:location|gps|gnss)?(?:horizontal)?accuracy|(?:gps|gnss)?hacc",
    "vertical": r"(?:location|gps|gnss)?verticalaccuracy|(?:gps|gnss)?vacc",
    "speed_sigma": r"(?:location|gps|gnss)?speedaccuracy",
    "course_sigma": r"(?:location|gps|gnss)?(?:course|bearing)accuracy",
    "pressure": r"(?:atmospheric|air|altimeter|barometer)?pressure|barometer|p",
}
_UNITS = {
    **dict.fromkeys(("accel", "linear", "gravity", "gforce"), ACCELERATION),
    **dict.fromkeys(("gyro", "motion_gyro"), ANGULAR_RATE),
    **dict.fromkeys(("field", "motion_field"), FLUX_DENSITY),
    "pressure": PRESSURE,
    **dict.fromkeys(("speed", "speed_sigma"), SPEED),
    **dict.fromkeys(("height", "horizontal", "vertical"), LENGTH),
}
_NO_VECTOR = re.compile(r"uncal|rotationvector|orientation|timestamp|accuracy|bias|drift|heading|headphone")
# Mean size of specific force, as shares of gravity, for a unit that the heading does not say.
_LIKE_GRAVITY = (0.7, 1.3)


@dataclass(frozen=True)
class Channels:
    """Columns of a table by what they hold: vectors as three names, numbers as one."""

    table: TextTable
    vectors: Mapping[str, tuple[str, str, str]]
    scalars: Mapping[str, str]

    def has(self, *roles: str) -> bool:
        """Whether all of these are there."""
        return all(role in self.vectors or role in self.scalars for role in roles)

    def vector(self, role: str, default: float = 1.0) -> Floats:
        """Readings (n, 3) in SI (uT for a magnetometer); `default` is the unit where the heading says none.

        Raises
        ------
        SessionError
            A cell is no number, or the unit is not known.
        """
        names = self.vectors[role]
        factors = [self._factor(role, name, default) for name in names]
        return self.table.floats(*names) * factors

    def scalar(self, role: str, default: float = 1.0) -> Floats | None:
        """Readings (n,); None where the log has none."""
        if role not in self.scalars:
            return None
        return self.table.floats(self.scalars[role]) * self._factor(role, self.scalars[role], default)

    def _factor(self, role: str, name: str, default: float) -> float:
        unit, known = unit_in(name), _UNITS.get(role)
        if known is None or not unit:
            return default
        if unit not in known:
            if role in ("vertical", "horizontal", "height"):
                return default  # some write a degree sign there
            expected = f"one of {', '.join(known)}"
            raise SessionError(self.table.path, f"column {name!r} is in {unit!r}", expected, "name the unit so")
        return known[unit]


def channels_of(table: TextTable, but: Iterable[str] = ()) -> Channels:
    """The columns of a table that are known by their names; the first of several that fit.

    but : roles not to look for
    """
    vectors: dict[str, dict[str, str]] = {}
    scalars: dict[str, str] = {}
    left = {role: pattern for role, pattern in VECTORS.items() if role not in but}
    for name in table.cells:
        quantity = quantity_in(name)
        role, axis = ("", "") if _NO_VECTOR.search(quantity) else _vector_role(quantity, left)
        if role:
            vectors.setdefault(role, {}).setdefault(axis, name)
        elif role := next((r for r, pattern in SCALARS.items() if re.fullmatch(pattern, quantity)), ""):
            scalars.setdefault(role, name)
    whole = {role: (axes["x"], axes["y"], axes["z"]) for role, axes in vectors.items() if len(axes) == 3}
    return Channels(table, whole, scalars)


def _vector_role(quantity: str, patterns: Mapping[str, str]) -> tuple[str, str]:
    for role, pattern in patterns.items():
        if found := re.fullmatch(f"(?:{pattern}){_AXIS}", quantity):
            return role, found[1]
    return "", ""


def force_of(channels: Channels, sign: float = 1.0) -> Floats | None:
    """Specific force (n, 3) m/s^2 of the columns that have gravity in them; None where there is no accelerometer.

    sign : -1 for logs of iOS, which give it with the opposite sign

    Raises
    ------
    SessionError
        There is an accelerometer, but without gravity.
    """
    file = channels.table.path
    force: Floats | None = None
    for role in ("accel", "gforce"):
        if role in channels.vectors and (force is None or not _has_gravity(force)):
            stated = bool(unit_in(channels.vectors[role][0])) or role == "gforce"
            force = channels.vector(role, STANDARD_GRAVITY if role == "gforce" else 1.0)
            force = force if stated else _in_metres(force)
    if (force is None or not _has_gravity(force)) and channels.has("linear", "gravity"):
        force = channels.vector("linear") + channels.vector("gravity")
    if force is None and channels.has("linear"):
        force = channels.vector("linear")
    if force is not None and not _has_gravity(force):
        found = f"median acceleration is {_size(force):.3g} m/s^2: gravity is missing"
        remedy = "log the accelerometer with gravity (not the linear acceleration), or gravity beside it"
        raise SessionError(file, found, f"specific force, {STANDARD_GRAVITY} m/s^2 at rest", remedy, stream="imu")
    return None if force is None else force * sign


def _size(force: Floats) -> float:
    size = np.linalg.norm(force, axis=1)
    known = size[np.isfinite(size)]
    return float(np.median(known)) if len(known) else np.nan


def _has_gravity(force: Floats) -> bool:
    return not _size(force) < _LIKE_GRAVITY[0] * STANDARD_GRAVITY


def _in_metres(force: Floats) -> Floats:
    """Readings without a stated unit: of the size of 1 they are shares of gravity."""
    return force * STANDARD_GRAVITY if _LIKE_GRAVITY[0] < _size(force) < _LIKE_GRAVITY[1] else force


def read_vector(table: TextTable, t_ns: Times, values: Floats, repairs: tuple[str, ...]) -> Samples:
    """Readings of one sensor in order of time, with what was left out of the file."""
    found = in_time_order(table.path, t_ns, values, repairs)
    return Samples(found.file, found.t_ns, found.values, {**table.skipped, **found.counts})


def fixes_of(channels: Channels, t_ns: Times, rows: Mask | None = None) -> LoggedFixes:
    """Fixes of the columns that are there, of the rows of a mask (n,).

    Heights are in metres, speeds in m/s unless the heading says otherwise.
    """
    keep = np.ones(len(t_ns), dtype=bool) if rows is None else rows
    columns = {role: channels.scalar(role) for role in SCALARS if role != "pressure"}
    lat, lon = columns["lat"], columns["lon"]
    assert lat is not None and lon is not None  # the caller has asked

    def kept(role: str) -> Floats | None:
        column = columns[role]
        return None if column is None else column[keep]

    return LoggedFixes(
        t_ns[keep],
        lat[keep],
        lon[keep],
        height=kept("height"),
        horizontal=kept("horizontal"),
        vertical=kept("vertical"),
        speed=kept("speed"),
        course=kept("course"),
        speed_sigma=kept("speed_sigma"),
        course_sigma=kept("course_sigma"),
    )
