"""Several files -> one session: the inertial log and what belongs to it, on one clock, at one place."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from smartnav_graph.core.arrays import Times
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.timebase import NS, find_gaps
from smartnav_graph.readers import load, read
from smartnav_graph.readers.clock_tie import Tie, tie
from smartnav_graph.readers.columns import ColumnMap, read_columns
from smartnav_graph.readers.positions.listed import SurveyedPoints, is_control, read_points
from smartnav_graph.readers.positions.places import fitting_systems
from smartnav_graph.session.calibration.model import Calibration
from smartnav_graph.session.detect.standstills import StandstillConfig, find_standstills
from smartnav_graph.session.session import Session
from smartnav_graph.session.stream import Located, Stream
from smartnav_graph.session.streams import GnssFix, PoseFix

FAR_M = 50_000.0  # between the places of one recording
_LEAST_STOP_S, _MOST_STOP_S = 5.0, 30.0  # of a device that is put on a surveyed point
_LEAST_WITH_FIXES_S = 2.0  # where the fixes choose among the stops
_AWAY_M, _AWAY_SIGMAS = 10.0, 4.0  # of a fix from the point at which it was taken
_STAMPS = ("t_ns", "arrival_ns", "t_end_ns", "t_1_ns")
_SAME_ROWS = 0.5  # share of positions that two files have in common when they are of one receiver


@dataclass(frozen=True)
class Joined:
    """A session and how the clock of each further source was tied to it."""

    session: Session
    ties: tuple[Tie, ...]


def join(
    sources: Iterable[str],
    name: str | None = None,
    repairs: Iterable[str] = (),
    shifts: Mapping[str, float] | None = None,
    columns: ColumnMap | None = None,
) -> Joined:
    """One session of one or several sources, one of which has the inertial data.

    Parameters
    ----------
    sources : of `readers.read`; lists of control points may lack times, if the device rested on each, in their order
    name : format of all sources; by default each is recognised
    repairs : as in `readers.read`
    shifts : seconds to add to the stamps of a source, instead of tying its clock
    columns : description of the columns of those sources that no reader knows; see `columns`

    Raises
    ------
    SessionError
        A source cannot be read, its clock not be tied, two hold the same stream, or their places do not fit.
    """
    sources, repairs = list(sources), tuple(repairs)
    files = [source for source in sources if columns is not None and columns.describes(source)]
    described = {", ".join(files): read_columns(files, columns, repairs)} if columns is not None and files else {}
    unknown = sorted(set(shifts or {}) - {*sources, *(Path(source).name for source in sources)})
    if unknown:
        raise SessionError("--shift", f"names {unknown[0]!r}", f"one of {', '.join(sources)}", "name the file")
    others = [source for source in sources if source not in files]
    of_points = [source for source in others if name in (None, "control") and is_control(source)]
    lists = {source: read_points(Path(source)) for source in of_points}
    untimed = {source: points for source, points in lists.items() if points.t_ns is None}
    parts = {
        source: load(source, repairs=repairs) if name is None else read(source, name, repairs)
        for source in sources
        if source in others and source not in untimed
    }
    parts |= described
    if len(parts) == 1 and not untimed:
        return Joined(next(iter(parts.values())), ())
    inertial = [source for source, part in parts.items() if part.imu is not None]
    if len(inertial) != 1:
        found = "no inertial data" if not inertial else f"inertial data in {', '.join(inertial)}"
        raise SessionError(", ".join(sources), found, "one inertial log", "give one, and what belongs to it")
    session, ties = parts.pop(inertial[0]), []
    for source, part in parts.items():
        seconds = (shifts or {}).get(source, (shifts or {}).get(Path(source).name))
        found_tie = tie(session, part, source) if seconds is None else Tie(source, round(seconds * NS), "as asked for")
        ties.append(found_tie)
        session = _merged(session, shifted(part, found_tie.shift_ns), source)
    for source, points in untimed.items():
        timed = _at_stops(session, points)
        ties.append(Tie(source, 0, f"{len(points.ids)} points at the stops found in the inertial data"))
        session = _merged(session, timed.session(repairs), source)
    for points in lists.values():
        _check_places(session, points)
    return Joined(session, tuple(ties))


def shifted(session: Session, shift_ns: int) -> Session:
    """The session with `shift_ns` added to every stamp."""
    if not shift_ns:
        return session
    changes = {}
    for name, stream in session.streams().items():
        values = {f: getattr(stream, f, None) for f in _STAMPS}
        changes[name] = dataclasses.replace(stream, **{f: v + shift_ns for f, v in values.items() if v is not None})
    return session.replace(**changes)


def _merged(base: Session, other: Session, source: str) -> Session:
    """The streams of both; those of a second receiver become pose fixes."""
    other = _on_one_frame(base, other, source)
    streams: dict[str, Stream] = {}
    mounts = {**other.sensors, **base.sensors}
    dropped = {**base.dropped, **other.dropped}
    for name, stream in other.streams().items():
        ours = getattr(base, name)
        if ours is None:
            streams[name] = stream
        elif name in ("control", "static"):
            streams[name] = _in_order(ours, stream)
        elif isinstance(stream, GnssFix) and base.pose_fixes is None and not _same_fixes(ours, stream):
            streams["pose_fixes"] = _as_pose_fixes(stream, Path(source).name)
            if "gnss" not in base.sensors:
                mounts.pop("gnss", None)
            reasons = {"velocities of a second receiver left out": len(stream)} if stream.velocity is not None else {}
            dropped |= {"pose_fixes": {**reasons, **other.dropped.get("gnss", {})}} if reasons else {}
            dropped["gnss"] = base.dropped.get("gnss", {})
        else:
            what = "the same fixes" if isinstance(stream, GnssFix) and _same_fixes(ours, stream) else f"{name} rows"
            raise SessionError(source, f"holds {what} that another file holds too", "one of them", "leave one out")
    return base.replace(
        **streams,
        origin=base.origin or other.origin,
        calibration=base.calibration or other.calibration,
        sensors=mounts,
        pictures=other.pictures if "images" in streams else base.pictures,
        dropped={name: counts for name, counts in dropped.items() if counts},
    )


def _in_order(one: Stream, other: Stream) -> Stream:
    """Rows of both, by time; columns that one lacks are left out of neither: text is empty, numbers unknown."""
    tables = [one.columns(), other.columns()]
    counts = [len(one), len(other)]
    rows = {}
    for name in dict.fromkeys([*tables[0], *tables[1]]):
        text = next(table[name] for table in tables if name in table).dtype == object
        missing = [np.full(n, "", dtype=object) if text else np.full(n, np.nan) for n in counts]
        rows[name] = np.concatenate([table.get(name, gap) for table, gap in zip(tables, missing, strict=True)])
    order = np.argsort(rows["t_ns"], kind="stable")
    return type(one).from_columns({name: column[order] for name, column in rows.items()})


def _as_pose_fixes(stream: GnssFix, source: str) -> PoseFix:
    names = np.full(len(stream), source, dtype=object)
    at, known = stream.t_ns, stream.arrival_ns
    return PoseFix(
        t_ns=at, arrival_ns=known, lla=stream.lla, enu=stream.enu, sigma=stream.sigma, source=names, extra=stream.extra
    )


def _same_fixes(one: GnssFix, other: GnssFix) -> bool:
    """Whether most positions of the shorter one are in the other, to every digit."""
    if one.lla is None or other.lla is None:
        return False
    rows, theirs = ({tuple(row) for row in s.lla[:, :2].tolist()} for s in (one, other) if s.lla is not None)
    return len(rows & theirs) > _SAME_ROWS * min(len(rows), len(theirs))


def _on_one_frame(base: Session, other: Session, source: str) -> Session:
    """`other` with geodetic positions where `base` has an origin and they are local to another one."""
    local = {n: s for n, s in other.streams().items() if isinstance(s, Located) and s.enu is not None}
    geodetic = any(isinstance(s, Located) and s.lla is not None for s in base.streams().values())
    if local and other.origin is not None and base.origin not in (None, other.origin):
        frame = other.frame
        assert frame is not None
        places = {n: frame.lla_from_nav(other.nav_position(s)) for n, s in local.items()}
        return other.replace(**{n: dataclasses.replace(s, lla=places[n], enu=None) for n, s in local.items()})
    if local and geodetic and other.origin is None:
        remedy = "give EPSG codes, lat and lon, or [origin]"
        raise SessionError(source, "has local metres beside latitude and longitude", "one frame", remedy)
    return other


def _at_stops(session: Session, points: SurveyedPoints) -> SurveyedPoints:
    """Points in the order of a list at the stops of the device: those near the fixes, else as many as there are."""
    n, with_fixes = len(points.ids), session.gnss is not None and not points.is_local
    least_s = _LEAST_WITH_FIXES_S if with_fixes else _LEAST_STOP_S
    stops = _stops(session, session.device.vehicle, least_s)
    if len(stops) < n and session.device.vehicle == "none":
        stops = _stops(session, "foot", least_s)  # a device in a hand is never quite at rest
    if len(stops) >= n and with_fixes:
        stops = stops[_nearest_in_order(session, points, stops)]
    elif len(stops) > n:
        stops = stops[(stops[:, 1] - stops[:, 0]) <= _MOST_STOP_S * NS]
    if len(stops) != n:
        listed = ", ".join(f"{a:.0f}-{b:.0f} s" for a, b in session.seconds(stops).reshape(-1, 2)[:20])
        text = f"{n} points in order, but {len(stops)} stops of {least_s:g} s or more ({listed or 'none'})"
        raise SessionError(points.path, text, "one stop a point", "add columns start and end, or leave points out")
    return dataclasses.replace(points, t_ns=stops[:, 0], t_end_ns=stops[:, 1], clock_epoch=session.clock_epoch)


def _stops(session: Session, vehicle: str, least_s: float) -> Times:
    """First and last stamp (k, 2) of the stops of a device that is carried so, of `least_s` and more."""
    imu, calibration = session.require_imu(), session.calibration or Calibration()
    gaps = find_gaps(imu.t_ns, np.hstack([imu.gyro, imu.accel]))
    config = StandstillConfig(mounting=session.device.mounting)
    found = find_standstills(imu, session.static, gaps, vehicle, calibration.imu_noise, session.gravity, config)
    long = [stop for stop in found.spans() if stop[1] - stop[0] >= least_s * NS]
    return np.array(long, dtype=np.int64).reshape(-1, 2)


def _nearest_in_order(session: Session, points: SurveyedPoints, stops: Times) -> list[int]:
    """Indices of the stops, increasing, at which the fixes are nearest to the points: dynamic programming."""
    from smartnav_graph.session.health.facts import fix_sigma

    fixes = session.gnss
    assert fixes is not None and session.frame is not None
    where, at = session.nav_position(fixes)[:, :2], session.frame.nav_from_lla(np.nan_to_num(points.rows))[:, :2]
    middle = stops[:, 0] + (stops[:, 1] - stops[:, 0]) // 2
    since = fixes.t_ns - fixes.t_ns[0]
    near = np.stack([np.interp(middle - fixes.t_ns[0], since, axis) for axis in where.T], axis=1)
    sigma = np.interp(middle - fixes.t_ns[0], since, fix_sigma(fixes))
    apart = np.linalg.norm(at[:, None] - near[None], axis=2)
    cost = (apart / sigma) ** 2
    n, m = cost.shape
    best = np.full((n + 1, m + 1), np.inf)
    best[0] = 0.0
    for i in range(1, n + 1):
        for j in range(i, m + 1):
            best[i, j] = min(best[i, j - 1], best[i - 1, j - 1] + cost[i - 1, j - 1])
    found, j = [], m
    for i in range(n, 0, -1):
        while best[i, j] == best[i, j - 1]:
            j -= 1
        j -= 1
        found.append(j)
    found = found[::-1]
    for i, j in enumerate(found):
        if apart[i, j] > _AWAY_M + _AWAY_SIGMAS * sigma[j]:
            text = f"point {points.ids[i]} lies {apart[i, j]:.0f} m from the fixes at the stop at "
            text += f"{float(session.seconds(middle[j])):.0f} s, the best in this order"
            raise SessionError(points.path, text, "a stop at every point", "add columns start and end", row=i)
    return found


def _check_places(session: Session, points: SurveyedPoints) -> None:
    """Control points of the wrong zone lie far from everything else."""
    import pyproj

    others = [s.lla for n, s in session.positions().items() if n != "control" and s.lla is not None and len(s)]
    if points.is_local or not others:
        return
    lat, lon, _ = np.median(others[0], axis=0)
    apart = pyproj.Geod(ellps="WGS84").inv(points.rows[0, 1], points.rows[0, 0], lon, lat)[2]
    if apart < FAR_M:
        return
    found = f"point {points.ids[0]} lies {apart / 1000.0:.0f} km from the fixes"
    remedy = "check the coordinates and their reference system"
    if points.given is not None and points.epsg is not None:
        east, north = map(float, points.given[0, :2])
        codes = fitting_systems(points.epsg, east, north, lat, lon, FAR_M)
        found += f" by EPSG {points.epsg}"
        remedy = f"EPSG {' or '.join(map(str, codes))} puts it near them" if codes else remedy
    elif pyproj.Geod(ellps="WGS84").inv(points.rows[0, 0], points.rows[0, 1], lon, lat)[2] < FAR_M:
        remedy = "exchange latitude and longitude"
    raise SessionError(points.path, found, "the place of the recording", remedy, row=0)


__all__ = ["Joined", "Tie", "join", "shifted"]
