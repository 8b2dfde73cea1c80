"""Axes of a unit that is mounted on a vehicle: x ahead, unless the data show otherwise."""

from __future__ import annotations

import logging
from pathlib import Path

from smartnav_graph.readers.axes import BodyAxes, find_body_axes
from smartnav_graph.readers.log_session import LogParts

_log = logging.getLogger(__name__)


def device_axes(path: Path, parts: LogParts) -> BodyAxes:
    """Axes that the streams ``imu`` and ``gnss`` show; forward is +x by default, where that is not vertical.

    REP 103 (forward, left, up) and the makers of navigation units (forward, right, down) have x ahead.
    """
    if "imu" not in parts.tables:
        return BodyAxes("+x", "+z")
    found = find_body_axes(parts.tables["imu"][1], parts.tables["gnss"][1] if "gnss" in parts.tables else None)
    forward = found.forward if found.forward_found or found.up[1] == "x" else "+x"
    source = "by the course of the fixes" if found.forward_found else "by default; the fixes do not show it"
    _log.info("%s: up %s by gravity, forward %s %s", path, found.up, forward, source)
    return BodyAxes(forward, found.up, found.forward_found, found.up_found)
