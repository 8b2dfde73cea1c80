"""What a reader, or a script that reads the DOM, finds in the report."""

from __future__ import annotations

import base64
import hashlib
import re
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from drive_case import GAPS, REJECTED, Scored, drive, summary
from lxml import html
from scipy.spatial.transform import Rotation

from smartnav_graph.core.errors import SessionError
from smartnav_graph.graph.solution import Residuals, Solution
from smartnav_graph.output.report import facts, reference, report_markdown, write_report
from smartnav_graph.output.report.statistics import accelerations
from smartnav_graph.output.report.template import whole_page
from smartnav_graph.output.report.timeline import lanes
from smartnav_graph.session.session import Session
from smartnav_graph.session.streams import Imu


@pytest.fixture(scope="module")
def dom(page):
    return html.fromstring(page.read_text(encoding="utf-8"))


def words(node) -> str:
    return " ".join(" ".join(node.itertext()).split()).replace("\u202f", " ")


def written(tmp_path: Path, case, **changes):
    arguments = {"session": case.session, "solution": case.solution, "summary": case.summary} | changes
    write_report(tmp_path / "report.html", **arguments)
    return html.fromstring((tmp_path / "report.html").read_text(encoding="utf-8"))


def section(dom, name: str):
    return dom.get_element_by_id(name)


def test_headline_says_what_happened(dom) -> None:
    text = words(section(dom, "headline"))
    assert "The recording of 7 min 49 s over 4.32 km was smoothed in one batch at 470 epochs." in text
    assert "Rejected as outliers: GNSS 4. IMU data gaps: 4, 7.1 s in all." in text
    assert "Withheld GNSS: 235 measurements, RMS difference 0.284 m (horizontal)." in text


def test_position_sigma_at_300_s_is_that_of_the_covariance(dom, case) -> None:
    node = section(dom, "sigma-at")
    e, n = np.sqrt(np.diag(case.solution.covariance[300])[3:5])
    assert float(node.get("data-t-s")) == 300.0
    assert float(node.get("data-sigma-e-m")) == pytest.approx(e, rel=1e-9)
    assert float(node.get("data-sigma-horizontal-m")) == pytest.approx(np.hypot(e, n), rel=1e-9)
    assert f"Position, 1 sigma at t = 300 s: {np.hypot(e, n):.3f} m horizontal" in words(node)


def test_sigma_of_a_short_run_is_at_its_middle(tmp_path) -> None:
    case = drive(61)
    node = section(written(tmp_path, case), "sigma-at")
    assert float(node.get("data-t-s")) == 30.0
    assert words(node).startswith("Position, 1 sigma at t = 30 s:")


def test_imu_data_gaps(dom) -> None:
    node = section(dom, "imu-gaps")
    found = [
        (float(h.get("data-start-s")), float(h.get("data-length-s")), h.get("data-kind"))
        for h in node.find_class("imu-gap")
    ]
    assert node.get("data-count") == "4"
    assert found == GAPS
    assert "IMU data gap at 36.4 s, 1.59 s, linearly interpolated" in words(node)
    assert "IMU data gap at 307.8 s, 2.41 s, no samples" in words(node)


def test_used_rejected_dropped_withheld(dom) -> None:
    (row,) = section(dom, "used").xpath('.//tr[@data-sensor="gnss"]')
    assert (row.get("data-rejected"), row.get("data-used"), row.get("data-dropped")) == ("4", "231", "2")
    assert [words(c) for c in row] == ["GNSS", "470", "231", "4", "235", "2", "1.11"]
    (row,) = section(dom, "withheld").xpath(".//tr[@data-withheld]")
    assert (row.get("data-withheld"), row.get("data-rms-horizontal-m")) == ("235", "0.284")


def test_withheld_errors_are_shown_one_by_one(dom, case) -> None:
    horizontal = np.linalg.norm(case.withheld["gnss"].error[:, :2], axis=1)
    assert f"95 %: {np.percentile(horizontal, 95):.3f} m" in words(section(dom, "withheld"))
    (dots,) = section(dom, "withheld").xpath('.//svg[@class="box"]/path[contains(@class, "withheld")]/@d')
    assert dots.count("M") == len(horizontal)


