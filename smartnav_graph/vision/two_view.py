"""The relative geometry of two images: its kind, the pose of the second camera, and the covariance of the pose.

    two_view(xy0, xy1, sigma) -> TwoView

1. The best rotation without a baseline is found. If the points do not move, the images are static.
2. First poses come from one of `METHODS`, and from two matches with a known rotation, or else from a camera that moves
   straight ahead. The best one is refined on all matches under a redescending loss.
3. A plane is fitted in the same way; rotation, plane and general pose are compared (`selection`).
4. The inliers are found, and the pose is refined by least squares on them, with the gyro's rotation as one more
   measurement.

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
from smartnav_graph.vision.parallax import CLEAR, cheirality, in_front
from smartnav_graph.vision.planar import CLEARLY_BETTER, PlanarFit, fit_plane
from smartnav_graph.vision.ransac import (
    LEAST,
    OPTICAL_AXIS,
    Pose,
    colmap,
    direction_by_samples,
    magsac,
    rotation_by_samples,
)
from smartnav_graph.vision.refine import (
    GATE_SQUARE,
    EpipolarModel,
    MatchedPoints,
    PlaneModel,
    PoseFit,
    ResidualModel,
    RotationModel,
    RotationPrior,
    State,
    angle,
    refine,
    transfer,
)
from smartnav_graph.vision.selection import ModelFit, by_chance, is_nearly_static, is_static, select_model
from smartnav_graph.vision.uncertainty import Alternative, covariance, mixture_covariance, probabilities

Kind = Literal["static", "rotation", "planar", "general", "failed"]

METHODS: dict[str, Callable[[MatchedPoints, Floats, int], list[Pose]]] = {
    "magsac": magsac,
    "colmap": colmap,
    "gyro": lambda matched, near, seed: [],  # nothing beyond what all methods try: two matches and the prior
}
ModelType = Callable[[MatchedPoints], ResidualModel]
MODELS: dict[str, ModelType] = {"rotation": RotationModel, "planar": PlaneModel, "general": EpipolarModel}
# Matches that determine a pose, and with a known rotation.
SAMPLES = {"static": (2, 1), "rotation": (2, 1), "planar": (4, 3), "general": (5, 2)}
MOST_BY_CHANCE = 0.05  # expected sets of agreeing matches among wrong ones
MOST_DEVIATION = 3.5  # sigmas of the gyro's rotation
INLIER_ROUNDS = 5  # rounds of inliers and least squares
LARGEST_LEVERAGE, TIMES_THE_MEAN = 0.3, 4.0  # of one match on the pose; the mean leverage is unknowns / matches
ROTATION_ITERATIONS = 6  # enough for a rotation
START_ITERATIONS = 3  # enough to compare first poses
# If the direction is known worse than WEAK_DIRECTION (rad), other baselines are tried, across the picture and ahead.
# DISTINCT: angle (rad) between the baselines of two different poses (their rotations: a tenth of it).
WEAK_DIRECTION, DISTINCT = 0.04, 0.35
ALTERNATIVE_ITERATIONS, LARGEST_COST_DIFFERENCE = 8, 30.0  # of another pose; the cost after START_ITERATIONS
REPORTED_SHARE = 0.05  # probability of other poses from which the reason mentions them
_OTHER_DIRECTIONS = [np.array([math.cos(a), math.sin(a), 0.0]) for a in np.pi * np.arange(4) / 4] + [OPTICAL_AXIS]
PLANE_AMBIGUITY = "another pose explains the plane as well; the smaller rotation was taken"
AMBIGUOUS = "another pose explains the matches about as well"


@dataclass(frozen=True)
class TwoView:
    """Relative geometry of two images.

    kind : static | rotation | planar | general | failed; reason : a remark in words, or empty
    c0_R_c1 (3, 3); c0_t_c1 (3,) unit direction of the baseline, zero where there is none
    covariance (5, 5) : [rotation rad, c0_R_c1 Exp(w); direction, unit(c0_t_c1 + B d)], B = `tangent_basis(c0_t_c1)`;
        infinite where not observable; if another pose explains the matches as well (see reason), the second moment
        of both. For kind rotation it assumes no baseline; a baseline too short to be found would bias the rotation
    inliers (m,) : matches that the geometry explains
    chi2_per_dof : of the inliers and the prior; NaN if failed
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
    TwoView; of kind ``failed``, with the reason, if the matches do not determine a pose.

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
    first = (rotation_by_samples(matched, seed),)
    rotation = refine(RotationModel(matched), first, prior=prior, iterations=ROTATION_ITERATIONS)
    displacement, _ = transfer(np.eye(3), matched)
    square = np.einsum("mk,mk->m", displacement, displacement)
    if is_static(square):
        return _solved("static", matched, rotation.state, prior)
    return _of_moving_points(matched, method, prior, seed, rotation, square)


