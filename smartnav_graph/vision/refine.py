"""The relative pose that fits matched points best: Levenberg-Marquardt with a loss per match, on three models.

A model gives k whitened residuals for each of m matches, at a state whose first element is c0_R_c1:

    EpipolarModel   (R, t)      k = 1, coplanarity (Sampson), 5 unknowns: rotation, direction of t
    RotationModel   (R,)        k = 2, point transfer without a baseline, 3 unknowns: rotation
    PlaneModel      (R, t, m)   k = 2, point transfer by a plane m . X1 = 1, 8 unknowns: rotation, direction, plane

Rotations change on the right, R <- R Exp(w); directions on the sphere, t <- unit(t + B d) with B = `tangent_basis(t)`.
Point transfer x0 = h(x1) is whitened with the noise of both images, S = sigma^2 (I + A A^T), A = dh / dx1.

Source: Hartley, Zisserman (2004), Multiple View Geometry, 4.2 and 11.4; Marquardt (1963); Geman, McClure (1987) for the
loss e^2 / (1 + e^2 / c^2); unlike Cauchy's it is bounded.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.errors import ConfigError
from smartnav_graph.core.so3 import exp, is_rotation, log
from smartnav_graph.vision.epipolar import cross, rays, sampson

State = tuple[Floats, ...]

LOSS_SCALE = 3.0  # of the loss before the inliers are known, in sigmas
GATE = 3.0  # largest distance of a match from its epipolar line, sigmas
GATE_SQUARE = {1: GATE**2, 2: 11.83}  # the same probability by the number of residuals: squared
ITERATIONS = 30
SMALL_STEP, COARSE_STEP = 1e-3, 0.05  # squared, in units of its covariance; the coarse one before the inliers are known
FIRST_DAMPING = 1e-4


@dataclass(frozen=True)
class RotationPrior:
    """Rotation from the gyro: c0_R_c1 (3, 3), second camera's axes in the first one's, and its sigma, rad an axis."""

    c0_R_c1: Floats
    sigma: float

    def __post_init__(self) -> None:
        R = np.asarray(self.c0_R_c1, dtype=np.float64)
        if R.shape != (3, 3) or not is_rotation(R):
            raise ConfigError("rotation prior", "c0_R_c1 is no rotation", "a (3, 3) rotation matrix")
        if not 0 < self.sigma < np.inf:
            raise ConfigError("rotation prior", f"sigma = {self.sigma} rad", "> 0 and finite", "leave the prior out")

    def deviation(self, R: Floats) -> Floats:
        """Rotation vector (3,) in sigmas from the prior to R, on the right."""
        return rotation_vector(self.c0_R_c1.T @ R) / self.sigma


class ResidualModel(Protocol):
    """Whitened residuals (m, k) with their derivatives (m, k, p), and the state changed by a step (p,)."""

    def rows(self, state: State) -> tuple[Floats, Floats]:
        """Whitened residuals (m, k) and their derivatives (m, k, d) at a state."""

    def retract(self, state: State, step: Floats) -> State:
        """The state moved by a step (d,)."""


class MatchedPoints(NamedTuple):
    """Matches: undistorted normalised points (m, 2) of both images and their sigma (m,)."""

    xy0: Floats
    xy1: Floats
    sigma: Floats

    def only(self, rows: NDArray[np.bool_]) -> MatchedPoints:
        """Some of them."""
        return MatchedPoints(self.xy0[rows], self.xy1[rows], self.sigma[rows])


def tangent_basis(t: Floats) -> Floats:
    """B (3, 2): unit columns u, v normal to the unit vector t: u = unit(t x e), e the axis least along t; v = t x u."""
    x, y, z = t
    k = int(np.argmin(np.abs(t)))
    u = np.array([(0.0, z, -y), (-z, 0.0, x), (y, -x, 0.0)][k]) / math.hypot(*np.delete(t, k))
    v = (y * u[2] - z * u[1], z * u[0] - x * u[2], x * u[1] - y * u[0])
    return np.array([u, v]).T


def angle(R: Floats) -> float:
    """Angle rad of a rotation (3, 3)."""
    return math.acos(min(max(0.5 * (float(np.trace(R)) - 1.0), -1.0), 1.0))


def rotation_vector(R: Floats) -> Floats:
    """Axis times angle (3,) of a rotation (3, 3); scipy's takes ten times as long and is used near half turns only."""
    twice = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    sine, cosine = 0.5 * math.sqrt(float(twice @ twice)), 0.5 * (float(np.trace(R)) - 1.0)
    if cosine < -0.99:
        return log(R)
    return 0.5 * twice * (math.atan2(sine, cosine) / sine if sine > 1e-12 else 1.0)


def retract_direction(t: Floats, d: Floats) -> Floats:
    """unit(t + B d)."""
    other = t + tangent_basis(t) @ d
    return np.asarray(other / np.linalg.norm(other))


@dataclass(frozen=True)
class EpipolarModel:
    """Coplanarity."""

    matched: MatchedPoints

    def rows(self, state: State) -> tuple[Floats, Floats]:
        R, t = state
        r, by_rotation, by_t = sampson(R, t, self.matched.xy0, self.matched.xy1)
        by_state = np.concatenate([by_rotation, by_t @ tangent_basis(t)], axis=1)
        return (r / self.matched.sigma)[:, None], (by_state / self.matched.sigma[:, None])[:, None]

    def retract(self, state: State, step: Floats) -> State:
        return state[0] @ exp(step[:3]), retract_direction(state[1], step[3:5])


