"""The geometry of two images: what kind it is, the pose of the second camera, how well it is known.

    two_view(xy0, xy1, sigma) -> TwoView

1. The best rotation without a baseline is sought; points that stay where they were are static: no more is fitted.
2. A first pose comes from one of `METHODS`, and another one from two matches once the rotation is known, or else from
   a camera that goes straight ahead; the better one is refined on all matches under a redescending loss.
3. A plane is fitted likewise; rotation, plane and general pose are weighed (`selection`).
4. Inliers are settled, the pose refined by least squares on them, with the gyro's rotation as one more measurement.

c0_R_c1, c0_t_c1: X0 = c0_R_c1 X1 + baseline c0_t_c1.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from smartnav_graph.core.arrays import Floats, Mask
from smartnav_graph.core.errors import ConfigError, SessionError
from smartnav_graph.vision.parallax import CLEAR, faced, in_front
from smartnav_graph.vision.planar import CLEARLY_BETTER, PlanarFit, fit_plane
from smartnav_graph.vision.ransac import LEAST, OPTICAL_AXIS, Pose, colmap, directions, magsac, turns
from smartnav_graph.vision.refine import (
    GATE_SQUARE,
    REACH,
    Epipolar,
    Fit,
    Matched,
    Model,
    Plane,
    RotationPrior,
    State,
    Turn,
    angle,
    minimise,
    transfer,
)
from smartnav_graph.vision.selection import Explained, by_chance, choose, hardly_moves, stands_still
from smartnav_graph.vision.uncertainty import Other, covariance, shared, shares

Kind = Literal["static", "rotation", "planar", "general", "failed"]

METHODS: dict[str, Callable[[Matched, Floats, int], list[Pose]]] = {
    "magsac": magsac,
    "colmap": colmap,
    "gyro": lambda matched, near, seed: [],  # two matches and the prior, which all methods try, are all it has
}
MODELS: dict[str, Callable[[Matched], Model]] = {"rotation": Turn, "planar": Plane, "general": Epipolar}
# Matches that fix a pose, and with the rotation known.
SAMPLES = {"static": (2, 1), "rotation": (2, 1), "planar": (4, 3), "general": (5, 2)}
MOST_BY_CHANCE = 0.05  # sets of agreeing matches expected among wrong ones
MOST_DEVIATION = 3.5  # sigmas of the gyro's rotation
SETTLING = 5  # rounds of inliers and least squares
LARGEST_SAY, TIMES_THE_MEAN = 0.3, 4.0  # of one match in the pose; the mean say is unknowns / matches
TURNING = 6  # iterations that a rotation needs if there is no more to it
TRIED = 3  # iterations that show which start is the best
# Direction (rad) known worse than this: other baselines are looked for, across the picture and ahead; angle by which
# they are others (their rotations a tenth of it); iterations that this may take, and cost after the first at which to
# go on; share of others that is told in words.
WEAK_DIRECTION, ELSEWHERE, LOOKING, WORTHLESS, WORTH_A_WORD = 0.04, 0.35, 8, 30.0, 0.05
_ELSEWHERE = [np.array([math.cos(a), math.sin(a), 0.0]) for a in np.pi * np.arange(4) / 4] + [OPTICAL_AXIS]
TWIN = "another pose explains the plane as well; the smaller rotation was taken"
AMBIGUOUS = "another pose explains the matches about as well"


@dataclass(frozen=True)
class TwoView:
    """Relative geometry of two images.

    kind : static | rotation | planar | general | failed; reason : in words, where there is something to say
    c0_R_c1 (3, 3); c0_t_c1 (3,) unit direction of the baseline, zero where there is none
    covariance (5, 5) : [rotation rad, c0_R_c1 Exp(w); direction, unit(c0_t_c1 + B d)], B = `tangent_basis(c0_t_c1)`;
        infinite variances of what is not known; where another pose explains the matches as well (see reason), the
        second moment of both. That of a rotation holds if there is no baseline: one too short to show would turn it
    inliers (m,) : matches the geometry explains
    chi2_per_dof : of the inliers, and of the prior where there is one; NaN if failed
    """

    kind: Kind
    reason: str
    c0_R_c1: Floats
    c0_t_c1: Floats
    covariance: Floats
    inliers: Mask
    chi2_per_dof: float


def two_view(
    xy0: Floats,
    xy1: Floats,
    sigma: float | Floats,
    *,
    method: str = "magsac",
    prior: RotationPrior | None = None,
    seed: int = 0,
) -> TwoView:
    """Kind, relative pose and covariance of two images from matched points, of which some are wrong.

    Parameters
    ----------
    xy0, xy1 : (m, 2) undistorted normalised coordinates in the first and second image
    sigma : of one coordinate, normalised; one for all, or (m,)
    method : where the first pose comes from: magsac (OpenCV), colmap (pycolmap), gyro (prior and two matches)
    prior : rotation known beforehand with its sigma
    seed : of all random samples

    Returns
    -------
    TwoView; of kind ``failed``, with the reason, where the matches allow no answer.

    Raises
    ------
    SessionError
        Shapes differ; a coordinate or sigma is not finite.
    ConfigError
        Unknown method; gyro without a prior.
    """
    matched = _checked(xy0, xy1, sigma)
    if method not in METHODS:
        raise ConfigError("two-view geometry", f"method = {method!r}", f"one of {', '.join(METHODS)}")
    if method == "gyro" and prior is None:
        raise ConfigError("two-view geometry", "method gyro without a rotation prior", "one", "give it, or use magsac")
    if len(matched.sigma) < LEAST:
        return _failed(len(matched.sigma), f"{len(matched.sigma)} matches; at least {LEAST} are needed")
    turn = minimise(Turn(matched), (turns(matched, seed),), reach=REACH, prior=prior, iterations=TURNING)
    at_rest, _ = transfer(np.eye(3), matched)
    still = np.einsum("mk,mk->m", at_rest, at_rest)
    if stands_still(still):
        return _told("static", "", matched, turn.state, prior)
    return _moved(matched, method, prior, seed, turn, still)


def _moved(matched: Matched, method: str, prior: RotationPrior | None, seed: int, turn: Fit, still: Floats) -> TwoView:
    """The geometry of images whose points move."""
    general = _general(matched, method, prior, seed, turn)
    plane = fit_plane(matched, general.square < GATE_SQUARE[1], prior, seed)
    models = {"static": Explained(still, _deviation(np.eye(3), prior)), "rotation": _explained(turn, prior)}
    models["general"] = _explained(general, prior)
    if plane is not None:
        models["planar"] = _explained(plane.fit, prior)
    kind = choose(models)
    if kind == "planar" and plane is not None:
        return _besides(_told("planar", "", matched, plane.fit.state, prior), plane.others, TWIN)
    if kind == "general":
        R, t = faced(matched.only(general.square < GATE_SQUARE[1]), *general.state, known_rotation=prior is not None)
        told = _told("general", "", matched, (R, t), prior)
        near = turn.state[0] if prior is None else prior.c0_R_c1
        return _besides(told, [] if told.kind == "failed" else _others(matched, told, plane, near, prior), AMBIGUOUS)
    at_rest = kind == "static" or hardly_moves(still[turn.square < GATE_SQUARE[2]])
    return _told("static" if at_rest else "rotation", "", matched, turn.state, prior)


def _checked(xy0: Floats, xy1: Floats, sigma: float | Floats) -> Matched:
    first, second = (np.asarray(xy, dtype=np.float64) for xy in (xy0, xy1))
    if first.ndim != 2 or first.shape != second.shape or first.shape[1] != 2:
        raise SessionError("matches", f"shapes {first.shape} and {second.shape}", "(m, 2) twice", stream="matches")
    spread = np.asarray(sigma, dtype=np.float64)
    if spread.shape not in ((), (len(first),)):
        raise SessionError("matches", f"sigma of shape {spread.shape}", f"one number or ({len(first)},)")
    spread = np.broadcast_to(spread, (len(first),))
    bad = np.flatnonzero(~(np.isfinite(first).all(axis=1) & np.isfinite(second).all(axis=1)))
    if len(bad):
        row = int(bad[0])
        raise SessionError("matches", f"no finite coordinates at row {row}", "numbers", "drop the row", row=row)
    if not (np.isfinite(spread).all() and (spread > 0).all()):
        raise SessionError("matches", f"sigma = {spread.min():g}", "> 0 and finite", "give normalised units")
    return Matched(first, second, spread)


def _general(matched: Matched, method: str, prior: RotationPrior | None, seed: int, turn: Fit) -> Fit:
    """The general pose of least cost, from all starts; turned and signed as it comes."""
    model, near = Epipolar(matched), turn.state[0] if prior is None else prior.c0_R_c1
    starts = METHODS[method](matched, near, seed)
    if prior is None:  # going ahead and turning aside from a sideways baseline look alike: where one is, try the other
        starts.append((near, OPTICAL_AXIS))
    else:
        starts.append(directions(matched, near, prior.sigma, seed))
    tried = [minimise(model, start, reach=REACH, prior=prior, iterations=TRIED) for start in starts]
    return minimise(model, min(tried, key=lambda fit: fit.cost).state, reach=REACH, prior=prior)


def _deviation(R: Floats, prior: RotationPrior | None) -> float:
    """Squared deviation from the prior in sigmas."""
    return 0.0 if prior is None else float(np.sum(prior.deviation(R) ** 2))


def _explained(fit: Fit, prior: RotationPrior | None) -> Explained:
    return Explained(fit.square, _deviation(fit.state[0], prior))


def _others(
    matched: Matched, told: TwoView, plane: PlanarFit | None, near: Floats, prior: RotationPrior | None
) -> list[Other]:
    """General poses of about the same cost that are not the one told: the two of a plane, and where little parallax
    leaves the direction weak, other baselines, or the same the other way round."""
    taken: State = (told.c0_R_c1, told.c0_t_c1)
    model = Epipolar(matched)
    cost = minimise(model, taken, reach=REACH, prior=prior, iterations=1).cost
    starts: list[State] = [] if plane is None else [plane.fit.state[:2], *((one.R, one.t) for one in plane.others)]
    found: list[Other] = []
    if np.linalg.eigvalsh(told.covariance[3:, 3:])[-1] > WEAK_DIRECTION**2:
        starts += [(near, t) for t in _ELSEWHERE]
        found += _backwards(matched.only(told.inliers), told)
    known: list[State] = [taken]
    for start in starts:
        fit = minimise(model, start, reach=REACH, prior=prior, iterations=TRIED)
        if fit.cost - cost > WORTHLESS or any(_alike(fit.state, pose) for pose in known):
            continue
        fit = minimise(model, fit.state, reach=REACH, prior=prior, iterations=LOOKING)
        if fit.cost - cost < 0.5 * CLEARLY_BETTER and not any(_alike(fit.state, pose) for pose in known):
            known.append(fit.state)
            R, t = faced(matched.only(fit.square < GATE_SQUARE[1]), *fit.state, known_rotation=prior is not None)
            there = minimise(model, (R, t), reach=REACH, prior=prior, iterations=1)
            spread = covariance("general", matched, there, prior)
            found += [] if spread is None else [Other(there.state[0], there.state[1], spread, there.cost - cost)]
    return found


def _alike(one: State, other: State) -> bool:
    """Whether two poses are one, but for the sign of the baseline."""
    return angle(one[0].T @ other[0]) < ELSEWHERE / 10.0 and abs(float(one[1] @ other[1])) > math.cos(ELSEWHERE)


def _backwards(inliers: Matched, told: TwoView) -> list[Other]:
    """The same baseline the other way round, if the points do not clearly lie in front: those that do would have to be
    infinitely far away."""
    votes = in_front(inliers, told.c0_R_c1, told.c0_t_c1)
    behind = 0.5 * CLEAR**2 * float((np.sign(votes) * votes**2).sum())
    if behind >= 0.5 * CLEARLY_BETTER:
        return []
    return [Other(told.c0_R_c1, -told.c0_t_c1, told.covariance, behind)]


def _besides(told: TwoView, others: Sequence[Other], reason: str) -> TwoView:
    """What is told of a pose that others come near to."""
    if not others or told.kind == "failed":
        return told
    spread = shared(told.covariance, (told.c0_R_c1, told.c0_t_c1), others)
    return replace(told, covariance=spread, reason=reason if sum(shares(others)) > WORTH_A_WORD else "")


def _told(kind: Kind, reason: str, matched: Matched, state: State, prior: RotationPrior | None) -> TwoView:
    """Settle the inliers of a model and tell its pose, or why not."""
    inliers, fit = _settled(MODELS["rotation" if kind == "static" else kind], matched, state, prior)
    spread = None if fit is None else covariance(kind, matched.only(inliers), fit, prior)
    refused = _refused(kind, matched, int(inliers.sum()), fit, prior)
    if refused or fit is None or spread is None:
        return _failed(len(inliers), refused or "the matches leave a direction of the pose open")
    R, t = fit.state[0], fit.state[1] if len(fit.state) > 1 else np.zeros(3)
    freedom = fit.residual.size + (0 if prior is None else 3) - len(fit.information)
    chi2 = float(fit.square.sum()) + _deviation(R, prior)
    return TwoView(kind, reason, R, t, spread, inliers, chi2 / freedom)


def _refused(kind: Kind, matched: Matched, agree: int, fit: Fit | None, prior: RotationPrior | None) -> str:
    """Why a settled pose is not to be believed; empty where it is."""
    told = f"{agree} of {len(matched.sigma)} matches agree"
    if fit is None or agree < LEAST:
        return f"{told}; at least {LEAST} must"
    if by_chance(matched, agree, kind, SAMPLES[kind][prior is not None]) > MOST_BY_CHANCE:
        return f"{told}: as many would by chance"
    deviation = math.sqrt(_deviation(fit.state[0], prior))
    if prior is not None and deviation > MOST_DEVIATION:
        return f"rotation {math.degrees(deviation * prior.sigma):.2f} deg off the gyro's, {deviation:.1f} sigma"
    return ""


def _settled(
    model: Callable[[Matched], Model], matched: Matched, state: State, prior: RotationPrior | None
) -> tuple[Mask, Fit | None]:
    """Inliers of a state and least squares on them, in turn until they stay."""
    checked = np.ones(len(matched.sigma), dtype=bool)
    inliers = _inliers(model, matched, state)
    for _ in range(SETTLING):
        if inliers.sum() < LEAST:
            return inliers, None
        fit = minimise(model(matched.only(inliers)), state, prior=prior)
        checked[np.flatnonzero(inliers)[_unchecked(fit)]] = False
        before, inliers, state = inliers, _inliers(model, matched, fit.state) & checked, fit.state
        if np.array_equal(before, inliers):
            break
    return before, fit


def _inliers(model: Callable[[Matched], Model], matched: Matched, state: State) -> Mask:
    r, _ = model(matched).rows(state)
    good = np.asarray(np.einsum("mk,mk->m", r, r) < GATE_SQUARE[r.shape[1]])
    if model is Epipolar:
        good &= in_front(matched, *state) > -1.0  # clearly behind a camera is no match, whatever its residual
    return good


def _unchecked(fit: Fit) -> Mask:
    """Matches (m,) with so much say in the pose that the others cannot show them wrong (Baarda's redundancy numbers).

    A wrong match that happens to agree is such a one: it shows a point far nearer than all the others.
    """
    known = np.linalg.pinv(fit.information, hermitian=True)
    say = np.einsum("mkp,pq,mkq->m", fit.jacobian, known, fit.jacobian)
    return np.asarray(say > max(LARGEST_SAY, TIMES_THE_MEAN * len(known) / len(say)))


def _failed(m: int, reason: str) -> TwoView:
    unknown = np.diag(np.full(5, np.inf))
    return TwoView("failed", reason, np.eye(3), np.zeros(3), unknown, np.zeros(m, dtype=bool), np.nan)
