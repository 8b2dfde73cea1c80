"""Speeds in a wrong unit, found by comparison with a known speed."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from smartnav_graph.core.arrays import Floats
from smartnav_graph.session.health.facts import LEAST_ROWS, Finding

_SPEEDS = {3.6: "km/h", 1.944: "knots", 2.237: "mph", 3.281: "ft/s", 100.0: "cm/s", 1000.0: "mm/s"}
_NEAR = 0.06  # of a unit's factor
_ODD = 1.3  # a factor that slip or tyres do not explain


def odd_speed(where: str, what: str, measured: Floats, known: Floats) -> Iterator[Finding]:
    """Speeds (n,) of a sensor against those known from elsewhere (n,) m/s."""
    if len(measured) < LEAST_ROWS:
        return
    factor = float(np.median(measured / known))
    scatter = float(np.median(np.abs(measured / known - factor)))
    if 1.0 / _ODD < factor < _ODD or scatter > 0.3 * abs(factor):
        return
    unit = next((name for f, name in _SPEEDS.items() if abs(factor / f - 1.0) < _NEAR), None)
    looks = f": it looks like {unit}" if unit else ""
    text = f"{what} is {factor:.3g} times the speed of the fixes{looks}"
    yield Finding("warning", where, text, f"divide {what} by {factor:.4g}" if unit is None else "give m/s")