def test_a_heading_through_north_is_one_line(tmp_path, case) -> None:
    """A drive that wavers about north: one line on an axis around 0, its labels headings."""
    turn = np.radians(90 - 6 * np.sin(case.solution.seconds / 30))
    wavering = Rotation.from_rotvec(turn[:, None] * [0.0, 0.0, 1.0]).as_matrix()
    dom = written(tmp_path, case, solution=replace(case.solution, nav_R_body=wavering))
    heading = section(dom, "attitude").xpath('.//svg[contains(@class, "plot")]')[0]
    labels = heading.xpath('./*[local-name()="text"][@class="tick ty"]/text()')
    assert "0" in labels and "355" in labels
    (line,) = heading.xpath('.//path[contains(@class, "line")]/@d')
    assert line.count("M") == 1


def test_percentiles_lie_on_the_curve(tmp_path, case) -> None:
    few = {
        "control": Scored(case.solution.t_ns[:5], np.array([[3.0, 0, 0], [1, 0, 0], [0, 2, 0], [4, 0, 0], [0, 5, 0]]))
    }
    score = {"control": {"count": 5, "rms_horizontal_m": 3.317}}
    dom = written(tmp_path, case, summary=summary() | {"withheld": score}, withheld=few)
    text = words(section(dom, "withheld"))
    assert "50 %: 3.00 m" in text and "5 withheld measurements (Control points)." in text
    (plot,) = section(dom, "withheld").xpath('.//svg[contains(@aria-label, "Cumulative")]')
    (curve,) = plot.xpath('.//path[contains(@class, "s0")]/@d')
    (pick, *_) = plot.xpath('.//path[contains(@class, "pick")]/@d')
    steps = np.array([[float(x) for x in p.split(",")] for p in re.sub(r"(?<=\d)-", ",-", curve.split("l")[1]).split()])
    start = np.array([float(x) for x in re.match(r"M(\d+) (\d+)", curve).groups()])
    where = np.array([float(x) for x in re.match(r"M(\d+) (\d+)", pick).groups()])
    assert start + steps[:2].sum(axis=0) == pytest.approx(where, abs=2)  # drawing units


def test_map_marks_the_rejected_fixes_where_they_are(dom, case) -> None:
    from smartnav_graph.output.report.track import fix_states

    xy, state = fix_states(case.session, case.solution)["gnss"]
    assert np.flatnonzero(state == "rejected").tolist() == list(REJECTED)
    (marks,) = section(dom, "map").xpath('.//svg[@class="box"]/path[contains(@class, "fix-rejected")]')
    east = np.array([float(m) for m in re.findall(r"M(\d+)", marks.get("d"))])
    span = (east[3] - east[0]) / 10_000  # drawing units to shares of the width
    assert np.sign(span) == np.sign(xy[301, 0] - xy[50, 0])


def test_reference_errors_are_tabled_with_percentiles(dom, case) -> None:
    (row,) = section(dom, "reference").xpath('.//tr[@data-error="ape_m"]')
    assert float(row.get("data-rmse")) == case.evaluation.to_dict()["ape_m"]["rmse"]
    text = words(section(dom, "reference"))
    assert "Compared with truth.csv at 470 epochs after yaw alignment, 4 epochs of it outside the run." in text
    horizontal = np.linalg.norm(case.evaluation.error_enu_m[:, :2], axis=1)
    assert f"67 %: {np.percentile(horizontal, 67):.3f} m" in text
    assert "Yaw 1.10 1" in words(section(dom, "reference").xpath(".//table")[2])


