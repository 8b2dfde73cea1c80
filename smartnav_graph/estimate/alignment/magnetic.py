"""Where north is at the start, for whoever neither rests nor has fixes: field and gravity over the first seconds.

Both are constant in nav; a body that turns sees them turn as its gyro says, but for gyro bias b and hard iron h:

    f_k = R_k(b)^T G        m_k = R_k(b)^T B + h        R_k : from the body at t_k to the body at the start

Gauss-Newton over b, h, G and B on stretches that double, so that an unknown bias never turns the guess away. G is up
and B shows north, both in axes of the body at the start.

Source: the same unknowns as Kok, Schön (2016), Magnetometer calibration using inertial sensors, IEEE Sensors J. 16(14),
without its noise-free start.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.so3 import exp, rotate, skew
from smartnav_graph.core.timebase import NS, interpolate, seconds_since
from smartnav_graph.graph.robust import loss_weights
from smartnav_graph.session.calibration.model import ImuNoise, MagnetometerNoise
from smartnav_graph.session.streams import Imu, Magnetometer

GRID_S = 0.05
FIRST_S = 4.0
LONGEST_S = 30.0
ITERATIONS = 5
# Acceleration (m/s^2) of a hand-held device beside gravity, and how long (s) it stays alike.
MOTION, MOTION_S = 1.0, 0.5
# A heading (rad) with a larger sigma than this is unknown.
SURE_HEADING = 0.5
BIAS, IRON, UP, FIELD = (slice(3 * i, 3 * i + 3) for i in range(4))


@dataclass(frozen=True)
class FieldStart:
    """nav_R_body (3, 3) and gyro bias (3,) rad/s at the start, hard iron (3,) uT; sigma of the heading rad, and what it
    is worth in hard iron, uT; seconds looked at."""

    nav_R_body: Floats
    gyro_bias: Floats
    iron: Floats
    heading_sigma: float
    iron_sigma: float
    length_s: float


@dataclass(frozen=True)
class Seen:
    """What body saw on a grid of `GRID_S`: mean rate (n, 3) rad/s, mean force (n, 3) m/s^2, reading (n, 3) uT at the
    middle of each interval."""

    rate: Floats
    force: Floats
    reading: Floats

    def first(self, count: int) -> Seen:
        """The first `count` rows."""
        return Seen(self.rate[:count], self.force[:count], self.reading[:count])


def seen(imu: Imu, magnetometer: Magnetometer, start_ns: int, noise: MagnetometerNoise) -> Seen | None:
    """The first seconds from `start_ns`; None where they are fewer than `FIRST_S`."""
    last = min(int(imu.t_ns[-1]), int(magnetometer.t_ns[-1]), start_ns + round(LONGEST_S * NS))
    count = int((last - start_ns) / NS / GRID_S)
    if count * GRID_S < FIRST_S or magnetometer.t_ns[0] > start_ns + NS:
        return None
    t = seconds_since(imu.t_ns, start_ns)
    border = np.arange(count + 1) * GRID_S
    rows = np.concatenate([imu.gyro, imu.accel], axis=1)
    steps = 0.5 * (rows[1:] + rows[:-1]) * np.diff(t)[:, None]
    integral = np.concatenate([np.zeros((1, 6)), np.cumsum(steps, axis=0)])
    mean = np.diff(np.stack([np.interp(border, t, column) for column in integral.T], axis=-1), axis=0) / GRID_S
    middle = start_ns + ((border[1:] - 0.5 * GRID_S) * NS).astype(np.int64)
    corrected = magnetometer.field_ut @ np.reshape(noise.soft_iron, (3, 3)).T
    return Seen(mean[:, :3], mean[:, 3:], interpolate(middle, magnetometer.t_ns, corrected))


def turns(rate: Floats, bias: Floats) -> tuple[Floats, Floats]:
    """Rotations (n, 3, 3) from the middle of each interval to the start, their derivatives (n, 3, 3) by the bias."""
    whole, half = exp((rate - bias) * GRID_S), exp((rate - bias) * (0.5 * GRID_S))
    R, J = np.eye(3), np.zeros((3, 3))
    rotations, derivatives = np.empty((len(rate), 3, 3)), np.empty((len(rate), 3, 3))
    for k in range(len(rate)):
        rotations[k] = R @ half[k]
        derivatives[k] = half[k].T @ J - 0.5 * GRID_S * np.eye(3)
        R, J = R @ whole[k], whole[k].T @ J - GRID_S * np.eye(3)
    return rotations, derivatives


@dataclass(frozen=True)
class Fit:
    """x (12,) of bias, iron, G and B, and its covariance (12, 12)."""

    x: Floats
    covariance: Floats


def fit(there: Seen, x: Floats, prior: Floats, sigma: Floats, noise: MagnetometerNoise) -> Fit:
    """Robust Gauss-Newton from `x`; prior (6,) and sigma (6,) of bias and iron."""
    weight_f = 1.0 / (MOTION * np.sqrt(2.0 * MOTION_S / GRID_S))
    weight_m = 1.0 / (np.hypot(noise.disturbance_ut, noise.sigma_ut) * np.sqrt(2.0 * noise.disturbance_s / GRID_S))
    held = np.concatenate([np.diag(1.0 / sigma), np.zeros((6, 6))], axis=1)
    for _ in range(ITERATIONS):
        R, J = turns(there.rate, x[BIAS])
        body_R_start = R.transpose(0, 2, 1)
        r, A = [(x[:6] - prior) / sigma], [held]
        for part, measured, weight in ((UP, there.force, weight_f), (FIELD, there.reading, weight_m)):
            predicted = rotate(body_R_start, np.tile(x[part], (len(R), 1)))
            residual = predicted - measured + (x[IRON] if part is FIELD else 0.0)
            robust = np.sqrt(_huber(np.linalg.norm(residual, axis=1))) * weight
            block = np.zeros((len(R), 3, 12))
            block[:, :, BIAS], block[:, :, part] = skew(predicted) @ J, body_R_start
            block[:, :, IRON] = np.eye(3) if part is FIELD else 0.0
            r.append((residual * robust[:, None]).ravel())
            A.append((block * robust[:, None, None]).reshape(-1, 12))
        rows = np.concatenate(A)
        normal = rows.T @ rows + 1e-9 * np.eye(12)
        x = x - np.linalg.solve(normal, rows.T @ np.concatenate(r))
    return Fit(x, np.linalg.inv(normal))


def _huber(size: Floats) -> Floats:
    """Weights (n,) of residuals by their size over its own robust level."""
    level = max(float(np.median(size)) / 1.54, 1e-9)  # the median norm of three unit normals
    return loss_weights(size**2, "huber", np.sqrt(3.0) * level)[0]


def field_start(
    imu: Imu,
    magnetometer: Magnetometer,
    start_ns: int,
    imu_noise: ImuNoise,
    noise: MagnetometerNoise,
    iron_sigma: float,
    declination: float,
) -> FieldStart | None:
    """Attitude and gyro bias at `start_ns` from at most `LONGEST_S` after it; None where north stays open.

    Parameters
    ----------
    iron_sigma : uT, of the hard iron of `noise`; declination rad
    """
    there = seen(imu, magnetometer, start_ns, noise)
    if there is None:
        return None
    soft = np.reshape(noise.soft_iron, (3, 3))
    prior = np.concatenate([np.zeros(3), soft @ np.asarray(noise.hard_iron_ut)])
    sigma = np.array([imu_noise.gyro_bias_sigma] * 3 + [iron_sigma] * 3)
    first = round(1.0 / GRID_S)
    up, field = there.force[:first].mean(axis=0), there.reading[:first].mean(axis=0)
    found, count = Fit(np.concatenate([prior, up, field - prior[3:]]), np.eye(12)), round(FIRST_S / GRID_S)
    while True:
        found = fit(there.first(count), found.x, prior, sigma, noise)
        if count >= len(there.rate):
            return _oriented(found, declination, np.linalg.inv(soft), count * GRID_S)
        count = min(2 * count, len(there.rate))


def _oriented(found: Fit, declination: float, raw: Floats, length_s: float) -> FieldStart | None:
    """Attitude of the start whose up is G and whose horizontal part of B shows magnetic north; `raw` (3, 3) undoes the
    soft iron."""
    x, P = found.x, found.covariance
    size = np.linalg.norm(x[UP])
    up = x[UP] / size
    dip = float(x[FIELD] @ up)
    level = x[FIELD] - dip * up
    strength = float(np.linalg.norm(level))
    north = level / strength
    east = np.cross(north, up)
    side = east @ P[FIELD, FIELD] @ east + (dip / size) ** 2 * (east @ P[UP, UP] @ east)
    sigma = float(np.sqrt(side)) / strength
    if not sigma < SURE_HEADING:
        return None
    magnetic_R_body = np.stack([east, north, up])
    c, s = np.cos(declination), np.sin(declination)
    nav_R_magnetic = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    return FieldStart(nav_R_magnetic @ magnetic_R_body, x[BIAS], raw @ x[IRON], sigma, sigma * strength, length_s)
