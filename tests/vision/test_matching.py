"""Which descriptors match: by hand-made distances."""

import numpy as np
import pytest

from smartnav_graph.core.errors import ConfigError
from smartnav_graph.vision import matching


def bits(*counts: int) -> np.ndarray:
    """Descriptors of 32 bytes with so many leading bits set: their Hamming distances are differences of counts."""
    rows = np.zeros((len(counts), 256), np.uint8)
    for row, count in zip(rows, counts, strict=True):
        row[:count] = 1
    return np.packbits(rows, axis=1)


def test_mutual_nearest_within_the_ratio():
    one, other = bits(0, 100, 200), bits(205, 3, 90)
    found = matching.pair(one, other)
    assert found.first.tolist() == [0, 1, 2] and found.second.tolist() == [1, 2, 0]
    np.testing.assert_allclose(found.score, [3 / 90, 10 / 97, 5 / 110])


def test_a_match_that_is_not_returned_is_none():
    # both 100 and 104 are nearest to 103; only the nearer keeps it
    assert matching.pair(bits(100, 104, 250), bits(103, 20, 248)).first.tolist() == [1, 2]


def test_the_second_nearest_must_be_farther():
    one = bits(100, 250)
    assert 0 not in matching.pair(one, bits(110, 89, 249)).first  # 10 of 11
    assert 0 in matching.pair(one, bits(110, 87, 249)).first  # 10 of 13
    assert 0 not in matching.pair(one, bits(100, 100, 249)).first  # twins: nobody knows which


def test_floats_are_compared_by_euclidean_distance():
    rng = np.random.default_rng(0)
    one = rng.normal(size=(40, 128)).astype(np.float32)
    order = rng.permutation(40)
    found = matching.pair(one, one[order] + 0.01)
    assert found.first.tolist() == list(range(40))
    np.testing.assert_array_equal(order[found.second], found.first)


@pytest.mark.parametrize(
    ("distances", "kept"),
    [
        ([10, 30, 31, 12, 500], [0, 3, 1]),  # three times the smallest, itself included
        (list(range(100, 80, -1)), list(range(19, 4, -1))),  # 15 of 20, the best first
        ([0, 0, 1], [0, 1]),  # none farther than three times nothing
    ],
)
def test_the_policy_of_the_thesis(distances, kept):
    nearest = np.arange(len(distances))[::-1]
    found = matching.choose_thesis(np.array(distances, float), nearest)
    assert found.first.tolist() == kept
    assert found.second.tolist() == nearest[kept].tolist()


def test_the_thesis_keeps_what_is_not_mutual():
    found = matching.pair(bits(100, 104, 250), bits(103, 20, 247), "thesis")
    assert found.first.tolist() == [1, 0, 2] and found.second.tolist() == [0, 0, 2]
    np.testing.assert_allclose(found.score, [1, 3, 3])


@pytest.mark.parametrize("policy", matching.POLICIES)
def test_too_few_points_give_no_match(policy):
    for one, other in ((bits(), bits(1, 2)), (bits(1, 2), bits(3)), (bits(1), bits(1))):
        found = matching.pair(one, other, policy)
        assert len(found.first) == len(found.second) == len(found.score) == 0


def test_an_unknown_policy():
    with pytest.raises(ConfigError, match="--policy: unknown policy 'best'; expected one of ratio, thesis"):
        matching.pair(bits(1, 2), bits(1, 2), "best")
