"""The public names of the package: light to import, and all there."""

import dataclasses
import json
import os
import subprocess
import sys
import typing
from pathlib import Path

import matplotlib
import numpy as np
import pandas as pd
import pytest

import smartnav_graph as sn
from smartnav_graph.estimate.config import RunConfig, RunOptions, given_options
from smartnav_graph.graph.solution import SIGMA_NAMES

matplotlib.use("Agg")
ROOT = Path(__file__).parents[1]


def loaded_after(code: str) -> set[str]:
    """Top-level modules that a fresh interpreter holds after `code`."""
    script = f"import json, sys\n{code}\nprint(json.dumps([name for name in sys.modules if '.' not in name]))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    return set(json.loads(done.stdout.splitlines()[-1]))


def test_importing_the_package_loads_nothing_heavy():
    assert not {"gtsam", "cv2", "pycolmap", "rerun", "numpy", "pandas"} & loaded_after("import smartnav_graph")


def test_smoothing_needs_neither_pictures_nor_viewer_nor_tables():
    code = "import smartnav_graph as sn\nsn.smooth(sn.simulate('figure-eight-60s'), end_s=5.0, initial='0,0,0,0,3,30')"
    there = loaded_after(code)
    assert "gtsam" in there
    assert not {"cv2", "pycolmap", "rerun", "pandas", "matplotlib"} & there


@pytest.mark.parametrize(
    "command",
    [
        *("--help", "smooth --help", "match --help", "import --help", "formats", "formats --columns"),
        *("calibrate --help", "calibrate camera --help", "calibrate static --help", "calibrate axes --help"),
    ],
)
def test_help_and_lists_load_little(command):
    code = f"from smartnav_graph.cli import main\nmain({command.split()})"
    assert not {"gtsam", "cv2", "pycolmap", "rerun", "scipy", "pandas", "matplotlib"} & loaded_after(code)


@pytest.mark.parametrize("command", ["smooth --help-all", "config", "config --dump"])
def test_the_configuration_is_shown_without_the_libraries_that_compute(command):
    code = f"from smartnav_graph.cli import main\nmain({command.split()})"
    there = loaded_after(code)
    assert "gtsam" in there  # in which the options of the factors are declared
    assert not {"cv2", "pycolmap", "rerun", "scipy", "pandas", "matplotlib"} & there


def test_every_promised_name_is_there():
    for name in sn.__all__:
        assert getattr(sn, name) is not None
    assert set(dir(sn)) == set(sn.__all__)
    with pytest.raises(AttributeError, match="no attribute 'smoooth'"):
        sn.smoooth  # noqa: B018


def test_three_lines_from_session_to_table(tmp_path):
    sn.save(sn.simulate("figure-eight-60s", 1), tmp_path / "eight")
    solution = sn.smooth(sn.load(tmp_path / "eight"), end_s=10.0, initial="0,0,0,0,3,30")
    assert isinstance(solution, sn.Solution)
    table = solution.to_pandas()
    assert table.index.name == "time" and table["seconds"].iloc[0] == 0.0
    assert {"e_m", "heading_deg", "sigma_heading_deg", "gyro_bias_z_rad_s"} <= set(table.columns)


def test_replay_gives_what_was_known_at_the_time():
    session = sn.simulate("figure-eight-60s", 1)
    options = {"end_s": 10.0, "initial": "0,0,0,0,3,30"}
    causal, smoothed = sn.replay(session, **options), sn.smooth(session, **options)
    assert (causal.sigmas[2, 3:5] > smoothed.sigmas[2, 3:5]).all()  # the future makes the past surer


def test_an_unknown_option_is_named():
    with pytest.raises(sn.SmartnavError, match="unknown option vehicel; expected some of vehicle, sensors"):
        sn.smooth(sn.simulate("figure-eight-60s"), vehicel="car")


def test_a_rate_may_be_a_number_and_what_is_withheld_a_text():
    assert given_options({"rate": 10, "withhold": "gnss:every=5"}) == {"rate": "10", "withhold": ("gnss:every=5",)}
    assert given_options({"rate": "imu", "withhold": ("a", "b")}) == {"rate": "imu", "withhold": ("a", "b")}


# What a notebook shows.


@pytest.fixture(scope="module")
def session():
    return sn.simulate("figure-eight-60s", 1)


@pytest.fixture(scope="module")
def run(session):
    return sn.run(session, end_s=20.0, initial="0,0,0,0,3,30", withhold=("gnss:every=4",))


def test_large_values_are_printed_in_a_line(session, run, tmp_path):
    sn.write_run(run, tmp_path / "run", report=False, recording=False)
    evaluation = sn.evaluate(run.solution, session.reference)
    values = [session, *session.streams().values(), run, run.solution, run.solution.residuals, evaluation]
    values += [sn.read_run(tmp_path / "run"), run.problem, run.estimate, run.diagnostics, *run.withheld.values()]
    for value in values:
        assert 10 < len(repr(value)) < 800 and "\n" not in repr(value), type(value)
    for value in values[:8]:
        html = value._repr_html_()
        assert html.startswith("<table>") and len(html) < 4000
    assert "verdict" in repr(run) and repr(session.imu) == "Imu(rows 6000; span 60.0 s, 100 Hz; fields gyro, accel)"


