"""Checks of a recorded session before anything is estimated: rates, gaps, units, signs, overlaps.

Nothing is repaired here. Every rule is a small generator of findings; `RULES` lists them: those of any stream in
`streams`, of the inertial stream in `inertial` and `axes`, of positions in `positions`, of the others in `sensors`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.timebase import Gap, find_gaps
from smartnav_graph.session.health import axes, inertial, positions, sensors
from smartnav_graph.session.health import streams as all_streams
from smartnav_graph.session.health.clocks import ClockReport, compare_clocks
from smartnav_graph.session.health.facts import AIDING, Facts, Finding
from smartnav_graph.session.health.inertial import quiet_accel, tilt_errors
from smartnav_graph.session.session import Session
from smartnav_graph.session.stream import Stream
from smartnav_graph.session.streams import ABSOLUTE

__all__ = ["AIDING", "Finding", "Health", "StreamHealth", "inspect", "quiet_accel", "tilt_errors"]


@dataclass(frozen=True)
class StreamHealth:
    """Rows of one stream; start in seconds since time zero, length in seconds, mean rate in Hz (NaN for one row)."""

    name: str
    rows: int
    start_s: float
    length_s: float
    rate_hz: float


@dataclass(frozen=True, kw_only=True)
class Health:
    """Contents and findings of a session. Accelerations m/s^2; gaps are those of the inertial stream."""

    streams: tuple[StreamHealth, ...]
    gaps: tuple[Gap, ...]
    clock_epoch: str
    gravity_m_s2: float
    quiet_accel_m_s2: float | None
    missing: tuple[str, ...]
    findings: tuple[Finding, ...]
    t0_ns: int

    def warnings(self) -> list[str]:
        """The warnings, each ``<where>: <found>; <remedy>``."""
        return [str(finding) for finding in self.findings if finding.level == "warning"]

    def raise_errors(self) -> None:
        """Raise the first finding of level error.

        Raises
        ------
        SessionError
            The session cannot be estimated from.
        """
        for finding in self.findings:
            if finding.level == "error":
                raise SessionError(finding.where, finding.text, remedy=finding.remedy)


def inspect(session: Session, gaps: Sequence[Gap] | None = None, clocks: ClockReport | None = None) -> Health:
    """The health of a session; `gaps` of the inertial stream and the comparison of `clocks`, where they are known
    already.

    Streams that will not be used can be left out: ``inspect(session.replace(magnetometer=None))``.
    """
    imu = session.imu
    usable = imu if imu is not None and len(imu) >= 2 else None
    if gaps is None:
        gaps = [] if usable is None else find_gaps(usable.t_ns, np.hstack([usable.gyro, usable.accel]))
    facts = Facts(session, tuple(gaps), None if usable is None else quiet_accel(usable))
    findings = list(all_streams.stamps(facts))
    if not findings:
        clocks = clocks or compare_clocks(session)
        findings = [*clocks.findings, *(finding for rule in RULES for finding in rule(facts))]
    parts = {
        "imu": imu is not None,
        f"absolute sensor ({', '.join(ABSOLUTE)})": bool(session.absolute()),
        "origin": session.origin is not None,
        "calibration": session.calibration is not None,
        "reference": session.reference is not None,
    }
    order = {"error": 0, "warning": 1, "info": 2}
    return Health(
        streams=tuple(_stream_health(session, name, stream) for name, stream in session.streams().items()),
        gaps=facts.gaps,
        clock_epoch=session.clock_epoch,
        gravity_m_s2=session.gravity,
        quiet_accel_m_s2=facts.quiet_accel,
        missing=tuple(name for name, there in parts.items() if not there),
        findings=tuple(sorted(findings, key=lambda finding: order[finding.level])),
        t0_ns=session.t0_ns,
    )


def _stream_health(session: Session, name: str, stream: Stream) -> StreamHealth:
    if not len(stream):
        return StreamHealth(name, 0, np.nan, 0.0, np.nan)
    start, end = session.seconds(stream.t_ns[[0, -1]])
    length = float(end - start)
    return StreamHealth(name, len(stream), float(start), length, (len(stream) - 1) / length if length else np.nan)


RULES: tuple[Callable[[Facts], Iterator[Finding]], ...] = (
    *all_streams.RULES,
    *inertial.RULES,
    *axes.RULES,
    *positions.RULES,
    *sensors.RULES,
    all_streams.dropped,
)
