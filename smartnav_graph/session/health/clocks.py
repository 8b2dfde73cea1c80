"""Clocks and axes of the position sensors against the inertial data; see `detect.clock` and `detect.axes`.

No rule of `inspect`: it is applied before, and what it finds is among the findings.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from smartnav_graph.core.timebase import LEAP_SECONDS, NS
from smartnav_graph.session.detect.axes import find_axes_fault
from smartnav_graph.session.detect.clock import ClockOffset, FixTrack, find_clock_offset
from smartnav_graph.session.detect.clock_changes import ClockChange, find_clock_change
from smartnav_graph.session.detect.motion import levelled_motion
from smartnav_graph.session.health.axes import axes_finding
from smartnav_graph.session.health.facts import Finding
from smartnav_graph.session.session import Session

# Lags below are of the receiver and its filter, and are estimated as a state. That is linear about zero: lags beyond
# the second are taken from the stamps before, where they are known this well (s) and this sharply.
STATE_S, LINEAR_S = 1.5, 0.3
_PRECISE_S, _SHARP = 0.06, 100.0
_GPS_EPOCH_S = 315_964_800.0
_SENSORS = ("gnss", "pose_fixes")


@dataclass(frozen=True)
class ClockReport:
    """What a comparison of the position sensors with the inertial data finds.

    offsets : of each sensor that could be compared; faults : of axes and of the stamps within a stream
    """

    offsets: tuple[ClockOffset, ...] = ()
    faults: tuple[Finding, ...] = ()

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Faults, and offsets that exceed what is estimated as a state."""
        return (*(_late(offset) for offset in self.offsets if beyond_state(offset)), *self.faults)

    def to_dict(self) -> dict[str, dict[str, float | bool]]:
        """Offsets by sensor, seconds."""
        return {
            o.sensor: {"lag_s": o.lag_s, "sigma_s": o.sigma_s, "sharpness": o.sharpness}
            | {"known": o.known, "applied": o.applied}
            for o in self.offsets
        }


def compare_clocks(session: Session) -> ClockReport:
    """Offsets of the position sensors to the inertial data of a session."""
    if session.imu is None or len(session.imu) < 2:
        return ClockReport()
    streams = {name: stream for name, stream in session.positions().items() if name in _SENSORS}
    motion = levelled_motion(session.imu) if streams else None
    if motion is None:
        return ClockReport()
    tracks = {
        name: FixTrack.of(stream.t_ns, session.nav_position(stream), motion.start_ns)
        for name, stream in streams.items()
    }
    offsets, faults = [], []
    for name, track in tracks.items():
        offset = find_clock_offset(name, motion, track)
        if offset is None:
            continue
        lag_s = offset.lag_s if offset.known else 0.0
        fault = find_axes_fault(session.imu, track, motion.start_ns, lag_s)
        if fault is not None:
            faults.append(axes_finding(session, fault))
        elif change := find_clock_change(motion, track, lag_s):
            offset = replace(offset, known=False)
            faults.append(_changing(name, change, motion.start_ns))
        offsets.append(offset)
    return ClockReport(tuple(offsets), tuple(faults))


def beyond_state(offset: ClockOffset) -> bool:
    """Whether an offset is known, and clearly larger than what is estimated as a state."""
    return offset.known and abs(offset.lag_s) - offset.sigma_s > STATE_S


def apply_offsets(session: Session, report: ClockReport) -> tuple[Session, ClockReport]:
    """Stamps without the offsets that are too large for a state alone, and the report that says so.

    The arrival of rows shifts with them: it is of the same clock.
    """
    changes, offsets = {}, []
    for offset in report.offsets:
        precise = offset.sigma_s < _PRECISE_S and offset.sharpness > _SHARP
        if beyond_state(offset) or (offset.known and precise and abs(offset.lag_s) > LINEAR_S):
            stream = session.positions()[offset.sensor]
            shift = round(offset.lag_s * NS)
            arrival = None if stream.arrival_ns is None else stream.arrival_ns - shift
            changes[offset.sensor] = replace(stream, t_ns=stream.t_ns - shift, arrival_ns=arrival)
            offset = replace(offset, applied=True)
        offsets.append(offset)
    return session.replace(**changes), replace(report, offsets=tuple(offsets))


def _late(offset: ClockOffset) -> Finding:
    way = "late" if offset.lag_s > 0 else "early"
    text = f"stamps are {abs(offset.lag_s):.2f} s {way} against the motion of the IMU, +- {offset.sigma_s:.2f} s"
    name = _name(offset.lag_s)
    remedy = "corrected for this run" if offset.applied else "`smartnav smooth` corrects it; better mend the stamps"
    return Finding(offset.sensor, text + (f": {name}" if name else ""), remedy, size=offset.lag_s)


def _changing(sensor: str, change: ClockChange, start_ns: int) -> Finding:
    at_ns = start_ns + round(change.at_s * NS)
    if change.is_rate:
        way = "slow" if change.size > 0 else "fast"
        text = f"clock runs {100 * abs(change.size):.1f} % {way} against that of {sensor}"
        remedy = f"multiply the time since its first row by {1.0 + change.size:.3f}"
        return Finding("imu", text, remedy, size=round(change.size, 4), start_ns=at_ns)
    text = f"stamps jump by {change.size:+.1f} s against the motion of the IMU, {change.at_s:.0f} s after its start"
    remedy = "correct the stamps from there on, or smooth both parts alone (--from, --to)"
    return Finding(sensor, text, remedy, size=round(change.size, 1), start_ns=at_ns)


def _name(lag_s: float) -> str:
    """What clocks differ by so much, within the lag of a receiver."""
    size = abs(lag_s)
    if abs(size - LEAP_SECONDS) < STATE_S:
        return f"GPS time against UTC ({LEAP_SECONDS} leap seconds)"
    if abs(size - _GPS_EPOCH_S) < LEAP_SECONDS + STATE_S:
        return "GPS epoch against Unix epoch"
    hours = size / 3600.0
    if 0.5 < hours < 14.5 and abs(size - 900.0 * round(4.0 * hours)) < STATE_S:
        return f"{round(4.0 * hours) / 4.0:g} hours: local time of a time zone against UTC"
    return ""
