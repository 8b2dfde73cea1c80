"""Solutions of RTKLIB (.pos): latitude, longitude and height, or ECEF, with sigmas and velocities.

RTKLIB manual 2.4.2, appendix B.1: the last heading line that begins with ``%`` names the columns; times are GPST, UTC
or JST, as dates or as GPS week and seconds.
"""

from __future__ import annotations

import io
import re
from pathlib import Path

import numpy as np

from smartnav_graph.core.arrays import Floats, Times
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.frames import lla_from_ecef
from smartnav_graph.core.timebase import NS, ns_from_texts
from smartnav_graph.readers.fixes import LoggedFixes
from smartnav_graph.readers.positions.track import session_of_fixes
from smartnav_graph.readers.source import Reader, first_bytes
from smartnav_graph.readers.stamps import YEARS
from smartnav_graph.readers.text import read_bytes
from smartnav_graph.session.session import Session

_HEADING = re.compile(rb"^%\s+(GPST|UTC|JST)[ ,]+(latitude|x-ecef|e-baseline)", re.MULTILINE)
_TIME_OF_DAY = re.compile(r"(\d\d?):(\d\d?):(\d\d?(?:\.\d*)?)")
_MOST_WEEKS = 10_000
_GPS_EPOCH_NS = int(np.datetime64("1980-01-06", "ns").astype(np.int64))
_JST_NS = 9 * 3600 * NS
_PLACES = {"lla": ("latitude(deg)", "longitude(deg)", "height(m)"), "ecef": ("x-ecef(m)", "y-ecef(m)", "z-ecef(m)")}
_SIGMAS, _VELOCITIES = ("sde(m)", "sdn(m)", "sdu(m)"), ("ve(m/s)", "vn(m/s)", "vu(m/s)")
_VELOCITY_SIGMAS = ("sdve", "sdvn", "sdvu")


def _read(source: str, repairs: tuple[str, ...]) -> Session:
    path = Path(source)
    data = read_bytes(path)
    heading = _HEADING.search(data)
    if heading is None:
        raise SessionError(path, "has no heading of columns", "a line '%  GPST  latitude(deg) ...'", "write it again")
    line = data[heading.start() : data.find(b"\n", heading.start())].decode("ascii", "replace")
    system, *names = re.split(r"[\s,]+", line.lstrip("% ").strip())
    rows = [re.split(r"[\s,;]+", row.strip()) for row in _body(data)]
    if not rows:
        raise SessionError(path, "has no rows", "at least one solution", "check the processing log of RTKLIB")
    width = len(names) + 2  # date and time, or week and seconds
    for i, row in enumerate(rows):
        if len(row) != width:
            found = f"row {i} has {len(row)} cells"
            raise SessionError(path, found, f"{width} as the heading names", "delete it", row=i)
    cells = {name: _numbers(path, name, [row[i + 2] for row in rows]) for i, name in enumerate(names)}
    t_ns = _times(path, [(row[0], row[1]) for row in rows], system)
    lat, lon, height = _places(path, cells).T
    fixes = LoggedFixes(
        *(t_ns, lat, lon, height),
        velocity=_group(cells, _VELOCITIES),
        velocity_sigma=_group(cells, _VELOCITY_SIGMAS),
        sigma=_group(cells, _SIGMAS),
        fix_type=cells["Q"].astype(np.int64) if "Q" in cells else None,
        above_sea=b"WGS84/geodetic" in data,
    )
    return session_of_fixes(path, fixes, "gps" if system == "GPST" else "unix", repairs)


def _body(data: bytes) -> list[str]:
    lines = io.TextIOWrapper(io.BytesIO(data), encoding="utf-8-sig", errors="replace")
    return [line for line in lines if line.strip() and not line.startswith("%")]


def _numbers(path: Path, name: str, texts: list[str]) -> Floats:
    try:
        return np.array(texts, dtype=np.float64)
    except ValueError as error:
        raise SessionError(path, f"{name}: {error}", "numbers", "correct or delete the row") from error


def _group(cells: dict[str, Floats], names: tuple[str, ...]) -> Floats | None:
    """Three columns (n, 3); None where one is not there."""
    return np.stack([cells[name] for name in names], axis=1) if all(name in cells for name in names) else None


def _places(path: Path, cells: dict[str, Floats]) -> Floats:
    kind = next((kind for kind, names in _PLACES.items() if all(name in cells for name in names)), None)
    if kind is None:
        remedy = "write it again with solution format Lat/Lon/Height, in degrees"
        raise SessionError(path, "holds a baseline or degrees with minutes", "latitude, longitude, height", remedy)
    rows = np.stack([cells[name] for name in _PLACES[kind]], axis=1)
    if kind == "lla":
        return rows
    return lla_from_ecef(rows)


def _times(path: Path, stamps: list[tuple[str, str]], system: str) -> Times:
    """Nanoseconds since the GPS epoch of GPST, Unix nanoseconds of the others."""
    first, second = [day for day, _ in stamps], [time for _, time in stamps]
    try:
        if "/" in first[0]:
            dates = np.array([day.replace("/", "-") for day in first], dtype="datetime64[D]")
            years = dates.astype("datetime64[Y]").astype(np.int64) + 1970
            if not ((years >= YEARS[0]) & (years <= YEARS[1])).all():
                raise ValueError(f"years {years.min()} to {years.max()}")
            days = dates.astype("datetime64[ns]")
            clock = [found for text in second if (found := _TIME_OF_DAY.fullmatch(text)) is not None]
            if len(clock) < len(second):
                raise ValueError(next(text for text in second if not _TIME_OF_DAY.fullmatch(text)))
            minutes = np.array([60 * int(m[1]) + int(m[2]) for m in clock], dtype=np.int64)
            t_ns = days.astype(np.int64) + minutes * 60 * NS + ns_from_texts([m[3] for m in clock])
            gps_ns = t_ns - _GPS_EPOCH_NS
        else:
            weeks = np.array(first, dtype=np.int64)
            if not ((weeks >= 0) & (weeks < _MOST_WEEKS)).all():
                raise ValueError(f"weeks {weeks.min()} to {weeks.max()}")
            gps_ns = weeks * 604_800 * NS + ns_from_texts(second)
            t_ns = gps_ns + _GPS_EPOCH_NS
    except (ValueError, SessionError) as error:
        raise SessionError(path, f"a time is not readable ({error})", "yyyy/mm/dd hh:mm:ss or week seconds") from error
    if system == "GPST":
        return np.asarray(gps_ns)
    return np.asarray(t_ns - (_JST_NS if system == "JST" else 0))


READER = Reader(
    name="rtklib",
    summary="solutions of RTKLIB (.pos)",
    recognised_by="a text file with a heading '%  GPST  latitude(deg) ...'",
    matches=lambda source: _HEADING.search(first_bytes(source)) is not None,
    read_source=_read,
)
