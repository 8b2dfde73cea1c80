"""A solution in the formats of other programs: TUM, KML, GeoJSON, GPX, CSV, and images with their position.

Geographic formats need an origin. Their times are absolute only where the clock counts from the Unix epoch; otherwise
the files have seconds since time zero. Their description says so, and that heights are ellipsoidal (WGS84): KML and
GPX programs take them for heights above sea level.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.files import replacing
from smartnav_graph.graph.solution import Solution
from smartnav_graph.output.export.geographic import write_geojson, write_gpx, write_kml
from smartnav_graph.output.export.pictures import Geotags, export_pictures
from smartnav_graph.output.export.plain import write_trajectory_csv, write_tum

__all__ = ["FORMATS", "Geotags", "export", "export_pictures", "write_trajectory_csv"]

PLAIN: dict[str, Callable[[Solution, Path], None]] = {"tum": write_tum, "csv": write_trajectory_csv}
GEOGRAPHIC: dict[str, Callable[[Solution, Path, bool], None]] = {
    "kml": write_kml,
    "geojson": write_geojson,
    "gpx": write_gpx,
}
FORMATS = ("tum", "kml", "geojson", "gpx", "csv")


def export(
    solution: Solution, format: str, path: str | Path, *, force: bool = False, clock_epoch: str = "unknown"
) -> None:
    """Write a solution as one file, all or nothing.

    Parameters
    ----------
    format : ``tum`` | ``kml`` | ``geojson`` | ``gpx`` | ``csv``
    force : replace an existing file
    clock_epoch : of the session; ``unix`` gives absolute times in the geographic formats

    Raises
    ------
    SessionError
        Unknown format; a geographic one without origin; the file exists; the system refuses to write.
    """
    if format not in FORMATS:
        raise SessionError("--format", f"{format!r}", f"one of {', '.join(FORMATS)}")
    if format in GEOGRAPHIC and solution.origin is None:
        raise SessionError(
            f"--format {format}",
            "the solution has no origin, only local metres",
            "an [origin] in session.toml",
            "add lat_deg, lon_deg, height_m and smooth again, or export tum or csv",
        )
    with replacing(path, force=force) as file:
        if format in GEOGRAPHIC:
            GEOGRAPHIC[format](solution, file, clock_epoch == "unix")
        else:
            PLAIN[format](solution, file)
