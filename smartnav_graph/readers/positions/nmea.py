"""NMEA 0183: positions of GGA, RMC, GLL or GNS, with the sigmas of GST or by the dilution of precision, and velocities.

Lines may hold more than the sentence (a logger's own stamp, a name in front). Stamps are UTC by RMC or ZDA; without a
date they are seconds of the day, of an unknown clock. Fixes of quality 0 or status V are no values.
"""

from __future__ import annotations

import datetime
import re
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from smartnav_graph.core.arrays import Floats, Times
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.timebase import NS
from smartnav_graph.readers.fixes import LoggedFixes
from smartnav_graph.readers.positions.track import RANGE_ERROR_M, session_of_fixes
from smartnav_graph.readers.source import Reader, first_bytes
from smartnav_graph.readers.text import read_bytes
from smartnav_graph.session.session import Session

if TYPE_CHECKING:
    from pynmeagps import NMEAMessage

KNOTS_M_S = 1852.0 / 3600.0
HEIGHT_RATIO = 2.0  # vertical sigma over that of a horizontal axis, where only the horizontal dilution is known
_NO_DILUTION = 99.0  # receivers write 99.99 or 100 where there is none
_SENTENCE = re.compile(rb"\$[A-Z]{2}(?:GGA|RMC|VTG|GST|ZDA|GLL|GNS),[^$*\r\n]*(?:\*[0-9A-Fa-f]{2})?")
_DAY_NS = 86_400 * NS
_Value = float | str | datetime.time | datetime.date | None


@dataclass
class _Epoch:
    """What the sentences of one time of day say."""

    day_ns: int  # since midnight
    date: datetime.date | None = None
    values: dict[str, float] = field(default_factory=dict)
    valid: bool = True


def _matches(source: str) -> bool:
    return _SENTENCE.search(first_bytes(source)) is not None


def _read(source: str, repairs: tuple[str, ...]) -> Session:
    path = Path(source)
    counts: Counter[str] = Counter()
    epochs = _epochs(_sentences(path, counts))
    used = [epoch for epoch in epochs if epoch.valid and {"lat", "lon"} <= epoch.values.keys()]
    counts["epochs without a fix"] = len(epochs) - len(used)
    if not used:
        found = f"holds no valid fix ({len(epochs)} epochs, all of quality 0 or status V)"
        raise SessionError(path, found, "NMEA sentences with positions", "record again with a view of the sky")
    t_ns, epoch = _stamps(used)
    lat, lon, alt, sep = (_column(used, name) for name in ("lat", "lon", "alt", "sep"))
    height = np.where(np.isfinite(sep), alt + sep, np.nan if np.isfinite(sep).any() else alt)
    fixes = LoggedFixes(
        *(t_ns, lat, lon, height),
        speed=_column(used, "spd"),
        course=_column(used, "cog"),
        sigma=_sigma(used),
        above_sea=not np.isfinite(sep).any(),
        fix_type=np.nan_to_num(_column(used, "quality"), nan=1.0).astype(np.int64),
    )
    return session_of_fixes(path, fixes, epoch, repairs, counts)


def _sentences(path: Path, counts: Counter[str]) -> list[NMEAMessage]:
    """The readable sentences; the others are counted."""
    from pynmeagps import NMEAMessageError, NMEAParseError, NMEAReader, NMEATypeError
    from pynmeagps.nmeatypes_core import VALCKSUM

    found = []
    for match in _SENTENCE.finditer(read_bytes(path)):
        try:
            message = NMEAReader.parse(match[0] + b"\r\n", validate=VALCKSUM if b"*" in match[0] else 0)
        except (NMEAParseError, NMEAMessageError, NMEATypeError, ValueError):
            message = None
        if message is None:
            counts["sentences with a wrong checksum or field"] += 1
        else:
            found.append(message)
    return found