def test_sections_are_in_reading_order(dom) -> None:
    ids = [node.get("id") for node in dom.xpath("//header | //section")]
    assert ids == [
        *(
            "headline",
            "map",
            "about",
            "warnings",
            "timeline",
            "statistics",
            "used",
            "imu-gaps",
            "uncertainty",
            "motion",
            "attitude",
        ),
        *(
            "biases",
            "residuals",
            "updates",
            "withheld",
            "reference",
            "states",
            "start",
            "solver",
            "timings",
            "versions",
        ),
    ]


def test_foreign_text_is_escaped_and_nothing_is_fetched(page) -> None:
    text = page.read_text(encoding="utf-8")
    assert "&lt;b&gt;missing&lt;/b&gt; &amp; assumed" in text
    assert not re.search(r"https?:|src=|href=.(?!#)|url\(|@import", text)


def test_the_only_script_is_allowed_by_its_hash(page, tmp_path) -> None:
    (script,) = re.findall(r"<script>(.*?)</script>", page.read_text(encoding="utf-8"), re.DOTALL)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}'" in page.read_text(encoding="utf-8")
    assert "<script" not in whole_page("plain", "", "<p>no plots over time</p>")


def test_statistics_of_motion_and_imu(dom, case) -> None:
    text = words(section(dom, "statistics"))
    speed = np.linalg.norm(case.solution.nav_v_body, axis=1)
    rate = np.degrees(np.linalg.norm(case.session.imu.gyro, axis=1))
    assert f"{speed.max():.1f} m/s" in text
    assert f"{rate.max():.1f} °/s at {rate.argmax() * 0.02:.1f} s" in text
    assert "Standstills 2 stops, 21.5 s in all Of these completely at rest 14.0 s" in text
    slow = np.diff(case.solution.seconds)[(speed[1:] < 0.1) & (speed[:-1] < 0.1)].sum()
    assert f"Slower than 0.1 m/s {slow:.1f} s" in text


def test_date_and_place_as_far_as_known(tmp_path, case) -> None:
    begun = 1_748_772_000 * 10**9 - case.solution.t0_ns  # 2025-06-01 10:00
    later = replace(case.solution, t_ns=case.solution.t_ns + begun, t0_ns=case.solution.t0_ns + begun)
    unix = case.session.replace(clock_epoch="unix", imu=None, gnss=None)
    text = words(section(written(tmp_path, case, session=unix, solution=later), "statistics"))
    assert "Begin (UTC) 2025-06-01 10:00:00" in text
    assert "Origin of east, north, up 49.011000° N, 8.422800° E, 112.8 m" in text
    text = words(section(written(tmp_path, case, solution=replace(case.solution, origin=None)), "statistics"))
    assert "Begin" not in text and "Origin" not in text


def test_acceleration_is_over_ground() -> None:
    """A body on its side that is pushed north with 2 m/s^2, its accelerometer biased."""
    turned, bias = Rotation.from_euler("x", 90, degrees=True), np.array([0.1, -0.2, 0.3])
    t_ns = np.arange(5) * 10**9
    still = {name: np.zeros((5, 3)) for name in ("nav_t_body", "nav_v_body", "gyro_bias")}
    solution = Solution(
        t_ns=t_ns,
        nav_R_body=np.tile(turned.as_matrix(), (5, 1, 1)),
        accel_bias=np.tile(bias, (5, 1)),
        covariance=np.zeros((5, 15, 15)),
        t0_ns=0,
        **still,
    )
    force = turned.inv().apply([0.0, 2.0, 9.81]) + bias
    at = np.array([500_000_000, 3_200_000_000])
    imu = Imu(t_ns=at, gyro=np.zeros((2, 3)), accel=np.tile(force, (2, 1)))
    assert accelerations(imu, solution, 9.81) == pytest.approx([2.0, 2.0], abs=1e-9)  # m/s^2


def test_no_standstill_is_reported(tmp_path, case) -> None:
    none = summary() | {"standstills": {"count": 0, "total_s": 0.0, "at_rest_s": 0.0, "spans_s": []}}
    assert "Standstills none detected" in words(section(written(tmp_path, case, summary=none), "statistics"))


