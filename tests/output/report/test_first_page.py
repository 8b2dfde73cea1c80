"""What somebody who signs the report finds on it: dates, datum, heights, settings, control points, company."""

from __future__ import annotations

import base64
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from drive_case import T0, Drive
from lxml import html
from pyproj import Transformer

from smartnav_graph.core.errors import ConfigError, SessionError
from smartnav_graph.core.frames import ABOVE_SEA
from smartnav_graph.estimate.both_ways import BothWays
from smartnav_graph.estimate.config import Config, ReportConfig, RunConfig
from smartnav_graph.evaluation import evaluate
from smartnav_graph.graph.solution import Residuals
from smartnav_graph.output.report import write_report
from smartnav_graph.output.report.about import check_shown
from smartnav_graph.output.report.comparison import write_comparison_report
from smartnav_graph.output.report.control_points import control_rows
from smartnav_graph.output.report.statistics import statistics_table
from smartnav_graph.session.session import Mount, Session
from smartnav_graph.session.streams import ControlPoint, Reference

BEGUN = 1_748_772_000 * 10**9 - T0  # 2025-06-01 10:00 UTC
PIXEL = b"\x89PNG\r\n"  # what a picture holds is not looked at


def dated(case: Drive, epoch: str = "unix") -> dict[str, object]:
    """The drive on a clock with dates; GPS time is 18 s ahead and counts from 1980."""
    shift = BEGUN if epoch == "unix" else BEGUN - 315_964_800 * 10**9 + 18 * 10**9
    moved = replace(case.solution, t_ns=case.solution.t_ns + shift, t0_ns=case.solution.t0_ns + shift)
    return {"session": case.session.replace(clock_epoch=epoch, imu=None, gnss=None), "solution": moved}


def page(tmp_path: Path, case: Drive, config: Config | None = None, **changes):
    arguments = {
        "session": case.session,
        "solution": case.solution,
        "summary": case.summary,
    } | changes
    write_report(tmp_path / "r.html", config=config, **arguments)
    return html.fromstring((tmp_path / "r.html").read_text(encoding="utf-8"))


def facts(dom) -> dict[str, list[str]]:
    rows = dom.xpath('//section[@id="about"]//dl/div')
    return {row.findtext("dt"): [" ".join(dd.text.split()) for dd in row.findall("dd")] for row in rows}


@pytest.mark.parametrize("epoch", ["unix", "gps"])
def test_dates_in_utc_and_in_the_zone_that_is_given(tmp_path, case, epoch):
    found = facts(page(tmp_path, case, Config(report=ReportConfig(time_zone="Europe/Berlin")), **dated(case, epoch)))
    assert found["Date and time"] == ["2025-06-01 10:00:00 UTC", "2025-06-01 10:07:49 UTC"]
    assert found["Local time, Europe/Berlin"][0] == "2025-06-01 12:00:00 CEST (UTC+0200)"


def test_no_zone_and_no_date_are_guessed(tmp_path, case):
    assert facts(page(tmp_path, case, **dated(case)))["Local time"] == ["no time zone given (report.time_zone)"]
    assert "no date" in facts(page(tmp_path, case))["Date"][0]
    with pytest.raises(ConfigError, match=r"time_zone = 'Berlin'; expected a name of the time zone database"):
        ReportConfig(time_zone="Berlin")


def test_datum_and_heights(tmp_path, case):
    found = facts(page(tmp_path, case))
    assert found["Coordinates"][0] == "Geodetic datum of the inputs, taken as WGS 84"
    assert "49.011000" in found["Coordinates"][1] and found["Heights"] == ["Results: above the ellipsoid WGS 84"]
    sea = case.session.replace(sensors={"gnss": Mount(frame="msl", geoid_m=47.5)})
    assert facts(page(tmp_path, case, session=sea))["Heights"][1] == "GNSS: recorded above the sea, geoid at 47.50 m"
    unknown = page(tmp_path, case, solution=replace(case.solution, heights=ABOVE_SEA))
    assert facts(unknown)["Heights"] == ["Results: above mean sea level (geoid not known)"]
    assert "ellipsoid" not in unknown.text_content()
    local = page(tmp_path, case, session=Session(), solution=replace(case.solution, origin=None))
    assert "no geodetic datum" in facts(local)["Coordinates"][0]
    assert facts(local)["Heights"] == ["Results: above the local origin"]