def _of_moving_points(
    matched: MatchedPoints, method: str, prior: RotationPrior | None, seed: int, rotation: PoseFit, static: Floats
) -> TwoView:
    """The geometry of images whose points move; static (m,) : their squared displacements."""
    near = rotation.state[0] if prior is None else prior.c0_R_c1
    general = _general(matched, method, prior, seed, near)
    plane = fit_plane(matched, general.square < GATE_SQUARE[1], prior, seed)
    models = {"static": ModelFit(static, _deviation(np.eye(3), prior)), "rotation": _explained(rotation, prior)}
    models["general"] = _explained(general, prior)
    if plane is not None:
        models["planar"] = _explained(plane.fit, prior)
    kind = select_model(models)
    if kind == "planar" and plane is not None:
        return _with_alternatives(_solved("planar", matched, plane.fit.state, prior), plane.others, PLANE_AMBIGUITY)
    if kind == "general":
        pose = _in_front(matched, general, prior)
        found = _solved("general", matched, pose, prior)
        others = [] if found.kind == "failed" else _alternatives(matched, found, plane, near, prior)
        return _with_alternatives(found, others, AMBIGUOUS)
    at_rest = kind == "static" or is_nearly_static(static[rotation.square < GATE_SQUARE[2]])
    return _solved("static" if at_rest else "rotation", matched, rotation.state, prior)


def _checked(xy0: Floats, xy1: Floats, sigma: float | Floats) -> MatchedPoints:
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
    return MatchedPoints(first, second, spread)


def _general(matched: MatchedPoints, method: str, prior: RotationPrior | None, seed: int, near: Floats) -> PoseFit:
    """The general pose of least cost, from all starts; which of the four poses of its essential matrix is open."""
    model = EpipolarModel(matched)
    starts = METHODS[method](matched, near, seed)
    if prior is None:  # a forward motion looks like a sideways motion with a rotation: try the other one too
        starts.append((near, OPTICAL_AXIS))
    else:
        starts.append(direction_by_samples(matched, near, prior.sigma, seed))
    tried = [refine(model, start, prior=prior, iterations=START_ITERATIONS) for start in starts]
    return refine(model, min(tried, key=lambda fit: fit.cost).state, prior=prior)


def _deviation(R: Floats, prior: RotationPrior | None) -> float:
    """Squared deviation from the prior in sigmas."""
    return 0.0 if prior is None else float(np.sum(prior.deviation(R) ** 2))


def _explained(fit: PoseFit, prior: RotationPrior | None) -> ModelFit:
    return ModelFit(fit.square, _deviation(fit.state[0], prior))


def _in_front(matched: MatchedPoints, fit: PoseFit, prior: RotationPrior | None) -> Pose:
    """The pose of a general fit with the scene in front of the cameras."""
    R, t = fit.state
    return cheirality(matched.only(fit.square < GATE_SQUARE[1]), R, t, known_rotation=prior is not None)


def _alternatives(
    matched: MatchedPoints, found: TwoView, plane: PlanarFit | None, near: Floats, prior: RotationPrior | None
) -> list[Alternative]:
    """General poses other than the one found, of about the same cost: the two of a plane, and where the direction is
    weak for lack of parallax, other baselines or the reversed one."""
    taken: State = (found.c0_R_c1, found.c0_t_c1)
    model = EpipolarModel(matched)
    cost = refine(model, taken, prior=prior, iterations=1).cost
    starts: list[State] = [] if plane is None else [plane.fit.state[:2], *((one.R, one.t) for one in plane.others)]
    others: list[Alternative] = []
    if np.linalg.eigvalsh(found.covariance[3:, 3:])[-1] > WEAK_DIRECTION**2:
        starts += [(near, t) for t in _OTHER_DIRECTIONS]
        others += _reversed_baseline(matched.only(found.inliers), found)
    known: list[State] = [taken]
    for start in starts:
        fit = refine(model, start, prior=prior, iterations=START_ITERATIONS)
        if fit.cost - cost > LARGEST_COST_DIFFERENCE or any(_same_pose(fit.state, pose) for pose in known):
            continue
        fit = refine(model, fit.state, prior=prior, iterations=ALTERNATIVE_ITERATIONS)
        if fit.cost - cost < 0.5 * CLEARLY_BETTER and not any(_same_pose(fit.state, pose) for pose in known):
            known.append(fit.state)
            fit = refine(model, _in_front(matched, fit, prior), prior=prior, iterations=1)
            spread = covariance("general", matched, fit, prior)
            others += [] if spread is None else [Alternative(fit.state[0], fit.state[1], spread, fit.cost - cost)]
    return others


def _same_pose(one: State, other: State) -> bool:
    """Whether two poses are the same, except for the sign of the baseline."""
    return angle(one[0].T @ other[0]) < DISTINCT / 10.0 and abs(float(one[1] @ other[1])) > math.cos(DISTINCT)