def _epochs(sentences: list[NMEAMessage]) -> list[_Epoch]:
    """Sentences of one time of day together; VTG belongs to those before it."""
    epochs: list[_Epoch] = []
    for message in sentences:
        time, date = getattr(message, "time", None), getattr(message, "date", None)
        if isinstance(time, datetime.time):
            seconds = (time.hour * 60 + time.minute) * 60 + time.second
            day_ns = seconds * NS + time.microsecond * 1000
            if not epochs or epochs[-1].day_ns != day_ns:
                epochs.append(_Epoch(day_ns))
        if not epochs or (message.msgID != "VTG" and not isinstance(time, datetime.time)):
            continue
        epoch = epochs[-1]
        if isinstance(date, datetime.date):
            epoch.date = date
        elif message.msgID == "ZDA" and isinstance(message.year, int) and message.year > 0:
            epoch.date = datetime.date(message.year, message.month, message.day)
        _add(epoch, message)
    return epochs


def _add(epoch: _Epoch, message: NMEAMessage) -> None:
    """The values of a sentence; a position of GGA precedes those of others, which lack the height."""
    kind = message.msgID
    if getattr(message, "status", "A") == "V" or getattr(message, "quality", 1) == 0:
        epoch.valid = False
    names = {"lat": "lat", "lon": "lon", "alt": "alt", "sep": "sep", "HDOP": "hdop", "quality": "quality"}
    if kind == "GST":
        names = {"stdLat": "sigma_n", "stdLong": "sigma_e", "stdAlt": "sigma_u"}
    elif kind == "RMC":
        names |= {"spd": "spd", "cog": "cog"}
    elif kind == "VTG":
        names = {"cogt": "cog", "sogn": "spd"}
    for theirs, ours in names.items():
        value: _Value = getattr(message, theirs, None)
        if isinstance(value, int | float) and not (ours in ("lat", "lon") and kind != "GGA" and ours in epoch.values):
            epoch.values[ours] = float(value) * (KNOTS_M_S if ours == "spd" else 1.0)


def _column(epochs: list[_Epoch], name: str) -> Floats:
    return np.array([epoch.values.get(name, np.nan) for epoch in epochs])


def _sigma(epochs: list[_Epoch]) -> Floats:
    """Those of GST, else the dilution of precision by the range error of the fix's quality."""
    quality = np.nan_to_num(_column(epochs, "quality"), nan=1.0)
    error = np.array([RANGE_ERROR_M.get(int(q), np.nan) for q in quality])
    hdop = _column(epochs, "hdop")
    h = np.where(hdop < _NO_DILUTION, hdop, np.nan) * error / np.sqrt(2.0)
    stated = np.stack([_column(epochs, f"sigma_{axis}") for axis in "enu"], axis=1)
    return np.where(stated > 0.0, stated, np.stack([h, h, HEIGHT_RATIO * h], axis=1))


def _stamps(epochs: list[_Epoch]) -> tuple[Times, str]:
    """Stamps (n,) and their epoch; a day begins where the time of day falls back by half a day."""
    day_ns = np.array([epoch.day_ns for epoch in epochs], dtype=np.int64)
    day = np.cumsum(np.concatenate([[0], np.diff(day_ns) < -_DAY_NS // 2]).astype(np.int64))
    dated = [(i, epoch.date) for i, epoch in enumerate(epochs) if epoch.date is not None]
    if not dated:
        return day * _DAY_NS + day_ns, "unknown"
    ordinal = np.array([(date - datetime.date(1970, 1, 1)).days for _, date in dated], dtype=np.int64)
    rows = np.array([i for i, _ in dated])
    nearest = np.clip(np.searchsorted(rows, np.arange(len(epochs)), side="right") - 1, 0, None)
    return (ordinal[nearest] + day - day[rows[nearest]]) * _DAY_NS + day_ns, "unix"


READER = Reader(
    name="nmea",
    summary="NMEA 0183: GGA, RMC, VTG, GST, ZDA",
    recognised_by="a text file with sentences such as $GPGGA,... in its first lines",
    matches=_matches,
    read_source=_read,
    general=True,
)
