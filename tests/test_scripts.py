"""What a newcomer runs first: the scripts, and the versions they install."""

import json
import os
import re
import subprocess
import sys
import tomllib
from importlib.metadata import version
from pathlib import Path

import pytest

import smartnav_graph as sn
from smartnav_graph.output.run_folder import write_run

ROOT = Path(__file__).parents[1]


def canonical(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def pins() -> dict[str, str]:
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    rows = [line for line in lines if line and not line.startswith("#")]
    assert all(re.fullmatch(r"[\w.-]+==[\w.+!]+", row) for row in rows)  # names and versions only: no place, no address
    return {canonical(row.split("==")[0]): row.split("==")[1] for row in rows}


def test_every_declared_dependency_is_pinned():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]  # those that the scripts install
    declared = [*project["dependencies"], *extras["test"], *extras["docs"]]
    names = {canonical(re.split(r"[<>=!~ \[]", text)[0]) for text in declared}
    assert names <= set(pins())


def test_the_versions_that_matter_are_the_pinned_ones():
    for name in ("gtsam", "rerun-sdk", "opencv-python-headless", "pycolmap"):
        assert version(name) == pins()[name]


@pytest.mark.parametrize("name", ["scripts/demo", "scripts/test", "scripts/docs", "scripts/benchmark", ".ci/run"])
def test_scripts_can_be_run(name):
    assert os.access(ROOT / name, os.X_OK)
    subprocess.run(["bash", "-n", ROOT / name], check=True)


def find_python(path: Path) -> subprocess.CompletedProcess[str]:
    command = f"source {ROOT}/scripts/environment.sh && find_python"
    environment = {"PATH": str(path)}
    return subprocess.run(["/bin/bash", "-c", command], env=environment, capture_output=True, text=True, check=False)


def tool(folder: Path, name: str, code: str) -> None:
    (folder / name).write_text(f"#!/bin/sh\n{code}\n")
    (folder / name).chmod(0o755)


def test_an_old_python_is_passed_over_and_its_absence_reported(tmp_path):
    tool(tmp_path, "dirname", 'exec /usr/bin/dirname "$@"')
    tool(tmp_path, "python3.12", "exit 127")  # a shim without a version behind it
    tool(tmp_path, "python3", "exit 1")  # too old
    done = find_python(tmp_path)
    assert done.returncode != 0 and done.stdout == ""
    assert "No Python of 3.11, 3.12 or 3.13 with venv was found; install one" in done.stderr
    tool(tmp_path, "python3.11", f'exec {sys.executable} "$@"')
    assert find_python(tmp_path).stdout == "python3.11\n"


def test_a_benchmark_measures_a_fresh_process(tmp_path):
    sn.save(sn.simulate("figure-eight-60s"), tmp_path / "eight")
    command = [sys.executable, ROOT / "scripts" / "benchmark.py", "--measure", "replay", tmp_path / "eight"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    result = json.loads(done.stdout)
    assert set(result) == {"seconds", "peak_memory_mb", "detail"}
    assert result["detail"]["keyframes"] == 62 and result["peak_memory_mb"] > 50
    assert result["seconds"] == pytest.approx(result["detail"]["update_ms"]["p99"] / 1e3)


def test_the_baseline_runs():
    command = [sys.executable, ROOT / "scripts" / "bare_gtsam.py", "2", "imu"]
    result = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    assert set(result["cpu_s"]) == {"preintegrate", "build", "solve", "covariance"} and result["rms_m"] < 10.0


def test_the_front_end_is_measured_beside_bare_opencv(tmp_path):
    def measured(*arguments: object) -> dict[str, float]:
        command = [sys.executable, *map(str, arguments)]
        return json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)

    scripts, folder = ROOT / "scripts", tmp_path / "pictures"
    subprocess.run([sys.executable, scripts / "bare_front_end.py", "make", folder, "4"], check=True)
    ours = measured(scripts / "benchmark.py", "--measure", "front-end", folder)["detail"]
    bare = measured(scripts / "bare_front_end.py", folder)
    assert ours["pairs"] == bare["pairs"] == 3
    assert ours["matches"] > 1500 and bare["matches"] > 1500  # of 3 x 1500 points


def test_two_view_geometry_is_measured_beside_bare_opencv():
    scripts = ROOT / "scripts"
    commands = [[scripts / "benchmark.py", "--measure", "two-view", "simulated"], [scripts / "bare_two_view.py"]]
    runs = [subprocess.run([sys.executable, *c], capture_output=True, text=True, check=True) for c in commands]
    ours, bare = json.loads(runs[0].stdout)["detail"], json.loads(runs[1].stdout)
    assert ours["rotation_deg"] < bare["rotation_deg"] and ours["direction_deg"] < 0.8 * bare["direction_deg"]


def test_a_recording_is_measured_beside_bare_rerun(tmp_path):
    scripts, session, run = ROOT / "scripts", tmp_path / "eight", tmp_path / "run"
    sn.save(sn.simulate("figure-eight-60s"), session)
    write_run(sn.run(sn.load(session)), run, report=False, recording=False)
    commands = [
        [scripts / "benchmark.py", "--measure", "recording", session],
        [scripts / "bare_recording.py", session, run, tmp_path / "bare.rrd"],
    ]
    runs = [subprocess.run([sys.executable, *c], capture_output=True, text=True, check=True) for c in commands]
    ours, bare = json.loads(runs[0].stdout)["detail"], json.loads(runs[1].stdout)
    assert ours["samples"] == 6000 and ours["keyframes"] == 62 and ours["pictures"] == 0
    assert 0.3 < bare["size_mb"] < ours["size_mb"]  # the same arrays, and more
