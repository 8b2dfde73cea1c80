"""Matches of image pairs over their images, by their use."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from recordings import T0, make_session, make_solution, stamps, write

from smartnav_graph.core.timebase import NS
from smartnav_graph.estimate.result.diagnostics import Diagnostics, ImagePairs
from smartnav_graph.factors.coplanarity import CONTRARY, FEW, IN_USE, STILL
from smartnav_graph.output.rerun_log import colours, pairs
from smartnav_graph.session.calibration.camera import Camera
from smartnav_graph.session.calibration.model import Calibration
from smartnav_graph.session.session import Mount
from smartnav_graph.session.streams import Images, Matches
from smartnav_graph.vision.pairs import Pairs

CAMERA = Camera(640, 480, 500.0, 510.0, 320.0, 240.0)
MOUNT = Mount((0.1, 0.2, 0.3), ((0.0, 0.0, 1.0), (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0)))
# image pairs 0-1, 0-2, 1-2, 2-3, 3-4, of 2, 1, 3, 2, 1 matches
PAIRS = Pairs(
    t_ns=stamps([1.0, 2.0, 3.0, 4.0, 5.0]),
    images=np.array([[0, 1], [0, 2], [1, 2], [2, 3], [3, 4]]),
    x0=np.arange(18.0).reshape(9, 2) / 100,
    x1=np.arange(18.0).reshape(9, 2) / 100 + 0.05,
    pair=np.array([0, 0, 1, 2, 2, 2, 3, 3, 4]),
)
USE = np.array([1, 0, 1, 1, 1, 0, 0, 0, 0], dtype=bool)
VERDICT = np.array([IN_USE, IN_USE, IN_USE, CONTRARY, STILL])


def seen_session(**changes):
    images = Images(
        t_ns=PAIRS.t_ns,
        image_id=np.arange(5),
        file=np.array([""] * 5, dtype=object),
        camera=np.array(["cam0"] * 5, dtype=object),
    )
    calibration = Calibration(cameras={"cam0": CAMERA})
    return make_session(images=images, calibration=calibration, sensors={"cam0": MOUNT}, **changes)


def trace_of(verdict=VERDICT):
    from recordings import NO_WIRING

    return Diagnostics(make_solution().t_ns, NO_WIRING, pairs=ImagePairs(PAIRS, USE, verdict))


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    return write(tmp_path_factory.mktemp("pairs") / "run.rrd", session=seen_session(), diagnostics=trace_of())


PATH = "/world/est/body/cam0/image/matches"


def test_arrows_lead_from_the_first_image_to_the_second_in_pixels(found):
    shown = [(0, 1), (3, 4, 5), (6, 7), (8,)]  # matches of pairs 0-1, 1-2 (shorter than 0-2), 2-3, 3-4
    origins = found.rows(PATH, "Arrows2D:origins")
    vectors = found.rows(PATH, "Arrows2D:vectors")
    scale, centre = np.array([500.0, 510.0]), np.array([320.0, 240.0]) + 0.5
    for rows, start, way in zip(shown, origins, vectors, strict=True):
        np.testing.assert_allclose(start, PAIRS.x0[list(rows)] * scale + centre, rtol=1e-6)
        np.testing.assert_allclose(way, np.full((len(rows), 2), 0.05) * scale, rtol=1e-4)
    stamps_ = found.index(PATH, "Arrows2D:origins", "elapsed") / NS
    assert stamps_.tolist() == [2.0, 3.0, 4.0, 5.0]  # of the second images


def test_colour_tells_what_became_of_a_match(found):
    colors = [[(c >> 24, c >> 16 & 255, c >> 8 & 255) for c in row] for row in found.rows(PATH, "Arrows2D:colors")]
    good, bad, unused = (tuple(c) for c in (colours.MATCH, colours.OUTLIER, colours.UNUSED))
    assert colors == [[good, bad], [good, good, bad], [bad, bad], [unused]]


def test_counts_and_verdicts_stand_on_the_time_line(found):
    counts = found.values("/pairs/matches", "Scalars:scalars")
    assert counts.tolist() == [[1, 1], [2, 1], [0, 2], [0, 1]]
    states = found.texts("/status/image_pairs", "StateChange:state")
    assert states == ["in use", "inconsistent with the other sensors", "insufficient baseline"]
    when = found.index("/status/image_pairs", "StateChange:state", "elapsed") / NS
    assert when.tolist() == [2.0, 4.0, 5.0]
    assert {"Camera cam0", "Matches of image pairs"} <= set(found.view_names())


def test_camera_sits_on_the_body_and_sees_as_calibrated(found):
    at = found.rows("/world/est/body/cam0", "Transform3D:translation", static=True)[0][0]
    np.testing.assert_allclose(at, MOUNT.body_t, rtol=1e-6)
    axes = np.array(found.rows("/world/est/body/cam0", "Transform3D:mat3x3", static=True)[0][0]).reshape(3, 3).T
    np.testing.assert_array_equal(axes, np.array(MOUNT.body_R))  # columns are stored one after the other
    matrix = np.array(found.rows("/world/est/body/cam0", "Pinhole:image_from_camera", static=True)[0][0])
    # the centre of the first pixel is (0, 0) to a calibration and (0.5, 0.5) to the viewer
    np.testing.assert_allclose(matrix.reshape(3, 3).T, [[500, 0, 320.5], [0, 510, 240.5], [0, 0, 1]])
    size = found.rows("/world/est/body/cam0", "Pinhole:resolution", static=True)[0][0]
    assert list(size) == [640, 480]


def test_of_pairs_of_one_image_the_shortest_in_use_is_shown():
    def shown(*verdict):
        return pairs.shown(ImagePairs(PAIRS, USE, np.array(verdict))).tolist()

    assert shown(IN_USE, IN_USE, IN_USE, IN_USE, IN_USE) == [0, 2, 3, 4]
    assert shown(IN_USE, IN_USE, CONTRARY, IN_USE, IN_USE) == [0, 1, 3, 4]
    assert shown(FEW, FEW, STILL, FEW, FEW) == [0, 2, 3, 4]


def test_matches_of_a_session_are_shown_before_it_is_solved(tmp_path):
    ids = np.array([0, 0, 1])
    matches = Matches(
        t_ns=PAIRS.t_ns[ids],
        image_id_0=ids,
        image_id_1=ids + 1,
        t_1_ns=PAIRS.t_ns[ids + 1],
        xy0_n=PAIRS.x0[:3],
        xy1_n=PAIRS.x1[:3],
    )
    session = seen_session(matches=matches)
    found = write(tmp_path / "s.rrd", session=session, solution=None, evaluation=None, summary=None)
    assert [len(row) for row in found.rows("/camera/cam0/image/matches", "Arrows2D:origins")] == [2, 1]
    assert "/pairs/matches" not in found.paths and "/status/image_pairs" not in found.paths
    assert "Camera cam0" in found.view_names()
    session = session.replace(calibration=None)
    bare = write(tmp_path / "b.rrd", session=session, solution=None, evaluation=None, summary=None)
    start = bare.rows("/tracks/cam0/matches", "Arrows2D:origins")
    np.testing.assert_allclose(np.concatenate(start), PAIRS.x0[:3], rtol=1e-6)
    assert "Points of cam0 (normalised)" in bare.view_names()
    assert session.t0_ns == T0


def test_legend_says_what_the_colours_of_matches_mean(found):
    legend = found.rows("/legend", "TextDocument:text", static=True)[0][0]
    assert f"* [{PATH}](recording:/{PATH}): **lines** from a point in the first image" in legend
    assert "/pairs/matches" not in legend


def test_static_data_of_no_entity_are_in_parts_whose_order_is_left_to_chance(found):
    parts = Counter(str(chunk.entity_path) for chunk in found.chunks if chunk.is_static)
    assert max(parts.values()) == 1