@dataclass(frozen=True)
class RotationModel:
    """Point transfer by a rotation alone."""

    matched: MatchedPoints

    def rows(self, state: State) -> tuple[Floats, Floats]:
        (R,) = state
        r, by_y = transfer(R, self.matched)
        return r, by_y @ _by_rotation(R, rays(self.matched.xy1))

    def retract(self, state: State, step: Floats) -> State:
        return (state[0] @ exp(step),)


@dataclass(frozen=True)
class PlaneModel:
    """Point transfer by a plane: x0 ~ (R + t m^T) x1."""

    matched: MatchedPoints

    def rows(self, state: State) -> tuple[Floats, Floats]:
        R, t, m = state
        b = rays(self.matched.xy1)
        r, by_y = transfer(R + np.outer(t, m), self.matched)
        by_direction = (b @ m)[:, None, None] * tangent_basis(t)
        by_plane = t[None, :, None] * b[:, None, :]
        return r, by_y @ np.concatenate([_by_rotation(R, b), by_direction, by_plane], axis=2)

    def retract(self, state: State, step: Floats) -> State:
        return state[0] @ exp(step[:3]), retract_direction(state[1], step[3:5]), state[2] + step[5:]


def transfer(H: Floats, matched: MatchedPoints) -> tuple[Floats, Floats]:
    """Whitened h(x1) - x0 (m, 2) of the homography H (3, 3), and its derivative (m, 2, 3) by y = H x1.

    The whitening is taken as constant: its change is of second order. Points mapped to infinity have a huge residual.
    """
    y = rays(matched.xy1) @ H.T
    depth = np.where(np.abs(y[:, 2]) > 1e-9, y[:, 2], 1e-9)
    h = y[:, :2] / depth[:, None]
    by_y = np.zeros((len(y), 2, 3))
    by_y[:, 0, 0] = by_y[:, 1, 1] = 1.0 / depth
    by_y[:, :, 2] = -h / depth[:, None]
    A = by_y @ H[:, :2]
    whitener = _whitener(A) / matched.sigma[:, None, None]
    return np.asarray((whitener @ (h - matched.xy0)[:, :, None])[:, :, 0]), whitener @ by_y


def _whitener(A: Floats) -> Floats:
    """Inverse Cholesky factors (m, 2, 2) of I + A A^T."""
    p = 1.0 + A[:, 0, 0] ** 2 + A[:, 0, 1] ** 2
    q = A[:, 0, 0] * A[:, 1, 0] + A[:, 0, 1] * A[:, 1, 1]
    r = 1.0 + A[:, 1, 0] ** 2 + A[:, 1, 1] ** 2
    out = np.zeros_like(A)
    out[:, 0, 0] = 1.0 / np.sqrt(p)
    out[:, 1, 1] = 1.0 / np.sqrt(r - q**2 / p)
    out[:, 1, 0] = -q / p * out[:, 1, 1]
    return out


def _by_rotation(R: Floats, b: Floats) -> Floats:
    """Derivative (m, 3, 3) of R Exp(w) b by w: -R [b]x."""
    return cross(b[:, None, :], R)


@dataclass(frozen=True)
class PoseFit:
    """State of least cost; whitened residuals (m, k) there, half the loss, and the information (p, p)."""

    state: State
    residual: Floats
    cost: float
    information: Floats
    gradient: Floats
    jacobian: Floats

    @property
    def square(self) -> Floats:
        """Squared whitened residual (m,) of every match."""
        return np.asarray(np.einsum("mk,mk->m", self.residual, self.residual))


def refine(
    model: ResidualModel,
    state: State,
    *,
    loss_scale: float | None = LOSS_SCALE,
    prior: RotationPrior | None = None,
    iterations: int = ITERATIONS,
) -> PoseFit:
    """The state of least cost, from an initial value.

    Parameters
    ----------
    loss_scale : of a Geman-McClure loss on each match, in sigmas; None: least squares
    prior : added as a residual without loss
    """
    fit, damping = _linearised(model, state, loss_scale, prior), FIRST_DAMPING
    for _ in range(iterations):
        step = _step(fit, damping)
        trial = _linearised(model, model.retract(fit.state, step), loss_scale, prior)
        if trial.cost <= fit.cost:
            converged = float(step @ fit.information @ step) < (SMALL_STEP if loss_scale is None else COARSE_STEP)
            fit, damping = trial, damping / 10.0
            if converged:
                break
        elif damping > 1e6:
            break
        else:
            damping *= 10.0
    return fit


def _step(fit: PoseFit, damping: float) -> Floats:
    scale = np.diag(fit.information)
    floor = 1e-12 * max(float(scale.max()), np.finfo(float).tiny)  # unobservable directions do not change
    return np.asarray(-np.linalg.solve(fit.information + np.diag(damping * scale + floor), fit.gradient))


def _linearised(model: ResidualModel, state: State, loss_scale: float | None, prior: RotationPrior | None) -> PoseFit:
    r, J = model.rows(state)
    square = np.einsum("mk,mk->m", r, r)
    weight, cost = np.ones(len(r)), 0.5 * float(square.sum())
    if loss_scale is not None:
        weight = 1.0 / (1.0 + square / loss_scale**2)
        cost, weight = 0.5 * float((square * weight).sum()), weight**2
    flat = (weight[:, None, None] * J).reshape(-1, J.shape[2])
    information = flat.T @ J.reshape(-1, J.shape[2])
    gradient = flat.T @ r.ravel()
    if prior is not None:
        # d Log(prior^T R Exp(w)) / dw is I but for the deviation itself, which is small if the prior is right
        deviation = prior.deviation(state[0])
        information[:3, :3] += np.eye(3) / prior.sigma**2
        gradient[:3] += deviation / prior.sigma
        cost += 0.5 * float(deviation @ deviation)
    return PoseFit(state, r, cost, information, gradient, J)
