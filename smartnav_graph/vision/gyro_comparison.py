"""Clock and boresight of a camera by the gyroscope, before any graph: turns between images against integrated rates.

With clock offset d, boresight a and gyro bias b the rotation between the images at t0 and t1 is

    c0_R_c1 = C^T D C,   C = body_R_cam Exp(a),   D the turn of the body by the rates less b from t0 + d to t1 + d

Given it, the normals of the epipolar planes are perpendicular to the baseline of the pair, which is eliminated as the
direction that the matches miss least (`gating`). The offset is searched over a second to both sides; then offset,
boresight and bias follow by Gauss-Newton. It is known where each other offset fits worse in most of the pairs; its
sigma covers what parts of the recording find by themselves: the clock of a camera may drift.

Source: Furgale, Rehder, Siegwart (2013), Unified temporal and spatial calibration for multi-sensor systems, IROS, for
the states; Kneip, Chli, Siegwart (2011), Robust real-time visual odometry with a single camera and an IMU, BMVC.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.so3 import across, chained, exp
from smartnav_graph.core.timebase import seconds_since
from smartnav_graph.session.calibration.camera import Camera
from smartnav_graph.session.health.facts import Finding
from smartnav_graph.session.session import Mount
from smartnav_graph.session.streams import Imu
from smartnav_graph.vision.elimination import eliminated
from smartnav_graph.vision.epipolar import sampson
from smartnav_graph.vision.gating import Geometry
from smartnav_graph.vision.pairs import Pairs

# Offsets (s) that are searched, and the step between them; an offset further than `APART_S` from the best is another.
SEARCH_S, SEARCH_STEP_S, APART_S = 1.0, 0.04, 0.1
# Sigmas by which every other offset must fit worse, pair by pair. Spans of tracks overlap: half of them count.
SHARP = 4.0
# Pairs are compared that are so far apart (s), have so many matches at least, and of those no more.
LONGEST_S, LEAST_MATCHES, MOST_MATCHES, LEAST_PAIRS, MOST_PAIRS = 2.5, 8, 40, 20, 250
# Prior sigmas of boresight, rad, and gyro bias, rad/s; scale of the Cauchy loss of a match, sigmas.
BORESIGHT_SIGMA, BIAS_SIGMA, LOSS_SCALE = float(np.radians(3.0)), 0.05, 2.0
SEARCH_ROUNDS, ROUNDS, CONVERGED = 3, 15, 1e-4
# A clock offset below this (s) is estimated as a state alone: motion is linear over it. Sigmas that contradict.
LINEAR_S, CLEAR = 0.025, 2.0
# What the boresight of a camera that was calibrated seems to be, rad.
LEAST_BORESIGHT_SIGMA = float(np.radians(0.25))
SHOWN = 0.2  # of its prior sigma: that of a boresight that the turns show
TABLE_S = 0.01  # step of the integrated rates
LEAST_NOISE = 1e-5  # of a match, normalised: less is no camera
MOST_BLOCKS = 8  # parts of the recording that the offset is found in


@dataclass(frozen=True)
class GyroComparison:
    """What turns of images and of the gyroscope show.

    offset_s, sigma_s : a frame stamped t shows IMU time t + calibrated offset + this; drift_s : what it changes by from
    the first to the last part of the recording, zero where that is not significant
    sharpness : sigmas by which the next best offset fits worse
    boresight, boresight_sigma (3,) rad, camera axes : of the axes of the camera, C = body_R_cam Exp(boresight)
    gyro_bias (3,) rad/s; sound : share of the pairs that agree with the gyroscope; pairs : number compared
    """

    offset_s: float
    sigma_s: float
    drift_s: float
    sharpness: float
    boresight: Floats
    boresight_sigma: Floats
    gyro_bias: Floats
    sound: float
    pairs: int

    @property
    def known(self) -> bool:
        """Whether the offset is."""
        return self.sharpness > SHARP

    @property
    def certain_boresight(self) -> Floats:
        """Boresight (3,) rad, zero in the components that are not certain: about the axis that a camera turns about it
        does not show."""
        sigma = np.hypot(self.boresight_sigma, LEAST_BORESIGHT_SIGMA)
        sure = self.known & (np.abs(self.boresight) > 3.0 * sigma) & (self.boresight_sigma < SHOWN * BORESIGHT_SIGMA)
        return np.where(sure, self.boresight, 0.0)

    @property
    def turned_by(self) -> float:
        """Its largest component, rad."""
        return float(np.abs(self.certain_boresight).max())

    def to_dict(self) -> dict[str, object]:
        """As in summary.json."""
        return {
            "clock_offset_s": round(self.offset_s, 5),
            "clock_sigma_s": round(self.sigma_s, 5),
            "clock_drift_s": round(self.drift_s, 5),
            "sharpness": round(self.sharpness, 2),
            "known": self.known,
            "boresight_deg": np.degrees(self.boresight).round(4).tolist(),
            "boresight_sigma_deg": np.degrees(self.boresight_sigma).round(4).tolist(),
            "sound_share": round(self.sound, 3),
            "pairs": self.pairs,
        }


def compare_with_gyro(
    pairs: Pairs, imu: Imu, camera: Camera, mount: Mount, row_s: float = 0.0
) -> GyroComparison | None:
    """Compare the pairs of a camera with the gyroscope, beside its calibration; None where too few pairs can be.

    row_s : time (s) from the first row of an image to the middle one, where rows have their own time
    """
    turns, body_R_cam = _Turns(imu, np.zeros(3)), np.array(mount.body_R, dtype=np.float64)
    problem = _Problem.of(pairs, turns, body_R_cam, max(camera.noise, LEAST_NOISE), camera.time_offset_s + row_s)
    if problem is None:
        return None
    offsets = np.arange(-SEARCH_S, SEARCH_S + 0.5 * SEARCH_STEP_S, SEARCH_STEP_S)
    costs = np.array([problem.cost_at(turns, offset) for offset in offsets])
    best = int(costs.sum(axis=1).argmin())
    more = costs[np.abs(offsets - offsets[best]) > APART_S] - costs[best]
    sharpness = float((more.mean(axis=1) / np.maximum(more.std(axis=1), 1e-12)).min() * np.sqrt(more.shape[1] / 2.0))
    x = np.zeros(7)
    x[6] = offsets[best]
    bias = np.zeros(3)
    for _ in range(ROUNDS):  # rates are integrated anew: to first order a large bias makes a false boresight
        step = problem.at(turns, x).step(x, bias)
        x, bias = x + step, bias + step[3:6]
        x[3:6] = 0.0
        turns = _Turns(imu, bias)
        if np.abs(step).max() < CONVERGED:
            break
    return _comparison(problem, problem.at(turns, x), x, bias, sharpness)


def contradictions(found: GyroComparison | None, camera: Camera) -> Iterator[Finding]:
    """Where the gyroscope contradicts the calibration of a camera."""
    if found is None or not found.known:
        return
    offset_s, sigma_s = found.offset_s, np.hypot(found.sigma_s, camera.time_offset_sigma_s)
    if abs(offset_s) > max(CLEAR * sigma_s, LINEAR_S):
        text = f"the camera shows {1e3 * (camera.time_offset_s + offset_s):.0f} +- {1e3 * found.sigma_s:.0f} ms later"
        text += f" than its stamps by the gyroscope, not {1e3 * camera.time_offset_s:.0f} ms"
        yield Finding("images", text, "corrected for this run; calibrate its clock", verdict="good", size=offset_s)
    if found.drift_s:
        text = f"the clock of the camera drifts by {1e3 * found.drift_s:.0f} ms against the gyroscope"
        yield Finding("images", text, "the offset is an average; use one clock", verdict="good", size=found.drift_s)
    if found.turned_by > CLEAR * np.radians(camera.boresight_sigma_deg):
        angles = ", ".join(f"{angle:.1f}" for angle in np.degrees(found.certain_boresight))
        text = f"the camera is turned by {angles} deg about its axes by the gyroscope"
        yield Finding("images", text, "estimated from there; calibrate its mount", verdict="good", size=found.turned_by)


def _comparison(problem: _Problem, found: _Rotations, x: Floats, bias: Floats, sharpness: float) -> GyroComparison:
    covariance = np.linalg.inv(found.normal.sum(axis=0) + PRIOR)
    parts = [part for part in np.array_split(np.argsort(problem.t0), _blocks(len(problem.t0))) if len(part)]
    weight = np.array([found.normal[part, 6, 6].sum() for part in parts]) + 1e-12
    own = np.array([found.scores[part, 6].sum() for part in parts]) / weight
    at = np.array([np.average(problem.t0[part], weights=found.normal[part, 6, 6] + 1e-12) for part in parts])
    spread = float(np.sqrt(np.average(own**2, weights=weight)))
    drift, formal = 0.0, float(np.sqrt(covariance[6, 6]))
    if len(parts) > 2:
        line = np.polyfit(at, own, 1, w=np.sqrt(weight))
        slope, left = line[0], own - np.polyval(line, at)
        middle = np.average(at, weights=weight)
        sigma = np.sqrt((weight * left**2).sum() / (len(parts) - 2) / (weight * (at - middle) ** 2).sum())
        drift = float(slope * (at[-1] - at[0])) if abs(slope) > 3.0 * sigma else 0.0
    worse = max(1.0, spread * float(np.sqrt(weight.sum() / len(parts))))
    return GyroComparison(
        float(x[6]),
        max(formal, spread),
        drift,
        sharpness,
        x[:3],
        np.sqrt(np.diagonal(covariance)[:3]) * worse,
        bias,
        float(found.sound.mean()),
        len(problem.t0),
    )


def _blocks(pairs: int) -> int:
    return int(np.clip(pairs // LEAST_PAIRS, 1, MOST_BLOCKS))


# Inverse prior covariance of boresight, bias and offset.
PRIOR = np.diag([BORESIGHT_SIGMA**-2] * 3 + [BIAS_SIGMA**-2] * 3 + [SEARCH_S**-2])


class _Turns:
    """Attitude of the body by the rates less a bias (3,), in a frame that does not turn, seconds after `start_ns`."""

    def __init__(self, imu: Imu, bias: Floats) -> None:
        self.start_ns = int(imu.t_ns[0])
        t = seconds_since(imu.t_ns, self.start_ns)
        rate = imu.gyro - bias
        integral = np.concatenate([np.zeros((1, 3)), np.cumsum((rate[1:] + rate[:-1]) / 2 * np.diff(t)[:, None], 0)])
        self.grid = np.arange(0.0, t[-1] + TABLE_S, TABLE_S)
        self.integral = np.stack([np.interp(self.grid, t, column) for column in integral.T], axis=1)
        self.R = chained(np.diff(self.integral, axis=0, prepend=0.0)).as_matrix()

    def at(self, t: Floats) -> Floats:
        """Attitude (n, 3, 3) at times (n,)."""
        k = np.clip((t / TABLE_S).astype(np.intp), 0, len(self.grid) - 1)
        return np.asarray(self.R[k] @ exp(self._turned(t) - self.integral[k]))

    def rate(self, t: Floats) -> Floats:
        """Rates (n, 3) rad/s, body axes."""
        return (self._turned(t + TABLE_S) - self._turned(t - TABLE_S)) / (2.0 * TABLE_S)

    def _turned(self, t: Floats) -> Floats:
        return np.stack([np.interp(t, self.grid, column) for column in self.integral.T], axis=1)


class _Rotations(NamedTuple):
    """Pairs at given parameters [boresight, bias, offset]: cost (n,), normal equations (n, 7, 7), (n, 7), and whether a
    pair agrees with the rotation (n,)."""

    cost: Floats
    normal: Floats
    scores: Floats
    sound: NDArray[np.bool_]

    def step(self, x: Floats, bias: Floats) -> Floats:
        """Gauss-Newton step from x, where `bias` was taken out before."""
        from_prior = PRIOR @ (x + np.concatenate([np.zeros(3), bias, np.zeros(1)]))
        from_prior[6] = 0.0
        return np.asarray(np.linalg.solve(self.normal.sum(axis=0) + PRIOR, self.scores.sum(axis=0) - from_prior))


class _Problem(NamedTuple):
    """Pairs that are compared, and their times (n,) s on the clock of the inertial data as it is known."""

    pairs: Pairs
    t0: Floats
    t1: Floats
    body_R_cam: Floats
    sigma: float

    @classmethod
    def of(cls, pairs: Pairs, turns: _Turns, body_R_cam: Floats, sigma: float, offset_s: float) -> _Problem | None:
        t = seconds_since(pairs.t_ns, turns.start_ns) + offset_s
        t0, t1 = t[pairs.images].T
        usable = (pairs.length_s <= LONGEST_S) & (pairs.count >= LEAST_MATCHES)
        usable &= (t0 >= SEARCH_S) & (t1 + SEARCH_S <= turns.grid[-1])
        rows = np.flatnonzero(usable)
        if len(rows) < LEAST_PAIRS:
            return None
        # where the rate changes most, offsets show most
        around = np.arange(-SEARCH_S, SEARCH_S, 0.1)
        rates = np.stack([turns.rate(0.5 * (t0[rows] + t1[rows]) + dt) for dt in around])
        change = rates.std(axis=0).max(axis=1)
        rows = np.sort(rows[np.argsort(-change)[:MOST_PAIRS]])
        some = pairs.of(rows)
        first = np.concatenate([[0], np.cumsum(some.count)])[:-1]
        place = np.arange(len(some.pair)) - first[some.pair]
        every = np.maximum(some.count // MOST_MATCHES, 1)[some.pair]
        kept = (place % every == 0) & (place // every < MOST_MATCHES)
        some = Pairs(some.t_ns, some.images, some.x0[kept], some.x1[kept], some.pair[kept])
        return cls(some, t0[rows], t1[rows], body_R_cam, sigma)

    def cost_at(self, turns: _Turns, offset: float) -> Floats:
        """Cost (n,) of the pairs at an offset, boresight and bias estimated."""
        x = np.zeros(7)
        x[6] = offset
        for _ in range(SEARCH_ROUNDS):
            step = self.at(turns, x).step(x, np.zeros(3))
            x[:6] += step[:6]
        return self.at(turns, x).cost

    def at(self, turns: _Turns, x: Floats) -> _Rotations:
        """The pairs at parameters, bias to first order beside that of the turns."""
        t0, t1 = self.t0 + x[6], self.t1 + x[6]
        R0, R1 = turns.at(t0), turns.at(t1)
        D = R0.transpose(0, 2, 1) @ R1
        C = self.body_R_cam @ exp(x[:3])
        middle = [turns.at(t0 + share * (t1 - t0)) for share in (0.25, 0.5, 0.75)]
        back = R1.transpose(0, 2, 1)
        by_bias = -(back @ (R0 + 2.0 * sum(middle) + R1)) * ((t1 - t0) / 8.0)[:, None, None]
        R = C.T @ D @ exp(by_bias @ x[3:6]) @ C
        by_clock = turns.rate(t1) - (D.transpose(0, 2, 1) @ turns.rate(t0)[:, :, None])[:, :, 0]
        by = np.concatenate(
            [np.eye(3) - R.transpose(0, 2, 1), C.T @ by_bias, (by_clock @ C)[:, :, None]],
            axis=2,
        )
        return self._eliminated(R, by)

    def _eliminated(self, R: Floats, by: Floats) -> _Rotations:
        """The pairs with these rotations (n, 3, 3), by (n, 3, 7) their derivatives; baselines are eliminated."""
        pairs, sigma = self.pairs, self.sigma
        geometry, there = Geometry.of(pairs, R), pairs.there
        weight = there / np.maximum((geometry.normals**2).sum(axis=-1), sigma**2)
        for _ in range(3):
            t = geometry.fitted(weight)
            square = geometry.square(t) / sigma**2
            weight = there / (1.0 + square / LOSS_SCALE**2) / geometry.scale(t)
        x0, x1, _ = pairs.matches
        missed = sampson(R, t, x0, x1)
        white = missed.residual / sigma
        beyond = (white / LOSS_SCALE) ** 2  # Cauchy loss
        weight, cost = there / (1.0 + beyond), 0.5 * LOSS_SCALE**2 * np.log1p(beyond)
        J, own = missed.by_rotation @ by / sigma, missed.by_translation @ across(t) / sigma
        least = 1e-9 * (1.0 + np.einsum("nka,nk,nka->n", own, weight, own))  # of a pair without parallax
        normal, scores = eliminated(J, own, white, weight, least[:, None, None] * np.eye(2))
        sound = ((np.abs(white) < 4.0) & there).sum(axis=1) >= 0.5 * pairs.count
        return _Rotations((cost * there).sum(axis=1), normal, scores, sound)
