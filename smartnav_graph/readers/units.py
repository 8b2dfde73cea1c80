"""Units in the headings of logs -> SI, matched with tolerance: ``(m/s²)``, ``[m/s^2]``, ``(G)``, ``(µT)``."""

from __future__ import annotations

import re

import numpy as np

from smartnav_graph.core.frames import STANDARD_GRAVITY
from smartnav_graph.core.timebase import NS

# Spellings, without blanks, brackets and case -> factor to the unit of the session's columns.
ACCELERATION = {"m/s2": 1.0, "m/s^2": 1.0, "m/s/s": 1.0, "ms-2": 1.0, "m*s^-2": 1.0, "mps2": 1.0} | dict.fromkeys(
    ("g", "gs", "gn"), STANDARD_GRAVITY
)
ACCELERATION |= {"mg": STANDARD_GRAVITY / 1000.0, "cm/s2": 0.01, "cm/s^2": 0.01}
ANGULAR_RATE = dict.fromkeys(("rad/s", "rads", "radpersec", "rads-1", "r/s", "rad*s^-1"), 1.0)
ANGULAR_RATE |= dict.fromkeys(("deg/s", "dps", "°/s", "degs-1", "deg/sec"), float(np.pi / 180.0))
ANGULAR_RATE |= {"mdps": float(np.pi / 180_000.0), "mdeg/s": float(np.pi / 180_000.0)}
FLUX_DENSITY = dict.fromkeys(("ut", "microt", "microtesla"), 1.0) | {"t": 1e6, "mt": 1e3, "nt": 1e-3}
FLUX_DENSITY |= dict.fromkeys(("gauss", "gs", "g"), 100.0) | dict.fromkeys(("mgauss", "mg"), 0.1)
PRESSURE = dict.fromkeys(("hpa", "mbar", "mb", "millibar"), 1.0) | {
    "kpa": 10.0,
    "pa": 0.01,
    "bar": 1000.0,
    "mmhg": 1.33322,
}
SPEED = {"m/s": 1.0, "mps": 1.0, "mph": 0.44704, "knots": 0.514444, "kn": 0.514444, "kt": 0.514444}
SPEED |= dict.fromkeys(("km/h", "kmh", "kph", "kmph"), 1.0 / 3.6)
LENGTH = {"m": 1.0, "meter": 1.0, "meters": 1.0, "km": 1000.0, "ft": 0.3048, "feet": 0.3048, "cm": 0.01, "mm": 0.001}
TEMPERATURE = dict.fromkeys(("°c", "c", "degc", "celsius"), 1.0)
TIME_NS = dict.fromkeys(("s", "sec", "secs", "second", "seconds"), NS)
TIME_NS |= dict.fromkeys(("ms", "milli", "millis", "millisecond", "milliseconds"), NS // 10**3)
TIME_NS |= dict.fromkeys(("us", "micros", "microsecond", "microseconds"), NS // 10**6)
TIME_NS |= dict.fromkeys(("ns", "nano", "nanos", "nanosecond", "nanoseconds"), 1) | {"min": 60 * NS, "h": 3600 * NS}

_LOST = {"?t": "ut", "m/s?": "m/s2", "?/s": "°/s", "?": "°"}
_IN_BRACKETS = re.compile(r"[(\[]\s*([^)\]]*?)\s*[)\]]")
_SAME = str.maketrans({"²": "2", "μ": "u", "µ": "u", "−": "-", "·": "*", "º": "°", "⁻": "-", "¹": "1"})


def plain_heading(name: str) -> str:
    """A heading in small letters without blanks: ``LOCATION Speed ( Kmh)`` -> ``locationspeed(kmh)``."""
    return re.sub(r"[\s_\"']", "", name.translate(_SAME).lower())


def unit_in(heading: str) -> str:
    """What a heading has in its last brackets, plain; empty without brackets. A sign that no code page could write, and
    that became a question mark, is that of micro, of a square or of degrees."""
    found = _IN_BRACKETS.findall(heading)
    unit = plain_heading(found[-1]) if found else ""
    return _LOST.get(unit.replace("\ufffd", "?"), unit)


def quantity_in(heading: str) -> str:
    """A heading without brackets, plain: ``accelerometerAccelerationX(G)`` -> ``accelerometeraccelerationx``."""
    return re.sub(r"[^0-9a-z]", "", plain_heading(_IN_BRACKETS.sub("", heading)))
