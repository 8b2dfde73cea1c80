"""Tracks as points in space: the native factors as the builder makes them, at the true motion of a simulated room."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smartnav_graph.core.errors import ConfigError
from smartnav_graph.estimate import config
from smartnav_graph.estimate.problem import prepare
from smartnav_graph.factors.coplanar_rows import Rig
from smartnav_graph.factors.smart import FOCAL, IN_USE, OUTSIDE, SmartConfig
from smartnav_graph.graph.pass_state import PassState, Phase
from smartnav_graph.graph.states import key
from smartnav_graph.graph.update import GraphUpdate
from smartnav_graph.session.streams import Tracks
from smartnav_graph.simulation.scenarios import SCENARIOS

ROOM = SCENARIOS["room-30s"]
EXACT = replace(ROOM, camera=replace(ROOM.camera, camera=replace(ROOM.camera.camera, noise_px=1e-9)))
IN_FORCE = PassState(stage=1, phase=Phase.GATED, outlier_tests={"smart": 1})
SIGMA = 1e-3


def options(**sections):
    return config.from_dict({"smart": {"enabled": True}, **sections}, "test")


@pytest.fixture(scope="module")
def problem():
    return prepare(EXACT(0), options())


def smart(problem):
    builder = next(b for b in problem.builders if b.name == "smart")
    return replace(builder, sigma=SIGMA)


def selected(builder, **changes):
    """All tracks in use."""
    selection = builder.selection(IN_FORCE)
    selection = replace(selection, verdict=np.full_like(selection.verdict, IN_USE))
    return replace(IN_FORCE, selections={"smart": replace(selection, **changes)})


def steps(problem, builder, pass_state=None):
    """What the builder adds to the update of every window."""
    found, previous, builder = [], None, builder.begin()
    pass_state = selected(builder) if pass_state is None else pass_state
    for window in problem.windows:
        update = GraphUpdate(window.index, window.t1_ns, 0.0)
        builder.add(update, window, previous, pass_state)
        found.append(update)
        previous = update
    return found


def truth(problem):
    """True poses of all keyframes as gtsam.Values."""
    reference, values = problem.session.reference, gtsam.Values()
    at = np.searchsorted(reference.t_ns, [window.t1_ns for window in problem.windows])
    at = np.minimum(at, len(reference) - 1)  # the end, which no image has
    for window, row in zip(problem.windows, at, strict=True):
        R = Rotation.from_quat(reference.quat[row], scalar_first=True).as_matrix()
        values.insert(key("X", window.index), gtsam.Pose3(gtsam.Rot3(R), reference.enu[row]))
    return values


@pytest.fixture(scope="module")
def factors(problem):
    return [factor for step in steps(problem, smart(problem)) for _, factor in step.factors]


def test_nothing_is_left_at_the_truth(problem, factors):
    values = truth(problem)
    assert len(factors) > 300
    assert max(factor.error(values) for factor in factors) < 1e-6


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("axes", lambda rig: Rig(rig.body_R_cam.T, rig.body_t_cam)),
        ("boresight", lambda rig: Rig(rig.body_R_cam @ Rotation.from_rotvec([0, 0.02, 0]).as_matrix(), rig.body_t_cam)),
        ("lever arm", lambda rig: Rig(rig.body_R_cam, rig.body_t_cam + np.array([0.3, 0.0, 0.3]))),
    ],
)
def test_a_wrong_camera_is_seen(problem, name, wrong):
    builder = smart(problem)
    right = builder.camera_model
    builder.camera_model = replace(right, rig=wrong(right.rig))
    mistaken = [factor for step in steps(problem, builder) for _, factor in step.factors]
    builder.camera_model = right
    values = truth(problem)
    assert np.median([factor.error(values) for factor in mistaken]) > 3.0


def test_derivatives_are_those_of_the_error(problem, factors):
    values, rng = truth(problem), np.random.default_rng(0)
    for factor in factors[5:200:40]:
        moved, names = gtsam.Values(values), factor.keys()
        for name in names:
            moved.update(name, values.atPose3(name).retract(rng.normal(0, 3e-3, 6)))
        A, b = factor.linearize(moved).jacobian()
        assert len(A) == 2 * len(names) - 3
        assert 0.5 * b @ b == pytest.approx(factor.error(moved), rel=1e-3)
        h, gradient = 1e-6, []
        for name in names:
            for axis in np.eye(6):
                pose = moved.atPose3(name)
                cost = []
                for side in (h, -h):
                    moved.update(name, pose.retract(side * axis))
                    cost.append(factor.error(moved))
                moved.update(name, pose)
                gradient.append((cost[0] - cost[1]) / (2 * h))
        np.testing.assert_allclose(-A.T @ b, gradient, rtol=0.02, atol=0.02 * np.abs(gradient).max())


def way(factor, values):
    """How far apart the first and the farthest keyframe of a track are, m."""
    names = factor.keys()
    place = np.array([values.atPose3(name).translation() for name in names])
    return np.linalg.norm(place - place[0], axis=1).max()


def test_a_point_is_searched_to_the_end(problem):
    """GTSAM's search for a point ends at an absolute change of the squares: in small units it would not begin."""
    builder, values = smart(problem), truth(problem)
    rng = np.random.default_rng(0)
    clean = builder.sightings.xy
    noise = selected(builder, xy=clean + rng.normal(0, SIGMA, clean.shape))
    noisy = [factor for step in steps(problem, builder, noise) for _, factor in step.factors]
    noisy = [factor for factor in noisy if way(factor, values) > 0.3]  # m: the rest has no point
    rows = sum(2 * factor.size() - 3 for factor in noisy)
    assert 2 * sum(factor.error(values) for factor in noisy) / rows == pytest.approx(1.0, abs=0.05)
    assert FOCAL * SIGMA > 100.0


