"""GPX: the points of all tracks, with speed, course and accuracy where a logger wrote them.

Stamps are UTC (GPX 1.1 schema, Topografix). Elevations are above mean sea level by custom, ellipsoidal where the point
has the height of the geoid.
"""

from __future__ import annotations

import datetime
import logging
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.timebase import NS
from smartnav_graph.readers.fixes import RADIUS_68, LoggedFixes, unmarked
from smartnav_graph.readers.positions.track import RANGE_ERROR_M, session_of_fixes
from smartnav_graph.readers.source import Reader, first_bytes
from smartnav_graph.readers.stamps import YEARS
from smartnav_graph.readers.text import read_bytes
from smartnav_graph.session.session import Session

if TYPE_CHECKING:
    from gpxpy.gpx import GPXTrackPoint

_EPOCH = datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC)
# Elements in extensions, by their lower-case name without namespace.
_EXTENSIONS = {
    "speed": ("speed",),
    "course": ("course", "bearing", "heading"),
    "accuracy": ("accuracy", "hacc", "horizontalaccuracy"),
    "vertical": ("vacc", "verticalaccuracy"),
}


def _read(source: str, repairs: tuple[str, ...]) -> Session:
    path = Path(source)
    every = _points(path)
    points = [point for point in every if point.time is not None]
    if not points:
        found = f"holds no point with a time ({len(every)} track points)"
        raise SessionError(path, found, "track points with <time>", "give a list of places as control points (CSV)")
    times = [point.time for point in points if point.time is not None]
    if others := [row for row, time in enumerate(times) if not YEARS[0] <= time.year <= YEARS[1]]:
        found = f"time is {times[others[0]].isoformat()} at row {others[0]} ({len(others)} such points in all)"
        raise SessionError(path, found, f"years {YEARS[0]} to {YEARS[1]}", "correct the point", row=others[0])
    t_ns = np.array([_nanoseconds(time) for time in times], dtype=np.int64)
    place = [(p.latitude, p.longitude, p.elevation, p.geoid_height) for p in points]
    lla = np.array([[np.nan if value is None else value for value in row] for row in place], dtype=np.float64)
    geoid = lla[:, 3]
    if np.isfinite(geoid).any():
        lla[:, 2] += geoid
    extra = {name: np.array([_extension(point, names) for point in points]) for name, names in _EXTENSIONS.items()}
    horizontal, vertical = _accuracies(points, extra["accuracy"], extra["vertical"])
    fixes = LoggedFixes(
        *(t_ns, lla[:, 0], lla[:, 1], lla[:, 2], horizontal, vertical),
        speed=_or(points, "speed", extra["speed"]),
        course=_or(points, "course", extra["course"]),
        above_sea=not np.isfinite(geoid).any(),
    )
    unused = {"points without a time": len(every) - len(points)}
    return session_of_fixes(path, fixes, "unix", repairs, unused)


def _points(path: Path) -> list[GPXTrackPoint]:
    """Every track point, in order."""
    import gpxpy
    import gpxpy.gpx

    logging.getLogger("gpxpy.gpx").setLevel(logging.ERROR)
    try:
        found = gpxpy.parse(read_bytes(path))
    except (gpxpy.gpx.GPXException, ValueError) as error:
        raise SessionError(path, f"is no GPX ({error})", "a whole GPX file", "export it again") from error
    return [point for track in found.tracks for segment in track.segments for point in segment.points]


def _nanoseconds(time: datetime.datetime) -> int:
    since = (time if time.tzinfo is not None else time.replace(tzinfo=datetime.UTC)) - _EPOCH
    return (since.days * 86_400 + since.seconds) * NS + since.microseconds * 1000


def _extension(point: GPXTrackPoint, names: tuple[str, ...]) -> float:
    """The first number in the extensions of a point that has one of the names."""
    for top in point.extensions:
        for element in top.iter():
            if str(element.tag).rpartition("}")[2].lower() in names:
                try:
                    return float(element.text or "nan")
                except ValueError:
                    continue
    return np.nan


def _or(points: list[GPXTrackPoint], name: str, other: Floats) -> Floats:
    """An element of GPX 1.0, else that of the extensions."""
    own = np.array([np.nan if (value := getattr(p, name, None)) is None else float(value) for p in points])
    return np.where(np.isfinite(own), own, other)


def _accuracies(points: list[GPXTrackPoint], horizontal: Floats, vertical: Floats) -> tuple[Floats, Floats]:
    """Stated accuracies, else those of the dilutions of precision."""
    n, unknown = len(points), np.full(len(points), np.nan)
    dilutions = (_or(points, name, unknown) for name in ("horizontal_dilution", "vertical_dilution"))
    hdop, vdop = (dilution * RANGE_ERROR_M[1] for dilution in dilutions)
    h, v = unmarked(horizontal, n), unmarked(vertical, n)
    radius = hdop * RADIUS_68 / np.sqrt(2.0)  # of both axes together -> that of 68 %
    return np.where(np.isfinite(h), h, radius), np.where(np.isfinite(v), v, vdop)


READER = Reader(
    name="gpx",
    summary="GPX tracks, with speed and accuracy where written",
    recognised_by="an XML file with <gpx",
    matches=lambda source: b"<gpx" in first_bytes(source),
    read_source=_read,
)
