"""Positions of a solution in another coordinate reference system, by its EPSG code."""

from __future__ import annotations

import re

import numpy as np

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.errors import SessionError
from smartnav_graph.graph.solution import Solution
from smartnav_graph.output.export.geographic import lla_of

FARTHEST_DEG = 5.0  # of arc outside the area of use; national maps use one UTM zone for the zones beside it
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


def refuse_elsewhere(lla: Floats, crs: str) -> None:
    """Refuse a system that is made for another place than geodetic rows lla (n, 3); one that is not known is left to
    `transformed`.

    Raises
    ------
    SessionError
        A position lies more than `FARTHEST_DEG` outside the area of use.
    """
    import pyproj

    try:
        area = pyproj.CRS.from_user_input(crs).area_of_use
    except pyproj.exceptions.ProjError:
        return
    if area is None:
        return
    outside = _outside_deg(lla, area.bounds)
    worst = int(np.argmax(outside))
    if outside[worst] > FARTHEST_DEG:
        lat, lon = lla[worst, :2].tolist()
        region = re.split("[.:;] ", area.name.rstrip("."))[0]  # without its list of states
        found = f"is made for '{region}'; a position at {lat:.5f}, {lon:.5f} deg lies {outside[worst]:.0f} deg outside"
        utm = (32600 if lat >= 0 else 32700) + int((lon + 180.0) // 6.0) % 60 + 1
        raise SessionError(f"--crs {crs}", found, "a system of the place", f"such as EPSG:{utm}, its UTM zone")


def _outside_deg(lla: Floats, bounds: tuple[float, float, float, float]) -> Floats:
    """Degrees of arc (n,) by which positions lie outside west, south, east, north; 0 inside."""
    west, south, east, north = bounds
    lat, lon = lla[:, 0], lla[:, 1]
    half = (east - west) % 360.0 / 2.0 if east - west < 360.0 else 180.0  # an area may cross 180 deg
    from_middle = np.abs((lon - west - half + 180.0) % 360.0 - 180.0)
    beside = np.maximum(from_middle - half, 0.0) * np.cos(np.radians(lat))
    found: Floats = np.hypot(beside, np.maximum(np.maximum(south - lat, lat - north), 0.0))
    return found


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