def test_tracks_join_once_they_are_tested_for_outliers(problem):
    builder = smart(problem)
    for pass_state in (PassState(stage=1), replace(IN_FORCE, phase=Phase.CAUSAL)):
        assert not any(step.factors for step in steps(problem, builder, pass_state))
    verdict = selected(builder).selections["smart"].verdict.copy()
    verdict[::2] = OUTSIDE
    some = steps(problem, builder, selected(builder, verdict=verdict))
    assert sum(len(step.factors) for step in some) == (verdict == IN_USE).sum()
    coplanarity = next(b for b in problem.builders if b.name == "image_pairs")
    assert not any(step.blocks for step in steps(problem, coplanarity, IN_FORCE))


def test_every_factor_stands_at_the_keyframe_that_saw_its_track_last(problem):
    builder = smart(problem)
    for step in steps(problem, builder):
        for tag, factor in step.factors:
            names = factor.keys()
            seen = [gtsam.symbolIndex(name) for name in names]
            assert tag.t_ns == step.t_ns and max(seen) == step.index and seen == sorted(set(seen))
            assert len(seen) <= builder.config.most_seen


def test_off_unless_asked_for():
    assert not any(b.name == "smart" for b in prepare(EXACT(0), config.from_dict({}, "test")).builders)


def test_what_cannot_be_is_refused():
    session = EXACT(0)
    with pytest.raises(ConfigError, match=r"\[smart\]: enabled, but the session has no tracks.*--features klt"):
        prepare(session.replace(tracks=None), options())
    with pytest.raises(ConfigError, match="in a replay without its polish"):
        prepare(session, options(replay={"polish": False}), causal=True)
    for wrong in ({"most_seen": 2}, {"least_parallax": 0.0}):
        with pytest.raises(ConfigError, match=r"\[smart\]"):
            SmartConfig(**wrong)


def test_two_observations_make_no_point():
    session = EXACT(0)
    tracks = session.tracks
    few = tracks.take(tracks.t_ns < tracks.t_ns[0] + 600_000_000)
    assert isinstance(few, Tracks)
    builder = smart(prepare(session.replace(tracks=few), options()))
    assert builder.sightings.count.max() <= 3
