"""Commands open no socket and write nothing outside of --out; the package depends on nothing under GPL."""

import re
import shutil
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, metadata, requires

import pytest

WRITES = re.compile(
    r'(?:openat\(.*?"([^"]+)", [^)]*O_(?:WRONLY|RDWR|CREAT)|(?:mkdir|unlink|rename)\w*\(.*?"([^"]+)").* = \d'
)


def traced(folder, *words):
    """Sockets and paths written of a command."""
    trace = folder / "trace.txt"
    calls = "socket,connect,openat,mkdir,rename,renameat2,unlink"
    command = [
        "strace",
        "-f",
        "-qq",
        "-e",
        f"trace={calls}",
        "-o",
        trace,
        sys.executable,
        "-m",
        "smartnav_graph",
        *words,
    ]
    assert subprocess.run(command, cwd=folder, capture_output=True, check=False).returncode in (0, 3)
    lines = trace.read_text(errors="replace").splitlines()
    written = {a or b for line in lines for a, b in WRITES.findall(line)}
    return [line for line in lines if " socket(" in line or " connect(" in line], written


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("strace") is None, reason="needs strace")
def test_no_socket_and_nothing_written_elsewhere(tmp_path):
    for words in (("simulate", "walk-60s", "--out", "walk"), ("smooth", "walk", "--out", "run", "--to", "15")):
        sockets, written = traced(tmp_path, *words)
        elsewhere = {path for path in written if path.startswith("/") and not path.startswith((str(tmp_path), "/dev/"))}
        assert sockets == [] and {path for path in elsewhere if "__pycache__" not in path} == set() and written


def licences(name, seen):
    """Licences of a package and of all that it requires, by name."""
    if name in seen:
        return seen
    try:
        about = metadata(name)
    except PackageNotFoundError:
        return seen
    classifiers = [text for text in about.get_all("Classifier") or [] if "License" in text]
    seen[name] = " ".join([about["License-Expression"] or (about["License"] or "")[:200], *classifiers])
    for need in requires(name) or []:
        if "extra ==" not in need:
            licences(re.split(r"[^\w.-]", need)[0].lower(), seen)
    return seen


def test_no_dependency_is_under_the_gpl():
    found = licences("smartnav-graph", {})
    assert len(found) > 20
    assert {name: text for name, text in found.items() if re.search(r"\bA?GPL|GNU (Affero )?General", text)} == {}
