"""Start in motion by images and inertial data alone: gravity, velocity and accelerometer bias, without any position.

With the rotations R of the body since the start by the gyroscope, in axes of the body at the start,

    p(t) = v t + g t^2 / 2 + A(t) - B(t) b,      A = int int R f,   B = int int R

is linear in v, g and b, and so is the baseline of every image pair, which the normals of its matches are perpendicular
to. The accelerometer gives the length. |g| is known, b has the prior of its class. Where the device hardly accelerates
the length is open: the sigma of the velocity says so.

Source: Martinelli (2014), Closed-form solution of visual-inertial structure from motion, IJCV 106; Kneip, Weiss,
Siegwart (2011), Deterministic initialization of metric state estimation filters for loosely-coupled monocular
vision-inertial systems, IROS.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from smartnav_graph.core.arrays import Floats, Times
from smartnav_graph.core.so3 import chained, exp, rotate
from smartnav_graph.core.timebase import NS, seconds_since
from smartnav_graph.factors.coplanarity import LEAST_MATCHES, TURN_DRIFT, TURN_SIGMA, CoplanarityBuilder
from smartnav_graph.session.calibration.model import ImuNoise
from smartnav_graph.session.streams import Imu
from smartnav_graph.vision.epipolar import sampson
from smartnav_graph.vision.gating import gate
from smartnav_graph.vision.pairs import Pairs

# Lengths (s) that are tried, least number of pairs, least share of matches within three sigmas of a good fit; among
# fits of nearly the best share the velocity decides.
LENGTHS_S, LEAST_PAIRS, GOOD_SHARE, NEARLY = (4.0, 6.0, 8.0), 8, 0.5, 0.9
ROUNDS, LOSS_SCALE, GRAVITY_SIGMA, DIRECTION_SIGMA = 8, 2.0, 0.02, 0.02
# Errors of matches last over many pairs: the covariance of the fit is multiplied by the square of this.
CORRELATED = 10.0


@dataclass(frozen=True)
class VisualStart:
    """In axes of the body at the start: gravity (3,) m/s^2, velocity (3,) m/s and its sigma (3,); biases (6,) of
    accelerometer and gyro; length_s : of the data it was found by; share : of the matches within three sigmas."""

    gravity: Floats
    velocity: Floats
    velocity_sigma: Floats
    bias: Floats
    length_s: float
    share: float


def visual_start(
    builder: CoplanarityBuilder, imu: Imu, start_ns: int, gravity: float, noise: ImuNoise, gyro_bias: Floats
) -> VisualStart | None:
    """Of the image pairs after `start_ns`; None where none of the lengths has pairs that fit."""
    curve, found = _Curve(imu, start_ns, gyro_bias, max(LENGTHS_S)), list[VisualStart]()
    for length_s in LENGTHS_S:
        end_ns = start_ns + round(length_s * NS)
        at = builder.image_ns[builder.seen.images]
        rows = np.flatnonzero((at[:, 0] >= start_ns) & (at[:, 1] <= end_ns) & (builder.seen.count >= LEAST_MATCHES))
        if len(rows) < LEAST_PAIRS:
            continue
        found.append(_fitted(builder, builder.seen.of(rows), curve, _Prior(gravity, noise), length_s))
    share = max((one.share for one in found), default=0.0)
    good = [one for one in found if one.share > max(GOOD_SHARE, NEARLY * share)]
    return min(good, key=lambda one: float(one.velocity_sigma.sum()), default=None)


class _Curve:
    """Rotation (k, 3, 3) of the body since the start, A (k, 3) and B (k, 3, 3), at the samples t (k,) s."""

    def __init__(self, imu: Imu, start_ns: int, gyro_bias: Floats, length_s: float) -> None:
        rows = slice(*np.searchsorted(imu.t_ns, [start_ns, start_ns + round((length_s + 0.1) * NS)]))
        self.gyro_bias, self.start_ns = gyro_bias, start_ns
        self.t = seconds_since(imu.t_ns[rows], start_ns)
        dt, rate = np.diff(self.t, prepend=0.0)[:, None], imu.gyro[rows] - gyro_bias
        rate = np.concatenate([rate[:1], 0.5 * (rate[1:] + rate[:-1])])  # up to each sample
        self.R, self.turn = chained(rate * dt).as_matrix(), np.cumsum(rate * dt, axis=0)
        self.force = rotate(self.R, imu.accel[rows])
        both = np.concatenate([self.force, self.R.reshape(-1, 9)], axis=1)
        once = np.cumsum(both * dt, axis=0)
        self.integrals = np.cumsum((once - 0.5 * both * dt) * dt, axis=0)

    def at(self, t_ns: Times) -> tuple[Floats, Floats, Floats, Floats]:
        """Times (m,) s, R, A and B at stamps (m,)."""
        t = seconds_since(t_ns, self.start_ns)
        row = np.clip(np.searchsorted(self.t, t), 0, len(self.t) - 1)
        turn, both = (
            np.stack([np.interp(t, self.t, column) for column in values.T], axis=1)
            for values in (self.turn, self.integrals)
        )
        return t, self.R[row] @ exp(turn - self.turn[row]), both[:, :3], both[:, 3:].reshape(-1, 3, 3)


class _Prior:
    """On [v, g, b]: the size of gravity, the class of the accelerometer bias, next to nothing on the velocity."""

    def __init__(self, gravity: float, noise: ImuNoise) -> None:
        self.gravity = gravity
        self.weight = np.diag([1e-4] * 3 + [1e-6] * 3 + [noise.accel_bias_sigma**-2] * 3)

    def normal(self, x: Floats) -> tuple[Floats, Floats]:
        """Normal equations (9, 9), (9,) at x."""
        size = float(np.linalg.norm(x[3:6]))
        row = np.concatenate([np.zeros(3), x[3:6] / size, np.zeros(3)]) / GRAVITY_SIGMA
        centred = x * np.array([1.0] * 3 + [0.0] * 3 + [1.0] * 3)
        return np.outer(row, row) + self.weight, row * (size - self.gravity) / GRAVITY_SIGMA + self.weight @ centred


def _fitted(builder: CoplanarityBuilder, pairs: Pairs, curve: _Curve, prior: _Prior, length_s: float) -> VisualStart:
    """Gauss-Newton in x = [v, g, b]: first on the directions of the baselines, then on the matches under a loss."""
    (t0, R0, A0, B0), (t1, R1, A1, B1) = (curve.at(builder.image_ns[pairs.images[:, k]]) for k in (0, 1))
    C, lever, sigma = builder.camera_model.body_R_cam, builder.rig.body_t_cam, builder.sigma
    back = C.T @ R0.transpose(0, 2, 1)
    R = back @ R1 @ C
    fixed = rotate(back, A1 - A0 + (R1 - R0) @ lever)
    time, square = ((t[:, None, None] * np.eye(3)) for t in (t1 - t0, 0.5 * (t1**2 - t0**2)))
    by = back @ np.concatenate([time, square, -(B1 - B0)], axis=2)
    gated = gate(pairs, R, np.hypot(sigma, TURN_SIGMA + TURN_DRIFT * pairs.length_s))
    weight = gated.parallax / (gated.parallax + sigma) * (gated.inliers.sum(axis=1) >= LEAST_MATCHES)
    across = np.eye(3) - gated.direction[:, :, None] * gated.direction[:, None, :]
    up = curve.force.mean(axis=0)
    x = np.concatenate([np.zeros(3), -up / np.linalg.norm(up) * prior.gravity, np.zeros(3)])
    for k in range(ROUNDS):
        t = fixed + by @ x
        scale = weight / DIRECTION_SIGMA / (np.linalg.norm(t, axis=1) if k else 1.0)
        J = (across @ by) * scale[:, None, None]
        white = rotate(across, t) * scale[:, None]
        robust = 1.0 / (1.0 + (white**2).sum(axis=1) / LOSS_SCALE**2) if k > 1 else np.ones(len(t))
        x = x + _step(J, white, robust[:, None] * np.ones(3), prior.normal(x))[0]
    for _ in range(ROUNDS):
        missed = sampson(R, fixed + by @ x, *pairs.matches[:2])
        white = missed.residual / sigma
        loss = gated.inliers / (1.0 + (white / LOSS_SCALE) ** 2)
        step, normal = _step(missed.by_translation @ by / sigma, white, loss, prior.normal(x))
        x = x + step
    share = float((np.abs(white) < 3.0)[pairs.there].mean())
    spread = CORRELATED * np.sqrt(np.diagonal(np.linalg.inv(normal))[:3])
    return VisualStart(x[3:6], x[:3], spread, np.concatenate([x[6:], curve.gyro_bias]), length_s, share)


def _step(J: Floats, white: Floats, weight: Floats, prior: tuple[Floats, Floats]) -> tuple[Floats, Floats]:
    """Gauss-Newton step (9,) and normal equations (9, 9) of residuals (n, k) with derivatives (n, k, 9)."""
    weighted = (J * weight[..., None]).reshape(-1, 9).T
    normal = weighted @ J.reshape(-1, 9) + prior[0]
    return np.asarray(-np.linalg.solve(normal, weighted @ white.ravel() + prior[1])), np.asarray(normal)
