"""The documentation: built strictly with its notebooks executed, complete, and readable in a browser."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright import sync_api

import smartnav_graph as sn
from smartnav_graph.cli import COMMANDS
from smartnav_graph.factors import FACTORS
from smartnav_graph.session.format_page import format_page

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
CHROMIUM = os.environ.get("CHROMIUM") or shutil.which("chromium")
WIDTHS = (1400, 390)
PAGES = ("index", "start", "tutorials/surveyor", "tutorials/data-scientist", "understand/factors", "gallery")
PAGES += ("reference/python", "reference/commands", "reference/faq")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site; building fails where a notebook fails, a link is broken or something comes from the network."""
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
    return folder


def test_the_site_has_what_was_made_when_it_was_built(site):
    for name in ("surveyor", "robotics", "data-scientist", "calibration", "images"):
        page = (site / f"tutorials/{name}.html").read_text(encoding="utf-8")
        assert 'class="filename">Output<' in page and (site / f"tutorials/{name}.ipynb").is_file()
    assert len(list(site.glob("gallery-*.html"))) == 5 and len(list(site.glob("gallery-*.png"))) >= 5
    commands = (site / "reference/commands.html").read_text(encoding="utf-8")
    assert all(f'id="{name}"' in commands for name in COMMANDS)
    python = (site / "reference/python.html").read_text(encoding="utf-8")
    assert all(re.search(rf'id="smartnav_graph[\w.]*\.{name}"', python) for name in sn.__all__)


def test_every_factor_has_its_formula_and_its_source(site):
    text = (DOCS / "understand/factors.md").read_text(encoding="utf-8")
    assert set(FACTORS) <= set(re.findall(r"\{ #(\w+) \}", text))
    page = (site / "understand/factors.html").read_text(encoding="utf-8")
    assert page.count("<math") > 50 and r"\(" not in page and r"\frac" not in page


def test_the_page_of_the_session_folder_is_that_of_the_code():
    assert (DOCS / "session-format.md").read_text(encoding="utf-8") == format_page()


def test_links_of_a_page_are_followed(tmp_path):
    sys.path.insert(0, str(ROOT / "scripts"))
    from docs_pages import broken_links

    (tmp_path / "a.html").write_text('<h1 id="x">A</h1><a href="b.html#y">b</a><a href="https://example.org">far</a>')
    (tmp_path / "b.html").write_text('<h1 id="y">B</h1><a href="a.html#x">a</a>')
    assert not list(broken_links(tmp_path))
    (tmp_path / "b.html").write_text(
        '<a href="a.html#z">a</a><a href="c.html">c</a><img src="https://example.org/i.png">'
    )
    faults = sorted(broken_links(tmp_path))
    assert [fault.split(": ")[1] for fault in faults] == [
        *("b.html#y has no such anchor", "a.html#z has no such anchor"),
        *("c.html does not exist", "loads https://example.org/i.png"),
    ]


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    assert CHROMIUM, "no Chromium: install one, or name its program in CHROMIUM (scripts/test does)"
    with sync_api.sync_playwright() as p:
        chromium = p.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", "--disable-background-networking"])
        yield chromium
        chromium.close()


@pytest.mark.parametrize("colours", ["light", "dark"])
def test_pages_are_readable(site, browser, colours):
    faults, errors, requests = [], [], []
    for width in WIDTHS:
        page = browser.new_page(viewport={"width": width, "height": 900}, color_scheme=colours)
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("request", lambda request: requests.append(request.url))
        for name in PAGES:
            page.goto((site / f"{name}.html").as_uri())
            wide = page.evaluate("document.documentElement.scrollWidth - document.documentElement.clientWidth")
            faults += [f"{name} at {width} px: {wide} px too wide"] if wide > 0 else []
            found = Axe().run(page).response["violations"]
            serious = [one for one in found if one["impact"] in ("serious", "critical")]
            faults += [f"{name} at {width} px: {one['id']} {one['nodes'][0]['html'][:100]}" for one in serious]
        page.close()
    assert not [*faults, *errors]
    assert not [address for address in requests if not address.startswith(("file:", "data:", "blob:"))]
