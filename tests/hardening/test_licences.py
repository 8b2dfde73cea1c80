"""Licences of all packages that are installed with this one are listed, and none is the GPL."""

import re
import sys
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
import licences

PAGE = Path(__file__).parents[2] / "docs" / "licences.md"


def needed(name, seen):
    """A package and all that it requires, without extras."""
    name = re.sub(r"[-_.]+", "-", name).lower()
    if name in seen:
        return seen
    try:
        needs = requires(name) or []
    except PackageNotFoundError:  # on another system or version of Python
        return seen
    seen.add(name)
    for need in needs:
        if "extra ==" not in need:
            needed(re.split(r"[^\w.-]", need)[0], seen)
    return seen


def test_no_package_is_under_the_gpl():
    found = licences.rows()
    assert len(found) > 40
    assert {name: text for name, text in found.items() if licences.COPYLEFT.search(text)} == {}


def test_what_runs_is_not_under_the_lgpl_either():
    found = licences.rows(needed("smartnav-graph", set()))
    assert len(found) > 25
    assert {name: text for name, text in found.items() if "GPL" in text or "GNU" in text} == {}


def test_the_words_of_these_licences_are_known():
    for text in (
        "GPL-3.0-only",
        "AGPL-3.0",
        "GNU General Public License v3 (GPLv3)",
        "GNU Affero General Public License",
    ):
        assert licences.COPYLEFT.search(text)
    for text in ("GNU Library or Lesser General Public License (LGPL)", "MIT", "MPL-2.0"):
        assert not licences.COPYLEFT.search(text)


def test_the_page_lists_every_pinned_package():
    listed = dict(re.findall(r"^\| (\S+) \| (.+) \|$", PAGE.read_text(), re.MULTILINE))
    assert {name: listed.get(name) for name in licences.rows()} == licences.rows(), "python tests/hardening/licences.py"
