"""What the readers of positions share: range errors of receivers, a session of fixes alone, heights above the sea."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from smartnav_graph.core.errors import SessionError
from smartnav_graph.readers.fixes import LoggedFixes, first_fix, fix_table
from smartnav_graph.readers.source import build_session
from smartnav_graph.session.session import Session

# Range error (m, 1 sigma) that turns a dilution of precision into the sigma of a position, by the quality of an NMEA
# fix: 1 code, 2 differential, 3 encrypted code, 4 carrier phase with fixed and 5 with float ambiguities, 6 dead
# reckoning. HDOP is of both horizontal axes together.
RANGE_ERROR_M = {1: 4.0, 2: 1.5, 3: 1.5, 4: 0.02, 5: 0.3, 6: 20.0}


def session_of_fixes(
    path: Path, fixes: LoggedFixes, epoch: str, repairs: tuple[str, ...], unused: Mapping[str, int] | None = None
) -> Session:
    """A session of fixes alone, with its origin at the first; `unused` counts what else the file holds."""
    table, counts = fix_table(fixes, may_repeat=True)
    if not len(table["t_ns"]):
        found = f"holds no position in {len(fixes.t_ns)} rows"
        raise SessionError(path, found, "at least one fix", "record again with a view of the sky", stream="gnss")
    mounts = fixes.mounts(table)
    session = build_session(
        {"gnss": (path, table)}, repairs, clock_epoch=epoch, origin=first_fix(table), sensors=mounts
    )
    counts = {**{reason: count for reason, count in (unused or {}).items() if count}, **counts}
    return session.replace(dropped={**session.dropped, "gnss": counts} if counts else session.dropped)
