"""Every format is read back by somebody else's parser."""

from __future__ import annotations

import csv
import dataclasses
import json
import re
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest
from lxml import etree
from scipy.spatial.transform import Rotation

from smartnav_graph.core import frames
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.frames import LocalFrame, Origin
from smartnav_graph.graph.solution import Solution
from smartnav_graph.output.export import FORMATS, export, write_trajectory_csv
from smartnav_graph.output.export.geographic import GPX_NAMESPACE, MARKS, OWN_NAMESPACE
from smartnav_graph.readers.reference import load_reference

ORIGIN = Origin(48.9825, 8.3904, 116.3)
T0 = 1_748_772_000_123_456_789
UTC0 = "2025-06-01T10:00:00.123456Z"
KML = {"k": "http://www.opengis.net/kml/2.2", "gx": "http://www.google.com/kml/ext/2.2"}


def make_solution(n: int = 40, origin: Origin | None = ORIGIN) -> Solution:
    rng = np.random.default_rng(7)
    t = np.arange(n)
    return Solution(
        t_ns=T0 + t * 300_000_001,
        nav_R_body=Rotation.from_euler("zyx", 0.1 * rng.normal(size=(n, 3)) + [2.0, 0.0, 0.0]).as_matrix(),
        nav_t_body=np.cumsum(rng.normal(size=(n, 3)), axis=0),
        nav_v_body=rng.normal(size=(n, 3)),
        accel_bias=np.zeros((n, 3)),
        gyro_bias=np.zeros((n, 3)),
        covariance=np.broadcast_to(np.diag(np.r_[np.full(3, 1e-4), 0.09, 0.16, 4.0, np.ones(9)]), (n, 15, 15)),
        t0_ns=T0,
        origin=origin,
    )


@pytest.fixture
def solution() -> Solution:
    return make_solution()


@pytest.fixture
def lla(solution) -> np.ndarray:
    return LocalFrame(solution.origin).lla_from_nav(solution.nav_t_body)


def test_tum_stamps_are_exact_and_poses_read_back(solution, tmp_path):
    export(solution, "tum", tmp_path / "a.tum")
    rows = [line.split() for line in (tmp_path / "a.tum").read_text().splitlines()]
    assert rows[0][0] == "1748772000.123456789"
    assert [int(Decimal(row[0]) * 10**9) for row in rows] == solution.t_ns.tolist()
    values = np.array([[float(x) for x in row[1:]] for row in rows])
    assert np.array_equal(values[:, :3], solution.nav_t_body)
    assert np.allclose(Rotation.from_quat(values[:, 3:]).as_matrix(), solution.nav_R_body, atol=1e-15)


def test_tum_before_time_zero_of_a_clock(solution, tmp_path):
    early = dataclasses.replace(solution, t_ns=solution.t_ns - T0 - 1_500_000_000)
    export(early, "tum", tmp_path / "a.tum")
    assert (tmp_path / "a.tum").read_text().startswith("-1.500000000 ")


def test_tum_is_read_back_as_a_reference(solution, tmp_path):
    export(solution, "tum", tmp_path / "a.tum")
    path = load_reference(tmp_path / "a.tum")
    assert np.array_equal(path.t_ns, solution.t_ns)
    assert np.array_equal(path.enu, solution.nav_t_body)
    assert np.abs(np.sum(path.quat * solution.quat_wxyz, axis=1)) == pytest.approx(1.0)


def test_csv_is_trajectory_csv(solution, tmp_path):
    export(solution, "csv", tmp_path / "a.csv")
    with open(tmp_path / "a.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert ",".join(rows[0]) == (
        "t_ns,e_m,n_m,u_m,lat_deg,lon_deg,height_m,qw,qx,qy,qz,ve_m_s,vn_m_s,vu_m_s,"
        "heading_deg,pitch_deg,roll_deg,sigma_e_m,sigma_n_m,sigma_u_m,sigma_heading_deg"
    )
    for name, values in solution.trajectory_columns().items():
        kind = int if name == "t_ns" else float
        assert [kind(row[name]) for row in rows] == values.tolist(), name  # every bit


