"""A solution in the formats of other programs: TUM, KML, GeoJSON, GPX, CSV.

Geographic formats need an origin. Their times are absolute only where the clock counts from the Unix epoch; otherwise
the files carry seconds since time zero, and their description says so. Heights are ellipsoidal (WGS84), and that is
told too, since KML and GPX programs take them for heights above sea level.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.errors import SessionError
from smartnav_graph.files import replacing
from smartnav_graph.frames import LocalFrame
from smartnav_graph.solution import POS, Solution
from smartnav_graph.timebase import NS

Floats = NDArray[np.float64]

GPX_NAMESPACE = "http://www.topografix.com/GPX/1/1"


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


def write_trajectory_csv(solution: Solution, path: str | Path) -> None:
    """The columns of trajectory.csv: t_ns whole, floats in the shortest text that reads back the same.

    What is unknown stays empty: latitude, longitude and height without an origin. Writes straight to `path`.
    """
    import pyarrow as pa
    import pyarrow.csv

    columns = solution.trajectory_columns()
    table = pa.table({name: pa.array(values, from_pandas=True) for name, values in columns.items()})
    with open(path, "wb") as file:
        file.write((",".join(columns) + "\n").encode())  # pyarrow would quote the names
        pyarrow.csv.write_csv(table, file, pyarrow.csv.WriteOptions(include_header=False))


def write_tum(solution: Solution, path: str | Path) -> None:
    """Lines ``t x y z qx qy qz qw`` (Sturm et al. 2012): seconds on the solution's clock, nav metres, nav_R_body."""
    values = np.concatenate([solution.nav_t_body, solution.quat_wxyz[:, [1, 2, 3, 0]]], axis=1).tolist()
    stamps = map(_decimal_seconds, solution.t_ns.tolist())
    lines = (f"{t} {' '.join(map(repr, row))}\n" for t, row in zip(stamps, values, strict=True))
    with open(path, "w", encoding="ascii") as file:
        file.writelines(lines)


def _decimal_seconds(t_ns: int) -> str:
    # a binary float would round a Unix epoch to 0.2 us
    whole, rest = divmod(abs(t_ns), NS)
    return f"{'-' if t_ns < 0 else ''}{whole}.{rest:09d}"


def write_kml(solution: Solution, path: str | Path, absolute_time: bool) -> None:
    """A gx:Track with a time and one-sigma arrays a point; without absolute time a line."""
    import simplekml

    lla = _lla(solution)
    coordinates = list(map(tuple, lla[:, [1, 0, 2]].tolist()))
    kml = simplekml.Kml(name="smartnav_graph", description=_description(solution, absolute_time))
    shape: Any
    if absolute_time:
        schema = kml.newschema(name="uncertainty")
        shape = kml.newgxtrack(name="trajectory")
        shape.newgxcoord(coordinates)
        shape.newwhen(_utc(solution))
        shape.extendeddata.schemadata.schemaurl = schema.id
        for name, values in _sigmas(solution).items():
            schema.newgxsimplearrayfield(name=name, type=simplekml.Types.float, displayname=name)
            shape.extendeddata.schemadata.newgxsimplearraydata(name, values)
    else:
        shape = kml.newlinestring(name="trajectory", coords=coordinates)
    shape.description = kml.document.description
    shape.altitudemode = simplekml.AltitudeMode.absolute
    shape.style.linestyle.color, shape.style.linestyle.width = simplekml.Color.orangered, 3
    kml.save(str(path), format=False)


def write_gpx(solution: Solution, path: str | Path, absolute_time: bool) -> None:
    """One GPX 1.1 track; points carry a time where it is absolute."""
    ElementTree.register_namespace("", GPX_NAMESPACE)
    root = ElementTree.Element(f"{{{GPX_NAMESPACE}}}gpx", version="1.1", creator="smartnav_graph")

    def add(parent: ElementTree.Element, tag: str, text: str | None = None, **attributes: str) -> ElementTree.Element:
        child = ElementTree.SubElement(parent, f"{{{GPX_NAMESPACE}}}{tag}", attributes)
        child.text = text
        return child

    track = add(root, "trk")
    add(track, "name", "trajectory")
    add(track, "desc", _description(solution, absolute_time))
    segment = add(track, "trkseg")
    times = _utc(solution) if absolute_time else [None] * len(solution)
    for (lat, lon, height), time in zip(_lla(solution).tolist(), times, strict=True):
        point = add(segment, "trkpt", lat=f"{lat:.10f}", lon=f"{lon:.10f}")
        add(point, "ele", f"{height:.4f}")
        if time is not None:
            add(point, "time", time)
    ElementTree.ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)


def write_geojson(solution: Solution, path: str | Path, absolute_time: bool) -> None:
    """A FeatureCollection of one LineString (RFC 7946); per-point times and sigmas stand in its properties."""
    properties: dict[str, Any] = {
        "name": "trajectory",
        "description": _description(solution, absolute_time),
        "t_ns": solution.t_ns.tolist(),
        "elapsed_s": solution.seconds.tolist(),
        **_sigmas(solution),
        "heading_deg": solution.heading_pitch_roll_deg[:, 0].tolist(),
    }
    if absolute_time:
        properties["coordTimes"] = _utc(solution)
    line = {"type": "LineString", "coordinates": _lla(solution)[:, [1, 0, 2]].tolist()}
    feature = {"type": "Feature", "geometry": line, "properties": properties}
    with open(path, "w", encoding="utf-8") as file:
        json.dump({"type": "FeatureCollection", "features": [feature]}, file, allow_nan=False)


def _lla(solution: Solution) -> Floats:
    assert solution.origin is not None  # `export` checked
    return LocalFrame(solution.origin).lla_from_nav(solution.nav_t_body)


def _utc(solution: Solution) -> list[str]:
    """ISO 8601 in UTC, cut to the microsecond (what other programs read)."""
    text: list[str] = np.datetime_as_string(solution.t_ns.astype("datetime64[ns]"), unit="us").tolist()
    return [f"{t}Z" for t in text]


def _sigmas(solution: Solution) -> dict[str, list[float | None]]:
    columns = dict(zip(("sigma_e_m", "sigma_n_m", "sigma_u_m"), solution.sigmas[:, POS].T, strict=True))
    return {name: [x if np.isfinite(x) else None for x in values.tolist()] for name, values in columns.items()}


def _description(solution: Solution, absolute_time: bool) -> str:
    horizontal, vertical = np.hypot(*solution.sigmas[:, POS][:, :2].T), solution.sigmas[:, POS][:, 2]
    clock = "times are UTC" if absolute_time else "no absolute time: the session's clock has no Unix epoch"
    return (
        f"{len(solution)} epochs over {solution.seconds[-1] - solution.seconds[0]:.3f} s; {clock}; time zero is "
        f"{solution.t0_ns} ns on the session's clock; heights are ellipsoidal (WGS84); one sigma horizontal: median "
        f"{np.median(horizontal):.3f} m, largest {horizontal.max():.3f} m; vertical: median "
        f"{np.median(vertical):.3f} m, largest {vertical.max():.3f} m"
    )


PLAIN: dict[str, Callable[[Solution, Path], None]] = {"tum": write_tum, "csv": write_trajectory_csv}
GEOGRAPHIC: dict[str, Callable[[Solution, Path, bool], None]] = {
    "kml": write_kml,
    "geojson": write_geojson,
    "gpx": write_gpx,
}
FORMATS = ("tum", "kml", "geojson", "gpx", "csv")
