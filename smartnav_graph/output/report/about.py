"""What somebody who signs the report must know: when, where, datum and heights, device, software, settings."""

from __future__ import annotations

import base64
import dataclasses
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple
from zoneinfo import ZoneInfo

import numpy as np

from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.frames import ELLIPSOIDAL, LOCAL_HEIGHTS, LocalFrame
from smartnav_graph.core.timebase import NS, utc_from_gps
from smartnav_graph.estimate.config import LOGOS, Config, ReportConfig
from smartnav_graph.factors import title_of
from smartnav_graph.graph.solution import Solution
from smartnav_graph.output.report.statistics import place_of
from smartnav_graph.output.summary_json import Summary, numbers_of, table_of, text_of
from smartnav_graph.output.text import count, fixed
from smartnav_graph.session.session import Session
from smartnav_graph.session.stream import Positioned

Facts = list[tuple[str, list[str]]]
LARGEST_LOGO = 1_000_000  # bytes
FEW = 8  # changed settings listed on the first page


class Option(NamedTuple):
    """One option of the configuration, its value and default as text."""

    name: str
    value: str
    default: str


def options_of(config: Config) -> list[Option]:
    """Every option, ``section.field``."""
    mine, defaults = dataclasses.asdict(config), dataclasses.asdict(Config())
    return [
        Option(f"{section}.{name}", _shown(value), _shown(defaults[section][name]))
        for section, fields in mine.items()
        for name, value in fields.items()
    ]


def changed_options(config: Config) -> list[Option]:
    """The options whose value is not the default."""
    return [one for one in options_of(config) if one.value != one.default]


def _shown(value: object) -> str:
    if isinstance(value, bool) or value is None:
        return {True: "true", False: "false", None: "not set"}[value]
    if isinstance(value, float):
        return f"{value:.8g}"
    return ", ".join(map(_shown, value)) or "none" if isinstance(value, tuple | list) else str(value) or "none"


