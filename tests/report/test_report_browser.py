"""The report in a real browser: quiet, offline, readable on a phone."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drive_case import drive

from smartnav_graph.report import write_report

CHROMIUM = shutil.which("chromium")
sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine")

OVERLAPS = """() => [...document.querySelectorAll('svg.plot')].flatMap(plot => {
  const boxes = [...plot.querySelectorAll('text.tick, text.title')].map(t => [t.textContent, t.getBoundingClientRect()])
    .filter(([, r]) => r.width > 0);
  return boxes.flatMap(([a, p], i) => boxes.slice(i + 1)
    .filter(([, q]) => p.left < q.right && q.left < p.right && p.top < q.bottom && q.top < p.bottom)
    .map(([b]) => plot.getAttribute('aria-label') + ': ' + a + ' / ' + b));
})"""
OUTSIDE = """() => [...document.querySelectorAll('svg.plot text')].filter(t => {
  const r = t.getBoundingClientRect();
  return r.width > 0 && (r.left < 0 || r.right > innerWidth); }).map(t => t.textContent)"""
COVERED = """() => { const plots = [...document.querySelectorAll('svg.plot')];
  return plots.slice(1).filter((p, i) => {
    const low = Math.max(...[...plots[i].querySelectorAll('text.tick')].map(t => t.getBoundingClientRect().bottom));
    const title = p.querySelector('text.ty0').getBoundingClientRect(), other = plots[i].getBoundingClientRect();
    return other.left < title.right && title.left < other.right && title.top < low; })
  .map(p => p.getAttribute('aria-label')); }"""
SMALLEST = """() => Math.min(...[...document.querySelectorAll('svg.plot text.tick')].filter(t => t.getBBox().width > 0)
  .map(t => parseFloat(getComputedStyle(t).fontSize)))"""


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
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


@pytest.mark.parametrize("width", [1400, 390])
def test_long_labels(browser: Any, far_page: Path, width: int) -> None:
    look(browser, far_page, width, "light")


@pytest.mark.parametrize("width", [1400, 390])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_page(browser: Any, page: Path, width: int, scheme: str) -> None:
    look(browser, page, width, scheme)


def look(browser: Any, page: Path, width: int, scheme: str) -> None:
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
    assert tab.evaluate(OVERLAPS) == []
    assert tab.evaluate(OUTSIDE) == []
    assert tab.evaluate(COVERED) == []
    assert tab.evaluate(SMALLEST) >= 11.0  # px, legible
    light = tab.evaluate("getComputedStyle(document.body).backgroundColor.match(/\\d+/g).map(Number)[0]")
    assert (light > 200) == (scheme == "light")
    tab.close()