def test_settings_in_full_and_those_that_were_changed(tmp_path, case):
    dom = page(tmp_path, case, Config(run=RunConfig(vehicle="car", withhold=("gnss:every=2",))))
    changed = {row.get("data-option"): row.findtext("td") for row in dom.xpath("//tr[@data-option]")}
    assert changed == {"run.vehicle": "car", "run.withhold": "gnss:every=2"}
    assert facts(dom)["Settings"] == ["run.vehicle = car", "run.withhold = gnss:every=2"]
    names = [node.text for node in dom.xpath('//dl[@class="options"]//dt')]
    assert len(names) > 80 and {"run.vehicle", "gnss.loss", "report.company"} <= set(names)
    assert facts(page(tmp_path, case, Config()))["Settings"] == ["all options at their defaults"]


def test_company_and_logo(tmp_path, case):
    (tmp_path / "logo.png").write_bytes(PIXEL)
    dom = page(tmp_path, case, Config(report=ReportConfig(company="Kurz & Lang", logo=str(tmp_path / "logo.png"))))
    (brand,) = dom.find_class("brand")
    assert brand.text_content() == "Kurz & Lang"
    assert brand.find("img").get("src") == f"data:image/png;base64,{base64.b64encode(PIXEL).decode()}"
    assert "Kurz & Lang" in dom.findtext(".//style").split("@bottom-left")[-1]  # on every printed page
    with pytest.raises(SessionError, match=r"gone\.png: cannot be read"):
        page(tmp_path, case, Config(report=ReportConfig(logo=str(tmp_path / "gone.png"))))
    with pytest.raises(ConfigError, match="expected a file of"):
        ReportConfig(logo="logo.exe")


@pytest.fixture
def surveyed(case) -> Drive:
    """Three points 1 m ahead of the IMU (body axes), given 0.1 m too far east; the second is withheld, the third
    rejected."""
    rows, lever = [40, 90, 140], np.array([1.0, 0.0, 0.0])
    at = case.solution.nav_t_body[rows] + case.solution.nav_R_body[rows] @ lever + [0.1, 0.0, 0.0]
    points = ControlPoint(
        t_ns=case.solution.t_ns[rows],
        enu=at,
        sigma=np.full((3, 3), 0.02),
        point_id=np.array(["A1", "B2", "C3"], dtype=object),
    )
    t_ns = case.solution.t_ns[[40, 40, 40, 140, 140, 140]]
    residuals = Residuals(
        t_ns=t_ns,
        sensor=np.array(["control"] * 6, dtype=object),
        axis=np.tile(np.arange(3), 2),
        whitened=np.zeros(6),
        weight=np.ones(6),
        used=np.repeat([True, False], 3),
    )
    session = case.session.replace(control=points, sensors={"control": Mount(body_t=(1.0, 0.0, 0.0))})
    return replace(case, session=session, solution=replace(case.solution, residuals=residuals))


def test_control_points_are_computed_less_given(tmp_path, surveyed):
    dom = page(tmp_path, surveyed)
    rows = dom.xpath("//tr[@data-point]")
    assert [(row.get("data-point"), row.get("data-use")) for row in rows] == [
        ("A1", "in"),
        ("B2", "withheld"),
        ("C3", "rejected"),
    ]
    found = [[float(row.get(f"data-d{axis}-m")) for axis in "enu"] for row in rows]
    assert found == [pytest.approx([-0.1, 0.0, 0.0], abs=1e-9)] * 3  # m
    (withheld,) = dom.xpath('//tr[@data-use="withheld" and @data-rms-horizontal-m]')
    assert float(withheld.get("data-rms-horizontal-m")) == pytest.approx(0.1)
    assert not dom.xpath('//section[@id="control"]//ul')  # 0.1 m, beside a sigma of 0.1 m
    names = dom.xpath('//section[@id="map"]//*[local-name()="text"][contains(@class, "name")]/text()')
    assert names == ["A1", "B2", "C3"]
    assert not page(tmp_path, replace(surveyed, session=surveyed.session.replace(control=None))).xpath(
        '//section[@id="control"]'
    )


