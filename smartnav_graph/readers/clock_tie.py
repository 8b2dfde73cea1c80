"""The clock of one file against that of another: by their own stamps, else by the motion that both recorded."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.timebase import NS, gps_from_utc, utc_from_gps
from smartnav_graph.session.detect.clock import ClockOffset, FixTrack, find_clock_offset
from smartnav_graph.session.detect.motion import levelled_motion
from smartnav_graph.session.session import Session

_DAY_NS, _WEEK_NS = 86_400 * NS, 604_800 * NS
_QUARTER_NS = 900 * NS
_ZONES = range(-14 * 4, 14 * 4 + 1)  # quarters of an hour
_SAME_S = 2.5  # a lag found by motion is that of a receiver beside one that the stamps explain
_COMMON = 0.5  # share of the shorter recording that both must cover where only stamps tie them
_DATED = ("unix", "gps")


@dataclass(frozen=True)
class Tie:
    """How the stamps of a source became those of the session: `shift_ns` was added to them."""

    source: str
    shift_ns: int
    how: str
    confirmed: bool = True

    def __str__(self) -> str:
        shift = f"{self.shift_ns / NS:+.3f} s, " if self.shift_ns else ""
        return f"{self.source}: {shift}{self.how}" + ("" if self.confirmed else " (not confirmed by the motion)")


@dataclass(frozen=True)
class _Way:
    """A shift that would be explained by the clocks."""

    shift_ns: int
    how: str
    by_zone: bool = False  # one of many time zones


def time_span(session: Session) -> tuple[int, int]:
    """First and last stamp of all streams."""
    stamps = [stream.t_ns for stream in session.streams().values() if len(stream)]
    return min(int(t[0]) for t in stamps), max(int(t[-1]) for t in stamps)


def tie(base: Session, other: Session, source: str) -> Tie:
    """The shift that carries the stamps of `other` to the clock of `base`.

    The same clock, or Unix against GPS time, where both say which they have and overlap. Else the motion decides where
    it can, at any lag; a time zone, the date of a time of day, the week of a GPS time of week or a start at zero
    explain the shift. Without motion such an explanation alone is taken, where the recordings then overlap and it is
    no choice between time zones, and said to be unconfirmed.

    Raises
    ------
    SessionError
        Neither ties the clocks.
    """
    ways = list(_ways(base, other))
    if base.clock_epoch in _DATED and other.clock_epoch in _DATED and _common(base, other, ways[0].shift_ns) > 0.0:
        return Tie(source, ways[0].shift_ns, ways[0].how)
    lag = _by_motion(base, other)
    if lag is not None:
        shift = -round(lag.lag_s * NS)
        near = [way for way in ways if abs(way.shift_ns - shift) < _SAME_S * NS]
        if near:
            best = min(near, key=lambda way: (way.by_zone, abs(way.shift_ns - shift)))
            return Tie(source, best.shift_ns, f"{best.how}, as the motion confirms")
        return Tie(source, shift, f"found by the motion of both, +- {lag.sigma_s:.2f} s")
    fitting = [way for way in ways if _common(base, other, way.shift_ns) >= _COMMON]
    plain = [way for way in fitting if not way.by_zone] or (fitting if len(fitting) == 1 else [])
    if not plain:
        raise _not_tied(base, other, source, fitting)
    return Tie(source, plain[0].shift_ns, plain[0].how, confirmed=False)


def _ways(base: Session, other: Session) -> Iterator[_Way]:
    """Shifts that the clocks themselves explain, the plainest first."""
    begin, first = time_span(base)[0], time_span(other)[0]
    if base.clock_epoch in _DATED and other.clock_epoch in _DATED:
        dated = _between_epochs(base.clock_epoch, other.clock_epoch, first)
        how = "both have one clock" if not dated else f"{other.clock_epoch} time against {base.clock_epoch} time"
        yield _Way(dated, how)
        yield from _zones(dated, "local time")
        return
    yield _Way(0, "the same stamps")
    if base.clock_epoch in _DATED:
        day = begin // _DAY_NS * _DAY_NS
        if first > 10**17:  # a date without time zone
            yield from _zones(_between_epochs(base.clock_epoch, "unix", first), "local time")
        elif 0 <= first < _DAY_NS:
            yield _Way(day, "time of day, UTC")
            yield from _zones(day, "local time of day")
        yield from _weeks(begin, first, base.clock_epoch, 1)
    elif other.clock_epoch in _DATED:
        yield from _weeks(first, begin, other.clock_epoch, -1)
    yield _Way(begin, "seconds since the first inertial sample")


def _between_epochs(base: str, other: str, at_ns: int) -> int:
    """Shift of stamps of one epoch to the other, at a stamp of `other`."""
    if base == other:
        return 0
    t = np.array([at_ns], dtype=np.int64)
    return int((utc_from_gps(t) if other == "gps" else gps_from_utc(t))[0]) - at_ns


def _zones(shift: int, what: str) -> Iterator[_Way]:
    for quarters in _ZONES:
        if quarters:
            yield _Way(shift - quarters * _QUARTER_NS, f"{what}, UTC{quarters / 4:+g} h", by_zone=True)


def _weeks(dated_ns: int, week_ns: int, epoch: str, sign: int) -> Iterator[_Way]:
    """GPS time of week against a clock with dates."""
    if not 0 <= week_ns < _WEEK_NS + _DAY_NS:
        return
    gps_ns = dated_ns if epoch == "gps" else int(gps_from_utc(np.array([dated_ns], dtype=np.int64))[0])
    week = (gps_ns - week_ns + _WEEK_NS // 2) // _WEEK_NS * _WEEK_NS
    yield _Way(sign * (week + dated_ns - gps_ns), f"GPS time of week {week // _WEEK_NS}")


def _common(base: Session, other: Session, shift: int) -> float:
    """Share of the shorter recording that both cover; 1 for a single epoch inside."""
    (a, b), (c, d) = time_span(base), time_span(other)
    overlap = min(b, d + shift) - max(a, c + shift)
    shorter = min(b - a, d - c)
    return float(overlap >= 0) if shorter == 0 else max(0.0, overlap / shorter)


def _by_motion(base: Session, other: Session) -> ClockOffset | None:
    """The offset of positions of `other` to the inertial data of `base`, where both show it."""
    positions = [stream for name, stream in other.positions().items() if name != "control"]
    motion = levelled_motion(base.imu) if base.imu is not None and len(base.imu) > 1 and positions else None
    if motion is None:
        return None
    track = FixTrack.of(positions[0].t_ns, other.nav_position(positions[0]), motion.start_ns)
    found = find_clock_offset(positions[0].NAME, motion, track)
    return found if found is not None and found.known else None


def _not_tied(base: Session, other: Session, source: str, fitting: list[_Way]) -> SessionError:
    (a, b), (c, d) = time_span(base), time_span(other)
    found = f"runs from {_moment(c, other)} to {_moment(d, other)}, the inertial log from {_moment(a, base)} to "
    found += f"{_moment(b, base)}, and the motion does not tie the clocks"
    if fitting:
        found += f"; possible are {', '.join(way.how for way in fitting[:4])}"
    remedy = f"give the seconds to add to its stamps: --shift {source}=S"
    return SessionError(source, found, "clocks with a known offset", remedy)


def _moment(t_ns: int, session: Session) -> str:
    """A stamp as a date where the clock has dates, else in seconds."""
    if session.clock_epoch not in _DATED and t_ns < 10**17:
        return f"{t_ns / NS:.3f} s"
    unix = int(utc_from_gps(np.array([t_ns]))[0]) if session.clock_epoch == "gps" else t_ns
    return f"{np.datetime64(unix, 'ns').astype('datetime64[s]')}" + (" UTC" if session.clock_epoch in _DATED else "")
