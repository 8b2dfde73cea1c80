"""Two-view geometry: its kinds, its pose, its covariance, on simulated pairs of which the truth is known."""

import math
from collections import Counter

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from view_pairs import FORWARD, NOWHERE, SHORT, SIDEWAYS, SIGMA, turned, view

from smartnav_graph.core.errors import ConfigError, SessionError
from smartnav_graph.vision.refine import (
    EpipolarModel,
    MatchedPoints,
    PlaneModel,
    RotationModel,
    RotationPrior,
    refine,
    rotation_vector,
    tangent_basis,
)
from smartnav_graph.vision.two_view import METHODS, two_view
from smartnav_graph.vision.uncertainty import covariance

GYRO = 0.002  # rad


def run(pair, *, prior=None, method="magsac", seed=0, sigma=SIGMA):
    reported = None if prior is None else RotationPrior(prior, GYRO)
    return two_view(pair.xy0, pair.xy1, sigma, method=method, prior=reported, seed=seed)


def error(found_R, found_t, R, t):
    """Rotation (3) and direction (2) from the estimate to the truth, in the tangents of the covariance."""
    turn = Rotation.from_matrix(found_R.T @ R).as_rotvec()
    return np.concatenate([turn, tangent_basis(found_t).T @ t / max(found_t @ t, 0.05)])


def nees(found, pair):
    """Squared error over covariance a degree of freedom."""
    if not found.c0_t_c1.any():
        off = Rotation.from_matrix(found.c0_R_c1.T @ pair.R).as_rotvec()
        return off @ np.linalg.solve(found.covariance[:3, :3], off) / 3.0
    off = error(found.c0_R_c1, found.c0_t_c1, pair.R, pair.t)
    return off @ np.linalg.solve(found.covariance, off) / 5.0


def angle_deg(a, b):
    return math.degrees(math.acos(min(max(float(a @ b), -1.0), 1.0)))


def turn_deg(a, b):
    return math.degrees(Rotation.from_matrix(a.T @ b).magnitude())


@pytest.mark.parametrize("motion", [SIDEWAYS, FORWARD, SHORT], ids=["sideways", "forward", "short"])
@pytest.mark.parametrize("wrong", [0.0, 0.3])
def test_the_pose_of_a_moving_camera(motion, wrong):
    for seed in range(5):
        pair = view(seed, wrong=wrong, t=motion)
        found = run(pair)
        assert found.kind == "general" and found.reason == ""
        assert turn_deg(found.c0_R_c1, pair.R) < 0.5 and angle_deg(found.c0_t_c1, pair.t) < 12.0
        assert found.inliers[pair.right].mean() > 0.97 and found.inliers[~pair.right].sum() <= 4
        assert np.linalg.norm(found.c0_t_c1) == pytest.approx(1.0)
        assert 0.8 < found.chi2_per_dof < 1.2


@pytest.mark.parametrize("wrong", [0.1, 0.6])
def test_covariance_holds_with_wrong_matches_too(wrong):
    # A wrong match that happens to agree shows a point far nearer than all others: it would pull the pose by ten sigma.
    pairs = [view(seed, wrong=wrong, t=FORWARD) for seed in range(12)]
    ratios = [nees(run(pair), pair) for pair in pairs]
    assert np.mean(ratios) < 1.7 and max(ratios) < 5.0  # mean of 60 squares: 1 +- 0.18


def mean_nees(motion, matches, reported, seeds):
    """Of fits to right matches, with a sigma reported."""
    out = []
    for seed in seeds:
        pair = view(seed, matches, t=motion)
        matched = MatchedPoints(pair.xy0, pair.xy1, np.full(matches, reported))
        fit = refine(EpipolarModel(matched), (pair.R, pair.t), loss_scale=None)
        off = error(*fit.state, pair.R, pair.t)
        out.append(off @ np.linalg.solve(covariance("general", matched, fit, None), off) / 5.0)
    return np.mean(out)


