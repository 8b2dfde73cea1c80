"""Image pairs side by side: of matches and along tracks."""

import numpy as np
import pytest

from smartnav_graph.core.timebase import NS
from smartnav_graph.session.streams import Matches, Tracks
from smartnav_graph.vision.pairs import pairs_of_matches, pairs_of_tracks


def tracks():
    """Three points over five images 0.1 s apart; point 2 is seen in images 0 to 2 only."""
    rows = [(image, track) for image in range(5) for track in range(3) if track < 2 or image < 3]
    image, track = np.array(rows).T
    xy = np.stack([image + 10.0 * track, -track], axis=1)
    return Tracks(t_ns=image * NS // 10, image_id=image, track_id=track, xy_n=xy)


def test_tracks_are_paired_at_their_spans():
    pairs = pairs_of_tracks(tracks(), 10.0, (1, 3))
    assert [tuple(p) for p in pairs.images] == [(0, 1), (1, 2), (2, 3), (0, 3), (3, 4), (1, 4)]
    assert pairs.count.tolist() == [3, 3, 2, 2, 2, 2]
    np.testing.assert_array_equal((pairs.x1 - pairs.x0)[:, 0], np.repeat([1, 1, 1, 3, 1, 3], pairs.count))
    np.testing.assert_allclose(pairs.length_s, [0.1, 0.1, 0.1, 0.3, 0.1, 0.3])


def test_images_are_no_closer_than_the_rate():
    assert pairs_of_tracks(tracks(), 5.0, (1,)).t_ns.tolist() == [0, 2 * NS // 10, 4 * NS // 10]
    assert len(pairs_of_tracks(tracks(), 1.0, (1,))) == 0


def test_padding_and_back():
    pairs = pairs_of_tracks(tracks(), 10.0, (1, 3))
    padded = pairs.padded(pairs.x0)
    assert padded.shape == (6, 3, 2) and pairs.there.sum() == len(pairs.x0)
    np.testing.assert_array_equal(pairs.flat(padded), pairs.x0)
    assert not padded[~pairs.there].any()
    some = pairs.of(np.array([0, 3]))
    np.testing.assert_array_equal(some.x0, pairs.x0[np.isin(pairs.pair, [0, 3])])
    assert some.images.tolist() == [[0, 1], [0, 3]] and some.count.tolist() == [3, 2]


def matches(t_ns, t_1_ns):
    n = len(t_ns)
    ids = np.arange(n)
    xy = np.arange(2.0 * n).reshape(n, 2)
    return Matches(
        t_ns=np.array(t_ns), t_1_ns=np.array(t_1_ns), image_id_0=ids, image_id_1=ids, xy0_n=xy, xy1_n=xy + 100.0
    )


def test_the_later_image_comes_second():
    pairs = pairs_of_matches(matches([0, 0, 30, 30], [20, 30, 20, 20]))
    assert pairs.t_ns.tolist() == [0, 20, 30]
    assert [tuple(p) for p in pairs.images] == [(0, 1), (0, 2), (1, 2)]
    assert pairs.x0[:2, 0].tolist() == [0.0, 2.0] and pairs.x0[2:, 0].tolist() == [104.0, 106.0]


def test_an_image_matched_with_itself_is_no_pair():
    assert len(pairs_of_matches(matches([5, 5], [5, 5]))) == 0


@pytest.mark.parametrize("spans", [(1,), (7,)])
def test_tracks_without_common_points_make_no_pairs(spans):
    lone = Tracks(t_ns=np.arange(3) * NS, image_id=np.arange(3), track_id=np.arange(3), xy_n=np.zeros((3, 2)))
    pairs = pairs_of_tracks(lone, 10.0, spans)
    assert len(pairs) == 0 and pairs.padded(pairs.x0).shape[0] == 0
