"""Pairs of images beside integrated rates; first clock offset and attitude of a camera by the rotations of pairs."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from smartnav_graph.core.arrays import Floats, Indices
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.so3 import best_rotation, exp, log, rotate
from smartnav_graph.core.timebase import seconds_since
from smartnav_graph.session.calibration.camera import Camera
from smartnav_graph.session.streams import Imu
from smartnav_graph.vision.epipolar import rays
from smartnav_graph.vision.pairs import Pairs
from smartnav_graph.vision.two_view import two_view

SEARCH_S, STEP_S = 1.0, 0.01
APART_S = 0.1  # lags farther from the best than this are other lags
LEAST_PAIRS, START_PAIRS = 20, 40
CAUCHY = 2.0  # sigmas
ROTATION_SIGMA = 0.005  # rad, of a rotation by `two_view` beside its own
BLOCKS, LEAST_BLOCK_S = 20, 1.0


class Attitudes:
    """Attitude by integrated rates, between samples by the mean rate."""

    def __init__(self, imu: Imu, t0_ns: int, bias: Floats) -> None:
        self._t = seconds_since(imu.t_ns, t0_ns)
        self._turn = (0.5 * (imu.gyro[1:] + imu.gyro[:-1]) - bias) * np.diff(self._t)[:, None]
        R = np.tile(np.eye(3), (len(imu), 1, 1))
        R[1:] = exp(self._turn)
        step = 1
        while step < len(R):  # running products by doubling
            R[step:] = R[:-step] @ R[step:]
            step *= 2
        self._R = R

    def at(self, t: Floats) -> Floats:
        """Attitudes (n, 3, 3) at times (n,) s, the ends beyond the recording."""
        row = np.clip(np.searchsorted(self._t, t, side="right") - 1, 0, len(self._t) - 2)
        share = np.clip((t - self._t[row]) / (self._t[row + 1] - self._t[row]), 0.0, 1.0)
        return np.asarray(self._R[row] @ exp(share[:, None] * self._turn[row]))


@dataclass(frozen=True)
class TurnState:
    """What turns of images against the gyroscope determine: clock offset (s) and drift of the camera, its attitude
    body_R_cam (3, 3), the gyroscope bias (3,) rad/s, and the readout of a rolling shutter (s)."""

    offset_s: float
    drift: float
    body_R_cam: Floats
    bias: Floats
    readout_s: float

    def stepped(self, term: str, step: Floats) -> TurnState:
        """Changed by a step (k,) of one term."""
        if term == "boresight":
            return replace(self, body_R_cam=self.body_R_cam @ exp(step))
        if term == "bias":
            return replace(self, bias=self.bias + step)
        name = {"offset": "offset_s", "drift": "drift", "readout": "readout_s"}[term]
        return replace(self, **{name: getattr(self, name) + float(step[0])})


class TurnProblem:
    """Matches of pairs, padded, and the rates."""

    def __init__(self, pairs: Pairs, imu: Imu, camera: Camera | None) -> None:
        self.pairs, self.imu = pairs, imu
        self.t0_ns = int(pairs.t_ns[0])
        stamps = seconds_since(pairs.t_ns, self.t0_ns)
        self.t = stamps[pairs.images]  # (n, 2)
        self.middle = float(stamps[-1]) / 2
        self.x = pairs.matches[:2]
        self.there = pairs.there
        self.blocks = time_blocks(self.t)
        self._kept: tuple[Floats, Attitudes] | None = None
        self.t_imu = seconds_since(imu.t_ns, self.t0_ns)
        self.rows: tuple[Floats, ...] = ()
        if camera is not None:
            last = camera.height - 1.0
            self.rows = tuple(
                np.asarray(pairs.padded(np.clip(camera.pixels(x)[:, 1] / last, 0.0, 1.0))) for x in (pairs.x0, pairs.x1)
            )

    def times(self, state: TurnState) -> Floats:
        """IMU times (n, 2) s of the first rows."""
        return np.asarray(self.t + state.offset_s + state.drift * (self.t - self.middle))

    def attitudes(self, state: TurnState) -> Attitudes:
        """By the rates less the bias of the state; the last ones are kept."""
        if self._kept is None or not np.array_equal(self._kept[0], state.bias):
            self._kept = state.bias, Attitudes(self.imu, self.t0_ns, state.bias)
        return self._kept[1]

    def by_bias(self, state: TurnState) -> Floats:
        """Derivative (n, 3, 3) of the rotations c0_R_c1 Exp(w) by the gyro bias, by attitudes at quarters of each."""
        attitudes, t = self.attitudes(state), self.times(state)
        length = t[:, 1] - t[:, 0]
        R = [attitudes.at(t[:, 0] + share * length) for share in (0.0, 0.25, 0.5, 0.75, 1.0)]
        back = -np.swapaxes(R[4], 1, 2) @ (R[0] + 2.0 * (R[1] + R[2] + R[3]) + R[4]) * (length / 8.0)[:, None, None]
        return np.asarray(state.body_R_cam.T @ back)

    def rotation(self, state: TurnState) -> Floats:
        """c0_R_c1 (n, 3, 3)."""
        attitudes, t = self.attitudes(state), self.times(state)
        R0, R1 = attitudes.at(t[:, 0]), attitudes.at(t[:, 1])
        return np.asarray(state.body_R_cam.T @ np.swapaxes(R0, 1, 2) @ R1 @ state.body_R_cam)

    def seen(self, state: TurnState) -> tuple[Floats, Floats]:
        """Points (n, k, 2) of both images as they were seen at the time of the first row."""
        if state.readout_s == 0 or not self.rows:
            return self.x
        t, out = self.times(state), []
        for i, (x, row) in enumerate(zip(self.x, self.rows, strict=True)):
            at = t[:, i] + state.readout_s / 2
            rate = np.stack([np.interp(at, self.t_imu, column) for column in self.imu.gyro.T], axis=1)
            rate = (rate - state.bias) @ state.body_R_cam
            turn = (state.readout_s * row[..., None] * rate[:, None, :]).reshape(-1, 3)
            ray = rotate(exp(turn), rays(x).reshape(-1, 3)).reshape(*x.shape[:2], 3)
            out.append(ray[..., :2] / ray[..., 2:])
        return out[0], out[1]


def start_of_turns(problem: TurnProblem, sigma: float) -> tuple[TurnState, float]:
    """The best lag and attitude by the rotations of pairs, and by how many deviations it beats other lags."""
    chosen = np.unique(np.linspace(0, len(problem.pairs) - 1, START_PAIRS).astype(int))
    x0, x1 = problem.x
    turns, spread, rows = [], [], []
    for row in chosen:
        there = problem.there[row]
        seen = two_view(x0[row][there], x1[row][there], sigma)
        variance = np.trace(seen.covariance[:3, :3]) / 3
        if seen.kind != "failed" and np.isfinite(variance):
            turns.append(log(seen.c0_R_c1))
            spread.append(np.sqrt(variance + ROTATION_SIGMA**2))
            rows.append(row)
    if len(rows) < LEAST_PAIRS // 2:
        found = f"{len(rows)} of {len(chosen)} pairs show a rotation"
        raise SessionError("images against gyro", found, "sound matches", "see smartnav match --benchmark")
    camera_turn, scale, t = np.array(turns), np.array(spread), problem.t[rows]
    attitudes = Attitudes(problem.imu, problem.t0_ns, np.zeros(3))
    lags = np.arange(-SEARCH_S, SEARCH_S + STEP_S / 2, STEP_S)
    costs, rotations = [], []
    for lag in lags:
        R0, R1 = attitudes.at(t[:, 0] + lag), attitudes.at(t[:, 1] + lag)
        body_turn = log(np.swapaxes(R0, 1, 2) @ R1)
        R, cost = _best_attitude(body_turn, camera_turn, scale)
        costs.append(cost)
        rotations.append(R)
    cost = np.array(costs)  # (lags, pairs)
    best = int(np.argmin(cost.sum(axis=1)))
    others = np.abs(lags - lags[best]) > APART_S
    gain = cost[others] - cost[best]
    deviation = gain.std(axis=1) / np.sqrt(gain.shape[1]) + 1e-9
    known = float((gain.mean(axis=1) / deviation).min())
    return TurnState(float(lags[best]), 0.0, rotations[best], np.zeros(3), 0.0), known


def _best_attitude(body: Floats, camera: Floats, scale: Floats) -> tuple[Floats, Floats]:
    """body_R_cam that turns rotation vectors (n, 3) of the camera into those of the body, each less its mean (which a
    gyro bias changes), and the costs (n,)."""
    weight, R, square = 1.0 / scale**2, np.eye(3), np.zeros(len(scale))
    for _ in range(5):
        a, b = (x - np.average(x, axis=0, weights=weight) for x in (camera, body))
        root = np.sqrt(weight)[:, None]
        R, _ = best_rotation(root * a, root * b)
        square = ((b - a @ R.T) ** 2).sum(axis=1) / (CAUCHY * scale) ** 2
        weight = 1.0 / (1.0 + square) / scale**2
    return R, np.log1p(square)


def time_blocks(t: Floats) -> list[Indices]:
    """Rows of the pairs (n, 2) s of each block of time."""
    middle = t.mean(axis=1)
    length = max(float(np.ptp(middle)) / BLOCKS, LEAST_BLOCK_S)
    number = np.floor((middle - middle.min()) / length).astype(int)
    return [np.flatnonzero(number == i) for i in np.unique(number)]
