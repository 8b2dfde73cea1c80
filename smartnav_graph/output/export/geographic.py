"""KML, GPX and GeoJSON: latitude, longitude, height; time and one sigma of every point where known.

Sources: OGC 12-007r2 KML 2.3 (gx:Track); TopoGrafix, GPX 1.1 schema; RFC 7946 (GeoJSON).
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from smartnav_graph.core.arrays import Floats, Times
from smartnav_graph.core.errors import warn
from smartnav_graph.core.frames import ELLIPSOIDAL, LocalFrame
from smartnav_graph.graph.solution import POS, Solution

Rows = list[list[float]]

KML_NAMESPACE = "http://www.opengis.net/kml/2.2"
GX_NAMESPACE = "http://www.google.com/kml/ext/2.2"
GPX_NAMESPACE = "http://www.topografix.com/GPX/1/1"
OWN_NAMESPACE = "urn:smartnav-graph:trajectory"  # of sigmas, for which GPX has no element
ORANGE = "ff0045ff"  # opacity, blue, green, red
MARKS = 100  # single points of a KML track
SIGMAS = ("sigma_e_m", "sigma_n_m", "sigma_u_m")


def _add(parent: Element, space: str, tag: str, text: str | None = None, **attributes: str) -> Element:
    child = ElementTree.SubElement(parent, f"{{{space}}}{tag}", attributes)
    child.text = text
    return child


def write_kml(solution: Solution, path: str | Path, absolute_time: bool) -> None:
    """A gx:Track with times and one-sigma arrays, without absolute time a line; and about `MARKS` points along it with
    time, one sigma and heading."""
    ElementTree.register_namespace("", KML_NAMESPACE)
    ElementTree.register_namespace("gx", GX_NAMESPACE)
    root = Element(f"{{{KML_NAMESPACE}}}kml")
    document = _add(root, KML_NAMESPACE, "Document")
    _add(document, KML_NAMESPACE, "name", "smartnav_graph")
    _add(document, KML_NAMESPACE, "description", _description(solution, absolute_time))
    _kml_styles(document)
    if absolute_time:
        schema = _add(document, KML_NAMESPACE, "Schema", name="uncertainty", id="uncertainty")
        for name in SIGMAS:
            _add(schema, GX_NAMESPACE, "SimpleArrayField", name=name, type="float")
    coordinates = lla_of(solution)[:, [1, 0, 2]].tolist()
    (_kml_track if absolute_time else _kml_line)(_kml_placemark(document, "trajectory", "#path"), solution, coordinates)
    _kml_marks(document, solution, coordinates, absolute_time)
    ElementTree.ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)


def _kml_styles(document: Element) -> None:
    path = _add(_add(document, KML_NAMESPACE, "Style", id="path"), KML_NAMESPACE, "LineStyle")
    _add(path, KML_NAMESPACE, "color", ORANGE)
    _add(path, KML_NAMESPACE, "width", "3")
    epoch = _add(document, KML_NAMESPACE, "Style", id="epoch")
    for kind in ("IconStyle", "LabelStyle"):
        _add(_add(epoch, KML_NAMESPACE, kind), KML_NAMESPACE, "scale", "0.5")


def _kml_placemark(parent: Element, name: str, style: str, when: str | None = None) -> Element:
    placemark = _add(parent, KML_NAMESPACE, "Placemark")
    _add(placemark, KML_NAMESPACE, "name", name)
    if when is not None:
        _add(_add(placemark, KML_NAMESPACE, "TimeStamp"), KML_NAMESPACE, "when", when)
    _add(placemark, KML_NAMESPACE, "styleUrl", style)
    return placemark


def _kml_line(placemark: Element, solution: Solution, coordinates: Rows) -> None:
    line = _add(placemark, KML_NAMESPACE, "LineString")
    _add(line, KML_NAMESPACE, "altitudeMode", "absolute")
    _add(line, KML_NAMESPACE, "coordinates", " ".join(",".join(map(repr, row)) for row in coordinates))


def _kml_track(placemark: Element, solution: Solution, coordinates: Rows) -> None:
    track = _add(placemark, GX_NAMESPACE, "Track")
    _add(track, KML_NAMESPACE, "altitudeMode", "absolute")
    for time in utc(solution.t_ns):
        _add(track, KML_NAMESPACE, "when", time)
    for row in coordinates:
        _add(track, GX_NAMESPACE, "coord", " ".join(map(repr, row)))
    data = _add(track, KML_NAMESPACE, "ExtendedData")
    table = _add(data, KML_NAMESPACE, "SchemaData", schemaUrl="#uncertainty")
    for name, values in _sigmas(solution).items():
        column = _add(table, GX_NAMESPACE, "SimpleArrayData", name=name)
        for value in values:
            _add(column, GX_NAMESPACE, "value", "" if value is None else f"{value:.6g}")


def _kml_marks(document: Element, solution: Solution, coordinates: Rows, absolute_time: bool) -> None:
    """Points at equal steps of the epochs, in a separate folder."""
    folder = _add(document, KML_NAMESPACE, "Folder")
    _add(folder, KML_NAMESPACE, "name", "epochs")
    columns = {"elapsed_s": solution.seconds.tolist(), **_sigmas(solution)}
    columns["heading_deg"] = solution.heading_pitch_roll_deg[:, 0].tolist()
    chosen = np.unique(np.linspace(0, len(solution) - 1, min(MARKS, len(solution))).round().astype(int))
    for i, stamp in zip(chosen.tolist(), utc(solution.t_ns[chosen]), strict=True):
        when = stamp if absolute_time else None
        placemark = _kml_placemark(folder, f"{columns['elapsed_s'][i]:.1f} s", "#epoch", when)
        data = _add(placemark, KML_NAMESPACE, "ExtendedData")
        for name, values in columns.items():
            if values[i] is not None:
                _add(_add(data, KML_NAMESPACE, "Data", name=name), KML_NAMESPACE, "value", f"{values[i]:.6g}")
        point = _add(placemark, KML_NAMESPACE, "Point")
        _add(point, KML_NAMESPACE, "altitudeMode", "absolute")
        _add(point, KML_NAMESPACE, "coordinates", ",".join(map(repr, coordinates[i])))


def write_gpx(solution: Solution, path: str | Path, absolute_time: bool) -> None:
    """One GPX 1.1 track; points have a time where it is absolute, and their sigmas as extensions."""
    ElementTree.register_namespace("", GPX_NAMESPACE)
    ElementTree.register_namespace("smartnav", OWN_NAMESPACE)
    root = Element(f"{{{GPX_NAMESPACE}}}gpx", version="1.1", creator="smartnav_graph")
    track = _add(root, GPX_NAMESPACE, "trk")
    _add(track, GPX_NAMESPACE, "name", "trajectory")
    _add(track, GPX_NAMESPACE, "desc", _description(solution, absolute_time))
    segment = _add(track, GPX_NAMESPACE, "trkseg")
    times = utc(solution.t_ns) if absolute_time else [None] * len(solution)
    sigmas = list(zip(*_sigmas(solution).values(), strict=True))
    for (lat, lon, height), time, sigma in zip(lla_of(solution).tolist(), times, sigmas, strict=True):
        point = _add(segment, GPX_NAMESPACE, "trkpt", lat=f"{lat:.10f}", lon=f"{lon:.10f}")
        _add(point, GPX_NAMESPACE, "ele", f"{height:.4f}")
        if time is not None:
            _add(point, GPX_NAMESPACE, "time", time)
        if None not in sigma:
            beside = _add(point, GPX_NAMESPACE, "extensions")
            for name, value in zip(SIGMAS, sigma, strict=True):
                _add(beside, OWN_NAMESPACE, name, f"{value:.4f}")
    ElementTree.ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)


def write_geojson(solution: Solution, path: str | Path, absolute_time: bool) -> None:
    """A FeatureCollection: the line, then every epoch as a point with its time, one sigma and heading."""
    coordinates = lla_of(solution)[:, [1, 0, 2]].tolist()
    columns: dict[str, Sequence[object]] = {
        "t_ns": solution.t_ns.tolist(),
        "elapsed_s": solution.seconds.tolist(),
        **_sigmas(solution),
        "heading_deg": solution.heading_pitch_roll_deg[:, 0].tolist(),
    }
    if absolute_time:
        columns["time"] = utc(solution.t_ns)
    about: dict[str, object] = {"name": "trajectory", "description": _description(solution, absolute_time)}
    features = [_feature("LineString", coordinates, about)]
    for place, *row in zip(coordinates, *columns.values(), strict=True):
        features.append(_feature("Point", place, dict(zip(columns, row, strict=True))))
    with open(path, "w", encoding="utf-8") as file:
        json.dump({"type": "FeatureCollection", "features": features}, file, allow_nan=False)


def _feature(kind: str, coordinates: object, properties: dict[str, object]) -> dict[str, object]:
    return {"type": "Feature", "geometry": {"type": kind, "coordinates": coordinates}, "properties": properties}


def lla_of(solution: Solution) -> Floats:
    """Latitude deg, longitude deg, ellipsoidal height m (n, 3) of a solution that has an origin."""
    assert solution.origin is not None  # checked by `export`
    return LocalFrame(solution.origin).lla_from_nav(solution.nav_t_body)


def warn_of_heights(solution: Solution, where: str) -> None:
    """Warn of heights that are not above the ellipsoid, for files that do not say so."""
    if solution.origin is not None and solution.heights != ELLIPSOIDAL:
        remedy = "for ellipsoidal heights give geoid_m in [sensors.NAME] of session.toml and smooth again"
        warn(f"{where}: heights are {solution.heights}, and are written as they are; {remedy}")


def utc(t_ns: Times) -> list[str]:
    """ISO 8601 in UTC of Unix nanoseconds, truncated to microseconds (which other programs read)."""
    text: list[str] = np.datetime_as_string(t_ns.astype("datetime64[ns]"), unit="us").tolist()
    return [f"{t}Z" for t in text]


def _sigmas(solution: Solution) -> dict[str, list[float | None]]:
    columns = dict(zip(SIGMAS, solution.sigmas[:, POS].T, strict=True))
    return {name: [x if np.isfinite(x) else None for x in values.tolist()] for name, values in columns.items()}


def _description(solution: Solution, absolute_time: bool) -> str:
    horizontal, vertical = np.hypot(*solution.sigmas[:, POS][:, :2].T), solution.sigmas[:, POS][:, 2]
    clock = "times are UTC" if absolute_time else "no absolute time: the session's clock has no Unix epoch"
    return (
        f"{len(solution)} epochs over {solution.seconds[-1] - solution.seconds[0]:.3f} s; {clock}; time zero is "
        f"{solution.t0_ns} ns on the session's clock; heights are {solution.heights}; one sigma horizontal: median "
        f"{np.median(horizontal):.3f} m, largest {horizontal.max():.3f} m; vertical: median "
        f"{np.median(vertical):.3f} m, largest {vertical.max():.3f} m"
    )
