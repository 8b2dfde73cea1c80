"""Standstills that images show."""

import numpy as np

from smartnav_graph.core.timebase import NS
from smartnav_graph.session.streams import Tracks
from smartnav_graph.vision.pairs import pairs_of_tracks
from smartnav_graph.vision.zero_motion import MOST_DISPLACEMENT, static_periods

RATE = 10


def seen(speed, seconds=12.0, count=20, noise=3e-4):
    """Tracks of a camera whose image moves by `speed(t)` a second."""
    rng = np.random.default_rng(0)
    t = np.arange(round(seconds * RATE)) / RATE
    place = np.cumsum([speed(s) / RATE for s in t])
    start = rng.uniform(-0.4, 0.4, (count, 2))
    xy = start[None] + place[:, None, None] * [1.0, 0.5] + rng.normal(0, noise, (len(t), count, 2))
    image, track = np.meshgrid(np.arange(len(t)), np.arange(count), indexing="ij")
    t_ns = (t * NS).round().astype(np.int64)[image.ravel()]
    return Tracks(t_ns=t_ns, image_id=image.ravel(), track_id=track.ravel(), xy_n=xy.reshape(-1, 2))


def periods(tracks):
    found = static_periods(pairs_of_tracks(tracks, 4.0, (1, 2, 4)))
    return [] if found is None else [(a / NS, b / NS) for a, b in zip(found.t_ns, found.t_end_ns, strict=True)]


def test_two_stops_are_two_periods():
    found = periods(seen(lambda s: 0.0 if s < 3 or 7 <= s < 10 else 0.05))
    assert len(found) == 2
    np.testing.assert_allclose(found, [(0.0, 3.0), (7.0, 10.0)], atol=0.35)  # images 0.3 s apart


def test_a_moving_camera_never_stands():
    assert periods(seen(lambda s: 4 * MOST_DISPLACEMENT)) == []


def test_points_too_few_to_tell_say_nothing():
    assert periods(seen(lambda s: 0.0, count=5)) == []
