"""Dates and times of day in logs -> Unix nanoseconds, every digit kept."""

from __future__ import annotations

import re

import numpy as np

from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.timebase import NS

_DATE = re.compile(
    r"\s*(\d{4})[-/.]?(\d\d)[-/.]?(\d\d)[T _]\s*(\d\d)[:h-]?(\d\d)[:m-]?(\d\d)(?:[.,:_](\d{1,9})\d*)?\s*"
    r"(Z|UTC|GMT|[+-]\d\d:?\d\d|[+-]\d\d)?\s*\Z",
    re.IGNORECASE,
)

YEARS = (1700, 2250)  # whose nanoseconds since 1970 are numbers of 64 bits


def ns_from_date(text: str) -> int:
    """Unix nanoseconds of a date such as ``2023-12-31T22:33:02.400Z`` or ``2018-08-03 20:47:12:853``.

    Without a zone the text is taken as UTC.

    Raises
    ------
    SessionError
        It is no date, or one that does not exist.
    """
    found = _DATE.match(text)
    try:
        if found is None:
            raise ValueError
        year, month, day, hour, minute, second, fraction, zone = found.groups()
        days = int(np.datetime64(f"{year}-{month}-{day}", "D").astype(np.int64))
        if not YEARS[0] <= int(year) <= YEARS[1] or int(hour) > 24 or int(minute) > 59 or int(second) > 60:
            raise ValueError
    except ValueError as error:
        raise SessionError("time stamp", f"{text!r} is no date", "such as 2023-12-31T22:33:02.400Z") from error
    seconds = days * 86_400 + int(hour) * 3600 + int(minute) * 60 + int(second) - _zone_s(zone or "Z")
    return seconds * NS + int((fraction or "0").ljust(9, "0"))


def is_date(text: str) -> bool:
    """Whether a text is a date and a time of day."""
    return _DATE.match(text) is not None


def has_zone(text: str) -> bool:
    """Whether a date has its time zone."""
    found = _DATE.match(text)
    return found is not None and found[8] is not None


def _zone_s(zone: str) -> int:
    digits = re.sub(r"\D", "", zone)
    if not digits:
        return 0
    return (-1 if zone.startswith("-") else 1) * (int(digits[:2]) * 3600 + int(digits[2:4] or 0) * 60)
