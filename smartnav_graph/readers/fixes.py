"""Position fixes of phones and receivers -> columns of the stream ``gnss``.

A phone writes an accuracy, a speed and a course; marks replace what it does not know (-1, -9999, 0,0); wide logs
repeat the last fix in every row. Accuracy is the radius that holds 68 % of the errors (Android: Location.getAccuracy),
so that sigma of each axis = accuracy / 1.5096 for normally distributed errors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from smartnav_graph.core.arrays import Column, Floats, Mask, Table, Times
from smartnav_graph.core.frames import Origin
from smartnav_graph.session.session import Mount

RADIUS_68 = float(np.sqrt(-2.0 * np.log(1.0 - 0.68)))  # of a normal distribution in the plane, in sigmas of an axis
_MARKS = (-9999.0, -999.0, -1.0)  # of an unknown value, where the value cannot be negative


@dataclass(frozen=True)
class LoggedFixes:
    """LoggedFixes as they were logged; every field is (n,), and NaN or a mark where a value is unknown.

    t_ns : of the fix, on the clock of the session; lat, lon deg; height m
    horizontal, vertical : accuracies m, of 68 % radius and interval; a negative horizontal one marks a fix as invalid
    speed m/s, course deg clockwise from north, with their sigmas
    velocity : (n, 3) m/s east, north, up, where the log has it instead of speed and course; sigma (n,) or (n, 3) m/s
    sigma : (n, 3) m east, north, up, where the log has it instead of accuracies; fix_type : quality of the receiver
    above_sea : whether heights are above mean sea level, the geoid not being known
    """

    t_ns: Times
    lat: Floats
    lon: Floats
    height: Floats | None = None
    horizontal: Floats | None = None
    vertical: Floats | None = None
    speed: Floats | None = None
    course: Floats | None = None
    speed_sigma: Floats | None = None
    course_sigma: Floats | None = None
    velocity: Floats | None = None
    velocity_sigma: Floats | None = None
    sigma: Floats | None = None
    fix_type: Times | None = None
    above_sea: bool = False

    def mounts(self, table: Table) -> dict[str, Mount]:
        """Frame of the stream ``gnss`` as the session has it, by its columns: none where no height is known."""
        known = self.above_sea and np.isfinite(np.asarray(table["height_m"], dtype=np.float64)).any()
        return {"gnss": Mount(frame="msl")} if known else {}


def unmarked(values: Floats | None, rows: int) -> Floats:
    """Values (n,) that cannot be negative, NaN where they are marked as unknown or not there at all."""
    if values is None:
        return np.full(rows, np.nan)
    return np.where(np.isfinite(values) & (values >= 0.0), values, np.nan)


def no_position(fixes: LoggedFixes) -> Mask:
    """Mask (n,) of rows without a position: not a number, outside the Earth, a mark, or marked as invalid."""
    lat, lon = fixes.lat, fixes.lon
    outside = ~(np.abs(lat) <= 90.0) | ~(np.abs(lon) <= 360.0)
    marked = (lat == lon) & np.isin(lat, (0.0, *_MARKS))
    invalid = np.zeros(len(lat), dtype=bool) if fixes.horizontal is None else fixes.horizontal < 0.0
    return np.asarray(outside | marked | invalid)


def fix_table(fixes: LoggedFixes, *, may_repeat: bool = False) -> tuple[Table, dict[str, int]]:
    """Columns of the stream ``gnss``, and the counts of the rows left out.

    Rows come in order of time; one that repeats the stamp, or all values, of the row before is left out.
    `may_repeat` : every row is a fix of its own, which at rest may be that before.
    """
    n = len(fixes.t_ns)
    height = np.full(n, np.nan) if fixes.height is None else np.where(fixes.height > -9000.0, fixes.height, np.nan)
    if not np.nan_to_num(height).any():  # nothing but zeros: of fixes without a height
        height = np.full(n, np.nan)
    columns: Table = {"t_ns": fixes.t_ns, "lat_deg": fixes.lat, "lon_deg": fixes.lon, "height_m": height}
    columns |= _sigmas(fixes) | _velocities(fixes)
    if fixes.fix_type is not None:
        columns["fix_type"] = fixes.fix_type
    bad = no_position(fixes)
    kept = np.flatnonzero(~bad)
    kept = kept[np.argsort(fixes.t_ns[kept], kind="stable")]
    moved = int((np.diff(fixes.t_ns[~bad]) < 0).sum())
    t_ns = fixes.t_ns[kept]
    first = np.concatenate([[True], np.diff(t_ns) > 0])[: len(t_ns)]
    same = np.concatenate([[False], _repeats([np.asarray(c)[kept] for name, c in columns.items() if name != "t_ns"])])
    same &= not may_repeat
    counts = {
        "without a position left out": int(bad.sum()),
        "disordered rows sorted": moved,
        "that repeat the stamp of the fix before left out": int((~first).sum()),
        "that repeat the fix before left out": int((first & same[: len(first)]).sum()),
    }
    kept = kept[first & ~same[: len(first)]]
    table = {name: np.asarray(column)[kept] for name, column in columns.items()}
    return table, {reason: count for reason, count in counts.items() if count}


def _repeats(columns: list[Column]) -> Mask:
    """Mask (n - 1,) of the rows that have every value of the row before."""
    same = np.ones(max(len(columns[0]) - 1, 0), dtype=bool)
    for column in columns:
        values = np.asarray(column, dtype=np.float64)
        same &= (np.diff(values) == 0.0) | (np.isnan(values[1:]) & np.isnan(values[:-1]))
    return same


def _sigmas(fixes: LoggedFixes) -> Table:
    n = len(fixes.t_ns)
    horizontal, vertical = unmarked(fixes.horizontal, n) / RADIUS_68, unmarked(fixes.vertical, n)
    axes = (horizontal, horizontal, vertical) if fixes.sigma is None else fixes.sigma.T
    known = [np.where(sigma > 0.0, sigma, np.nan) for sigma in axes]
    if not np.isfinite(known[0]).any():
        return {}
    return {f"sigma_{axis}_m": sigma for axis, sigma in zip("enu", known, strict=True)}


def _velocities(fixes: LoggedFixes) -> Table:
    """East, north, up velocity and its sigma; of speed and course the vertical part is unknown."""
    n = len(fixes.t_ns)
    if fixes.velocity is not None:
        rows = fixes.velocity
        sigma = np.broadcast_to(unmarked(fixes.velocity_sigma, n).reshape(n, -1), (n, 3))
    elif fixes.speed is not None and fixes.course is not None:
        speed, course = unmarked(fixes.speed, n), np.radians(unmarked(fixes.course, n))
        speed = np.where((speed == 0.0) & (course == 0.0), np.nan, speed)  # of Android: no speed, or none known
        course = np.where((speed == 0.0) & np.isnan(course), 0.0, course)
        rows = np.stack([speed * np.sin(course), speed * np.cos(course), np.full(n, np.nan)], axis=-1)
        along = unmarked(fixes.speed_sigma, n)
        across = np.fmax(along, speed * np.radians(unmarked(fixes.course_sigma, n)))
        s, c = np.sin(course), np.cos(course)
        sigma = np.stack([np.hypot(along * s, across * c), np.hypot(along * c, across * s), np.full(n, np.nan)], -1)
    else:
        return {}
    if not np.isfinite(rows[:, :2]).any():
        return {}
    sigma = np.where(sigma > 0.0, sigma, np.nan)
    table: Table = {f"v{axis}_m_s": column for axis, column in zip("enu", rows.T, strict=True)}
    if np.isfinite(sigma[:, :2]).any():
        table |= {f"sigma_v{axis}_m_s": column for axis, column in zip("enu", sigma.T, strict=True)}
    return table


def first_fix(table: Table) -> Origin:
    """Origin of the local frame at the first fix of a table; height zero where no fix has one."""
    lat, lon, height = (np.asarray(table[name], dtype=np.float64) for name in ("lat_deg", "lon_deg", "height_m"))
    known = height[np.isfinite(height)]
    return Origin(float(lat[0]), float(lon[0]), float(known[0]) if len(known) else 0.0)
