"""Factors and readers of other packages, by entry points: the example of the documentation as it is printed."""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import smartnav_graph as sn

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs/how-to/own-factor.md").read_text()


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """A folder on the path with the package of the page, and the record of its entry points that pip would write."""
    folder = tmp_path_factory.mktemp("site")
    for name, text in re.findall(r"`([\w./]+)`\n\n```(?:toml|python)\n(.*?)```", PAGE, re.DOTALL):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text)
    record(folder, (folder / "pyproject.toml").read_text())
    return folder


def record(folder: Path, project: str) -> None:
    groups = re.findall(r'entry-points\."([\w.]+)"\]\n((?:.+\n)+)', project)
    (folder / "level_floor-1.0.dist-info").mkdir()
    (folder / "level_floor-1.0.dist-info/METADATA").write_text(
        "Metadata-Version: 2.1\nName: level-floor\nVersion: 1.0\n"
    )
    text = "".join(f"[{group}]\n{rows.replace(chr(34), '')}\n" for group, rows in groups)
    (folder / "level_floor-1.0.dist-info/entry_points.txt").write_text(text)


def call(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), str(ROOT)])}
    command = [sys.executable, "-m", "smartnav_graph", *arguments]
    return subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True, timeout=120)


def test_a_factor_of_another_package_changes_the_result_and_has_its_chi_square(installed):
    eight = sn.simulate("figure-eight-60s", 1)
    sn.save(eight, installed / "eight")
    options = ["--to", "20", "--initial", "0,0,0,0,3,30", "--level-floor.enabled", "true", "--level-floor.height-m"]
    height = str(float(eight.reference.enu[:200, 2].mean()))
    done = call(installed, "smooth", "eight", "--out", "run", *options, height)
    assert (done.returncode, done.stderr) == (0, "")
    found = sn.read_run(installed / "run")
    assert found.summary["factors"]["level_floor"] == found.summary["keyframes"]
    assert "level_floor" in found.summary["chi2_per_dof"]
    assert np.median(found.solution.sigmas[:, 5]) < 0.06  # m; fixes of 4.5 m alone leave much more
    assert "Level floor" in (installed / "run/report.html").read_text()
    assert "level_floor" in (installed / "run/config.toml").read_text()


def test_its_options_and_its_reader_are_listed(installed):
    shown = call(installed, "config", "--help-all").stdout
    assert "[level_floor]" in shown and re.search(r"--level-floor\.sigma-m M\s+Of that height, m", shown)
    assert "tinylog" in call(installed, "formats").stdout
    lines = [f"tinylog {100 + i / 100:.2f} 0.01 0 0 0 0 9.81" for i in range(300)]
    (installed / "walk.txt").write_text("\n".join(lines))
    done = call(installed, "import", "walk.txt", "--out", "walk")
    assert done.returncode == 0 and "rows: imu 300" in done.stdout, done.stderr
    assert sn.load(installed / "walk").imu.t_ns[0] == 100_000_000_000


def test_parts_that_cannot_be_used_are_left_out_with_a_warning(tmp_path):
    (tmp_path / "faulty.py").write_text("READER = 3\n1 / 0\n")
    (tmp_path / "other.py").write_text("READER = 3\n")
    project = '[project.entry-points."smartnav_graph.readers"]\n'
    project += 'broken = "faulty:READER"\neuroc = "other:READER"\nnumber = "other:READER"\n'
    project += '\n[project.entry-points."smartnav_graph.builders"]\ngnss = "other:READER"\n'
    record(tmp_path, project)
    done = call(tmp_path, "formats")
    assert done.returncode == 0 and "gtsam-kitti" in done.stdout
    assert "broken = faulty:READER [smartnav_graph.readers]: cannot be loaded (ZeroDivisionError" in done.stderr
    assert "euroc = other:READER [smartnav_graph.readers]: the name is taken" in done.stderr
    assert "number = other:READER [smartnav_graph.readers]: is int; expected a" in done.stderr
    assert "gnss = other:READER [smartnav_graph.builders]: the name is taken" in call(tmp_path, "config").stderr