def test_a_table_has_every_sigma_and_the_time_in_utc(run):
    table = run.solution.to_pandas()
    assert str(table.index[0]) == "2025-06-01 10:00:00+00:00" and table["seconds"].iloc[-1] == pytest.approx(20.0)
    names = [name for name in table if name.startswith("sigma_")]
    assert len(names) == 16  # of fifteen states, and the heading in degrees
    np.testing.assert_array_equal(table[[*SIGMA_NAMES]], run.solution.sigmas)
    np.testing.assert_allclose(np.degrees(table["sigma_rot_u_rad"]), table["sigma_heading_deg"])
    undated = dataclasses.replace(run.solution, clock_epoch="boot").to_pandas()
    assert undated.index.name == "seconds" and "seconds" not in undated.columns
    gps = dataclasses.replace(run.solution, clock_epoch="gps").to_pandas()
    # from 1970-01-01 to 1980-01-06, less the leap seconds
    assert gps.index[0] - table.index[0] == pd.Timedelta(days=3657, seconds=-18)


def test_a_run_read_back_has_the_same_table(run, tmp_path):
    sn.write_run(run, tmp_path / "run", report=False, recording=False)
    again = sn.read_run(tmp_path / "run").solution.to_pandas()
    pd.testing.assert_frame_equal(again, run.solution.to_pandas())


def test_plots_have_an_axis_a_quantity(session, run, tmp_path):
    path, height, speed, heading = run.solution.plot()
    np.testing.assert_array_equal(path.lines[0].get_xydata(), run.solution.nav_t_body[:, :2])
    assert [axis.get_ylabel() for axis in (height, speed, heading)] == ["height, m", "speed, m/s", "heading, deg"]
    band = height.collections[0].get_paths()[0].vertices[:, 1]
    sigma, u = run.solution.sigmas[:, 5], run.solution.nav_t_body[:, 2]
    assert (band.min(), band.max()) == pytest.approx(((u - 2 * sigma).min(), (u + 2 * sigma).max()))
    assert len(run.plot_residuals()) == len(run.solution.residuals.sensors())
    axes = sn.evaluate(run.solution, session.reference).plot()
    assert [axis.get_ylabel() for axis in axes] == ["east, m", "north, m", "up, m", "rotation, deg"]
    axes[0].figure.savefig(tmp_path / "errors.png")
    assert (tmp_path / "errors.png").stat().st_size > 5000
    matplotlib.pyplot.close("all")


def test_without_matplotlib_the_error_says_how_to_get_it(run, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(sn.SmartnavError, match=r"expected matplotlib .*; pip install 'smartnav-graph\[plot\]'"):
        run.solution.plot()


def test_a_doubtful_verdict_is_a_warning_and_a_good_one_is_silent(session, warned):
    options = {"end_s": 20.0, "initial": "0,0,0,0,3,30"}
    assert sn.run(session, **options).summary["verdict"]["level"] == "good" and warned() == ""
    moved = dataclasses.replace(session.gnss, lla=session.gnss.lla + np.outer(np.arange(60) >= 10, [3e-4, 0.0, 0.0]))
    sn.smooth(session.replace(gnss=moved), **options)
    assert "verdict: " in warned() and "gnss" in warned()


def test_a_warning_names_the_line_of_the_user(recwarn):
    sn.Session.from_arrays(imu={"t_ns": [0, 10**7], "gyro": np.zeros((2, 3)), "accel": np.ones((2, 3)), "lux": [1, 2]})
    assert recwarn[0].filename == __file__


def test_progress_is_shown_when_asked(session, capsys):
    options = {"end_s": 10.0, "initial": "0,0,0,0,3,30"}
    sn.smooth(session, **options)
    assert capsys.readouterr().err == ""
    sn.smooth(session, progress=True, **options)
    shown = capsys.readouterr().err
    assert "finding the start" in shown and shown.endswith("\r")  # the line is removed at the end
    stages = []
    sn.smooth(session, progress=lambda stage, done, total: stages.append(stage), **options)
    assert "preparing" in stages


def test_options_of_a_run_have_the_types_of_the_configuration():
    assert typing.get_type_hints(RunOptions) == typing.get_type_hints(RunConfig)


USER = """
import pandas as pd
import smartnav_graph as sn

session = sn.Session.from_pandas(imu=pd.DataFrame(), device=sn.Device(forward="+x"))
solution = sn.smooth(session, vehicle="car", progress=True)
reveal_type(solution.nav_t_body)
reveal_type(sn.run(session).summary["verdict"])
reveal_type(sn.Imu(t_ns=session.require_imu().t_ns, gyro=solution.gyro_bias, accel=solution.accel_bias).gyro)
reveal_type(solution.to_pandas())
sn.smoooth(session)
sn.smooth("kitti")
sn.smooth(session, vehicle=3)
sn.smooth(session, vehicel="car")
"""


def test_a_script_of_a_user_is_checked_by_mypy(tmp_path):
    (tmp_path / "script.py").write_text(USER)
    options = (ROOT / "pyproject.toml").read_text().replace('packages = ["smartnav_graph"]', "")
    (tmp_path / "pyproject.toml").write_text(options)  # those of the package, whose cache then serves
    command = [sys.executable, "-m", "mypy", "--no-error-summary", "--cache-dir", ROOT / ".mypy_cache", "script.py"]
    path = {**os.environ, "MYPYPATH": str(ROOT)}
    found = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, env=path).stdout
    assert found.count("note: Revealed type") == 4 and "ndarray" in found and "DataFrame" in found
    assert 'Module has no attribute "smoooth"' in found and '"smooth" has incompatible type "str"' in found
    assert 'argument "vehicle"' in found.replace("Argument", "argument") and "vehicel" in found
    assert found.count("error:") == 4, found
