"""A session with pictures and no matches is matched when it is prepared; `-images` leaves out all that images gave."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from smartnav_graph.core.timebase import NS
from smartnav_graph.estimate.config import Config, RunConfig
from smartnav_graph.estimate.pictures import policy
from smartnav_graph.estimate.problem import prepare
from smartnav_graph.session.streams import Images, PoseFix
from smartnav_graph.simulation.scenarios import simulate
from smartnav_graph.vision import match_store

sys.path.insert(0, str(Path(__file__).parents[1] / "vision"))
from scenes2d import CAMERA, centred, seen, session_of, texture

PLANE = texture(seed=7)
SHIFT = np.array([[1, 0, 6.0], [0, 1, -4.0], [0, 0, 1]])


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Ten pictures in 2.5 s of a figure eight: one has no file, one is dark, one repeated."""
    pictures = [seen(PLANE, np.linalg.matrix_power(SHIFT, k) @ centred(PLANE)) for k in range(10)]
    pictures[3], pictures[5], pictures[8] = None, np.zeros_like(pictures[0]), pictures[7]
    folder = tmp_path_factory.mktemp("recorded") / "s"
    found, eight = session_of(pictures, folder), simulate("figure-eight-60s", 0)
    images = replace(found.images, t_ns=found.images.t_ns - found.images.t_ns[0] + eight.imu.t_ns[0] + 10 * NS)
    return eight.replace(images=images, pictures=found.pictures, calibration=found.calibration)


def test_pictures_are_matched_and_those_that_cannot_be_used_are_counted(recorded):
    problem = prepare(recorded, Config())
    assert len(problem.session.matches) > 100 and problem.pairs is not None and len(problem.pairs) > 5
    assert problem.pictures.used == 7
    assert problem.dropped["images"] == {"missing file": 1, "dark or without contrast": 1, "repeated": 1}
    assert any(text.startswith("images: 1 rows missing file") for text in problem.warnings)


def test_images_left_out_leave_all_that_they_gave(recorded):
    matched = prepare(recorded, Config()).session
    model = np.array(["colmap", "total station"], dtype=object)
    fixes = PoseFix(t_ns=matched.imu.t_ns[[100, 200]], enu=np.zeros((2, 3)), source=model)
    for session in (recorded, matched.replace(pose_fixes=fixes)):
        problem = prepare(session, Config(run=RunConfig(sensors=("-images",))))
        assert problem.session.matches is None and problem.pairs is None and problem.pictures is None
        left = problem.session.pose_fixes
        assert left is None or list(left.source) == ["total station"]


def test_pictures_of_an_unknown_camera_are_a_warning(recorded):
    problem = prepare(recorded.replace(calibration=None), Config())
    assert problem.pairs is None
    assert any("images: not used" in text and "camera without calibration" in text for text in problem.warnings)


@pytest.mark.parametrize(("rate_hz", "features"), [(20.0, "klt"), (10.0, "klt"), (4.0, "orb"), (1.25, "orb")])
def test_the_rate_decides_what_is_matched(rate_hz, features):
    n = 30
    t_ns = np.round(np.arange(n) * NS / rate_hz).astype(np.int64)
    names = np.full(n, "a.png", dtype=object)
    images = Images(t_ns=t_ns, image_id=np.arange(n), file=names, camera=np.full(n, "cam", dtype=object))
    assert policy(images).features == features


def test_a_session_that_was_matched_before_reports_its_pictures(tmp_path):
    pictures = [seen(PLANE, np.linalg.matrix_power(SHIFT, k) @ centred(PLANE)) for k in range(4)]
    session_of([*pictures, None], tmp_path / "s")
    made = match_store.match(tmp_path / "s")
    assert match_store.stored_report(tmp_path / "s") == made.report
    assert made.report.skipped == {"missing file": 1} and CAMERA.width == 320
    assert match_store.stored_report(tmp_path) is None