@pytest.mark.parametrize(
    ("motion", "matches"),
    [(SIDEWAYS, 15), (SIDEWAYS, 300), (FORWARD, 30), (FORWARD, 100), (SHORT, 300)],
    ids=["sideways-15", "sideways-300", "forward-30", "forward-100", "short-300"],
)
def test_covariance_is_consistent(motion, matches):
    assert 0.85 < mean_nees(motion, matches, SIGMA, range(300)) < 1.15  # 300 x 5 squares: 1 +- 0.037
    assert mean_nees(motion, matches, SIGMA / 2.0, range(60)) > 2.5


def test_the_reported_covariance_is_consistent():
    pairs = [view(seed, 100) for seed in range(150)]
    found = [run(pair) for pair in pairs]
    assert 0.82 < np.mean([nees(one, pair) for one, pair in zip(found, pairs, strict=True)]) < 1.18  # 1 +- 0.05
    halved = [run(pair, sigma=SIGMA * 2.0) for pair in pairs[:40]]
    assert np.mean([nees(one, pair) for one, pair in zip(halved, pairs[:40], strict=True)]) < 0.5


@pytest.mark.parametrize("prior", [False, True], ids=["alone", "gyro"])
@pytest.mark.parametrize("wrong", [0.0, 0.3, 0.6])
def test_a_camera_at_rest_is_static_and_never_flips(wrong, prior):
    for seed in range(6):
        pair = view(seed, wrong=wrong, t=NOWHERE, w=NOWHERE)
        found = run(pair, prior=turned(pair.R, seed, GYRO) if prior else None)
        assert found.kind == "static"
        assert turn_deg(found.c0_R_c1, np.eye(3)) < 0.2
        assert not found.c0_t_c1.any() and np.isinf(np.diag(found.covariance)[3:]).all()


@pytest.mark.parametrize("prior", [False, True], ids=["alone", "gyro"])
@pytest.mark.parametrize("wrong", [0.0, 0.3, 0.6])
def test_a_turn_on_the_spot_has_no_baseline(wrong, prior):
    ratios = []
    for seed in range(6):
        pair = view(seed, wrong=wrong, t=NOWHERE)
        found = run(pair, prior=turned(pair.R, seed, GYRO) if prior else None)
        assert found.kind == "rotation" and not found.c0_t_c1.any()
        ratios.append(nees(found, pair))
    assert np.mean(ratios) < 2.5  # 18 squares


def test_rotation_of_a_turn_on_the_spot_is_consistent():
    pairs = [view(seed, 60, t=NOWHERE) for seed in range(100)]
    found = [(run(pair), pair) for pair in pairs]
    assert sum(one.kind == "rotation" for one, _ in found) >= 97
    assert 0.75 < np.mean([nees(one, pair) for one, pair in found if one.kind == "rotation"]) < 1.25  # 1 +- 0.08


@pytest.mark.parametrize("wrong", [0.0, 0.3])
def test_a_plane_is_seen_as_one_and_the_gyro_tells_its_two_poses_apart(wrong):
    pairs = [view(seed, wrong=wrong, plane=True) for seed in range(12)]
    found = [run(pair, prior=turned(pair.R, seed, GYRO)) for seed, pair in enumerate(pairs)]
    assert Counter(one.kind for one in found)["planar"] >= 11
    assert max(turn_deg(one.c0_R_c1, pair.R) for one, pair in zip(found, pairs, strict=True)) < 0.5
    assert max(angle_deg(one.c0_t_c1, pair.t) for one, pair in zip(found, pairs, strict=True)) < 5.0
    assert np.mean([nees(one, pair) for one, pair in zip(found, pairs, strict=True)]) < 1.8