def test_image_pairs_by_outcome(dom) -> None:
    text = words(section(dom, "used"))
    assert "100 image pairs Count Share In use 60 60 % Insufficient baseline 39 39 %" in text
    assert "Inconsistent with the other sensors 1 1.0 %" in text


def test_constraints_are_listed_apart_from_sensors(dom) -> None:
    (row,) = section(dom, "used").xpath('.//tr[@data-model="vehicle"]')
    assert [words(c) for c in row] == ["Vehicle constraint", "460", "wheels move neither sideways nor off the road"]
    assert not section(dom, "used").xpath('.//tr[@data-sensor="vehicle"]')


def test_longest_time_without_a_fix(tmp_path, case) -> None:
    r = case.solution.residuals
    late = r.of("gnss") & (r.t_ns > case.solution.t0_ns + 200 * 10**9) & (r.t_ns < case.solution.t0_ns + 263 * 10**9)
    dom = written(tmp_path, case, solution=replace(case.solution, residuals=replace(r, used=r.used & ~late)))
    node = dom.get_element_by_id("outage")
    assert (float(node.get("data-start-s")), float(node.get("data-length-s"))) == (200.0, 64.0)
    assert words(node) == "Longest time without a position in use (GNSS): 64.0 s, from t = 200.0 s."


def test_clocks_mounts_and_noise_one_number_a_row(dom) -> None:
    node = section(dom, "states")
    rows = {words(row[0]): [words(cell) for cell in row[1:]] for row in node.xpath(".//tbody/tr")}
    assert rows["GNSS time offset [s]"] == ["0.0612", "0.00310", "estimated"]
    assert rows["GNSS lever arm, y [m]"] == ["−0.310", "–", "fixed"]
    assert rows["Vehicle mount, pitch [°]"] == ["−0.441", "0.0516", "estimated"]  # of -0.0077 rad
    assert rows["Rear axle, left of the IMU [m]"] == ["−0.270", "1.45", "not observable (prior only)"]
    assert rows["GNSS 1 sigma, up [m]"] == ["1.20", "–", "estimated"]
    sentences = [words(p) for p in node.find_class("clock")]
    assert sentences == [
        "GNSS: measured 61 ms later than the time stamp (1 sigma 3.1 ms).",
        "Images: measured 4.0 ms earlier than the time stamp (1 sigma 0.50 ms).",
    ]


def test_timeline_has_a_lane_for_what_there_was(dom, case) -> None:
    names = [words(t) for t in section(dom, "timeline").xpath('.//*[local-name()="text"][contains(@class, "note")]')]
    assert names == ["GNSS in use, 4 rejected", "GNSS withheld", "Standstills", "IMU data gaps"]
    lanes = section(dom, "timeline").xpath('.//svg[@class="box"]/path[contains(@class, "lane")]')
    gaps = [p for p in lanes if "imu-gap" in p.get("class")]
    starts = [float(re.match(r"M(\d+)", p.get("d"))[1]) / 10_000 * 469 for p in gaps]
    assert starts == pytest.approx([h[0] for h in GAPS], abs=0.05)  # s, half a drawing unit
    assert len([p for p in lanes if "out" in p.get("class")]) == len(REJECTED)


def test_a_rejection_at_the_time_of_a_used_one_is_on_the_timeline(case) -> None:
    rejections = [{"t_s": 7.0, "sensor": "gnss"}, {"t_s": 8.0, "sensor": "gnss"}, {"t_s": 8.0, "sensor": "gnss"}]
    assert 8 not in REJECTED  # something of that time is in use
    (lane, *_) = lanes(case.solution, summary() | {"rejections": rejections, "rejected": {"gnss": 3}}, [], {})
    assert lane.name == "GNSS in use, 3 rejected"
    np.testing.assert_array_equal(lane.out, [7.0, 8.0])


def test_the_total_of_a_report_says_that_writing_is_not_in_it() -> None:
    known = {"solve": 1.0, "total": 1.2}
    assert [facts.timing_name(name, known) for name in known] == ["Solve", "Total, without writing"]
    assert facts.timing_name("total", known | {"write": 0.5}) == "Total"


