"""Points of tracks: found where they are, by rays that are right, among rays that are wrong."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smartnav_graph.session.streams import Tracks
from smartnav_graph.vision.points import Cameras, TrackObservations, observations_of_tracks, triangulate

SIGMA = 1e-3


@pytest.fixture
def rng():
    return np.random.default_rng(3)


def tracks(rows):
    """Rows of stamp, track, x, y."""
    t, track, x, y = (np.array(column) for column in zip(*rows, strict=True))
    return Tracks(t_ns=t, image_id=t, track_id=track, xy_n=np.column_stack([x, y]).astype(float))


def test_tracks_in_some_images_in_parts_of_even_length():
    rows = [(t, 7, t / 10, 0.0) for t in range(10)] + [(t, 3, 0.0, t / 10) for t in (2, 4)] + [(5, 4, 0.5, 0.5)]
    found = observations_of_tracks(tracks(sorted(rows)), np.array([0, 1, 2, 3, 4, 5, 6]), 4)
    # track 7 is seen in seven of the images: three and four of them; track 4 in one, which says nothing
    assert found.track.tolist() == [7, 3, 7] and found.count.tolist() == [4, 2, 3] and found.last.tolist() == [3, 4, 6]
    assert found.image[found.there].tolist() == [0, 1, 2, 3, 2, 4, 4, 5, 6]
    np.testing.assert_allclose(found.xy[found.there][:4], [[0, 0], [0.1, 0], [0.2, 0], [0.3, 0]])


def test_a_track_with_two_places_in_an_image_has_none_there():
    rows = [(t, 1, t / 10, 0.0) for t in range(4)] + [(2, 1, 0.9, 0.9), (2, 3, 0.1, 0.1), (3, 3, 0.1, 0.1)]
    found = observations_of_tracks(tracks(sorted(rows)), np.arange(4), 20)
    assert found.track.tolist() == [1, 3] and found.image[0].tolist() == [0, 1, 3]


def test_no_track_at_all():
    assert len(observations_of_tracks(tracks([(1, 2, 0.0, 0.0), (3, 4, 0.0, 0.0)]), np.array([1, 3]), 20)) == 0


def scene(rng, noise=0.0, n=60, seen=12):
    """Points before cameras that move sideways and turn."""
    point = rng.uniform([-2, -2, 4], [2, 2, 9], (n, 3))
    R = Rotation.from_rotvec(rng.normal(0, 0.1, (seen, 3))).as_matrix()
    t = np.column_stack([np.linspace(-0.6, 0.6, seen), *rng.normal(0, 0.1, (2, seen))])
    cameras = Cameras(np.tile(R, (n, 1, 1, 1)), np.tile(t, (n, 1, 1)))
    xy = cameras.project(point) + rng.normal(0, noise or 1e-300, (n, seen, 2))
    image, there = np.tile(np.arange(seen), (n, 1)), np.ones((n, seen), dtype=bool)
    there[::2, 9:] = False
    return point, TrackObservations(np.arange(n), image, xy, there), cameras


def test_points_are_where_they_are(rng):
    point, observations, cameras = scene(rng)
    found = triangulate(observations, cameras, SIGMA, observations.there)
    np.testing.assert_allclose(found.point, point, atol=1e-6)  # m
    assert found.inside[observations.there].all() and not found.inside[~observations.there].any()
    first, last = (cameras.t[:, k] - point for k in (0, -1))
    angle = np.arccos((first * last).sum(1) / np.linalg.norm(first, axis=1) / np.linalg.norm(last, axis=1))
    assert found.parallax[1::2] == pytest.approx(angle[1::2], rel=0.1)


def test_the_adjustment_is_that_of_least_squares(rng):
    """Residuals have the redundancy of 2 l - 3 equations, and the errors of the points their covariance."""
    point, observations, cameras = scene(rng, noise=SIGMA, n=400)
    found = triangulate(observations, cameras, SIGMA, observations.there)
    square = (found.residual[observations.there] ** 2).sum() / SIGMA**2
    assert square / (2 * observations.count.sum() - 3 * 400) == pytest.approx(1.0, abs=0.1)
    assert np.median(np.linalg.norm(found.point - point, axis=1)) < 0.06  # m, at 4 to 9 m


def test_wrong_observations_are_found(rng):
    point, observations, cameras = scene(rng, noise=SIGMA, n=200)
    wrong = rng.random(observations.there.shape) < 0.25
    spoilt = TrackObservations(
        observations.track,
        observations.image,
        np.where(wrong[..., None], rng.uniform(-0.5, 0.5, observations.xy.shape), observations.xy),
        observations.there,
    )
    found = triangulate(spoilt, cameras, SIGMA, observations.there)
    near = np.linalg.norm(found.point - point, axis=1) < 0.3
    assert near.mean() > 0.97
    inside = found.inside[near]
    assert inside[wrong[near]].mean() < 0.02 and inside[~wrong[near] & observations.there[near]].mean() > 0.98


def test_nothing_ahead_is_nothing(rng):
    """Rays that meet behind the cameras, and rays that are parallel, harm nobody."""
    _, observations, cameras = scene(rng)
    behind = TrackObservations(observations.track, observations.image, -observations.xy, observations.there)
    mirrored = Cameras(cameras.R @ np.diag([-1.0, -1.0, 1.0]), -cameras.t)
    for found in (
        triangulate(behind, mirrored, SIGMA, observations.there),
        triangulate(observations, Cameras(cameras.R, 0 * cameras.t), SIGMA, observations.there),
    ):
        assert np.isfinite(found.point).all() and np.isfinite(found.residual).all()
    still = triangulate(
        TrackObservations(observations.track, observations.image, 0 * observations.xy, observations.there),
        Cameras(np.broadcast_to(np.eye(3), cameras.R.shape), 0 * cameras.t),
        SIGMA,
        observations.there,
    )
    assert still.parallax.max() < 1e-6
