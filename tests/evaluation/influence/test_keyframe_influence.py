"""Influence on a keyframe, against systems that can be solved by hand."""

import numpy as np
import pytest

from smartnav_graph.core.errors import SolverError
from smartnav_graph.evaluation.influence import CALIBRATION, Group, Influence, Keyframes, influence_of_keyframe
from smartnav_graph.graph.states import key

EAST = 3  # of the fifteen components
UPRIGHT = np.eye(3)
TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # heading west: body x points north


def keyframes(count: int, R: np.ndarray = UPRIGHT) -> Keyframes:
    number = np.arange(count)
    return Keyframes(number, 10**9 * number, np.full(count, "normal", dtype=object), np.tile(R, (count, 1, 1)))


def group(sensor: str, index: tuple[int, ...], letters: str, *jacobians: np.ndarray, b: np.ndarray) -> Group:
    rows = np.concatenate([*jacobians, np.atleast_1d(b)[:, None]], axis=1)
    names = [[key(letter, i) for letter, i in zip(letters, index, strict=True)]]
    t_ns = np.array([10**9 * index[-1]])
    return Group(sensor, t_ns, np.array([7 * index[-1]]), np.array(names, dtype=np.uint64), rows[None])


def prior(index: int, *, place: bool) -> list[Group]:
    """Unit information of every component of one keyframe, of its position only on request."""
    of_pose = np.eye(6) if place else np.eye(6)[:3]
    return [
        group("prior", (index,), "X", of_pose, b=np.zeros(len(of_pose))),
        group("prior", (index,), "V", np.eye(3), b=np.zeros(3)),
        group("prior", (index,), "B", np.eye(6), b=np.zeros(6)),
    ]


def fix(index: int, sigma: float = 1.0, b: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Group:
    return group("gnss", (index,), "X", np.eye(6)[3:] / sigma, b=np.array(b))


def link(one: int, other: int, sigma: float, b: float = 0.0) -> Group:
    """Ties the places (body axes) of two keyframes, along each axis."""
    rows = np.eye(6)[3:] / sigma
    return group("imu", (one, other), "XX", -rows, rows, b=np.array([b, 0.0, 0.0]))


def test_fixes_alone_give_the_position_and_the_prior_alone_the_heading():
    found = influence_of_keyframe(Influence([*prior(0, place=False), fix(0, sigma=2.0)], keyframes(1)), 0)
    assert found.sources == ("gnss", "prior")
    np.testing.assert_allclose(found.share[0], [0, 0, 0, 1, 1, 1, *[0] * 9])
    np.testing.assert_allclose(found.share[1], [1, 1, 1, 0, 0, 0, *[1] * 9])
    np.testing.assert_allclose(found.sigma[3:6], 2.0)
    assert np.isinf(found.without[0, 3:6]).all() and np.isinf(found.without[1, :3]).all()
    np.testing.assert_allclose(found.without[1, 3:6], 1.0)
    assert found.touching.tolist() == [1, 3]


# Fixes at 0 and 3 of sigma 1, tied by a link of variance 2 and measured distance 0: x0 = 3/4, x1 = 9/4, variance 3/4.
CHAIN = [
    *prior(0, place=False),
    *prior(1, place=False),
    fix(0, b=(-0.75, 0.0, 0.0)),
    fix(1, b=(0.75, 0.0, 0.0)),
    link(0, 1, np.sqrt(2.0), b=-1.5 / np.sqrt(2.0)),
]


def test_shares_shifts_and_absences_along_a_chain():
    found = influence_of_keyframe(Influence(CHAIN, keyframes(2)), 0)
    gnss, imu, _ = range(3)
    np.testing.assert_allclose(found.covariance[EAST, EAST], 0.75)
    # K of the near fix is P = 3/4, of the link P sqrt(2) / 3, of the far fix P / 3
    np.testing.assert_allclose(found.share[:, EAST], [0.75 + 0.75 / 9, 0.75 * 2 / 9, 0.0], atol=1e-12)
    np.testing.assert_allclose(found.at_keyframe[:, EAST], [0.75, 0.0, 0.0], atol=1e-12)
    shifts = np.array([[-0.5625 + 0.1875, 0.375, 0.0], [-0.5625, 0.375, 0.0]]) / np.sqrt(0.75)  # K_f b_f
    np.testing.assert_allclose([found.shift[:, EAST], found.shift_at_keyframe[:, EAST]], shifts, atol=1e-12)
    np.testing.assert_allclose(found.without[imu, EAST], 1.0 / np.sqrt(0.75))
    assert np.isinf(found.without[gnss, EAST])
    np.testing.assert_allclose(found.own[[gnss, imu], EAST], [1.0, np.sqrt(2.0)])
    assert np.isinf(found.own[gnss, 0])


def test_every_measurement():
    each = influence_of_keyframe(Influence(CHAIN, keyframes(2)), 0).measurements
    far = np.flatnonzero((each.source == "gnss") & (each.t_ns == 10**9))
    np.testing.assert_allclose(each.share[far, EAST], 0.75 / 9)
    np.testing.assert_allclose(each.shift[far, EAST], 0.25 * 0.75 / np.sqrt(0.75))
    assert each.row[far] == [7]
    np.testing.assert_allclose(each.share.sum(axis=0), 1.0)
    np.testing.assert_allclose(each.shift.sum(axis=0), 0.0, atol=1e-12)  # the solution is where shifts balance


def test_components_are_in_nav_axes():
    """A body that heads west: a tie along its x axis is one to the north."""
    rows = np.eye(6)[3:] / np.array([[1.0], [2.0], [4.0]])
    places = group("gnss", (0,), "X", rows, b=np.array([0.5, 0.0, 0.0]))
    found = influence_of_keyframe(Influence([*prior(0, place=False), places], keyframes(1, TURN)), 0)
    np.testing.assert_allclose(found.sigma[3:6], [2.0, 1.0, 4.0])
    np.testing.assert_allclose(found.shift[0, 3:6], [0.0, 0.5, 0.0], atol=1e-12)


def test_a_session_state_is_not_another_keyframe():
    """A fix that also depends on a clock offset touches this keyframe alone."""
    timed = group("gnss", (0, 1), "XT", np.eye(6)[3:], np.array([[10.0], [0.0], [0.0]]), b=np.zeros(3))
    clock = group(CALIBRATION, (1,), "T", np.array([[20.0]]), b=np.zeros(1))
    found = influence_of_keyframe(Influence([*prior(0, place=False), timed, clock], keyframes(1)), 0)
    gnss, calibration = found.sources.index("gnss"), found.sources.index(CALIBRATION)
    # variance of the place: 1 of the fix, (10 / 20)^2 of the clock
    np.testing.assert_allclose(found.share[[gnss, calibration], EAST], [0.8, 0.2])
    np.testing.assert_allclose(found.at_keyframe[gnss, EAST], 0.8)


def test_a_keyframe_that_is_not_determined_is_refused():
    with pytest.raises(SolverError, match="keyframe 0: is not determined by the factors stored with the run"):
        influence_of_keyframe(Influence([*prior(0, place=False), *prior(1, place=True)], keyframes(2)), 0)