def test_too_many_rejections_are_a_warning(tmp_path, case) -> None:
    bad = summary() | {"used": {"gnss": 300}, "rejected": {"gnss": 170}}
    assert "GNSS: 170 of 470 measurements rejected, too many for outliers" in words(
        section(written(tmp_path, case, summary=bad), "warnings")
    )
    assert "too many" not in words(section(written(tmp_path, case), "warnings"))


def test_many_rejections_in_a_row_are_a_warning(tmp_path, case) -> None:
    r = case.solution.residuals
    end = r.of("gnss") & (r.t_ns >= case.solution.t0_ns + 440 * 10**9)
    dom = written(tmp_path, case, solution=replace(case.solution, residuals=replace(r, used=r.used & ~end)))
    assert (
        "GNSS: 15 measurements in a row rejected, from 440.0 s to 468.0 s; outliers are not that many in a row"
        in words(section(dom, "warnings"))
    )
    assert "in a row" not in words(section(written(tmp_path, case), "warnings"))


def test_errors_far_beyond_the_sigmas_are_a_sentence(tmp_path, case) -> None:
    table = case.evaluation.to_dict()
    assert "After alignment it is not meaningful" in reference.nees_sentence(table)
    text = reference.nees_sentence(table | {"align": "none", "nees": {"position": 75.0, "attitude": 3.1}})
    assert "position errors are 5.0 times their sigma. Either the sigmas are too small" in text
    assert "attitude" not in text
    assert "as large as the errors" in reference.nees_sentence(table | {"align": "none"})


def test_noise_set_too_large_is_reported_without_a_warning(tmp_path, case) -> None:
    small = summary() | {"chi2_per_dof": {"overall": 0.18, "imu": 0.06, "gnss": 1.1}, "warnings": []}
    dom = written(tmp_path, case, summary=small)
    assert "No warnings." in words(section(dom, "warnings"))
    assert "The residuals of IMU are smaller than the stated noise" in words(section(dom, "used"))


def test_updates_of_a_replay(dom, tmp_path, case) -> None:
    node = section(dom, "updates")
    rows = {words(row[0]): [words(cell) for cell in row[1:]] for row in node.xpath(".//tbody/tr")}
    assert rows["Computing time"] == ["3.00 ms", "4.96 ms", "5.00 ms"]  # of 1 .. 5 ms
    assert rows["Change of earlier states"][2] == "3.00 m"
    titles = [words(t) for t in node.xpath('.//*[local-name()="text"][contains(@class, "ty0")]')]
    assert titles[0] == "Change of earlier states [m]" and titles[-1] == "GNSS time offset [ms]"
    ticks = node.xpath('(.//svg[contains(@class, "plot")])[1]/*[local-name()="text"][@class="tick ty"]/text()')
    assert ticks[0] == "0.0001"  # m; rounding errors are not drawn as they are
    assert not written(tmp_path, case).xpath('//section[@id="updates"]')


def test_empty_summary_claims_nothing(tmp_path, case) -> None:
    dom = written(tmp_path, case, summary={})
    assert "The run did not record IMU data gaps." in words(section(dom, "imu-gaps"))
    assert section(dom, "imu-gaps").get("data-count") is None
    assert "did not record what was rejected" in words(section(dom, "used"))
    assert "no measurement was rejected" not in words(dom).lower()
    assert not dom.xpath('//section[@id="withheld" or @id="timings" or @id="versions"]')


def test_clean_run_says_so(tmp_path, case) -> None:
    clean = summary() | {"gaps": [], "rejected": {}, "dropped": {}, "warnings": []}
    dom = written(tmp_path, case, summary=clean)
    assert "No measurement was rejected. No IMU data gaps." in words(section(dom, "headline"))
    assert "No warnings." in words(section(dom, "warnings"))
    assert section(dom, "imu-gaps").get("data-count") == "0"