def test_csv_leaves_the_unknown_empty(tmp_path):
    write_trajectory_csv(make_solution(origin=None), tmp_path / "trajectory.csv")
    with open(tmp_path / "trajectory.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert {row[name] for row in rows for name in ("lat_deg", "lon_deg", "height_m")} == {""}
    assert all(row["e_m"] for row in rows)


def test_csv_of_a_long_run_is_fast(tmp_path):
    import time

    long = make_solution(25_000)
    start = time.process_time()
    write_trajectory_csv(long, tmp_path / "trajectory.csv")
    assert time.process_time() - start < 2.0  # s; measured 0.1, a Python loop over the cells takes several


def test_kml_track_with_time_and_sigma(solution, lla, tmp_path):
    export(solution, "kml", tmp_path / "a.kml", clock_epoch="unix")
    tree = etree.parse(str(tmp_path / "a.kml"))
    coordinates = [[float(x) for x in node.text.split()] for node in tree.iterfind(".//gx:Track/gx:coord", KML)]
    assert np.array_equal(np.array(coordinates)[:, [1, 0, 2]], lla)
    when = [node.text for node in tree.iterfind(".//gx:Track/k:when", KML)]
    assert when[0] == UTC0 and len(when) == len(solution)
    arrays = {node.get("name"): node for node in tree.iterfind(".//gx:SimpleArrayData", KML)}
    assert [float(v.text) for v in arrays["sigma_n_m"].iterfind("gx:value", KML)] == pytest.approx([0.4] * 40)
    description = tree.findtext(".//k:Document/k:description", namespaces=KML)
    assert "one sigma horizontal: median 0.500 m" in description and "vertical: median 2.000 m" in description
    assert tree.findtext(".//gx:Track/k:altitudeMode", namespaces=KML) == "absolute"


def test_kml_without_absolute_time_is_a_line_that_says_so(solution, lla, tmp_path):
    export(solution, "kml", tmp_path / "a.kml", clock_epoch="boot")
    tree = etree.parse(str(tmp_path / "a.kml"))
    text = tree.findtext(".//k:LineString/k:coordinates", namespaces=KML).split()
    assert np.array_equal(np.array([[float(x) for x in c.split(",")] for c in text])[:, [1, 0, 2]], lla)
    assert tree.find(".//k:when", KML) is None
    assert "no absolute time" in tree.findtext(".//k:Document/k:description", namespaces=KML)


def test_gpx_reads_back(solution, lla, tmp_path):
    export(solution, "gpx", tmp_path / "a.gpx", clock_epoch="unix")
    tree = etree.parse(str(tmp_path / "a.gpx"))
    ns = {"g": GPX_NAMESPACE}
    points = tree.findall(".//g:trk/g:trkseg/g:trkpt", ns)
    values = [[float(p.get("lat")), float(p.get("lon")), float(p.findtext("g:ele", namespaces=ns))] for p in points]
    assert np.abs(np.array(values) - lla)[:, :2].max() < 1e-10  # deg, 0.01 mm
    assert np.abs(np.array(values) - lla)[:, 2].max() < 1e-4  # m
    assert points[0].findtext("g:time", namespaces=ns) == UTC0


def test_gpx_is_read_by_gpxpy(solution, lla, tmp_path):
    gpxpy = pytest.importorskip("gpxpy")
    export(solution, "gpx", tmp_path / "a.gpx", clock_epoch="unix")
    points = gpxpy.parse((tmp_path / "a.gpx").read_text()).tracks[0].segments[0].points
    assert [p.latitude for p in points] == pytest.approx(lla[:, 0], abs=1e-10)
    assert [p.time.timestamp() for p in points] == pytest.approx(solution.t_ns / 1e9, abs=2e-6)


def test_gpx_without_absolute_time(solution, tmp_path):
    export(solution, "gpx", tmp_path / "a.gpx", clock_epoch="gps")
    text = (tmp_path / "a.gpx").read_text()
    assert "<time>" not in text and "no absolute time" in text


# Of the GPX 1.1 schema (TopoGrafix, gpx.xsd): the children of the elements that a track needs, in their order.
GPX_CHILDREN = {
    "gpx": "metadata wpt rte trk extensions",
    "trk": "name cmt desc src link number type extensions trkseg",
    "trkseg": "trkpt extensions",
    "trkpt": "ele time magvar geoidheight name cmt desc src link sym type fix sat hdop vdop pdop ageofdgpsdata dgpsid "
    "extensions",
}
GPX_SEVERAL = {"wpt", "rte", "trk", "trkseg", "trkpt", "link"}


def gpx_faults(path: Path) -> list[str]:
    """What the schema forbids in a file with one track."""
    root, faults = etree.parse(str(path)).getroot(), []
    if root.tag != f"{{{GPX_NAMESPACE}}}gpx" or root.get("version") != "1.1" or not root.get("creator"):
        faults.append(f"root {root.tag} {dict(root.attrib)}")
    for parent in root.iter(*(f"{{{GPX_NAMESPACE}}}{name}" for name in GPX_CHILDREN)):
        order = GPX_CHILDREN[etree.QName(parent).localname].split()
        children = [etree.QName(child) for child in parent]
        names = [child.localname for child in children if child.namespace == GPX_NAMESPACE]
        known = len(names) == len(children) and set(names) <= set(order)
        single = [name for name in names if name not in GPX_SEVERAL]
        if not known or sorted(names, key=order.index) != names or len(set(single)) != len(single):
            faults.append(f"{parent.tag}: {[str(child) for child in children]}")
    for point in root.iter(f"{{{GPX_NAMESPACE}}}trkpt"):
        if not (-90 <= float(point.get("lat")) <= 90 and -180 <= float(point.get("lon")) < 180):
            faults.append(f"trkpt {dict(point.attrib)}")
        faults += [
            node.text for node in point.iter(f"{{{GPX_NAMESPACE}}}ele") if not re.fullmatch(r"-?[\d.]+", node.text)
        ]
    for time in root.iter(f"{{{GPX_NAMESPACE}}}time"):
        if not re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(\.\d+)?Z", time.text):
            faults.append(f"time {time.text}")
    return faults


def test_gpx_is_valid_and_carries_sigmas(solution, tmp_path):
    for epoch in ("unix", "boot"):
        export(solution, "gpx", tmp_path / "a.gpx", clock_epoch=epoch, force=True)
        assert gpx_faults(tmp_path / "a.gpx") == []
    text = (tmp_path / "a.gpx").read_text()
    sigma = etree.fromstring(text.encode()).iterfind(f".//{{{OWN_NAMESPACE}}}sigma_n_m")
    assert [float(node.text) for node in sigma] == [0.4] * 40


@pytest.mark.parametrize(
    ("written", "broken"),
    [
        (r"<(/?)ele>", r"<\1height>"),
        (r"(<ele>.*?</ele>)\s*(<time>.*?</time>)", r"\2\1"),
        (r'lat="', 'lat="9'),
        (r"(<time>\S*?)Z", r"\1"),
        (r"(<ele>.*?</ele>)", r"\1\1"),
    ],
)
def test_faults_of_gpx_are_seen(solution, tmp_path, written, broken):
    export(solution, "gpx", tmp_path / "a.gpx", clock_epoch="unix")
    text, count = re.subn(written, broken, (tmp_path / "a.gpx").read_text())
    assert count
    (tmp_path / "b.gpx").write_text(text)
    assert gpx_faults(tmp_path / "b.gpx")


def kml_schema() -> etree.XMLSchema:
    """KML 2.2 with Google's extensions."""
    fastkml = pytest.importorskip("fastkml")
    return etree.XMLSchema(etree.parse(str(Path(fastkml.__file__).parent / "schema" / "kml22gx.xsd")))


@pytest.mark.parametrize("epoch", ["unix", "boot"])
def test_kml_keeps_to_its_schema(solution, epoch, tmp_path):
    schema = kml_schema()
    export(solution, "kml", tmp_path / "a.kml", clock_epoch=epoch)
    tree = etree.parse(str(tmp_path / "a.kml"))
    schema.assertValid(tree)
    for node in tree.iter(f"{{{KML['k']}}}name"):
        node.tag = f"{{{KML['k']}}}label"
    assert not schema.validate(tree)  # the schema does see a fault


def test_kml_tells_epochs_one_by_one(tmp_path):
    solution = make_solution(1000)
    export(solution, "kml", tmp_path / "a.kml", clock_epoch="unix")
    tree = etree.parse(str(tmp_path / "a.kml"))
    points = tree.findall(".//k:Folder/k:Placemark", KML)
    assert len(points) == MARKS
    last = {node.get("name"): float(node.findtext("k:value", namespaces=KML)) for node in points[-1].iter("{*}Data")}
    assert last["elapsed_s"] == pytest.approx(solution.seconds[-1], abs=1e-3)
    assert (last["sigma_e_m"], last["sigma_n_m"], last["sigma_u_m"]) == (0.3, 0.4, 2.0)
    assert last["heading_deg"] == pytest.approx(solution.heading_pitch_roll_deg[-1, 0], rel=1e-5)
    assert points[0].findtext("k:TimeStamp/k:when", namespaces=KML) == UTC0


@pytest.fixture
def fiona():
    """OGR, which QGIS reads with."""
    module = pytest.importorskip("fiona")
    module.drvsupport.supported_drivers["KML"] = "r"
    return module


def test_kml_line_is_read_by_ogr(solution, lla, fiona, tmp_path):
    export(solution, "kml", tmp_path / "a.kml", clock_epoch="boot")
    (layer,) = [name for name in fiona.listlayers(tmp_path / "a.kml") if name != "epochs"]
    with fiona.open(tmp_path / "a.kml", layer=layer) as rows:
        assert rows.driver == "KML"
        (row,) = rows
    assert np.array_equal(np.array(row.geometry["coordinates"])[:, [1, 0, 2]], lla)


def test_kml_track_has_its_epochs_in_ogr(solution, lla, fiona, tmp_path):
    export(solution, "kml", tmp_path / "a.kml", clock_epoch="unix")
    with fiona.open(tmp_path / "a.kml", layer="epochs") as rows:
        assert np.array_equal(np.array([r.geometry["coordinates"] for r in rows])[:, [1, 0, 2]], lla)


def test_gpx_is_read_by_ogr(solution, lla, fiona, tmp_path):
    export(solution, "gpx", tmp_path / "a.gpx", clock_epoch="unix")
    with fiona.open(tmp_path / "a.gpx", layer="tracks") as rows:
        (row,) = rows
    assert np.abs(np.array(row.geometry["coordinates"][0])[:, [1, 0]] - lla[:, :2]).max() < 1e-9  # deg, 0.1 mm
    with fiona.open(tmp_path / "a.gpx", layer="track_points") as rows:
        points = list(rows)
    assert [p.properties["ele"] for p in points] == pytest.approx(lla[:, 2], abs=1e-4)  # m
    assert points[0].properties["time"].startswith("2025-06-01T10:00:00")


def test_geojson_is_read_by_ogr_epoch_by_epoch(solution, lla, fiona, tmp_path):
    export(solution, "geojson", tmp_path / "a.geojson", clock_epoch="unix")
    with fiona.open(tmp_path / "a.geojson") as rows:
        features = list(rows)
    line, *points = features
    assert np.array_equal(np.array(line.geometry["coordinates"])[:, [1, 0, 2]], lla)
    assert np.array_equal(np.array([p.geometry["coordinates"] for p in points])[:, [1, 0, 2]], lla)
    assert [p.properties["t_ns"] for p in points] == solution.t_ns.tolist()
    assert [p.properties["elapsed_s"] for p in points] == solution.seconds.tolist()
    assert {p.properties["sigma_u_m"] for p in points} == {2.0}
    assert str(points[0].properties["time"]).startswith("2025-06-01T10:00:00.123")


def test_geojson_without_absolute_time(solution, tmp_path):
    export(solution, "geojson", tmp_path / "b.geojson")
    line, first, *_ = json.loads((tmp_path / "b.geojson").read_text())["features"]
    assert "time" not in first["properties"]
    assert "no absolute time" in line["properties"]["description"]


def test_geojson_of_an_unknown_covariance_is_valid_json(solution, tmp_path):
    blind = dataclasses.replace(solution, covariance=np.full((40, 15, 15), np.nan))
    export(blind, "geojson", tmp_path / "a.geojson")
    _, *points = json.loads((tmp_path / "a.geojson").read_text())["features"]
    assert {point["properties"]["sigma_e_m"] for point in points} == {None}


@pytest.mark.parametrize("format", ["kml", "gpx", "geojson"])
def test_geographic_formats_need_an_origin(format, tmp_path):
    with pytest.raises(SessionError, match=rf"--format {format}: .*no origin.*add lat_deg, lon_deg, height_m"):
        export(make_solution(origin=None), format, tmp_path / "a")
    assert list(tmp_path.iterdir()) == []


def test_unknown_format(solution, tmp_path):
    with pytest.raises(SessionError, match="--format: 'shp'; expected one of tum, kml, geojson, gpx, csv"):
        export(solution, "shp", tmp_path / "a")


@pytest.mark.parametrize("format", FORMATS)
def test_nothing_existing_is_overwritten_without_force(solution, format, tmp_path):
    path = tmp_path / f"a.{format}"
    path.write_text("precious")
    with pytest.raises(SessionError, match="exists already"):
        export(solution, format, path)
    assert path.read_text() == "precious"
    export(solution, format, path, force=True, clock_epoch="unix")
    assert path.read_bytes() != b"precious"


@pytest.mark.parametrize("format", ["kml", "gpx", "geojson"])
def test_a_failure_midway_leaves_the_old_file(solution, format, tmp_path, monkeypatch):
    (tmp_path / "a").write_text("precious")

    def broken(self, enu):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(frames.LocalFrame, "lla_from_nav", broken)
    with pytest.raises(SessionError, match=r"could not be written \(No space left on device\)"):
        export(solution, format, tmp_path / "a", force=True)
    assert [p.name for p in tmp_path.iterdir()] == ["a"] and (tmp_path / "a").read_text() == "precious"