def _reversed_baseline(inliers: MatchedPoints, found: TwoView) -> list[Alternative]:
    """The reversed baseline, if the points are not clearly in front: those that are would have to be at infinity."""
    votes = in_front(inliers, found.c0_R_c1, found.c0_t_c1)
    cost_difference = 0.5 * CLEAR**2 * float((np.sign(votes) * votes**2).sum())
    if cost_difference >= 0.5 * CLEARLY_BETTER:
        return []
    return [Alternative(found.c0_R_c1, -found.c0_t_c1, found.covariance, cost_difference)]


def _with_alternatives(found: TwoView, others: Sequence[Alternative], reason: str) -> TwoView:
    """The result with the covariance that includes the alternatives."""
    if not others or found.kind == "failed":
        return found
    spread = mixture_covariance(found.covariance, (found.c0_R_c1, found.c0_t_c1), others)
    return replace(found, covariance=spread, reason=reason if sum(probabilities(others)) > REPORTED_SHARE else "")


def _solved(kind: Kind, matched: MatchedPoints, state: State, prior: RotationPrior | None) -> TwoView:
    """The result of one model with its final inliers, or the reason why it fails."""
    inliers, fit = _final_inliers(MODELS["rotation" if kind == "static" else kind], matched, state, prior)
    spread = None if fit is None else covariance(kind, matched.only(inliers), fit, prior)
    rejection = _rejection(kind, matched, int(inliers.sum()), fit, prior)
    if rejection or fit is None or spread is None:
        return _failed(len(inliers), rejection or "the matches do not determine the pose")
    R, t = fit.state[0], fit.state[1] if len(fit.state) > 1 else np.zeros(3)
    freedom = fit.residual.size + (0 if prior is None else 3) - len(fit.information)
    chi2 = float(fit.square.sum()) + _deviation(R, prior)
    return TwoView(kind, "", R, t, spread, inliers, chi2 / freedom)


def _rejection(kind: Kind, matched: MatchedPoints, agree: int, fit: PoseFit | None, prior: RotationPrior | None) -> str:
    """Why a pose is rejected; empty if it is accepted."""
    agreement = f"{agree} of {len(matched.sigma)} matches agree"
    if fit is None or agree < LEAST:
        return f"{agreement}; at least {LEAST} must"
    if by_chance(matched, agree, kind, SAMPLES[kind][prior is not None]) > MOST_BY_CHANCE:
        return f"{agreement}: as many would by chance"
    deviation = math.sqrt(_deviation(fit.state[0], prior))
    if prior is not None and deviation > MOST_DEVIATION:
        return f"rotation {math.degrees(deviation * prior.sigma):.2f} deg off the gyro's, {deviation:.1f} sigma"
    return ""


def _final_inliers(
    model: ModelType, matched: MatchedPoints, state: State, prior: RotationPrior | None
) -> tuple[Mask, PoseFit | None]:
    """Inliers of a state and least squares on them, repeated until the inliers do not change."""
    checked = np.ones(len(matched.sigma), dtype=bool)
    inliers = _inliers(model, matched, state)
    for _ in range(INLIER_ROUNDS):
        if inliers.sum() < LEAST:
            return inliers, None
        fit = refine(model(matched.only(inliers)), state, loss_scale=None, prior=prior)
        checked[np.flatnonzero(inliers)[_uncontrolled(fit)]] = False
        before, inliers, state = inliers, _inliers(model, matched, fit.state) & checked, fit.state
        if np.array_equal(before, inliers):
            break
    return before, fit


def _inliers(model: ModelType, matched: MatchedPoints, state: State) -> Mask:
    r, _ = model(matched).rows(state)
    good = np.asarray(np.einsum("mk,mk->m", r, r) < GATE_SQUARE[r.shape[1]])
    if model is EpipolarModel:
        good &= in_front(matched, *state) > -1.0  # a point clearly behind a camera is a wrong match
    return good


def _uncontrolled(fit: PoseFit) -> Mask:
    """Matches (m,) of such leverage on the pose that the others cannot test them (Baarda's redundancy numbers).

    A wrong match that happens to agree is of this kind: its point is far nearer than all the others.
    """
    known = np.linalg.pinv(fit.information, hermitian=True)
    leverage = np.einsum("mkp,pq,mkq->m", fit.jacobian, known, fit.jacobian)
    return np.asarray(leverage > max(LARGEST_LEVERAGE, TIMES_THE_MEAN * len(known) / len(leverage)))


def _failed(m: int, reason: str) -> TwoView:
    unknown = np.diag(np.full(5, np.inf))
    return TwoView("failed", reason, np.eye(3), np.zeros(3), unknown, np.zeros(m, dtype=bool), np.nan)