def test_the_two_poses_of_a_plane_are_reported_where_nothing_separates_them():
    pairs = [view(seed, plane=True) for seed in range(20)]
    # the other plane is what the cameras see where the true one is turned by more
    pairs += [view(seed, plane=True, w=(0.3, -0.2, 0.1)) for seed in range(20)]
    found = [run(pair) for pair in pairs]
    assert all(one.kind == "planar" for one in found)
    reported = [
        one.reason == "another pose explains the plane as well; the smaller rotation was taken" for one in found
    ]
    assert np.mean(reported) > 0.9
    wrong = [angle_deg(one.c0_t_c1, pair.t) > 20.0 for one, pair in zip(found, pairs, strict=True)]
    assert not any(wrong[:20]) and all(wrong[20:])
    sigma = [np.degrees(np.sqrt(np.linalg.eigvalsh(one.covariance[3:, 3:])[-1])) for one in found]
    assert np.median(sigma) > 20.0  # deg: of the two poses, not of the one that was taken
    ratios = [spread(one, pair) for one, pair in zip(found, pairs, strict=True)]
    assert np.mean(ratios) < 4.0 and max(ratios) < 20.0  # thousands, were the one taken for sure


def spread(found, pair):
    """`nees` with the direction's error as an angle: on the tangent plane itself half a turn has no length."""
    across = tangent_basis(found.c0_t_c1).T @ pair.t
    length = np.linalg.norm(across)
    away = across / length * math.atan2(length, float(found.c0_t_c1 @ pair.t))
    off = np.concatenate([Rotation.from_matrix(found.c0_R_c1.T @ pair.R).as_rotvec(), away])
    return off @ np.linalg.solve(found.covariance, off) / 5.0


@pytest.mark.parametrize(("baseline", "matches"), [(0.15, 30), (0.08, 30), (0.05, 100)])
def test_few_matches_of_a_short_baseline_claim_little(baseline, matches):
    """Some fits look quite elsewhere, or the other way round: taken for sure they would be off by a hundred sigma."""
    pairs = [view(seed, matches, t=(baseline, 0.0, 0.0)) for seed in range(40)]
    found = [(run(pair), pair) for pair in pairs]
    ratios = [spread(one, pair) for one, pair in found if one.kind == "general"]
    assert len(ratios) > 30 and np.median(ratios) < 1.2 and np.mean(ratios) < 12.0
    assert np.mean(np.array(ratios) > 10.0) < 0.08


def test_a_baseline_that_may_point_either_way_is_reported():
    reported = [run(view(seed, 30, t=(0.05, 0.0, 0.0))) for seed in range(20)]
    doubted = [one for one in reported if one.kind == "general" and one.reason]
    assert len(doubted) >= 4 and {one.reason for one in doubted} == {"another pose explains the matches about as well"}
    assert min(np.linalg.eigvalsh(one.covariance[3:, 3:])[-1] for one in doubted) > 0.05  # rad^2


def test_what_lies_off_a_plane_tells_its_two_poses_apart():
    for seed in range(8):
        on, off = view(seed, 270, plane=True), view(seed + 100, 30)
        xy0, xy1 = (np.concatenate(both) for both in ((on.xy0, off.xy0), (on.xy1, off.xy1)))
        found = two_view(xy0, xy1, SIGMA)
        assert found.kind in ("planar", "general") and found.reason == ""
        assert turn_deg(found.c0_R_c1, on.R) < 0.6 and angle_deg(found.c0_t_c1, on.t) < 6.0


@pytest.mark.parametrize("method", METHODS)
def test_the_methods_agree(method):
    pair = view(3, wrong=0.4)
    found = run(pair, method=method, prior=turned(pair.R, 3, GYRO))
    other = run(pair, method="magsac", prior=turned(pair.R, 3, GYRO))
    assert found.kind == "general"
    off = error(found.c0_R_c1, found.c0_t_c1, other.c0_R_c1, other.c0_t_c1)
    assert np.all(np.abs(off) < 0.5 * np.sqrt(np.diag(found.covariance)))


