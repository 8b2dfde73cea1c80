"""Coplanarity of image pairs as rows of the graph: zero at the truth, exact derivatives, the sum of all matches."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smartnav_graph.factors.coplanar_rows import BASELINE_FLOOR_M, COLUMNS, CompressedRows, PairRows, Rig, relative
from smartnav_graph.vision.epipolar import sampson
from smartnav_graph.vision.pairs import Pairs

SIGMA = 1.5e-3
RIG = Rig(Rotation.from_euler("xyz", [-1.4, 0.1, 1.5]).as_matrix(), np.array([0.05, -0.1, 0.02]))


def pose(rotvec, place):
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = Rotation.from_rotvec(rotvec).as_matrix(), place
    return out


def scene(rng, rig=RIG, noise=0.0, counts=(25, 40)):
    """Two pairs of images of random points, their states and data."""
    first = np.array([pose([0.1, 0.2, -0.3], [1, 2, 3]), pose([0.3, -0.2, 0.4], [-1, 0, 1])])
    second = first @ np.array([pose([0.05, 0.1, -0.1], [0.3, 0.1, -0.05]), pose([-0.1, 0.02, 0.2], [-0.1, 0.4, 0.1])])
    data = np.zeros((2, COLUMNS))
    data[:, 0] = [0, 1]
    data[:, 1:] = rng.normal(0, 0.5, (2, 6))
    states = [first, second]
    if rig.timed:
        states += [rng.normal(0, 1, (2, 3)), rng.normal(0, 1, (2, 3)), np.full((2, 1), 0.02)]
    if rig.boresight:
        states += [np.tile([0.01, -0.02, 0.015], (2, 1))]
    if rig.focal:
        states += [np.zeros((2, 1))]
    R, t, _ = relative(rig, states, data)
    x0, x1, pair = [], [], []
    for k, count in enumerate(counts):
        far = rng.uniform([-2, -2, 3], [2, 2, 8], (count, 3))
        near = (far - t[k]) @ R[k]
        x0.append(far[:, :2] / far[:, 2:])
        x1.append(near[:, :2] / near[:, 2:])
        pair.append(np.full(count, k))
    x0, x1 = (np.concatenate(x) + rng.normal(0, noise or 1e-300, (sum(counts), 2)) for x in (x0, x1))
    stamps = np.arange(4, dtype=np.int64) * 10**9
    return Pairs(stamps, np.array([[0, 1], [2, 3]]), x0, x1, np.concatenate(pair)), states, data


def moved(letter, state, axis, h):
    if letter != "X":
        return state + h * np.eye(state.shape[1])[axis]
    step = np.zeros(6)
    step[axis] = h
    return np.array([gtsam.Pose3(p).retract(step).matrix() for p in state])


RIGS = [RIG, replace(RIG, boresight=True), replace(RIG, timed=True), replace(RIG, boresight=True, timed=True)]
RIGS.append(replace(RIGS[-1], focal=True))


@pytest.mark.parametrize("rig", RIGS)
def test_relative_pose_has_exact_derivatives(rng, rig):
    _, states, data = scene(rng, rig)
    R, _, by = relative(rig, states, data)
    h = 1e-6
    for slot, letter in enumerate(rig.letters[: len(by)]):
        for axis in range(by[slot].shape[2]):
            up, down = (
                relative(rig, [moved(letter, s, axis, f * h) if i == slot else s for i, s in enumerate(states)], data)
                for f in (1, -1)
            )
            turn = Rotation.from_matrix(down.R.transpose(0, 2, 1) @ up.R).as_rotvec() / (2 * h)
            np.testing.assert_allclose(by[slot][:, :3, axis], turn, atol=1e-7)
            np.testing.assert_allclose(by[slot][:, 3:, axis], (up.t - down.t) / (2 * h), atol=1e-7)
    assert Rotation.from_matrix(R).magnitude().min() > 0.05


@pytest.mark.parametrize("rig", RIGS)
def test_nothing_is_left_at_the_truth(rng, rig):
    pairs, states, data = scene(rng, rig)
    residual, jacobians = PairRows(pairs, rig, SIGMA, pairs.there, 2.0).linearize(states, data)
    assert np.abs(residual).max() < 1e-7
    assert all(jacobian[:, -1].any() == 0 for jacobian in jacobians)
    there = relative(rig, states, data)
    small = CompressedRows(pairs, rig, SIGMA, pairs.there, 1e6, there)
    assert np.abs(small.linearize(states, data)[0]).max() < 1e-3  # sigmas; the root of rounding


@pytest.mark.parametrize("shared", [0.0, 0.01])
@pytest.mark.parametrize("kind", ["pairs", "compressed"])
def test_derivatives_by_pose_and_focal_length(rng, kind, shared):
    """At poses near those of the matches and a focal length 3 % longer; matches that fit have a cost of none."""
    rig = replace(RIG, focal=True)
    pairs, states, data = scene(rng, rig)
    there = relative(rig, states, data)
    model = PairRows(pairs, rig, SIGMA, pairs.there, 1e6, shared=shared)
    if kind == "compressed":
        model = CompressedRows(pairs, rig, SIGMA, pairs.there, 1e6, there, shared=shared)
    off = [states[0], moved("X", states[1], 4, 0.01), np.full((2, 1), 0.01)]
    square = [(model.linearize(at, data)[0] ** 2).sum(axis=1) for at in (states, off)]
    assert (square[0] < 1e-5).all() and (square[1] > 1.0).all()
    residual, jacobians = model.linearize(off, data)
    h = 1e-6
    for slot, letter in enumerate(rig.letters):
        for axis in range(jacobians[slot].shape[2]):
            up, down = (
                model.linearize([moved(letter, s, axis, f * h) if i == slot else s for i, s in enumerate(off)], data)[0]
                for f in (1, -1)
            )
            if kind == "compressed":
                np.testing.assert_allclose(jacobians[slot][:, :, axis], (up - down) / (2 * h), rtol=1e-4, atol=1e-2)
            elif shared == 0.0:  # rows are rotated from state to state: their squares are not
                change = ((up**2).sum(axis=1) - (down**2).sum(axis=1)) / (2 * h)
                gradient = 2 * (residual * jacobians[slot][:, :, axis]).sum(axis=1)
                np.testing.assert_allclose(gradient, change, rtol=1e-4, atol=1e-1)


def test_an_error_of_direction_that_all_matches_share_counts_as_one(rng):
    """Turned by one sigma of it about the second camera, a pair of many matches costs about one."""
    pairs, states, data = scene(rng, counts=(400, 400))
    there, sigma = relative(RIG, states, data), 0.02
    across = np.cross(there.t, [0.0, 0.0, 1.0])
    across *= sigma * np.linalg.norm(there.t, axis=1)[:, None] / np.linalg.norm(across, axis=1)[:, None]
    nav_from_camera = states[0][:, :3, :3] @ RIG.body_R_cam
    aside = states[1].copy()
    aside[:, :3, 3] += np.einsum("nij,nj->ni", nav_from_camera, across)
    for model in (
        PairRows(pairs, RIG, SIGMA, pairs.there, 1e6, shared=sigma),
        CompressedRows(pairs, RIG, SIGMA, pairs.there, 1e6, there, shared=sigma),
    ):
        cost = (model.linearize([states[0], aside], data)[0] ** 2).sum(axis=1)
        assert ((cost > 0.5) & (cost < 1.1)).all()
    stiff = PairRows(pairs, RIG, SIGMA, pairs.there, 1e6).linearize([states[0], aside], data)[0]
    assert ((stiff**2).sum(axis=1) > 20.0).all()


def test_a_wrong_camera_is_seen(rng):
    pairs, states, data = scene(rng)
    for wrong in (
        replace(RIG, body_R_cam=RIG.body_R_cam.T),
        replace(RIG, body_t_cam=-5 * RIG.body_t_cam),
    ):
        assert np.abs(PairRows(pairs, wrong, SIGMA, pairs.there, 2.0).linearize(states, data)[0]).max() > 3.0
    turned_about = [states[1], states[0]]
    assert np.abs(PairRows(pairs, RIG, SIGMA, pairs.there, 2.0).linearize(turned_about, data)[0]).max() > 3.0


def test_a_row_says_what_all_of_its_matches_say(rng):
    """Cost and normal equations of a pair equal the sums over its matches, weighted by the loss."""
    pairs, states, data = scene(rng, noise=2 * SIGMA)
    use = pairs.there.copy()
    use[:, ::5] = False
    rows = PairRows(pairs, RIG, SIGMA, use, 2.0)
    residual, jacobians = rows.linearize(states, data)
    R, t, by = relative(RIG, states, data)
    for k in range(2):
        mask = use[k]
        x0, x1 = (np.asarray(pairs.padded(x))[k][mask] for x in (pairs.x0, pairs.x1))
        found = sampson(R[k], t[k], x0, x1, BASELINE_FLOOR_M)
        white = found.residual / SIGMA
        weight = 1 / (1 + white**2 / 4)
        J = np.concatenate([found.by_rotation, found.by_translation], axis=1) / SIGMA @ by[0][k]
        assert 0.5 * (residual[k] ** 2).sum() == pytest.approx(2 * np.log1p(white**2 / 4).sum(), rel=1e-9)
        np.testing.assert_allclose(jacobians[0][k].T @ jacobians[0][k], (J.T * weight) @ J, rtol=1e-8, atol=1e-3)
        np.testing.assert_allclose(jacobians[0][k].T @ residual[k], (J.T * weight) @ white, rtol=1e-6, atol=0.01)


def test_compressed_pairs_have_the_same_minimum_and_curvature(rng):
    pairs, states, data = scene(rng, noise=0.3 * SIGMA)
    there = relative(RIG, states, data)
    full = PairRows(pairs, RIG, SIGMA, pairs.there, 1e6)
    small = CompressedRows(pairs, RIG, SIGMA, pairs.there, 1e6, there)
    a, A = full.linearize(states, data)
    b, B = small.linearize(states, data)
    np.testing.assert_allclose((b**2).sum(axis=1), (a**2).sum(axis=1), rtol=1e-6)
    for k in range(2):
        one, other = A[1][k].T @ A[1][k], B[1][k].T @ B[1][k]
        assert np.abs(one - other).max() < 0.05 * np.abs(one).max()
    step = 1e-3
    for axis in range(6):
        there_too = [states[0], moved("X", states[1], axis, step)]
        cost = [(rows.linearize(there_too, data)[0] ** 2).sum(axis=1) for rows in (full, small)]
        np.testing.assert_allclose(cost[1], cost[0], rtol=0.05, atol=0.5)


def shifted(pairs, states, data, rng, size=0.03):
    """The pairs with every second image seen from elsewhere by so much a match, and told so."""
    R, t, _ = relative(RIG, states, data)
    shift = rng.normal(0, size, (len(pairs.pair), 3))
    near = rng.uniform([-2, -2, 3], [2, 2, 8], (len(pairs.pair), 3))
    far = (R[pairs.pair] @ near[..., None])[..., 0] + t[pairs.pair] + shift
    x0, x1 = far[:, :2] / far[:, 2:], near[:, :2] / near[:, 2:]
    return replace(pairs, x0=x0, x1=x1, shift=shift)


def test_a_shift_belongs_to_the_baseline(rng):
    pairs, states, data = scene(rng)
    seen = shifted(pairs, states, data, rng)
    there = relative(RIG, states, data)
    full = PairRows(seen, RIG, SIGMA, seen.there, 2.0)
    small = CompressedRows(seen, RIG, SIGMA, seen.there, 1e6, there)
    assert np.abs(full.linearize(states, data)[0]).max() < 1e-6
    assert np.abs(small.linearize(states, data)[0]).max() < 1e-3
    ignored = PairRows(replace(seen, shift=None), RIG, SIGMA, seen.there, 2.0)
    assert np.abs(ignored.linearize(states, data)[0]).max() > 3.0
    step = 1e-3
    for axis in range(6):
        moved_on = [states[0], moved("X", states[1], axis, step)]
        cost = [(rows.linearize(moved_on, data)[0] ** 2).sum(axis=1) for rows in (full, small)]
        np.testing.assert_allclose(cost[1], cost[0], rtol=0.3, atol=0.5)  # each match has its own length


def test_a_pair_seen_anew_replaces_the_old_one(rng):
    pairs, states, data = scene(rng)
    seen = shifted(pairs, states, data, rng)
    rows = PairRows(pairs, RIG, SIGMA, pairs.there, 2.0)
    rows.see(np.array([1]), seen.of(np.array([1])))
    residual = rows.linearize(states, data)[0]
    assert np.abs(residual).max() < 1e-6 and rows.shift[0].any() == 0 and rows.shift[1].any()


@pytest.mark.parametrize("rig", RIGS)
@pytest.mark.parametrize("kind", ["pairs", "compressed"])
def test_rows_fall_with_their_derivatives(rng, rig, kind):
    """The derivative of half the squares is J^T r, with outliers among the matches."""
    pairs, states, data = scene(rng, rig, noise=SIGMA)
    pairs.x1[::7] += 0.02
    there = relative(rig, states, data)
    rows = (
        PairRows(pairs, rig, SIGMA, pairs.there, 2.0)
        if kind == "pairs"
        else CompressedRows(pairs, rig, SIGMA, pairs.there, 1e6, there)
    )
    residual, jacobians = rows.linearize(states, data)
    h = 1e-6
    for slot, letter in enumerate(rig.letters):
        for axis in range(jacobians[slot].shape[2]):
            cost = [
                0.5
                * (
                    rows.linearize(
                        [moved(letter, s, axis, f * h) if i == slot else s for i, s in enumerate(states)], data
                    )[0]
                    ** 2
                ).sum(axis=1)
                for f in (1, -1)
            ]
            slope = np.einsum("md,md->m", jacobians[slot][:, :, axis], residual)
            np.testing.assert_allclose(slope, np.subtract(*cost) / (2 * h), rtol=1e-4, atol=1e-2)


def test_no_baseline_is_harmless(rng):
    pairs, states, data = scene(rng)
    still = [states[0], states[0]]
    there = relative(RIG, still, data)
    for rows in (
        PairRows(pairs, RIG, SIGMA, pairs.there, 2.0),
        CompressedRows(pairs, RIG, SIGMA, pairs.there, 1e6, there),
    ):
        residual, jacobians = rows.linearize(still, data)
        assert np.abs(residual).max() < 1e-7 and all(np.isfinite(jacobian).all() for jacobian in jacobians)


@pytest.fixture
def rng():
    return np.random.default_rng(3)
