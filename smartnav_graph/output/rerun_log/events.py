"""Gaps, outages, standstills and rejected fixes as time spans; without Rerun."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core.arrays import Times
from smartnav_graph.core.timebase import NS, Gap, find_gaps, ns_from_seconds
from smartnav_graph.graph.solution import Solution
from smartnav_graph.output.summary_json import GAP_KINDS, Summary, imu_gaps, standstill_spans
from smartnav_graph.session.session import Session
from smartnav_graph.session.stream import Stream

USED, REJECTED, WITHHELD = 0, 1, 2


@dataclass(frozen=True)
class Events:
    """Time spans of gaps, outages and standstills, and the use of every row of positions.

    use : by stream, (n,) USED, REJECTED, or WITHHELD (no residual: withheld, or outside the solution).
    """

    start_ns: int
    end_ns: int
    gaps: list[Gap]
    outages: list[Gap]
    standstills: list[Gap]
    use: Mapping[str, NDArray[np.int64]]


def find_events(session: Session, solution: Solution | None, summary: Summary) -> Events:
    """The events of a session, its solution and its summary."""
    start, end = span(session, solution)
    use = {name: fix_use(stream, solution) for name, stream in session.absolute().items()}
    fixes = session.gnss.t_ns[use["gnss"] == USED] if session.gnss is not None else np.zeros(0, dtype=np.int64)
    return Events(
        start_ns=start,
        end_ns=end,
        gaps=gap_spans(session, summary),
        outages=outages(fixes, start, end) if session.gnss is not None else [],
        standstills=_standstills(session, summary),
        use=use,
    )


def _standstills(session: Session, summary: Summary) -> list[Gap]:
    """Standstills of the summary, else those listed in the session."""
    if "standstills" in summary:
        spans = ns_from_seconds(np.array(standstill_spans(summary)).reshape(-1, 2)) + session.t0_ns
    elif session.static is not None:
        spans = np.stack([session.static.t_ns, session.static.t_end_ns], axis=1)
    else:
        return []
    return [Gap(int(a), int(b), "standstill") for a, b in spans]


def span(session: Session, solution: Solution | None) -> tuple[int, int]:
    """First and last stamp of the session and its solution."""
    times = [stream.t_ns for name, stream in session.streams().items() if name != "reference" and len(stream)]
    times += [solution.t_ns] if solution is not None and len(solution) else []
    if not times:
        return session.t0_ns, session.t0_ns
    return min(int(t[0]) for t in times), max(int(t[-1]) for t in times)


def gap_spans(session: Session, summary: Summary) -> list[Gap]:
    """IMU data gaps of the summary, else those found in the inertial stream."""
    if "gaps" in summary:
        gaps = imu_gaps(summary)
        starts = ns_from_seconds([gap.start_s for gap in gaps]) + session.t0_ns
        found = [
            Gap(int(t), int(t + ns_from_seconds(gap.length_s)), gap.kind) for t, gap in zip(starts, gaps, strict=True)
        ]
    elif session.imu is None:
        found = []
    else:
        found = find_gaps(session.imu.t_ns, np.concatenate([session.imu.gyro, session.imu.accel], axis=1))
    return [replace(gap, kind=GAP_KINDS.get(gap.kind, gap.kind)) for gap in found]


def fix_use(fixes: Stream, solution: Solution | None) -> NDArray[np.int64]:
    """USED, REJECTED or WITHHELD for every row of positions, by its residuals (n,); USED without any of the sensor."""
    if solution is None or not solution.residuals.of(fixes.NAME).any():
        return np.full(len(fixes), USED, dtype=np.int64)
    there, used = solution.residuals.found_for(fixes.NAME, fixes.t_ns)
    return np.where(used, USED, np.where(there, REJECTED, WITHHELD)).astype(np.int64)


def outages(t_ns: Times, start_ns: int, end_ns: int, *, periods: float = 3.0, least_s: float = 1.0) -> list[Gap]:
    """Spans of [start, end] without a sample for longer than `periods` median periods and `least_s`."""
    limit = max(least_s * NS, periods * float(np.median(np.diff(t_ns)))) if len(t_ns) > 1 else least_s * NS
    edges = np.concatenate([[start_ns], t_ns, [end_ns]]).astype(np.int64)
    return [Gap(int(edges[i]), int(edges[i + 1]), "outage") for i in np.flatnonzero(np.diff(edges) > limit)]


def stops(t_ns: Times, end_ns: int) -> Times:
    """Ends of a stream's data: one median period after the last sample before each outage."""
    if not len(t_ns):
        return t_ns
    period = int(np.median(np.diff(t_ns))) if len(t_ns) > 1 else 0
    quiet = outages(t_ns, int(t_ns[0]), end_ns, least_s=0.05)
    return np.array([gap.start_ns + min(period, (gap.end_ns - gap.start_ns) // 2) for gap in quiet], dtype=np.int64)


def switches(start_ns: int, spans: list[Gap], between: str) -> tuple[Times, list[str]]:
    """Times and names of a status that is `between` outside the spans and the span's kind inside."""
    at: dict[int, str] = {start_ns: between}
    for gap in spans:
        at.setdefault(gap.end_ns, between)
        at[gap.start_ns] = gap.kind
    times = sorted(at)
    keep = [i for i, t in enumerate(times) if i == 0 or at[t] != at[times[i - 1]]]
    return np.array([times[i] for i in keep], dtype=np.int64), [at[times[i]] for i in keep]
