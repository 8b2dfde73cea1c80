"""A solution in the formats of other programs: TUM, KML, GeoJSON, GPX, CSV, SBET, NMEA, GeoPackage, and images with
their position.

Geographic formats need an origin. Their times are absolute only where the clock counts from the Unix epoch; otherwise
the files have seconds since time zero. Their description says so, and what heights count from: KML and GPX
programs take them for heights above sea level. Formats without a description warn of heights that are not ellipsoidal.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.files import replacing
from smartnav_graph.graph.solution import Solution
from smartnav_graph.output.export.coordinates import coordinates_in, refuse_elsewhere
from smartnav_graph.output.export.geographic import lla_of, warn_of_heights, write_geojson, write_gpx, write_kml
from smartnav_graph.output.export.geopackage import write_geopackage
from smartnav_graph.output.export.navigation import write_nmea, write_sbet
from smartnav_graph.output.export.pictures import Geotags, export_pictures
from smartnav_graph.output.export.plain import write_trajectory_csv, write_tum

__all__ = ["FORMATS", "Geotags", "export", "export_pictures", "write_trajectory_csv"]

GEOGRAPHIC: dict[str, Callable[[Solution, Path, bool], None]] = {
    "kml": write_kml,
    "geojson": write_geojson,
    "gpx": write_gpx,
}
DATED: dict[str, Callable[[Solution, Path, str], None]] = {"sbet": write_sbet, "nmea": write_nmea}
FORMATS = ("tum", "kml", "geojson", "gpx", "csv", "sbet", "nmea", "gpkg")
IN_ANY_CRS = ("csv", "gpkg")
UNDESCRIBED = ("csv", "gpkg", "sbet")  # formats that cannot say what heights count from


def export(
    solution: Solution,
    format: str,
    path: str | Path,
    *,
    force: bool = False,
    clock_epoch: str = "unknown",
    crs: str | None = None,
) -> None:
    """Write a solution as one file, all or nothing.

    Parameters
    ----------
    format : one of `FORMATS`
    force : replace an existing file
    clock_epoch : of the session; ``unix`` gives absolute times in the geographic formats
    crs : system of the coordinates, such as ``EPSG:25832``: further columns of csv, geometry of gpkg

    Raises
    ------
    SessionError
        Unknown format or system, or a system of another place; one that needs an origin or a date that the session
        does not have; the file exists; the system refuses to write.
    """
    if format not in FORMATS:
        raise SessionError("--format", f"{format!r}", f"one of {', '.join(FORMATS)}")
    if crs is not None and format not in IN_ANY_CRS:
        raise SessionError(
            f"--crs {crs}", f"cannot be written as {format}", f"--format {' or '.join(IN_ANY_CRS)}", "leave --crs out"
        )
    if solution.origin is None and (format not in ("tum", "csv") or crs is not None):
        raise SessionError(
            f"--format {format}",
            "the solution has no origin, only local metres",
            "an [origin] in session.toml",
            "add lat_deg, lon_deg, height_m and smooth again, or export tum or csv",
        )
    if format == "gpkg" and Path(path).suffix != ".gpkg":
        raise SessionError(path, "is no name of a GeoPackage", "NAME.gpkg", "other programs would not open it")
    if crs is not None:
        refuse_elsewhere(lla_of(solution), crs)
    with replacing(path, force=force) as file:
        if format in GEOGRAPHIC:
            GEOGRAPHIC[format](solution, file, clock_epoch == "unix")
        elif format in DATED:
            DATED[format](solution, file, clock_epoch)
        elif format == "gpkg":
            write_geopackage(solution, file, clock_epoch, crs)
        elif format == "csv":
            write_trajectory_csv(solution, file, {} if crs is None else coordinates_in(solution, crs))
        else:
            write_tum(solution, file)
    if format in UNDESCRIBED:
        warn_of_heights(solution, f"--format {format}" if crs is None else f"--crs {crs}")
