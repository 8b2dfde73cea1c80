"""The report in a real browser: quiet, offline, readable on a phone, and its sentences those of summary.json."""

from __future__ import annotations

import csv
import json
import os
import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from axe_playwright_python.sync_playwright import Axe
from drive_case import Drive, drive
from playwright import sync_api

from smartnav_graph.cli import main
from smartnav_graph.estimate.config import Config, ReportConfig
from smartnav_graph.output.report import write_report

CHROMIUM = os.environ.get("CHROMIUM") or shutil.which("chromium")
LARGEST_BYTES = 3_000_000
# Every piece of text on the page with its boxes (of each line), a pixel and a half smaller all round.
TEXTS = """() => {
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT), found = [];
  for (let node; node = walker.nextNode();) {
    if (!node.textContent.trim()) continue;
    const svg = node.parentElement.closest('text');
    const range = document.createRange(); range.selectNodeContents(node);
    const boxes = svg ? [svg.getBoundingClientRect()] : [...range.getClientRects()];
    for (const r of boxes) if (r.width > 3 && r.height > 3 && node.parentElement.checkVisibility())
      found.push([node.textContent.trim().slice(0, 60), r.left + 1.5, r.top + 1.5, r.right - 1.5, r.bottom - 1.5]);
  }
  return found; }"""
TITLES = """(cls) => [...document.querySelectorAll('svg.plot text.' + cls)].map(t => t.textContent)"""
BARE = """() => [...document.querySelectorAll('section:not(#timeline) figure')].filter(f =>
  f.querySelectorAll('text.tx0').length < 1 ||
  f.querySelectorAll('svg.plot').length !== f.querySelectorAll('text.ty0').length)
  .map(f => f.querySelector('svg.plot').getAttribute('aria-label'))"""
SMALLEST = """() => Math.min(...[...document.querySelectorAll('svg.plot text')].filter(t => t.getBBox().width > 0)
  .map(t => parseFloat(getComputedStyle(t).fontSize)))"""
WORDS = "id => document.getElementById(id).textContent.replaceAll('\\u202f', '').replace(/\\s+/g, ' ')"
UNIT = re.compile(r"\[[^\]]+\]|sigma|density")


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    assert CHROMIUM, "no Chromium: install one, or name its program in CHROMIUM (scripts/test does)"
    with sync_api.sync_playwright() as p:
        chromium = p.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", "--disable-background-networking"])
        yield chromium
        chromium.close()


@pytest.fixture(scope="module")
def far_page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An hour in national grid coordinates, high up, badly known: long labels everywhere."""
    case = drive(3500)
    far = np.array([412_345.0, 5_932_101.0, 1234.0])
    solution = replace(
        case.solution, nav_t_body=case.solution.nav_t_body + far, covariance=case.solution.covariance * 1e9, origin=None
    )
    path = tmp_path_factory.mktemp("far") / "report.html"
    write_report(path, session=case.session.replace(gnss=None), solution=solution, summary=case.summary)
    return path


@pytest.fixture(scope="module")
def kitti_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The drive of the gtsam wheel with outliers put in and every fifth fix kept back."""
    folder = tmp_path_factory.mktemp("kitti")
    session, faulty, run = (str(folder / name) for name in ("kitti", "faulty", "run"))
    assert main(["import", "gtsam-kitti", "--out", session, "--quiet"]) == 0
    assert main(["degrade", session, "--outliers", "isolated:0.06:50-200", "--seed", "5", "--out", faulty]) == 0
    line = ["smooth", faulty, "--vehicle", "car", "--withhold", "gnss:every=2", "--to", "330", "--out", run, "--quiet"]
    assert main(line) == 0
    return folder / "run"


@pytest.mark.parametrize("width", [1400, 390])
def test_long_labels(browser: Any, far_page: Path, width: int) -> None:
    look(browser, far_page, width, "light").close()


@pytest.mark.parametrize("width", [1400, 390])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_page(browser: Any, page: Path, width: int, scheme: str) -> None:
    look(browser, page, width, scheme).close()


