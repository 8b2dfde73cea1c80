"""Positions of a solution in another coordinate reference system, by its EPSG code."""

from __future__ import annotations

import numpy as np

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.errors import SessionError
from smartnav_graph.graph.solution import Solution
from smartnav_graph.output.export.geographic import lla_of

UNITS = {"metre": "m", "degree": "deg", "US survey foot": "us_ft", "foot": "ft"}


def coordinates_in(solution: Solution, crs: str) -> dict[str, Floats]:
    """Coordinates (n,) in a system such as ``EPSG:25832``, by column name: ``epsg25832_east_m``, ``_north_m``,
    ``_height_m``. Heights of a system without a vertical part stay ellipsoidal.

    Raises
    ------
    SessionError
        The system is not known, needs a grid that is not installed, or does not hold at the place.
    """
    return dict(zip(*transformed(lla_of(solution), crs), strict=True))


def transformed(lla: Floats, crs: str) -> tuple[tuple[str, ...], tuple[Floats, Floats, Floats]]:
    """Column names and coordinates of geodetic rows lla (n, 3), WGS84; see `coordinates_in`."""
    import pyproj

    where = f"--crs {crs}"
    try:
        system = pyproj.CRS.from_user_input(crs)
        to_system = pyproj.Transformer.from_crs("EPSG:4979", system, always_xy=True, allow_ballpark=False)
        x, y, height = to_system.transform(lla[:, 1], lla[:, 0], lla[:, 2])
    except pyproj.exceptions.ProjError as error:
        remedy = "give a code of epsg.org; a system of heights above the sea needs its geoid grid (pyproj sync)"
        raise SessionError(where, f"cannot be used ({error})", "a system such as EPSG:25832", remedy) from error
    if not np.isfinite([x, y, height]).all():
        found = f"gives no coordinates at {lla[0, 0]:.5f}, {lla[0, 1]:.5f} deg"
        remedy = "choose the system of the place; heights above the sea need a geoid grid (pyproj sync)"
        raise SessionError(where, found, "a system that holds there", remedy)
    names = ("x", "y", "z") if system.is_geocentric else ("east", "north", "height")
    names = ("lon", "lat", "height") if system.is_geographic else names
    units = [UNITS.get(axis.unit_name, axis.unit_name.replace(" ", "_")) for axis in system.axis_info]
    units += ["m"] * (3 - len(units))
    code = (system.to_string() if len(crs) > 20 else crs).lower().replace(":", "").replace("+", "_")
    return tuple(f"{code}_{name}_{unit}" for name, unit in zip(names, units, strict=True)), (x, y, height)