@pytest.mark.parametrize("method", METHODS)
def test_the_same_seed_gives_the_same(method):
    pair = view(4, wrong=0.5)
    first, second = (run(pair, method=method, prior=pair.R, seed=5) for _ in range(2))
    np.testing.assert_array_equal(first.c0_R_c1, second.c0_R_c1)
    np.testing.assert_array_equal(first.covariance, second.covariance)


def test_a_prior_makes_the_pose_better():
    pairs = [view(seed, 30) for seed in range(30)]
    alone = [turn_deg(run(pair).c0_R_c1, pair.R) for pair in pairs]
    helped = [turn_deg(run(pair, prior=turned(pair.R, s, GYRO)).c0_R_c1, pair.R) for s, pair in enumerate(pairs)]
    assert np.median(helped) < 0.6 * np.median(alone)


def test_a_pair_in_which_all_points_jump_alike_is_refused_by_the_gyro():
    pair = view(0)
    jumped = pair._replace(xy1=pair.xy1 + np.array([17 / 467, 0.0]))  # a tracker's glitch of 17 px
    assert run(jumped).kind == "general"  # by itself it fits its own wrong motion
    found = run(jumped, prior=pair.R)
    assert found.kind == "failed" and "deg off the gyro's" in found.reason
    assert np.isinf(np.diag(found.covariance)).all() and not found.inliers.any() and math.isnan(found.chi2_per_dof)


def test_noise_by_match_weighs_the_matches():
    rng = np.random.default_rng(1)
    sigma = np.where(rng.random(300) < 0.5, SIGMA, 4.0 * SIGMA)
    off = {"each": [], "one": []}
    for seed in range(20):
        pair = view(seed, sigma=sigma[:, None])
        for name, reported in (("each", sigma), ("one", np.full(300, np.sqrt(np.mean(sigma**2))))):
            found = two_view(pair.xy0, pair.xy1, reported)
            off[name].append(turn_deg(found.c0_R_c1, pair.R))
    assert np.median(off["each"]) < 0.8 * np.median(off["one"])


def test_few_matches():
    pair = view(0, 5)
    assert run(pair).reason == "5 matches; at least 6 are needed"
    empty = two_view(np.zeros((0, 2)), np.zeros((0, 2)), SIGMA)
    assert empty.kind == "failed" and empty.inliers.shape == (0,)
    for matches in (6, 8):
        pairs = [view(seed, matches) for seed in range(10)]
        found = [run(pair, prior=turned(pair.R, seed, GYRO)) for seed, pair in enumerate(pairs)]
        assert all(one.kind == "general" for one in found)
        assert max(angle_deg(one.c0_t_c1, pair.t) for one, pair in zip(found, pairs, strict=True)) < 15.0


def test_agreement_by_chance_is_not_believed():
    rng = np.random.default_rng(0)
    for matches in (8, 12, 60):
        for seed, sigma in enumerate([SIGMA] * 7 + [1e-12]):
            xy0, xy1 = rng.uniform(-0.45, 0.45, (2, matches, 2))
            found = two_view(xy0, xy1, sigma, seed=seed)
            assert found.kind == "failed"
            assert "matches agree" in found.reason


def test_every_point_matched_twice_is_no_trouble():
    pair = view(0, 40)
    twice = [np.repeat(xy, 2, axis=0) for xy in (pair.xy0, pair.xy1)]
    assert turn_deg(two_view(*twice, SIGMA).c0_R_c1, pair.R) < 1.5
    one = np.tile([[0.1, 0.2]], (20, 1))
    assert two_view(one, one + 0.05, SIGMA).kind in ("failed", "rotation")