def test_visits_close_to_one_another_are_told_apart(surveyed):
    """The visit at 70 s is withheld; those of 60 s and 130 s are 10 s and a median spacing away."""
    at, residuals = surveyed.solution.t_ns[[0, 60, 70, 130, 190, 250]], surveyed.solution.residuals
    ids = np.array(list("ABCDEF"), dtype=object)
    points = ControlPoint(t_ns=at, enu=np.zeros((6, 3)), sigma=np.ones((6, 3)), point_id=ids)
    kept = at[[0, 1, 3, 4, 5, 5]]
    kept[1] += 90_000  # ns: at the keyframe of another sensor
    used = np.array([True, True, False, True, True, False])
    residuals = replace(residuals, t_ns=kept, axis=np.zeros(6, dtype=int), used=used)
    session = surveyed.session.replace(control=points)
    rows = control_rows(session, replace(surveyed.solution, residuals=residuals), surveyed.summary)
    assert [row.use for row in rows] == ["in", "in", "withheld", "rejected", "in", "in"]
    there, _ = residuals.found_for("control", at)  # as the recording and the map ask
    assert there.tolist() == [True, True, False, True, True, True]


def test_a_withheld_point_far_off_is_named(tmp_path, surveyed):
    sure = replace(surveyed.solution, covariance=surveyed.solution.covariance / 100)
    (warning,) = page(tmp_path, surveyed, solution=sure).xpath('//section[@id="control"]//ul/li/strong/text()')
    assert warning == "Withheld, and more than 4 sigma off: B2 at 90.0 s"


def test_unknown_heights_have_no_difference(surveyed):
    sea = surveyed.session.replace(sensors={"control": Mount(body_t=(1.0, 0.0, 0.0), frame="msl")})
    (row, *_) = control_rows(sea, surveyed.solution, surveyed.summary)
    assert np.isnan(row.difference[2]) and row.difference[0] == pytest.approx(-0.1)


def test_control_points_in_a_national_system(tmp_path, surveyed):
    config = Config(report=ReportConfig(crs="EPSG:25832"))
    dom = page(tmp_path, surveyed, config)
    (first, *_) = dom.xpath("//tr[@data-point]")
    e, n, h = (float(cell.text.replace("\u202f", "")) for cell in first.findall("td")[-3:])
    lon, lat = Transformer.from_crs("EPSG:25832", "EPSG:4326", always_xy=True).transform(e, n)
    origin = surveyed.solution.origin
    given = surveyed.session.control.enu[0]
    assert (lon - origin.lon_deg) * 73_050 == pytest.approx(given[0], rel=0.01)  # m a degree at 49 deg north
    assert (lat - origin.lat_deg) * 111_200 == pytest.approx(given[1], rel=0.01)
    assert h - origin.height_m == pytest.approx(given[2], abs=0.2)  # curvature of the Earth
    assert "ETRS89 / UTM zone 32N" in facts(dom)["Coordinates"][-1]


def test_a_system_that_does_not_hold_there_is_seen_before_the_run(surveyed):
    check_shown(ReportConfig(crs="EPSG:25832"), surveyed.session)
    with pytest.raises(SessionError, match="geoid grid"):
        check_shown(ReportConfig(crs="EPSG:5555"), surveyed.session)


@pytest.mark.parametrize("epoch", ["unix", "gps", "boot"])
def test_pages_of_a_clock_with_dates_tell_utc(tmp_path, case, epoch):
    """The report of a comparison, and the begin in the summary table."""
    session, solution = dated(case, epoch).values()
    truth, about = Reference(t_ns=solution.t_ns, enu=solution.nav_t_body), {"session": {"clock_epoch": epoch}}
    found = evaluate(solution, truth)
    write_comparison_report(tmp_path / "c.html", "run", solution, truth, found, about)
    told = html.parse(tmp_path / "c.html").getroot().find("body").get("data-utc-ms")
    assert told == (None if epoch == "boot" else "1748772000000")
    assert ("2025-06-01 10:00:00" in statistics_table(session, solution, {}).html()) == (epoch != "boot")


def test_forward_and_backward_are_compared(tmp_path, case):
    sigma = np.full((len(case.solution), 3), 0.5)
    ways = BothWays(case.solution.t_ns, np.tile([0.3, -0.4, 1.2], (len(sigma), 1)), sigma)
    (found,) = page(tmp_path, case, ways=ways).xpath('//section[@id="both-ways"]')
    assert "RMS east 0.300 m, north 0.400 m, up 1.20 m; 66.7 % inside two sigma" in found.text_content()
    none = BothWays(*(values[:0] for values in (ways.t_ns, ways.difference, ways.sigma)))
    for without in (None, none):
        assert not page(tmp_path, case, ways=without).xpath('//section[@id="both-ways"]')
