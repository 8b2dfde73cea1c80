"""What is handed on: the files of the project's root, the content of wheel and source distribution."""

import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest
import yaml

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
    extras = PROJECT["optional-dependencies"]
    declared = [*PROJECT["dependencies"], *(text for extra in extras.values() for text in extra)]
    assert all(extras.values())  # no empty ones
    assert not [text for text in declared if "@" in text or "/" in text]


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """The folder with a wheel and a source distribution, each built from the sources."""
    folder = tmp_path_factory.mktemp("dist")
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", folder, ROOT]
    subprocess.run(command, check=True, capture_output=True)
    return folder


def tracked(*places):
    """Files under version control; all files where there is no git."""
    done = subprocess.run(["git", "ls-files", *places], cwd=ROOT, capture_output=True, text=True)
    if done.returncode == 0 and done.stdout:
        return {name for name in done.stdout.splitlines() if (ROOT / name).is_file()}
    found = [path for place in places for path in (ROOT / place).rglob("*") if path.is_file()]
    return {path.relative_to(ROOT).as_posix() for path in found if "__pycache__" not in path.parts}


def test_the_wheel_contains_what_it_must(built):
    (wheel,) = built.glob("*.whl")
    names = set(zipfile.ZipFile(wheel).namelist())
    files = tracked("smartnav_graph")
    assert {"smartnav_graph/py.typed", "smartnav_graph/output/report/style.css"} <= files <= names
    rest = {name.split("/", 1)[1] for name in names - files if ".dist-info/" in name}
    assert rest == {"METADATA", "WHEEL", "entry_points.txt", "licenses/LICENSE", "RECORD"}
    assert not {name for name in names if not name.startswith("smartnav_graph")}


def test_the_source_distribution_can_be_built_tested_and_documented(built):
    (archive,) = built.glob("*.tar.gz")
    with tarfile.open(archive) as opened:
        names = {name.split("/", 1)[1] for name in opened.getnames() if "/" in name}
    files = tracked("smartnav_graph", "tests", "scripts", "docs", "datasets", ".ci", ".github")
    root = {"pyproject.toml", "README.md", "CHANGELOG.md", "CONTRIBUTING.md", "LICENSE", "CITATION.cff", "PKG-INFO"}
    root |= {"constraints.txt", "mkdocs.yml", "Dockerfile", ".dockerignore"}
    assert files | root <= names
    # no data, no environments, nothing that was made by a build
    extra = {name for name in names - files - root if "/" in name}
    assert not {name for name in extra if name.startswith((".venv", "site/", "demo/", "out/", ".git/"))}


def test_extras_of_the_wheel_are_those_declared(built):
    (wheel,) = built.glob("*.whl")
    with zipfile.ZipFile(wheel) as opened:
        (name,) = [name for name in opened.namelist() if name.endswith("METADATA")]
        text = opened.read(name).decode()
    assert set(re.findall(r"^Provides-Extra: (\S+)", text, re.MULTILINE)) == set(PROJECT["optional-dependencies"])
    assert "Requires-Python: >=3.11" in text and "License-Expression: BSD-3-Clause" in text


def test_the_release_workflow_publishes_what_it_built_without_a_token():
    text = (ROOT / ".github/workflows/release.yml").read_text()
    jobs = yaml.safe_load(text)["jobs"]
    assert jobs["publish"]["permissions"] == {"id-token": "write"} and jobs["publish"]["needs"] == ["build", "install"]
    assert "secrets." not in text and "password" not in text
    assert "windows-latest" in jobs["install"]["strategy"]["matrix"]["os"]
    assert any("python -m build" in step.get("run", "") for step in jobs["build"]["steps"])


def test_the_image_installs_the_pinned_versions_and_nothing_else():
    lines = (ROOT / "Dockerfile").read_text().splitlines()
    assert all("slim" in line for line in lines if line.startswith("FROM"))
    assert "-c constraints.txt" in "\n".join(lines) and 'ENTRYPOINT ["smartnav"]' in lines
    copied = [name for line in lines if line.startswith("COPY") and "--from" not in line for name in line.split()[1:-1]]
    kept = {line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    assert set(copied) == kept and all((ROOT / name).exists() for name in copied)


def test_the_module_is_the_command():
    command = [sys.executable, "-m", "smartnav_graph", "--version"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout == f"smartnav {PROJECT['version']}\n"
