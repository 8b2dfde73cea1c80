"""device_gnss.csv of Google's Smartphone Decimeter Challenge: one row a satellite, with the position of the epoch.

WlsPositionXEcefMeters, Y and Z are a weighted least squares solution of the pseudoranges of the epoch utcTimeMillis,
in the Earth's axes (WGS 84), without a sigma. Observations of the satellites are not read.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from smartnav_graph.core.frames import lla_from_ecef
from smartnav_graph.core.timebase import NS
from smartnav_graph.readers.fixes import LoggedFixes
from smartnav_graph.readers.positions.track import session_of_fixes
from smartnav_graph.readers.source import Reader
from smartnav_graph.readers.text import read_text
from smartnav_graph.readers.text_lines import heading_of
from smartnav_graph.session.session import Session

STAMP = "utcTimeMillis"
PLACE = tuple(f"WlsPosition{axis}EcefMeters" for axis in "XYZ")


def _matches(source: str) -> bool:
    try:
        path = Path(source)
        return path.is_file() and {STAMP, *PLACE} <= set(heading_of(path))
    except (OSError, ValueError):  # ValueError: a zero byte in the name
        return False


def _read(source: str, repairs: tuple[str, ...]) -> Session:
    path = Path(source)
    table = read_text(path, whole=True)
    table = table.rows(table.known(STAMP))
    t_ns, every = np.unique(table.times(STAMP, NS // 1000), return_index=True)
    ecef = table.floats(*PLACE)[every]
    known = np.isfinite(ecef).all(axis=1)
    lat, lon, height = lla_from_ecef(ecef[known]).T
    unused = {"epochs without a position": int((~known).sum())}
    return session_of_fixes(path, LoggedFixes(t_ns[known], lat, lon, height), "unix", repairs, unused)


READER = Reader(
    name="gsdc",
    summary="device_gnss.csv of the Smartphone Decimeter Challenge: positions",
    recognised_by="CSV with utcTimeMillis and WlsPositionXEcefMeters",
    matches=_matches,
    read_source=_read,
)
