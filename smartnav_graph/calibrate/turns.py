"""Clock, attitude and readout of a camera against the gyroscope, from matches alone: no graph, no map, no board.

    c0_R_c1 = body_R_cam^T b0_R_b1(t0 + offset, t1 + offset; rate - bias) body_R_cam

1. Start: rotations of pairs by `two_view`. Their size against that of the gyroscope's turns at every lag within
   `SEARCH_S`, with the best rotation of the camera in the body at each; a Cauchy cost.
2. All matches: every pair has the direction of its baseline as an unknown (two), which is eliminated; Gauss-Newton with
   Cauchy weights on offset, its drift, attitude, gyro bias (with a small change between blocks of time) and readout;
   Sampson residuals. With a readout a point is
   seen `readout` x row / rows after the first row; its ray is turned by the rate meanwhile, and the baseline changes by
   the change of the velocity (three unknowns of each pair, with a prior).
3. Covariance by the scatter between blocks of time: pairs overlap, tracks and the model are not perfect.

Source: Ovrén, Forssén (2015), Gyroscope-based video stabilisation with auto-calibration, ICRA; Kelly, Sukhatme (2011),
Visual-inertial sensor fusion, IJRR 30(1); Golub, Pereyra (1973) for the elimination.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from smartnav_graph.calibrate.turn_start import (
    CAUCHY,
    LEAST_PAIRS,
    SEARCH_S,
    TurnProblem,
    TurnState,
    start_of_turns,
)
from smartnav_graph.core.arrays import Floats, Mask
from smartnav_graph.core.clustered import clustered_covariance
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.so3 import across, log
from smartnav_graph.core.timebase import NS
from smartnav_graph.session.calibration.camera import Camera
from smartnav_graph.session.streams import Imu
from smartnav_graph.vision.elimination import eliminated
from smartnav_graph.vision.epipolar import Sampson, rays, sampson
from smartnav_graph.vision.gating import Geometry
from smartnav_graph.vision.pairs import Pairs

SIGNIFICANT = 3.0  # sigmas from which drift and readout are estimated
KNOWN = 3.0  # least deviations by which the best lag beats the others
LEAST_MATCHES, MOST_PAIRS, MOST_MATCHES = 8, 400, 100
BIAS_SIGMA = 0.05  # rad/s
BIAS_CHANGE = 3e-4  # rad/s, by which the bias of a block of time differs from the mean
DIRECTION_SIGMA = 1.0  # rad, of the baseline: none where there is no parallax
CHANGE_SIGMA = 4.0  # 1/s, change of the velocity between the images over the baseline: 2 m/s^2 over 0.5 m/s
_ITERATIONS, _CONVERGED = 30, 0.02  # sigmas
_STEPS = {"offset": 1e-4, "drift": 1e-5, "boresight": 1e-5}
ALL_TERMS = ("offset", "drift", "boresight", "bias", "readout")
WIDTH = {"offset": 1, "drift": 1, "boresight": 3, "bias": 3, "readout": 1}


@dataclass(frozen=True)
class GyroAlignment:
    """A camera against the gyroscope.

    offset_s : a frame stamped t shows IMU time t + offset, in the middle of the recording; drift : its change, s/s
    body_R_cam (3, 3); gyro_bias (3,) rad/s, mean; readout_s : from the first row to the last
    terms : what was estimated, of `ALL_TERMS`; covariance : of these, boresight as body_R_cam Exp(w), rad
    known : deviations by which this lag beats all that are more than 0.1 s away
    noise : sigma of a residual, normalised; sound (n,) : which pairs fit; blocks (k, 2) : middle (s since the first
    image) and offset of each block of time, by itself, with the rest held; block_sigma (k,) s
    """

    offset_s: float
    drift: float
    body_R_cam: Floats
    gyro_bias: Floats
    readout_s: float
    terms: tuple[str, ...]
    covariance: Floats
    known: float
    noise: float
    sound: Mask
    blocks: Floats
    block_sigma: Floats

    def sigma(self, term: str) -> Floats:
        """Of a term (k,); NaN where it was not estimated."""
        if term not in self.terms:
            return np.full(WIDTH[term], np.nan)
        return np.sqrt(np.diag(self.covariance)[term_slices(self.terms)[term]])

    @property
    def middle_sigma_s(self) -> float:
        """Sigma of offset + readout / 2, where both are terms: of the middle row."""
        where, a = term_slices(self.terms), np.zeros(len(self.covariance))
        a[where["offset"]], a[where["readout"]] = 1.0, 0.5
        return float(np.sqrt(a @ self.covariance @ a))


def term_slices(terms: Sequence[str]) -> dict[str, slice]:
    """Where each term is among the parameters."""
    found, first = {}, 0
    for term in terms:
        found[term] = slice(first, first + WIDTH[term])
        first += WIDTH[term]
    return found


def align_to_gyro(
    pairs: Pairs,
    imu: Imu,
    sigma: float,
    *,
    camera: Camera | None = None,
    terms: Sequence[str] = ALL_TERMS,
) -> GyroAlignment:
    """Align the clock and the attitude of a camera with the gyroscope.

    Parameters
    ----------
    pairs : matches, undistorted and normalised; imu : rates; sigma : of a coordinate, normalised, before it is known
    camera : says in which row a point was seen; without it the readout is not estimated
    terms : what is estimated; readout and drift are dropped where they are below three sigmas

    Raises
    ------
    SessionError
        Too few pairs or rotations, or no lag that fits clearly better than the others.
    """
    pairs = usable_pairs(pairs, imu)
    problem = TurnProblem(pairs, imu, camera)
    state, known = start_of_turns(problem, sigma)
    if known < KNOWN:
        found = f"no lag beats the others: the best by {known:.1f} deviations"
        remedy = "sound matches of a device that is turned"
        raise SessionError("images against gyro", found, f"at least {KNOWN:g}", remedy)
    terms = tuple(term for term in ALL_TERMS if term in terms and (term != "readout" or camera is not None))
    first = tuple(term for term in terms if term not in ("drift", "readout"))
    state, solved = _solve(problem, state, first, sigma)
    for optional in ("readout", "drift"):
        if optional not in terms:
            continue
        wider = tuple(term for term in ALL_TERMS if term in (*solved.terms, optional))
        _, once = _solve(problem, state, wider, solved.noise, iterations=1)
        if abs(once.step[term_slices(wider)[optional]][0]) < 0.7 * SIGNIFICANT * once.sigma(optional):
            continue  # not worth all steps
        tried_state, tried = _solve(problem, state, wider, solved.noise)
        value = tried_state.readout_s if optional == "readout" else tried_state.drift
        if abs(value) > SIGNIFICANT * tried.sigma(optional):
            state, solved = tried_state, tried
    blocks, block_sigma = _offset_of_blocks(problem, solved)
    blocks[:, 1] += state.offset_s + state.drift * (blocks[:, 0] - problem.middle)
    return GyroAlignment(
        *(state.offset_s, state.drift, state.body_R_cam, state.bias, state.readout_s, solved.terms, solved.covariance),
        *(known, solved.noise, solved.sound, blocks, block_sigma),
    )


def usable_pairs(pairs: Pairs, imu: Imu) -> Pairs:
    """Pairs with enough matches inside the inertial data, at most `MOST_PAIRS` evenly."""
    t = pairs.t_ns[pairs.images]
    inside = (t[:, 0] - imu.t_ns[0] > SEARCH_S * NS / 10) & (imu.t_ns[-1] - t[:, 1] > SEARCH_S * NS / 10)
    rows = np.flatnonzero(inside & (pairs.count >= LEAST_MATCHES))
    if len(rows) < LEAST_PAIRS:
        found = f"{len(rows)} pairs of images with {LEAST_MATCHES} matches inside the inertial data"
        raise SessionError("images against gyro", found, f"at least {LEAST_PAIRS}", "match more images")
    if len(rows) > MOST_PAIRS:
        rows = rows[np.unique(np.linspace(0, len(rows) - 1, MOST_PAIRS).astype(int))]
    some = pairs.of(rows.astype(np.intp))
    first = np.concatenate([[0], np.cumsum(some.count)])[:-1]
    place = np.arange(len(some.pair)) - first[some.pair]
    every = -(-some.count // MOST_MATCHES)[some.pair]
    kept = place % every == 0
    return Pairs(some.t_ns, some.images, some.x0[kept], some.x1[kept], some.pair[kept])


@dataclass(frozen=True)
class _Solved:
    terms: tuple[str, ...]
    covariance: Floats
    noise: float
    sound: Mask
    information: Floats  # (b, p, p) of each block of time
    scores: Floats  # (b, p)
    variance: float
    step: Floats  # (p,) the last one

    def sigma(self, term: str) -> float:
        """Of the first axis of a term."""
        where = term_slices(self.terms)[term]
        return float(np.sqrt(self.covariance[where.start, where.start]))


def _solve(
    problem: TurnProblem, state: TurnState, terms: tuple[str, ...], sigma: float, iterations: int = _ITERATIONS
) -> tuple[TurnState, _Solved]:
    """Gauss-Newton with Cauchy weights from a start."""
    where = term_slices(terms)
    p = sum(WIDTH[term] for term in terms)
    prior, t = np.zeros((p, p)), None
    noise = sigma
    step = np.zeros(p)
    for _ in range(iterations):
        R, (x0, x1) = problem.rotation(state), problem.seen(state)
        geometry = Geometry(rays(x0), rays(x1) @ np.swapaxes(R, 1, 2), R, problem.there)
        t = _directions(geometry, noise, t)
        seen = sampson(R, t, x0, x1)
        r = np.where(problem.there, seen.residual, 0.0)
        noise = 0.5 * (noise + max(1.4826 * float(np.median(np.abs(r[problem.there]))), 1e-6))
        weight = np.where(problem.there, 1.0 / (1.0 + (r / (CAUCHY * noise)) ** 2), 0.0)
        J = _derivatives(problem, state, terms, R, t, seen)
        Jt = np.einsum("nkj,nja->nka", seen.by_translation, across(t))
        spread = [DIRECTION_SIGMA] * 2
        if state.readout_s > 0 and problem.rows:
            delay = state.readout_s * 0.5 * (problem.rows[0] + problem.rows[1])
            Jt = np.concatenate([Jt, delay[..., None] * seen.by_translation], axis=2)
            spread += [CHANGE_SIGMA] * 3
        if "bias" in where:
            prior[where["bias"], where["bias"]] = np.eye(3) * (noise / BIAS_SIGMA) ** 2
        own_prior = np.diag((noise / np.array(spread)) ** 2)
        information, scores = _by_block(problem, *eliminated(J, -Jt, -r, weight, own_prior))
        if "bias" in where:
            information, scores = _free_bias(information, scores, where["bias"], noise)
        g = scores.sum(axis=0)
        if "bias" in where:
            g[where["bias"]] -= prior[where["bias"], where["bias"]] @ state.bias
        normal = information.sum(axis=0) + prior + 1e-15 * np.eye(p)
        step = np.linalg.solve(normal, g)
        for term in terms:
            state = state.stepped(term, step[where[term]])
        if step @ normal @ step < (_CONVERGED * noise) ** 2:
            break
    variance, factor = _variance(problem, r, weight, noise)
    covariance = factor * clustered_covariance(information, scores, variance, prior)
    sound = np.einsum("nk,nk->n", weight, problem.there) / problem.pairs.count > 0.5
    return state, _Solved(terms, covariance, noise, sound, information, scores, variance, step)


def _variance(problem: TurnProblem, r: Floats, weight: Floats, noise: float) -> tuple[float, float]:
    """Of weighted residuals, their baselines counted; and the factor by which Cauchy weights w exceed the derivatives
    of w r, squared: the covariance of an M-estimator (Huber, 1981) is s^2 (S E[(w r)'] / E[w])^-1 twice."""
    square = (r / (CAUCHY * noise)) ** 2
    slope = np.where(problem.there, (1.0 - square) / (1.0 + square) ** 2, 0.0)
    count = float(problem.there.sum())
    variance = float(((weight * r) ** 2).sum() / weight.sum()) * count / max(count - 2.0 * len(r), 1.0)
    return variance, float(weight.sum() / max(slope.sum(), 0.1 * weight.sum())) ** 2


def _derivatives(
    problem: TurnProblem, state: TurnState, terms: tuple[str, ...], R: Floats, t: Floats, seen: Sampson
) -> Floats:
    """Of the negative residuals (n, k, p): a step is added."""
    columns = []
    for term in terms:
        if term == "bias":
            by_bias = problem.by_bias(state)
            columns += [-np.einsum("nkj,nj->nk", seen.by_rotation, by_bias[:, :, axis]) for axis in range(3)]
            continue
        for axis in range(WIDTH[term]):
            step = np.zeros(WIDTH[term])
            if term == "readout":
                step[axis] = 1e-4
                x0, x1 = problem.seen(state.stepped(term, step))
                other = sampson(R, t, x0, x1).residual
                columns.append((seen.residual - other) / step[axis])
                continue
            step[axis] = _STEPS[term]
            turned = problem.rotation(state.stepped(term, step))
            w = log(np.swapaxes(R, 1, 2) @ turned) / step[axis]
            columns.append(-np.einsum("nkj,nj->nk", seen.by_rotation, w))
    return np.stack(columns, axis=-1)


def _by_block(problem: TurnProblem, information: Floats, scores: Floats) -> tuple[Floats, Floats]:
    """Of each block of time (b, p, p), (b, p)."""
    sums = [(information[rows].sum(axis=0), scores[rows].sum(axis=0)) for rows in problem.blocks]
    return np.array([one for one, _ in sums]), np.array([one for _, one in sums])


def _free_bias(information: Floats, scores: Floats, bias: slice, noise: float) -> tuple[Floats, Floats]:
    """The same where every block has a bias of its own beside the mean, which is eliminated."""
    own = information[:, bias, bias] + np.eye(3) * (noise / BIAS_CHANGE) ** 2
    carried = np.swapaxes(np.linalg.solve(own, information[:, bias, :]), 1, 2)
    return information - carried @ information[:, bias, :], scores - np.einsum("bpa,ba->bp", carried, scores[:, bias])


def _directions(geometry: Geometry, noise: float, before: Floats | None) -> Floats:
    """Directions (n, 3) of the baselines: the least eigenvectors of the normals of the epipolar planes, with Cauchy
    weights of the residuals."""
    there, t = geometry.there, before
    if t is None:
        t = geometry.fitted(there / ((geometry.normals**2).sum(axis=-1) + (3.0 * noise) ** 2))
    for _ in range(1 if before is not None else 6):
        weight = there / (1.0 + geometry.square(t) / (CAUCHY * noise) ** 2)
        t = geometry.fitted(weight / geometry.scale(t))
    return t


def _offset_of_blocks(problem: TurnProblem, solved: _Solved) -> tuple[Floats, Floats]:
    """Middle and correction of the offset (k, 2) s of each block, the other terms held; its sigma (k,)."""
    where, found, sigmas = term_slices(solved.terms)["offset"], [], []
    for rows, A, g in zip(problem.blocks, solved.information, solved.scores, strict=True):
        information, score = max(float(A[where, where].sum()), 1e-12), float(g[where].sum())
        found.append((float(problem.t[rows].mean()), score / information))
        sigmas.append(np.sqrt(solved.variance / information))
    return np.array(found), np.array(sigmas)
