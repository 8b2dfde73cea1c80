"""What is handed on: the files of the project's root and the content of the wheel."""

import re
import subprocess
import sys
import tomllib
import zipfile
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_the_licence_is_the_one_declared():
    text = (ROOT / "LICENSE").read_text()
    assert PROJECT["license"] == "BSD-3-Clause" and PROJECT["license-files"] == ["LICENSE"]
    assert text.startswith("BSD 3-Clause License") and "Copyright (c) 2026, smartnav_graph contributors" in text


def test_the_citation_and_the_changelog_know_the_version():
    citation = (ROOT / "CITATION.cff").read_text()
    assert f"\nversion: {PROJECT['version']}\n" in citation and "\nlicense: BSD-3-Clause\n" in citation
    assert re.search(r"^## \[(Unreleased|\d)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)


def test_no_dependency_comes_from_an_address():
    declared = [*PROJECT["dependencies"], *PROJECT["optional-dependencies"]["test"]]
    assert not [text for text in declared if "@" in text or "/" in text]


@pytest.mark.slow
@pytest.mark.skipif(find_spec("build") is None, reason="needs the package `build`")
def test_the_wheel_contains_what_it_must(tmp_path):
    subprocess.run([sys.executable, "-m", "build", "--outdir", tmp_path, ROOT], check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    names = set(zipfile.ZipFile(wheel).namelist())
    package = ROOT / "smartnav_graph"
    files = {str(path.relative_to(ROOT)) for path in package.rglob("*") if path.suffix not in ("", ".pyc")}
    assert {"smartnav_graph/py.typed", "smartnav_graph/output/report/style.css"} <= files <= names
    rest = {name.split("/", 1)[1] for name in names - files}
    assert rest == {"METADATA", "WHEEL", "entry_points.txt", "licenses/LICENSE", "RECORD"}
    assert len(list(tmp_path.glob("*.tar.gz"))) == 1
