"""Places in any coordinate reference system -> latitude, longitude (deg, WGS84) and height, by PROJ."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.errors import SessionError


def geodetic(path: Path, epsg: int, east: Floats, north: Floats, height: Floats) -> Floats:
    """Rows (n, 3) lat deg, lon deg, height m of coordinates (n,) each of the system `epsg`.

    Projected and geographic systems: east (longitude) before north (latitude); heights are left as they are. Geocentric
    ones: X, Y, Z.

    Raises
    ------
    SessionError
        No such system, or a place outside of it.
    """
    import pyproj

    try:
        system = pyproj.CRS.from_epsg(epsg)
        if system.is_geocentric:
            to_lla = pyproj.Transformer.from_crs(system, "EPSG:4979", always_xy=True)
            lon, lat, height = to_lla.transform(east, north, height)
        else:
            plane = system.sub_crs_list[0] if system.is_compound else system.to_2d()
            lon, lat = pyproj.Transformer.from_crs(plane, "EPSG:4326", always_xy=True).transform(east, north)
    except pyproj.exceptions.ProjError as error:
        raise SessionError(path, f"EPSG {epsg} is not known ({error})", "an EPSG code", "see epsg.org") from error
    rows = np.stack([np.asarray(lat), np.asarray(lon), np.asarray(height)], axis=1).astype(np.float64)
    outside = np.flatnonzero(~np.isfinite(rows[:, :2]).all(axis=1) | (np.abs(rows[:, 0]) > 90.0))
    if len(outside):
        row = int(outside[0])
        found = f"E {east[row]:.10g}, N {north[row]:.10g} at row {row} lie outside EPSG {epsg}, {system.name}"
        raise SessionError(path, found, "east before north, in metres", "exchange E and N, or correct EPSG", row=row)
    return rows


def fitting_systems(epsg: int, east: float, north: float, lat: float, lon: float, within_m: float) -> list[int]:
    """Other zones of UTM (WGS84, and ETRS89 where `epsg` is of it) in which a place lies near another one."""
    import pyproj

    geod = pyproj.Geod(ellps="WGS84")
    ours = [25800 + zone for zone in range(28, 39)] if 25828 <= epsg <= 25838 else []
    found = []
    for other in ours or [*range(32601, 32661), *range(32701, 32761)]:
        to_lla = pyproj.Transformer.from_crs(f"EPSG:{other}", "EPSG:4326", always_xy=True)
        there = to_lla.transform(east, north)
        if np.isfinite(there).all() and geod.inv(*there, lon, lat)[2] < within_m:
            found.append(other)
    return found
