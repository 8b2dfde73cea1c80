"""GoPro cameras: inertial data and fixes of a film (.mp4) or of its telemetry alone (.raw).

Samples have no stamps: those of a payload begin at STMP (us), TICK (ms), the time of the payload in the film, or the
UTC of its fixes, whichever there is, and come at a steady rate. ORIN names the axis of each channel, small letters
reversed; without it the order is z, x, y. GPS5 has latitude, longitude, height, 2-D and 3-D speed, GPS9 also date and
dilution of precision of every fix. Of the accuracy only that dilution (GPSP) is known: sigma is `USER_RANGE_ERROR`
times it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from smartnav_graph.core.arrays import Floats, Times
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.timebase import NS, ns_from_seconds
from smartnav_graph.readers.apps.gpmf import Item, is_gpmf, items_in, payloads
from smartnav_graph.readers.fixes import LoggedFixes
from smartnav_graph.readers.log_session import LogParts, log_session
from smartnav_graph.readers.samples import Samples, in_time_order
from smartnav_graph.readers.source import Reader
from smartnav_graph.readers.stamps import ns_from_date
from smartnav_graph.session.session import Session

PAYLOAD_S = 1.001  # of film at 29.97 pictures a second
USER_RANGE_ERROR = 3.0  # m, 1 sigma of a code receiver of this class
_LEAST_FIX = 2  # GPSF: 0 no lock, 2 and 3 a fix in two and three dimensions
_NO_DILUTION = 99.0
_Y2000_NS = 946_684_800 * NS


@dataclass
class _Stream:
    """Values of one sensor by payload, with what is said beside them."""

    values: list[Floats] = field(default_factory=list)
    payload: list[int] = field(default_factory=list)
    start_s: list[float] = field(default_factory=list)  # on the camera's clock; NaN where it is not said
    utc_ns: list[int] = field(default_factory=list)  # of GPSU; zero where there is none
    fix: list[float] = field(default_factory=list)
    dilution: list[float] = field(default_factory=list)

    def rows(self) -> Floats:
        return np.concatenate(self.values)

    def spread(self, of_payload: list[float]) -> Floats:
        """A value of each payload at its samples."""
        return np.repeat(of_payload, [len(rows) for rows in self.values])


_COLUMNS = {"ACCL": 3, "GYRO": 3, "MAGN": 3, "GPS5": 5, "GPS9": 9}


def _parse(path: Path, found: list[bytes]) -> tuple[dict[str, _Stream], str]:
    streams: dict[str, _Stream] = {}
    device = ""
    for index, payload in enumerate(found):
        for item in items_in(payload):
            for inner in items_in(item.data) if item.key == "DEVC" else ():
                if inner.key == "DVNM" and not device:
                    device = inner.text()
                elif inner.key == "STRM":
                    try:
                        _add(streams, index, list(items_in(inner.data)))
                    except ValueError as error:
                        raise SessionError(path, f"payload {index}: {error}", "GPMF", "copy the file again") from error
    return streams, device


def _add(streams: dict[str, _Stream], index: int, items: list[Item]) -> None:
    """The values of one stream of a payload, if it is known."""
    known = {item.key: item for item in items}
    data = next((item for item in items if item.key in _COLUMNS), None)
    if data is None or not data.data:
        return
    values = data.numbers(known["TYPE"].text() if "TYPE" in known else "")
    if values.shape[1] < _COLUMNS[data.key]:
        raise ValueError(f"{data.key} has {values.shape[1]} columns, not {_COLUMNS[data.key]}")
    scale = known["SCAL"].numbers().ravel() if "SCAL" in known else np.ones(1)
    if len(scale) not in (1, values.shape[1]) or not scale.all():
        raise ValueError(f"SCAL has {len(scale)} values for {values.shape[1]} columns of {data.key}")
    stream = streams.setdefault(data.key, _Stream())
    values = values / scale
    if data.key in ("ACCL", "GYRO", "MAGN"):
        values = _to_axes(values, known["ORIN"].text() if "ORIN" in known else "ZXY" if data.key != "MAGN" else "")
    stream.values.append(values)
    stream.payload.append(index)
    stamp = known.get("STMP", known.get("TICK"))
    unit = 1e-6 if "STMP" in known else 1e-3
    stream.start_s.append(float(stamp.numbers()[0, 0]) * unit if stamp is not None else np.nan)
    utc = known["GPSU"].text() if "GPSU" in known else ""
    stream.utc_ns.append(_utc(utc) if utc else 0)
    stream.fix.append(float(known["GPSF"].numbers()[0, 0]) if "GPSF" in known else 3.0)
    stream.dilution.append(float(known["GPSP"].numbers()[0, 0]) / 100.0 if "GPSP" in known else np.nan)


def _utc(text: str) -> int:
    """Unix nanoseconds of ``yymmddhhmmss.sss``; zero where it is none."""
    try:
        return ns_from_date(f"20{text[:2]}-{text[2:4]}-{text[4:6]}T{text[6:8]}:{text[8:10]}:{text[10:]}Z")
    except SessionError:
        return 0


def _to_axes(values: Floats, order: str) -> Floats:
    """Columns of the channels `order` as x, y, z of the camera."""
    if sorted(order.lower()) != ["x", "y", "z"] or values.shape[1] < 3:
        return values[:, :3]
    column = {letter.lower(): values[:, i] * (1.0 if letter.isupper() else -1.0) for i, letter in enumerate(order)}
    return np.stack([column[axis] for axis in "xyz"], axis=-1)


def _steady(stream: _Stream, starts: Floats) -> Times:
    """Stamps of the samples: the line of least squares through the begins of payloads over the samples before them."""
    counts = np.array([len(rows) for rows in stream.values])
    before = np.concatenate([[0], np.cumsum(counts)[:-1]])
    if len(starts) > 2:
        step, first = np.polyfit(before, starts, 1)
    else:
        step, first = (np.diff(starts)[0] if len(starts) > 1 else PAYLOAD_S) / counts[0], starts[0]
    return ns_from_seconds(first + step * np.arange(counts.sum()))


def _starts(stream: _Stream, film: list[float] | None, gps: _Stream | None) -> Floats:
    """When each payload of a stream begins, s: its own stamps, else those of the film, else the UTC of the fixes."""
    own = np.array(stream.start_s)
    if np.isfinite(own).all() and (len(own) < 2 or np.all(np.diff(own) > 0)):
        return own
    index = np.array(stream.payload)
    if film is not None:
        return np.asarray(np.array(film)[index], dtype=np.float64)
    if gps is not None:
        locked = (np.array(gps.utc_ns) > 0) & (np.array(gps.fix) >= _LEAST_FIX)
        at, utc = np.array(gps.payload)[locked], np.array(gps.utc_ns)[locked]
        if len(at) > 5:
            return np.asarray(np.polyval(np.polyfit(at, (utc - utc[0]) / NS, 1), index))
    return np.asarray(index * PAYLOAD_S, dtype=np.float64)


def _matches(source: str) -> bool:
    try:
        path = Path(source)
        return path.is_file() and is_gpmf(path)
    except (OSError, ValueError):  # ValueError: a zero byte in the name
        return False


def _read(source: str, repairs: tuple[str, ...]) -> Session:
    path = Path(source)
    found, film = payloads(path)
    streams, device = _parse(path, found)
    gps = streams.get("GPS9", streams.get("GPS5"))
    accel, gyro = streams.get("ACCL"), streams.get("GYRO")
    offset = _to_unix(gps, film, "GPS9" in streams)
    parts = LogParts()

    def samples(stream: _Stream) -> Samples:
        return in_time_order(path, _steady(stream, _starts(stream, film, gps)) + (offset or 0), stream.rows(), repairs)

    rate, force = (None if stream is None else samples(stream) for stream in (gyro, accel))
    parts.add_inertial(path, rate, force, streams, wanted=gps is None)
    if "MAGN" in streams:
        parts.add_magnetometer(samples(streams["MAGN"]))
    if gps is not None:
        fixes = _fixes_9(gps) if "GPS9" in streams else _fixes_5(gps, film, offset)
        parts.add_fixes(path, fixes)
        parts.count("gnss", {"without lock left out": int((~np.isfinite(fixes.lat)).sum())})
    return log_session(parts, repairs, name=f"GoPro {device}", epoch="unix" if offset is not None else "boot")


def _to_unix(gps: _Stream | None, film: list[float] | None, nine: bool) -> int | None:
    """Nanoseconds from the camera's clock to Unix time, by the fixes with lock."""
    if gps is None:
        return None
    at = _starts(gps, film, gps)
    if nine:
        first = np.array([rows[0] for rows in gps.values])
        utc, locked = _utc_9(first), first[:, 8] >= _LEAST_FIX
    else:
        utc, locked = np.array(gps.utc_ns), (np.array(gps.utc_ns) > 0) & (np.array(gps.fix) >= _LEAST_FIX)
    return int(np.median(utc[locked] - ns_from_seconds(at[locked]))) if locked.any() else None