def test_wrong_input_is_named():
    pair = view(0, 20)
    with pytest.raises(SessionError, match=r"shapes \(20, 2\) and \(19, 2\)"):
        two_view(pair.xy0, pair.xy1[:-1], SIGMA)
    with pytest.raises(SessionError, match="shapes"):
        two_view(pair.xy0.ravel(), pair.xy1.ravel(), SIGMA)
    broken = pair.xy1.copy()
    broken[7, 1] = np.nan
    with pytest.raises(SessionError, match="no finite coordinates at row 7"):
        two_view(pair.xy0, broken, SIGMA)
    for sigma in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(SessionError, match="sigma ="):
            two_view(pair.xy0, pair.xy1, sigma)
    with pytest.raises(SessionError, match=r"sigma of shape \(3,\)"):
        two_view(pair.xy0, pair.xy1, np.full(3, SIGMA))
    with pytest.raises(ConfigError, match="method = 'ransac'; expected one of magsac, colmap, gyro"):
        two_view(pair.xy0, pair.xy1, SIGMA, method="ransac")
    with pytest.raises(ConfigError, match="gyro without a rotation prior"):
        two_view(pair.xy0, pair.xy1, SIGMA, method="gyro")
    with pytest.raises(ConfigError, match="is no rotation"):
        RotationPrior(2.0 * np.eye(3), GYRO)
    with pytest.raises(ConfigError, match="sigma = 0"):
        RotationPrior(np.eye(3), 0.0)


@pytest.mark.parametrize("size", [0.0, 1e-13, 1e-6, 0.5, 3.0, 3.1, np.pi - 1e-7])
def test_the_vector_of_a_rotation(size):
    w = size * np.array([2.0, -1.0, 2.0]) / 3.0
    np.testing.assert_allclose(rotation_vector(Rotation.from_rotvec(w).as_matrix()), w, atol=1e-9, rtol=1e-9)


@pytest.mark.parametrize("kind", ["rotation", "planar", "general"])
def test_derivatives_are_those_of_differences(kind):
    pair = view(2, 25, plane=kind == "planar")
    matched = MatchedPoints(pair.xy0, pair.xy1, np.full(25, SIGMA))
    m = 0.31 * np.array([0.3, 0.2, 1.0]) / 4.0
    model, state = {
        "rotation": (RotationModel(matched), (pair.R,)),
        "planar": (PlaneModel(matched), (pair.R, pair.t, m)),
        "general": (EpipolarModel(matched), (pair.R, pair.t)),
    }[kind]
    _, J = model.rows(state)
    step = 1e-6
    for k in range(J.shape[2]):
        ahead, behind = (model.rows(model.retract(state, sign * step * np.eye(J.shape[2])[k]))[0] for sign in (1, -1))
        # the whitening of point transfer is held: a relative error of the size of the noise times its change
        atol = 1e-4 * np.abs(J[..., k]).max() if kind == "general" else 0.08 * np.abs(J[..., k]).max()
        np.testing.assert_allclose((ahead - behind) / (2 * step), J[..., k], atol=atol)


def test_degenerate_matches_are_answered_in_words():
    rng = np.random.default_rng(0)
    shapes = {
        "one point": lambda a: np.tile(a[:1], (len(a), 1)),
        "on a line": lambda a: np.column_stack([rng.uniform(-1, 1, len(a)), a[:, 1]]),
        "half a turn": lambda a: -a,
        "zoomed": lambda a: 1.2 * a,
        "shifted": lambda a: a + np.array([0.1, 0.0]),
        "anywhere": lambda a: rng.uniform(-1, 1, a.shape),
    }
    for k in range(90):
        name = list(shapes)[k % len(shapes)]
        xy0 = rng.uniform(-1, 1, (int(rng.integers(6, 40)), 2))
        xy0[:, 1] = 0.1 if name == "on a line" else xy0[:, 1]
        prior = RotationPrior(np.eye(3), 0.01) if k % 2 else None
        found = two_view(xy0, shapes[name](xy0), 10.0 ** rng.uniform(-6, -1), prior=prior, seed=k)
        assert np.isfinite(found.c0_R_c1).all() and np.isfinite(found.c0_t_c1).all()
        assert not np.isnan(found.covariance).any()
        assert found.kind == "failed" if name in ("on a line", "anywhere") else True
        assert bool(found.reason) or found.kind != "failed"
