"""Position of a camera in the body, from matches and inertial data alone: no board, no map, no fixes.

In each window of time, in axes that do not turn, the body moves by

    p(t) = v (t - s) + g (t - s)^2 / 2 + A(t) - B(t) b,    A = int int R f,   B = int int R

from its velocity v and gravity g at the start s, specific force f, accelerometer bias b and the rotation R by the
gyroscope; the camera by (R1 - R0) l more. The baseline of every image pair, which the normals of its matches are
perpendicular to, is linear in v, g, b and l; a turn e of the optical axes, such as of a wrong principal point, is a
further unknown. The accelerometer gives the length, and |g| is known. v and g of the windows are eliminated; covariance
by the scatter between windows, at least that of baselines of which a second of images errs by `DIRECTION_SIGMA`: errors
of features last over many pairs. Source: Martinelli (2014), Closed-form solution of visual-inertial structure from
motion, IJCV 106; Kelly, Sukhatme (2011), Visual-inertial sensor fusion, IJRR 30(1).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from smartnav_graph.calibrate.turn_start import CAUCHY, TurnProblem, TurnState
from smartnav_graph.core.arrays import Floats, Indices
from smartnav_graph.core.clustered import clustered_covariance
from smartnav_graph.core.so3 import across, exp, rotate, skew
from smartnav_graph.vision.elimination import eliminated
from smartnav_graph.vision.epipolar import sampson
from smartnav_graph.vision.gating import gate

WINDOW_S, LEAST_WINDOWS, LEAST_PAIRS = 4.0, 4, 6  # windows in a recording, pairs in a window
DIRECTION_SIGMA = np.radians(0.5)  # of the direction of a baseline by all images of a second
TURN_SIGMA = np.radians(0.03)  # of the turn of a pair by the gyroscope
GRAVITY_SIGMA, SPEED_SIGMA = 0.02, 30.0  # priors of a window: m/s^2 of |g|, m/s
# Inverse prior covariance of [b, l, e]: m/s^2 of a phone, m, rad.
PRIOR = np.diag([0.3**-2] * 3 + [0.5**-2] * 3 + [np.radians(0.5) ** -2] * 3)
COMMON, AXES = len(PRIOR), slice(6, 9)
START_SIGMA = 0.02  # rad, of a baseline in the first steps
START_ROUNDS, ROUNDS, CONVERGED_M = 8, 20, 1e-5


class Baselines(NamedTuple):
    """Baselines (n, 3) in camera axes = fixed + by x, x = [b, l, e, v, g of its window]; windows : rows"""

    fixed: Floats
    by: Floats
    windows: list[Indices]

    def at(self, common: Floats, own: Floats) -> Floats:
        """(n, 3) of [b, l, e] (9,), e = 0, and [v, g] (w, 6)."""
        t = self.fixed + self.by[:, :, :COMMON] @ common
        for rows, x in zip(self.windows, own, strict=True):
            t[rows] += self.by[rows][:, :, COMMON:] @ x
        return t


class Correction(NamedTuple):
    """Of [b, l, e] (9,) and [v, g] (w, 6); information (w, 9, 9) and scores (w, 9) of [b, l, e] by window."""

    common: Floats
    own: Floats
    information: Floats
    scores: Floats


def lever_arm(problem: TurnProblem, state: TurnState, sigma: float, gravity: float) -> tuple[Floats, Floats] | None:
    """Position (3,) m of the camera in the body, and covariance (3, 3); None where few windows have enough pairs.

    Parameters
    ----------
    problem : pairs and rates; state : clock, axes and gyro bias as `turns.align_to_gyro` found them
    sigma : of a coordinate of a match, normalised; gravity : m/s^2
    """
    linear, rows = _baselines(problem, state)
    if len(linear.windows) < LEAST_WINDOWS:
        return None
    some, R = problem.pairs.of(rows), problem.rotation(state)[rows]
    x0, x1 = (x[rows][:, : some.there.shape[1]] for x in problem.seen(state))
    gated = gate(some, R, np.full(len(rows), 3.0 * sigma))
    weight = gated.parallax / (gated.parallax + sigma)
    beside = np.eye(3) - gated.direction[:, :, None] * gated.direction[:, None, :]
    common, own = np.zeros(COMMON), np.zeros((len(linear.windows), 6))
    for k in range(START_ROUNDS):
        t = linear.at(common, own)
        scale = weight / START_SIGMA / (np.maximum(np.linalg.norm(t, axis=1), 1e-6) if k else 1.0)
        white, J = rotate(beside, t) * scale[:, None], (beside @ linear.by) * scale[:, None, None]
        robust = np.ones(len(t)) if k < 2 else 1.0 / (1.0 + (white**2).sum(axis=1) / CAUCHY**2)
        robust = np.repeat(robust[:, None], 3, axis=1)
        step = _solved(linear, *_normal(J, white, robust), common, own, gravity)
        common, own = common + step.common, own + step.own
    seconds = float(np.ptp(problem.times(state)[rows]))
    pair_sigma = DIRECTION_SIGMA * np.sqrt(len(rows) / seconds)
    for _ in range(ROUNDS):
        turn = exp(common[None, AXES])[0]
        t = linear.at(common, own) @ turn.T
        missed = sampson(R, t, x0, x1)
        white = missed.residual / sigma
        loss = gated.inliers / (1.0 + (white / CAUCHY) ** 2)
        by = turn @ linear.by
        by[:, :, AXES] = -skew(t)
        aside = across(t / np.linalg.norm(t, axis=1)[:, None]) * (np.linalg.norm(t, axis=1) * pair_sigma)[:, None, None]
        own_terms = np.concatenate([missed.by_translation @ aside, missed.by_rotation * TURN_SIGMA], axis=2) / sigma
        normal = eliminated(missed.by_translation @ by / sigma, own_terms, white, loss, np.eye(5))
        step = _solved(linear, *normal, common, own, gravity)
        common, own = common + step.common, own + step.own
        if np.abs(step.common[3:6]).max() < CONVERGED_M:
            break
    variance = max(float((loss * white**2).sum() / max(loss.sum(), 1.0)), 1e-6)
    covariance = clustered_covariance(step.information, step.scores, variance, variance * PRIOR)
    return common[3:6], covariance[3:6, 3:6]


def _normal(J: Floats, white: Floats, weight: Floats) -> tuple[Floats, Floats]:
    """Information (n, p, p) and scores (n, p) of each pair."""
    weighted = J * weight[:, :, None]
    return np.swapaxes(weighted, 1, 2) @ J, -np.einsum("nkp,nk->np", weighted, white)


def _baselines(problem: TurnProblem, state: TurnState) -> tuple[Baselines, Indices]:
    """Of the pairs that lie in one window, and their rows."""
    t, attitudes = problem.times(state), problem.attitudes(state)
    first = float(t.min())
    window = np.floor((t - first) / WINDOW_S).astype(np.intp)
    inside = window[:, 0] == window[:, 1]
    enough = np.bincount(window[inside, 0], minlength=int(window.max()) + 1) >= LEAST_PAIRS
    rows = np.flatnonzero(inside & enough[window[:, 0]])
    window, t = window[rows, 0], t[rows]
    once, twice = _integrals(problem, state, np.concatenate([t.T, [first + WINDOW_S * window]]))
    length = (t[:, 1] - t[:, 0])[:, None]
    moved = twice[1] - twice[0] - once[2] * length
    since = t - (first + WINDOW_S * window)[:, None]
    R0, R1 = attitudes.at(t[:, 0]), attitudes.at(t[:, 1])
    back = state.body_R_cam.T @ np.swapaxes(R0, 1, 2)
    unit = np.tile(np.eye(3), (len(t), 1, 1))
    square = 0.5 * (since[:, 1] ** 2 - since[:, 0] ** 2)
    columns = [-moved[:, 3:].reshape(-1, 3, 3), R1 - R0, 0.0 * unit, unit * length[:, :, None]]
    by = back @ np.concatenate([*columns, unit * square[:, None, None]], axis=2)
    windows = [np.flatnonzero(window == i) for i in np.unique(window)]
    return Baselines(rotate(back, moved[:, :3]), by, windows), rows.astype(np.intp)


def _integrals(problem: TurnProblem, state: TurnState, at: Floats) -> tuple[Floats, Floats]:
    """Integrals of [R f, R], once and twice, at times (3, n): (3, n, 12)."""
    t = problem.t_imu
    R = problem.attitudes(state).at(t)
    rate = np.concatenate([rotate(R, problem.imu.accel), R.reshape(-1, 9)], axis=1)
    dt = np.diff(t)[:, None]
    first = np.concatenate([np.zeros((1, 12)), np.cumsum(0.5 * (rate[1:] + rate[:-1]) * dt, axis=0)])
    steps = first[:-1] * dt + (2.0 * rate[:-1] + rate[1:]) * dt**2 / 6.0
    whole = np.concatenate([np.zeros((1, 12)), np.cumsum(steps, axis=0)])
    row = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(t) - 1)
    d = (at - t[row])[..., None]
    return first[row] + rate[row] * d, whole[row] + first[row] * d + rate[row] * d**2 / 2


def _solved(
    linear: Baselines, information: Floats, scores: Floats, common: Floats, own: Floats, gravity: float
) -> Correction:
    """Gauss-Newton step by information (n, 15, 15) and scores (n, 15) of the pairs."""
    reduced, right, parts = [], [], []
    for rows, x in zip(linear.windows, own, strict=True):
        S, g = information[rows].sum(axis=0), scores[rows].sum(axis=0)
        inner, inner_g = S[COMMON:, COMMON:] + np.eye(6) * SPEED_SIGMA**-2, g[COMMON:]
        size = float(np.linalg.norm(x[3:]))
        if size > 0:
            row = np.concatenate([np.zeros(3), x[3:] / size]) / GRAVITY_SIGMA
            inner, inner_g = inner + np.outer(row, row), inner_g - row * (size - gravity) / GRAVITY_SIGMA
        cross = S[COMMON:, :COMMON]
        carried = np.linalg.solve(inner, cross)
        reduced.append(S[:COMMON, :COMMON] - cross.T @ carried)
        right.append(g[:COMMON] - carried.T @ inner_g)
        parts.append((inner, inner_g, cross))
    step = np.linalg.solve(sum(reduced) + PRIOR, sum(right) - PRIOR @ common)
    more = np.array([np.linalg.solve(inner, g - cross @ step) for inner, g, cross in parts])
    return Correction(step, more, np.array(reduced), np.array(right))
