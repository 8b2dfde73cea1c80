"""What rays tell once the rotation is taken out: parallax, front and behind, the twin of a pose."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from view_pairs import FORWARD, NOWHERE, SIDEWAYS, SIGMA, view

from smartnav_graph.vision.epipolar import sampson
from smartnav_graph.vision.parallax import cheirality, in_front
from smartnav_graph.vision.ransac import direction_by_samples
from smartnav_graph.vision.refine import MatchedPoints


def matched(pair):
    return MatchedPoints(pair.xy0, pair.xy1, np.full(len(pair.xy0), SIGMA))


def twin(R, t):
    return Rotation.from_rotvec(np.pi * t).as_matrix() @ R


@pytest.mark.parametrize("motion", [SIDEWAYS, FORWARD])
def test_points_lie_in_front_of_the_right_pose_only(motion):
    pair = view(0, t=motion, sigma=1e-9)
    votes = [in_front(matched(pair), R, t).mean() for R in (pair.R, twin(pair.R, pair.t)) for t in (pair.t, -pair.t)]
    assert votes[0] > 0.95 and max(votes[1:]) < 0.1


@pytest.mark.parametrize("motion", [SIDEWAYS, FORWARD])
def test_all_four_poses_have_one_geometry_and_the_one_in_front_is_found(motion):
    pair = view(1, t=motion)
    for R in (pair.R, twin(pair.R, pair.t)):
        for t in (pair.t, -pair.t):
            here, there = (sampson(*pose, pair.xy0, pair.xy1).residual for pose in ((R, t), (pair.R, pair.t)))
            np.testing.assert_allclose(np.abs(here), np.abs(there), atol=1e-12)
            found = cheirality(matched(pair), R, t, known_rotation=False)
            np.testing.assert_allclose(found[0], pair.R, atol=1e-9)
            np.testing.assert_allclose(found[1], pair.t, atol=1e-9)


def test_without_parallax_the_smaller_rotation_is_taken():
    pair = view(2, t=NOWHERE, w=(0.0, 0.02, 0.0))
    t = np.array([0.0, 1.0, 0.0])
    for start in (pair.R, twin(pair.R, t)):
        R, _ = cheirality(matched(pair), start, t, known_rotation=False)
        np.testing.assert_allclose(R, pair.R, atol=1e-9)


def test_a_known_rotation_has_no_twin():
    pair = view(3, t=SIDEWAYS)
    R, t = cheirality(matched(pair), pair.R, -pair.t, known_rotation=True)
    assert R is pair.R
    np.testing.assert_allclose(t, pair.t)


def test_the_direction_of_two_matches():
    pair = view(4, wrong=0.5)
    _, t = direction_by_samples(matched(pair), pair.R, 0.001, seed=0)
    assert abs(t @ pair.t) > np.cos(np.radians(5.0))


def test_one_point_matched_over_and_over_has_no_direction_to_tell():
    one = MatchedPoints(np.tile([[0.1, 0.2]], (9, 1)), np.tile([[0.15, 0.2]], (9, 1)), np.full(9, SIGMA))
    _, t = direction_by_samples(one, np.eye(3), 0.0, seed=0)
    assert np.linalg.norm(t) == pytest.approx(1.0)