def test_failed_solve_is_in_headline_and_warnings(tmp_path, case) -> None:
    bad = summary() | {"converged": False, "chi2_per_dof": {"overall": 6.2}}
    dom = written(tmp_path, case, summary=bad)
    assert "The solver did not converge: do not rely on this result." in words(section(dom, "headline"))
    text = words(section(dom, "warnings"))
    assert "stopped after 7 iterations without converging" in text
    assert "chi2 per degree of freedom 6.20" in text


def test_dead_reckoning_is_named(tmp_path, case) -> None:
    dom = written(tmp_path, case, summary={"mode": "dead-reckoning"})
    assert "there is no absolute position measurement" in words(section(dom, "headline"))


def test_visual_inertial_odometry_is_named(tmp_path, case) -> None:
    dom = written(tmp_path, case, summary={"mode": "visual-inertial odometry"})
    assert "was processed by visual-inertial odometry; there is no absolute" in words(section(dom, "headline"))


def test_replay_has_its_kind_delay_and_final_solution(tmp_path, case) -> None:
    polish = {"largest_change_m": 0.0213, "largest_change_deg": 0.05, "passes": 2}
    extra = {"mode": "replay fixed-lag, interrupted", "delay_s": 29.9, "polish": polish}
    dom = written(tmp_path, case, summary=summary() | extra)
    assert "was replayed one window at a time (fixed-lag, interrupted)" in words(section(dom, "headline"))
    text = words(section(dom, "solver"))
    assert "Data used before the first output 29.9 s" in text
    assert "final batch solution 0.021 m, 0.0500°" in text


def test_bare_solution(tmp_path, case) -> None:
    """No origin, no residuals, no IMU, no fixes, unknown covariance; then a single epoch."""
    bare = replace(
        case.solution, residuals=Residuals.empty(), origin=None, covariance=case.solution.covariance * np.nan
    )
    dom = written(tmp_path, case, session=Session(), solution=bare, summary={"gaps": None, "withheld": None})
    assert "The position uncertainty is unknown" in words(section(dom, "sigma-at"))
    assert "recorded no residuals" in words(section(dom, "residuals"))
    assert "nan" not in words(dom.find(".//main")).lower()
    assert not any("nan" in d for d in dom.xpath("//path/@d"))
    one = {name: getattr(bare, name)[:1] for name in ("t_ns", "nav_R_body", "nav_t_body", "nav_v_body")}
    one |= {name: getattr(bare, name)[:1] for name in ("accel_bias", "gyro_bias", "covariance")}
    dom = written(tmp_path, case, session=Session(), solution=replace(bare, **one), summary={})
    assert "has no path" in words(section(dom, "map"))


def test_37_minutes_stay_small_and_quick(tmp_path) -> None:
    case = drive(2220)
    start = time.process_time()
    dom = written(tmp_path, case, causal=case.causal, evaluation=case.evaluation)
    assert time.process_time() - start < 3.0  # s, on a busy machine; 0.3 s alone
    assert (tmp_path / "report.html").stat().st_size < 3_000_000
    assert max(len(re.findall(r"[ ,M-]", d)) // 2 for d in dom.xpath('//path[contains(@class, "line")]/@d')) <= 3000


def test_unwritable_place_is_a_named_error(tmp_path, case) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(SessionError, match="cannot be written"):
        write_report(tmp_path / "file" / "r.html", session=case.session, solution=case.solution, summary={})


def test_markdown_carries_the_same_facts(case) -> None:
    text = report_markdown(case.summary, case.evaluation)
    assert "was smoothed in one batch at 470 epochs" in text
    assert "| GNSS | 231 | 4 | 235 | 2 | 1.11 |" in text
    assert "- IMU data gap at 36.4 s, 1.59 s, linearly interpolated" in text
    assert "| GNSS | 235 | 0.284 m | 0.410 m | 1.32 m |" in text
    assert "Started while moving" in text
    assert report_markdown({}).startswith("# Run report\n\nThe recording was smoothed.")
