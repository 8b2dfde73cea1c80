"""Positions out of reach of the others: of another place, not of a fast motion, an outage or a receiver's noise."""

import numpy as np
import pytest

from smartnav_graph.session.detect.out_of_reach import out_of_reach
from smartnav_graph.session.streams import GnssFix

NS = 10**9


def fixes(position, step_s=1.0, sigma=None):
    t_ns = (np.arange(len(position)) * step_s * NS).astype(np.int64)
    return GnssFix(t_ns=t_ns, enu=position, sigma=sigma)


def out(position, step_s=1.0, sigma=None, at_first=None):
    return out_of_reach(fixes(position, step_s, sigma), np.nan_to_num(position), at_first)


def drive(n=200, speed=15.0, step_s=1.0):
    t = np.arange(n) * step_s
    return np.stack([300 * np.sin(speed / 300 * t), 300 * np.cos(speed / 300 * t), 0.1 * t], axis=1)


def elsewhere(kind, n):
    rows = np.arange(n)
    return {
        "few": rows % 20 == 7,
        "half": np.random.default_rng(0).random(n) < 0.47,
        "every other": rows % 2 == 1,
        "thirds": rows % 3 == 0,
        "blocks": rows // 10 % 2 == 1,
        "second": rows > 0.55 * n,
        "first": rows < 0.4 * n,
    }[kind]


@pytest.mark.parametrize("kind", ["few", "half", "thirds", "blocks", "second", "first"])
@pytest.mark.parametrize("far", [(3e3, 0, 0), (0, 5e4, 0), (-1e6, 0, 0), (3e6, 4e6, 0), (0, 0, 2e4)])
def test_the_smaller_set_of_two_places_is_out_of_reach(kind, far):
    there = elsewhere(kind, 200)
    np.testing.assert_array_equal(out(drive() + there[:, None] * far), there)


def test_of_two_places_in_turn_one_is_left():
    there = elsewhere("every other", 201)
    np.testing.assert_array_equal(out(drive(201) + there[:, None] * [1e6, 0, 0]), there)


@pytest.mark.parametrize("kind", ["half", "blocks", "second"])
def test_a_replay_keeps_to_the_place_it_began_at(kind):
    there, first = elsewhere(kind, 200), np.arange(200) < 30
    found = out(drive() + there[:, None] * [1e6, 0, 0], at_first=first)
    assert (found == there).all() or (found == ~there).all()
    assert found[:30].mean() <= 0.5  # the set that was larger at first


def test_a_later_row_changes_nothing_in_a_replay():
    position = drive() + elsewhere("half", 200)[:, None] * [1e5, 0, 0]
    first = np.arange(200) < 30
    np.testing.assert_array_equal(out(position, at_first=first)[:120], out(position[:120], at_first=first[:120]))


@pytest.mark.parametrize(
    ("position", "step_s"),
    [
        (drive(), 1.0),
        (drive(speed=60.0, step_s=30.0), 30.0),  # sparse
        (np.arange(200.0)[:, None] * [250.0, 0, 10], 1.0),  # an aeroplane
        (np.arange(200.0)[:, None] * [7500.0, 0, 0], 1.0),  # a satellite
        (drive() + np.random.default_rng(1).normal(0, 15.0, (200, 3)), 1.0),  # a phone
        (drive(1), 1.0),
        (np.zeros((0, 3)), 1.0),
    ],
)
def test_one_motion_is_within_reach(position, step_s):
    assert not out(position, step_s).any()


def test_stated_noise_counts():
    noisy = drive() + np.random.default_rng(2).normal(0, 400.0, (200, 3))
    assert not out(noisy, sigma=np.full((200, 3), 400.0)).any()
    assert out(noisy).mean() > 0.3


def test_unknown_heights_are_no_distance():
    position = drive()
    position[::2, 2] = np.nan
    assert not out(position + np.array([0, 0, 5e3])).any()


def test_outliers_at_the_edge_of_reach_do_not_part_the_drive():
    """Three in a row, each within reach of the drive, not of each other."""
    position = drive(step_s=0.5)
    position[90:93] += np.array([[100.0, 0, 0], [-120.0, 0, 0], [110.0, 0, 0]])
    assert not out(position, 0.5).any()


def test_long_recordings_take_no_longer_than_a_moment():
    """Ten hours, a tenth elsewhere."""
    n = 36000
    there = np.random.default_rng(4).random(n) < 0.1
    np.testing.assert_array_equal(out(drive(n) + there[:, None] * [0, 3e5, 0]), there)