@pytest.mark.parametrize("width", [1400, 390])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_real_run(browser: Any, kitti_run: Path, width: int, scheme: str) -> None:
    """What the page says in words is what summary.json and trajectory.csv hold."""
    tab = look(browser, kitti_run / "report.html", width, scheme)
    summary = json.loads((kitti_run / "summary.json").read_text(encoding="utf-8"))

    gaps = tab.evaluate("[...document.querySelectorAll('#imu-gaps .imu-gap')].map(h => h.textContent)")
    shown = [[float(x) for x in re.findall(r"([\d.]+) s", gap)] for gap in gaps]
    assert len(shown) == 9
    assert shown == [[pytest.approx(g["start_s"], abs=0.05), pytest.approx(g["length_s"], abs=0.005)]
                    for g in summary["gaps"]]  # fmt: skip

    headline = tab.evaluate(WORDS, "headline")
    rejected, withheld = summary["rejected"]["gnss"], summary["withheld"]["gnss"]["count"]
    assert rejected >= 5 and withheld > 150
    assert f"Rejected as outliers: GNSS {rejected}. IMU data gaps: 9" in headline
    assert f"Withheld GNSS: {withheld} measurements" in headline
    cells = tab.evaluate("[...document.querySelectorAll('#used tr[data-sensor=gnss] td')].map(c => c.textContent)")
    assert cells[2:4] == [str(rejected), str(withheld)]

    with open(kitti_run / "trajectory.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    t = (np.array([int(row["t_ns"]) for row in rows]) - summary["session"]["t0_ns"]) / 1e9
    e, n, u = (np.interp(300.0, t, [float(row[f"sigma_{axis}_m"]) for row in rows]) for axis in "enu")
    said = re.search(
        r"1 sigma at t = 300 s: ([\d.]+) m horizontal \(([\d.]+) m east, ([\d.]+) m north\), ([\d.]+) m vertical",
        tab.evaluate(WORDS, "sigma-at"),
    )
    assert said is not None
    assert [float(x) for x in said.groups()] == pytest.approx([np.hypot(e, n), e, n, u], abs=6e-4)  # m, as rounded
    tab.close()


def test_values_under_the_pointer(browser: Any, page: Path, case: Drive) -> None:
    """The time cursor is in all plots, its values are those of the solution, and it marks the place on the map."""
    tab = browser.new_page(viewport={"width": 1400, "height": 900})
    tab.goto(page.resolve().as_uri())
    assert tab.locator("#cursor").is_hidden()
    tab.locator("#uncertainty svg.plot").first.hover()
    said = tab.locator("#cursor").inner_text()
    t = float(re.search(r"t = ([\d.]+) s", said)[1])
    assert t == pytest.approx(case.solution.seconds[-1] / 2, abs=1.0)
    found = {name: float(value) for name, value in re.findall(r"(East|North|Up) ([\d.]+)", said)}
    for i, name in enumerate(("East", "North", "Up")):
        expected = np.interp(t, case.solution.seconds, case.solution.sigmas[:, 3 + i])
        assert found[name] == pytest.approx(expected, rel=0.02), said
    cursors = tab.evaluate("[...document.querySelectorAll('.time-cursor')].map(c => c.getAttribute('x1'))")
    assert len(cursors) > 15 and len(set(cursors)) == 1
    places = "['#map .place-cursor', '#map .start'].map(c => document.querySelector(c).getBoundingClientRect())"
    before, start = tab.evaluate(f"{places}.map(r => [r.x + r.width / 2, r.y + r.height / 2])")
    assert np.hypot(*np.subtract(before, start)) > 20
    tab.locator("#map .start").hover(force=True)
    assert float(re.search(r"t = ([\d.]+) s", tab.locator("#cursor").inner_text())[1]) < 10.0
    tab.keyboard.press("Escape")
    assert tab.locator("#cursor").is_hidden()
    tab.close()


def test_print_shows_what_the_screen_folds(browser: Any, kitti_run: Path) -> None:
    tab = browser.new_page(viewport={"width": 700, "height": 900})
    tab.goto((kitti_run / "report.html").resolve().as_uri())
    row = tab.locator(".rejections tbody tr").first
    assert row.is_hidden()
    tab.emulate_media(media="print")
    assert row.is_visible() and tab.locator(".options dd").first.is_visible() and tab.locator(".sign").is_visible()
    assert tab.evaluate("document.documentElement.scrollWidth") <= 700
    tab.close()


@pytest.mark.parametrize("reasons", [1, 4, 10])
def test_map_and_first_facts_are_on_the_first_sheet(browser: Any, case: Drive, tmp_path: Path, reasons: int) -> None:
    """With many reasons of the verdict, too; labels of the small map do not cover each other."""
    text = "heights of the fixes are 4.2 m off those of the control points from 120 s to 180 s"
    reason = {"level": "doubtful", "sensor": "gnss", "start_s": None, "text": text, "remedy": "convert one of them"}
    summary = case.summary | {"verdict": {"level": "doubtful", "reasons": [reason] * reasons}}
    config = Config(report=ReportConfig(company="Surveyors", time_zone="Europe/Berlin", crs="EPSG:25832"))
    write_report(tmp_path / "r.html", session=case.session, solution=case.solution, summary=summary, config=config)
    tab = browser.new_page(viewport={"width": 688, "height": 1000})  # A4 less the margins, px
    tab.goto((tmp_path / "r.html").resolve().as_uri())
    tab.emulate_media(media="print")
    bottom = "q => document.querySelector(q).getBoundingClientRect().bottom"
    assert tab.evaluate(bottom, "#map figure") <= 1000
    assert tab.evaluate(bottom, "#about .facts div") <= 1000
    assert overlaps(tab.evaluate(TEXTS)) == []
    tab.close()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_accessible(browser: Any, page: Path, scheme: str) -> None:
    """axe-core finds nothing serious."""
    tab = browser.new_page(viewport={"width": 1400, "height": 900}, color_scheme=scheme)
    tab.goto(page.resolve().as_uri())
    assert serious(tab) == []
    tab.set_content("<html><img src='data:,'><p style='color:#ccc'>pale</p></html>")
    assert {"image-alt", "html-has-lang", "color-contrast"} <= {line.split(":")[0] for line in serious(tab)}
    tab.close()


def serious(tab: Any) -> list[str]:
    found = Axe().run(tab).response["violations"]
    return [f"{one['id']}: {one['nodes'][0]['html']}" for one in found if one["impact"] in ("serious", "critical")]


def look(browser: Any, page: Path, width: int, scheme: str) -> Any:
    """The page, once nothing is wrong with how it shows."""
    assert page.stat().st_size <= LARGEST_BYTES
    said: list[str] = []
    asked: list[str] = []
    tab = browser.new_page(viewport={"width": width, "height": 900}, color_scheme=scheme)
    tab.on("pageerror", lambda e: said.append(str(e)))
    tab.on("console", lambda m: said.append(m.text))
    tab.on("request", lambda r: asked.append(r.url))
    tab.goto(page.resolve().as_uri())
    assert said == []
    assert asked == [page.resolve().as_uri()]
    assert tab.evaluate("document.documentElement.scrollWidth") <= width
    texts = tab.evaluate(TEXTS)
    assert overlaps(texts) == []
    assert [t for t, left, _, right, _ in on_paper(tab, texts) if left < 0 or right > width] == []
    assert tab.evaluate(BARE) == []
    titles = tab.evaluate(TITLES, "tx0") + tab.evaluate(TITLES, "ty0")
    assert [title for title in titles if not UNIT.search(title)] == []
    assert tab.evaluate(SMALLEST) >= 11.0  # px, legible
    light = tab.evaluate("getComputedStyle(document.body).backgroundColor.match(/\\d+/g).map(Number)[0]")
    assert (light > 200) == (scheme == "light")
    return tab


def overlaps(texts: list[tuple[str, float, float, float, float]]) -> list[str]:
    """Pairs of texts of which one covers part of the other."""
    box = np.array([row[1:] for row in texts])
    across = (box[:, None, 0] < box[None, :, 2]) & (box[None, :, 0] < box[:, None, 2])
    along = (box[:, None, 1] < box[None, :, 3]) & (box[None, :, 1] < box[:, None, 3])
    first, second = np.nonzero(np.triu(across & along, 1))
    return [f"{texts[i][0]} / {texts[j][0]}" for i, j in zip(first, second, strict=True)]


def on_paper(tab: Any, texts: list[Any]) -> list[Any]:
    """The texts that do not stand in a box that scrolls by itself."""
    inside = tab.evaluate(
        "[...document.querySelectorAll('.scroll')].map(b => b.getBoundingClientRect()).map(r => [r.top, r.bottom])"
    )
    return [t for t in texts if not any(top <= t[2] <= bottom for top, bottom in inside)]


def test_the_rule_sees_an_overlap(browser: Any) -> None:
    tab = browser.new_page()
    drawn = "<text y='20'>four</text><text y='24'>five</text><text y='60'>six</text>"
    tab.set_content(f"<p>one</p><p style='margin-top:-30px'>two</p><p>three</p><svg>{drawn}</svg>")
    assert overlaps(tab.evaluate(TEXTS)) == ["one / two", "four / five"]
    tab.close()