def _utc_9(rows: Floats) -> Times:
    """Unix nanoseconds of days and seconds since 2000."""
    return np.asarray(rows[:, 5] * 86_400, dtype=np.int64) * NS + ns_from_seconds(rows[:, 6]) + _Y2000_NS


def _fixes_5(gps: _Stream, film: list[float] | None, offset: int | None) -> LoggedFixes:
    t_ns = _steady(gps, _starts(gps, film, gps)) + (offset or 0)
    return _logged(t_ns, gps.rows(), gps.spread(gps.fix), gps.spread(gps.dilution))


def _fixes_9(gps: _Stream) -> LoggedFixes:
    rows = gps.rows()
    return _logged(_utc_9(rows), rows, rows[:, 8], rows[:, 7])


def _logged(t_ns: Times, rows: Floats, fix: Floats, dilution: Floats) -> LoggedFixes:
    locked = (fix >= _LEAST_FIX) & ~(dilution >= _NO_DILUTION)
    place = np.where(locked[:, None], rows[:, :3], np.nan)
    sigma = USER_RANGE_ERROR * np.where(dilution > 0, dilution, np.nan)[:, None] * np.array([1.0, 1.0, 2.0])
    return LoggedFixes(t_ns, place[:, 0], place[:, 1], height=place[:, 2], sigma=sigma)


READER = Reader(
    name="gopro",
    summary="GoPro camera: film (.mp4) or telemetry (.raw)",
    recognised_by="a file that begins with DEVC, or an .mp4 file with a track gpmd",
    matches=_matches,
    read_source=_read,
)