def utc_of(session: Session, t_ns: int) -> datetime | None:
    """A stamp as a date in UTC; None where the clock has none."""
    if session.clock_epoch not in ("unix", "gps"):
        return None
    unix = int(utc_from_gps(np.array([t_ns]))[0]) if session.clock_epoch == "gps" else t_ns
    return datetime.fromtimestamp(unix // NS, UTC).replace(microsecond=unix % NS // 1000)


def facts_of(session: Session, solution: Solution, summary: Summary, config: Config | None) -> Facts:
    """Titles, each with its lines."""
    zone = "" if config is None else config.report.time_zone
    facts = [
        *_dates(session, solution, zone),
        ("Coordinates", _coordinates(solution, "" if config is None else config.report.crs)),
        ("Heights", _heights(session, solution)),
        ("Device", _device(session, "" if config is None else config.run.vehicle)),
        ("Measurements used", _used(summary)),
        ("Session", [str(session.path)] if session.path else []),
        ("Processing", [text_of(summary, "mode")] if text_of(summary, "mode") else []),
        ("Software", _software(summary)),
    ]
    if config is not None:
        facts.append(("Settings", _settings(config)))
    return [(title, lines) for title, lines in facts if lines]


def _dates(session: Session, solution: Solution, zone: str) -> Facts:
    ends = [utc_of(session, int(t)) for t in solution.t_ns[[0, -1]]] if len(solution) else []
    known = [end for end in ends if end is not None]
    if not known:
        return [("Date", [f"not known: the clock of the recording has no date (epoch {session.clock_epoch})"])]
    utc = [f"{end:%Y-%m-%d %H:%M:%S} UTC" for end in known]
    if not zone:
        return [("Date and time", utc), ("Local time", ["no time zone given (report.time_zone)"])]
    local = [f"{end.astimezone(ZoneInfo(zone)):%Y-%m-%d %H:%M:%S %Z (UTC%z)}" for end in known]
    return [("Date and time", utc), (f"Local time, {zone}", local)]


def _coordinates(solution: Solution, crs: str) -> list[str]:
    if solution.origin is None:
        return ["Local metres east, north, up of the recording; no geodetic datum is known"]
    lines = ["Geodetic datum of the inputs, taken as WGS 84"]
    lines.append(f"East, north, up: tangent plane at {place_of(solution.origin)}")
    return [*lines, f"Control points also in {crs}, {_name_of(crs)}"] if crs else lines


def _name_of(crs: str) -> str:
    import pyproj

    try:
        return str(pyproj.CRS.from_user_input(crs).name)
    except pyproj.exceptions.CRSError as error:
        raise SessionError(f"report.crs {crs}", "is not known", "a system such as EPSG:25832") from error


def _heights(session: Session, solution: Solution) -> list[str]:
    above = LOCAL_HEIGHTS if solution.origin is None else solution.heights
    lines = [f"Results: {'above the ellipsoid WGS 84' if above == ELLIPSOIDAL else above}"]
    for name, stream in session.positions().items():
        mount = session.mount(name)
        if isinstance(stream, Positioned) and mount.above_sea:
            geoid = f"geoid at {fixed(mount.geoid_m, 2)} m" if np.isfinite(mount.geoid_m) else "geoid not known"
            lines.append(f"{title_of(name)}: recorded above the sea, {geoid}")
    return lines


def _device(session: Session, vehicle: str) -> list[str]:
    device, vehicle = session.device, vehicle or session.device.vehicle
    carried = "" if vehicle == "none" else f"; carried by: {vehicle}"
    lines = [device.name, f"forward {device.forward}, up {device.up}{carried}"]
    if session.calibration is not None and session.calibration.device not in ("", "unknown", device.name):
        lines.append(f"calibration: {session.calibration.device}")
    return lines


def _used(summary: Summary) -> list[str]:
    used = [f"{title_of(name)} {count(n)}" for name, n in numbers_of(summary, "used").items() if n]
    return [", ".join(used)] if used else []


def _software(summary: Summary) -> list[str]:
    versions = table_of(summary, "versions")
    first = [f"{name} {versions[name]}" for name in ("smartnav-graph", "gtsam", "python") if name in versions]
    return [", ".join(first)] if first else []


def _settings(config: Config) -> list[str]:
    changed = [one for one in changed_options(config) if not one.name.startswith("report.")]
    if not changed:
        return ["all options at their defaults"]
    more = [f"and {len(changed) - FEW} more, see Settings"] if len(changed) > FEW else []
    return [*(f"{one.name} = {one.value}" for one in changed[:FEW]), *more]


def check_shown(report: ReportConfig, session: Session | None = None) -> None:
    """Check logo and coordinate system before a run is computed for a report that cannot be written.

    Raises
    ------
    SessionError
        The logo cannot be read, the system is not known, or does not hold at the control points of `session`.
    """
    logo_uri(report.logo)
    if not report.crs:
        return
    _name_of(report.crs)
    if session is not None and session.origin is not None and session.control is not None:
        from smartnav_graph.output.export.coordinates import transformed

        nav = session.nav_position(session.control)
        transformed(LocalFrame(session.origin).lla_from_nav(nav), report.crs)


def logo_uri(path: str) -> str:
    """The picture as an address that holds it; empty without one.

    Raises
    ------
    SessionError
        It cannot be read, or is larger than 1 MB.
    """
    if not path:
        return ""
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        found = f"cannot be read ({error.strerror})"
        raise SessionError(path, found, "a picture", "correct report.logo, or leave it out") from error
    if len(data) > LARGEST_LOGO:
        raise SessionError(path, f"has {len(data)} bytes", f"a logo of at most {LARGEST_LOGO}", "make it smaller")
    return f"data:{LOGOS[Path(path).suffix.lower()]};base64,{base64.b64encode(data).decode()}"
