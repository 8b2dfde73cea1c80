"""GnssLogger (Google; Android): text, one record a line, its columns named in the comments at the begin.

Stamps are elapsedRealtimeNanos, the phone's clock since boot, tied to Unix time by the fixes of the receiver, else by
utcTimeMillis. Fixes of one provider are used, since those of the others are made of the same observations: the
receiver's own (GPS), unless there are few, then the fused ones (FLP). Uncalibrated readings are less their first bias.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from smartnav_graph.core.arrays import Mask, Times
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.timebase import NS
from smartnav_graph.readers.apps.channels import read_vector
from smartnav_graph.readers.fixes import LoggedFixes
from smartnav_graph.readers.log_session import LogParts, log_session
from smartnav_graph.readers.samples import Samples, clock_offset
from smartnav_graph.readers.source import Reader
from smartnav_graph.readers.text import TextTable, read_bytes
from smartnav_graph.readers.text_lines import head_of, in_utf8
from smartnav_graph.session.session import Session

_MS = NS // 1000
# Columns where the file does not name them (versions before 2).
_DEFAULT = {
    "Fix": "Provider,LatitudeDegrees,LongitudeDegrees,AltitudeMeters,SpeedMps,AccuracyMeters,UnixTimeMillis",
    **{kind: f"utcTimeMillis,elapsedRealtimeNanos,{kind}X,{kind}Y,{kind}Z" for kind in ("Accel", "Gyro", "Mag")},
}
_SAME = {"latitude": "latitudedegrees", "longitude": "longitudedegrees", "altitude": "altitudemeters"}
_SAME |= {"speed": "speedmps", "accuracy": "accuracymeters", "(utc)timeinms": "unixtimemillis"}
_SENSORS = {"accel": ("Accel", "UncalAccel"), "gyro": ("Gyro", "UncalGyro"), "field": ("Mag", "UncalMag")}
_READ = ("Fix", *(kind for kinds in _SENSORS.values() for kind in kinds))
_LEAST_SHARE = 0.5  # of fused fixes: with fewer of its own the receiver was lost for most of the time


@dataclass
class _Log:
    """Records by type, and what the comments say."""

    path: Path
    device: str = "Android phone"
    names: dict[str, list[str]] = field(default_factory=dict)
    rows: dict[str, list[list[str]]] = field(default_factory=dict)
    others: dict[str, int] = field(default_factory=dict)
    torn: int = 0

    def table(self, kind: str) -> TextTable:
        """Records of one type; cells that a line lacks are empty."""
        names = self.names.get(kind) or [name.lower() for name in _DEFAULT.get(kind, "").split(",")]
        rows = self.rows[kind]
        long = next((i for i, row in enumerate(rows) if len(row) > len(names)), None)
        if long is not None:
            found = f"record {long} of {kind} has {len(rows[long])} cells"
            raise SessionError(self.path, found, f"{len(names)}: {', '.join(names)}", "export it again", row=long)
        cells = {name: [row[i].strip() if i < len(row) else "" for row in rows] for i, name in enumerate(names)}
        return TextTable.of(self.path, cells)


def _matches(source: str) -> bool:
    try:
        path = Path(source)
        if not path.is_file() or path.suffix.lower() not in (".txt", ".csv", ".log"):
            return False
        head = head_of(path)
    except (OSError, ValueError):  # ValueError: a zero byte in the name
        return False
    heading = re.search(r"^#\s*(Raw|Fix|UncalAccel),\w+", head, re.MULTILINE)
    return heading is not None


def _parse(path: Path) -> _Log:
    log = _Log(path)
    data = in_utf8(read_bytes(path))
    lines = data.decode("utf-8", errors="replace").split("\n")
    if lines and lines[-1].strip():  # without line end: the last number may be cut
        log.torn, lines = 1, lines[:-1]
    for line in lines:
        text = line.strip()
        if text.startswith("#"):
            _remark(log, text.lstrip("# "))
            continue
        kind, _, cells = text.partition(",")
        if kind in _READ:
            log.rows.setdefault(kind, []).append(cells.split(","))
        elif kind:
            log.others[kind] = log.others.get(kind, 0) + 1
    return log


def _remark(log: _Log, text: str) -> None:
    kind, _, names = text.partition(",")
    if names and re.fullmatch(r"\w+", kind):
        plain = [name.strip().lower() for name in names.split(",")]
        log.names[kind] = [_SAME.get(name, name) for name in plain]
    model = re.search(r"Manufacturer:\s*(.*?)\s+Model:\s*(.*?)\s*$", text)
    if model and model[2] not in ("", "null"):
        log.device = f"{model[1]} {model[2]}".strip()


def _read(source: str, repairs: tuple[str, ...]) -> Session:
    path = Path(source)
    log = _parse(path)
    parts = LogParts()
    fixes = log.table("Fix") if "Fix" in log.rows else None
    offset = _boot_to_unix(log, fixes)
    for kind, count in log.others.items():
        if re.fullmatch(r"[A-Za-z]+", kind):
            parts.count(kind.lower(), {"left out": count})
    every = {role: _vector(log, kinds, offset, repairs) for role, kinds in _SENSORS.items()}
    vectors = {role: samples for role, samples in every.items() if samples is not None}
    accel, gyro = vectors.get("accel"), vectors.get("gyro")
    parts.add_inertial(path, gyro, accel, log.rows)
    if "field" in vectors:
        parts.add_magnetometer(vectors["field"])
    if fixes is not None:
        _add_fixes(parts, fixes, offset)
    if not parts.tables and parts.refused is None:
        seen = f"holds no fixes and no inertial data (it has {', '.join(log.others) or 'no records'})"
        raise SessionError(path, seen, "records of Fix, Accel and Gyro", "switch them on in the app")
    parts.count("gnss" if "gnss" in parts.tables else "imu", {"cut at the end of the file left out": log.torn})
    return log_session(parts, repairs, name=log.device, epoch="unix")


def _boot_to_unix(log: _Log, fixes: TextTable | None) -> int:
    """Nanoseconds from the clock since boot to Unix time: by fixes of the receiver, else by the records of sensors."""
    if fixes is not None and {"elapsedrealtimenanos", "unixtimemillis", "provider"} <= set(fixes.cells):
        known = fixes.known("elapsedrealtimenanos") & fixes.known("unixtimemillis")
        own = fixes.rows(_of_provider(fixes, "gps") & known)
        if len(own):
            return clock_offset(own.times("elapsedrealtimenanos", 1), own.times("unixtimemillis", _MS))
    for kinds in _SENSORS.values():
        for kind in kinds:
            if kind in log.rows:
                table = log.table(kind)
                if not {"elapsedrealtimenanos", "utctimemillis"} <= set(table.cells):
                    continue
                table = table.rows(table.known("elapsedrealtimenanos") & table.known("utctimemillis"))
                if len(table):
                    return clock_offset(table.times("elapsedrealtimenanos", 1), table.times("utctimemillis", _MS))
    return 0


def _of_provider(fixes: TextTable, *names: str) -> Mask:
    return np.isin([str(text).lower() for text in fixes.texts("provider")], names)


def _vector(log: _Log, kinds: tuple[str, str], offset: int, repairs: tuple[str, ...]) -> Samples | None:
    """Readings of a sensor: calibrated, else uncalibrated less their first bias; the more frequent of the two."""
    found = sorted((kind for kind in kinds if len(log.rows.get(kind, ())) > 1), key=lambda k: -len(log.rows[k]))
    if not found:
        return None
    table = log.table(found[0])
    stamp = "elapsedrealtimenanos" if "elapsedrealtimenanos" in table.cells else "utctimemillis"
    table.require([stamp])
    table = table.rows(table.known(stamp))
    axes = {re.sub(r"(mps2|radpersec|microt)$", "", name): name for name in table.cells}
    readings = [axes.get(f"{found[0].lower()}{axis}") for axis in "xyz"]
    biases = [axes.get(f"bias{axis}", axes.get(f"drift{axis}")) for axis in "xyz"]
    columns = [name for name in readings if name is not None]
    if len(columns) < 3:
        raise SessionError(
            log.path, f"{found[0]} has columns {', '.join(table.cells)}", "X, Y and Z", "export it again"
        )
    if len(table) < 2:
        return None
    values = table.floats(*columns)
    if None not in biases:
        bias = table.floats(*(name for name in biases if name is not None))
        known = np.isfinite(bias).all(axis=1)
        values = values - (bias[known][0] if known.any() else 0.0)
    t_ns = table.times(stamp, 1) + offset if stamp.startswith("elapsed") else table.times(stamp, _MS)
    return read_vector(table, t_ns, np.where(np.any(values != 0.0, axis=1)[:, None], values, np.nan), repairs)


def _add_fixes(parts: LogParts, fixes: TextTable, offset: int) -> None:
    fixes.require(["provider", "latitudedegrees", "longitudedegrees"])
    own, fused = _of_provider(fixes, "gps"), _of_provider(fixes, "flp", "fused")
    used = own if own.sum() >= max(_LEAST_SHARE * fused.sum(), 1) else fused if fused.any() else np.ones_like(own)
    stamp = "elapsedrealtimenanos"
    boot = stamp in fixes.cells and fixes.known(stamp)[used].all()
    if not boot:
        stamp = "unixtimemillis"
        fixes.require([stamp])
    rows = fixes.rows(used & fixes.known(stamp))
    if len(rows):
        t_ns = rows.times(stamp, 1) + offset if boot else rows.times(stamp, _MS)
        parts.add_fixes(fixes.path, _fixes(rows, t_ns))
    parts.count("gnss", {"of other providers left out": int((~used).sum())})


def _fixes(table: TextTable, t_ns: Times) -> LoggedFixes:
    return LoggedFixes(
        t_ns,
        table.floats("latitudedegrees"),
        table.floats("longitudedegrees"),
        height=table.optional("altitudemeters"),
        horizontal=table.optional("accuracymeters"),
        vertical=table.optional("verticalaccuracymeters"),
        speed=table.optional("speedmps"),
        course=table.optional("bearingdegrees"),
        speed_sigma=table.optional("speedaccuracymps"),
        course_sigma=table.optional("bearingaccuracydegrees"),
    )


READER = Reader(
    name="gnss-logger",
    summary="GnssLogger app (Android): fixes and inertial records",
    recognised_by="text with a comment such as # Fix,Provider,... or # Raw,utcTimeMillis,...",
    matches=_matches,
    read_source=_read,
)
