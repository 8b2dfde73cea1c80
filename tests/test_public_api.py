"""The public names of the package: light to import, and all there."""

import json
import subprocess
import sys

import pytest

import smartnav_graph as sn


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


def test_help_is_as_light():
    for command in ("[", "['smooth', ", "['match', ", "['import', "):
        code = f"from smartnav_graph.cli import main\nmain({command}'--help'])"
        assert not {"gtsam", "cv2", "pycolmap", "rerun", "scipy", "pandas"} & loaded_after(code)


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
    assert table.index.name == "seconds" and table.index[0] == 0.0
    assert {"e_m", "heading_deg", "sigma_heading_deg", "gyro_bias_z_rad_s"} <= set(table.columns)


def test_replay_gives_what_was_known_at_the_time():
    session = sn.simulate("figure-eight-60s", 1)
    options = {"end_s": 10.0, "initial": "0,0,0,0,3,30"}
    causal, smoothed = sn.replay(session, **options), sn.smooth(session, **options)
    assert (causal.sigmas[2, 3:5] > smoothed.sigmas[2, 3:5]).all()  # the future makes the past surer


def test_an_unknown_option_is_named():
    with pytest.raises(sn.SmartnavError, match="unknown option vehicel; expected some of vehicle, sensors"):
        sn.smooth(sn.simulate("figure-eight-60s"), vehicel="car")
