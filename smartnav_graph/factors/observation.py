"""Measurements of the state at one instant, and the row models that carry them to keyframes.

An `Observation` knows the state (R, p, v) at its own time and nothing else. `AtKeyframe` takes it at a keyframe;
`AtInstant` at any time after one, predicted by partial preintegration, with the clock offset of its sensor as a state
where asked:

    R(t) = R_i dR Exp(w d)
    p(t) = p_i + v_i dt + g dt^2 / 2 + R_i dp + v d + a d^2 / 2
    v(t) = v_i + g dt + R_i dv + a d

with d the offset beyond the nominal one, w and a the rate and acceleration then. Third-order terms in d are left out:
1 mm for 0.1 s in a car that brakes.

Source: Forster, Carlone, Dellaert, Scaramuzza (2017), On-manifold preintegration, IEEE T-RO 33(1), III-V.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple, Protocol

import gtsam
import numpy as np

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.so3 import exp, rotate, skew
from smartnav_graph.core.timebase import NS
from smartnav_graph.graph.update import RowModel
from smartnav_graph.graph.windows import Window

# Whitened residual and its derivatives by state and by `extra`; see `Observation.observe`.
Observed = tuple[Floats, Floats, list[Floats]]


class Observation(Protocol):
    """One kind of measurement.

    extra : letters of the states it touches beside pose and velocity; width : columns of data it reads
    """

    extra: tuple[str, ...]
    width: int

    def observe(self, R: Floats, p: Floats, v: Floats, extra: Sequence[Floats], data: Floats) -> Observed:
        """Whitened residual (m, d) and its derivatives.

        Parameters
        ----------
        R (m, 3, 3), p (m, 3) m, v (m, 3) m/s : nav_R_body, nav_t_body, nav_v_body at the row's time
        extra : one array (m, n) a letter of `extra`; data : (m, width)

        Returns
        -------
        residual (m, d); by_state (m, d, 9) by rotation (body side: R <- R Exp(w)), nav position, nav velocity;
        by_extra, one (m, d, n) a letter
        """
        ...


class AtKeyframe:
    """Row model of an observation at keyframes, without a clock offset."""

    def __init__(self, observation: Observation) -> None:
        self.observation = observation
        self.letters: tuple[str, ...] = ("X", "V", *observation.extra)

    def linearize(self, states: Sequence[Floats], data: Floats) -> tuple[Floats, list[Floats]]:
        pose, v, *extra = states
        R = pose[:, :3, :3]
        residual, by, by_extra = self.observation.observe(R, pose[:, :3, 3], v, extra, data)
        by_pose = np.concatenate([by[:, :, :3], by[:, :, 3:6] @ R], axis=2)
        return residual, [by_pose, by[:, :, 6:9], *by_extra]


class PartialPreintegration(NamedTuple):
    """Preintegrated from a keyframe to an instant; see `preintegrated`.

    dt s; dR (3, 3), dp (3,), dv (3,) at `bias` (6,); by_bias (9, 6) of [rotation, dp, dv]; accel, gyro (3,) measured
    there; gravity m/s^2
    """

    dt: float
    dR: Floats
    dp: Floats
    dv: Floats
    by_bias: Floats
    bias: Floats
    accel: Floats
    gyro: Floats
    gravity: float

    def columns(self, offset: float = 0.0) -> Floats:
        """The data columns that `AtInstant` appends to an observation's own; `offset` s is the nominal time offset
        already contained in the instant."""
        deltas = self.dR.ravel(), self.dp, self.dv, self.by_bias.ravel()
        return np.concatenate([(self.dt,), *deltas, self.bias, self.accel, self.gyro, (self.gravity, offset)])


_AT = {"dt": 1, "dR": 9, "dp": 3, "dv": 3, "by_bias": 54, "bias": 6, "accel": 3, "gyro": 3, "gravity": 1, "offset": 1}
WIDTH = sum(_AT.values())
# Shorter times after a keyframe are none.
SHORTEST_S = 1e-9
# Bias steps (m/s^2, rad/s) of the numerical derivative of a partial preintegration: its second order is negligible.
_BIAS_STEP = np.array([1e-3] * 3 + [1e-5] * 3)


def at_keyframe(bias: gtsam.imuBias.ConstantBias, accel: Floats, gyro: Floats, gravity: float) -> PartialPreintegration:
    """The partial preintegration of no length: the instant is the keyframe itself."""
    zero = np.zeros(3)
    return PartialPreintegration(0.0, np.eye(3), zero, zero, np.zeros((9, 6)), bias.vector(), accel, gyro, gravity)


def preintegrated(window: Window, t_ns: int, bias: gtsam.imuBias.ConstantBias, gravity: float) -> PartialPreintegration:
    """From the keyframe before `window` to the instant `t_ns` inside it, at `bias` (gtsam ConstantBias).

    Raises
    ------
    ValueError
        The instant lies outside the window.
    """
    if not window.t0_ns <= t_ns <= window.t1_ns:
        raise ValueError(f"{t_ns} ns lies outside the window {window.t0_ns} to {window.t1_ns} ns")
    dt = _until(window.dt, (t_ns - window.t0_ns) / NS)
    last = max(len(dt) - 1, 0)
    if not len(dt):
        return at_keyframe(bias, window.accel[last], window.gyro[last], gravity)
    pim = gtsam.PreintegratedImuMeasurements(gtsam.PreintegrationParams.MakeSharedU(0.0), bias)
    for accel, gyro, step in zip(window.accel, window.gyro, dt.tolist(), strict=False):
        pim.integrateMeasurement(accel, gyro, step)
    dR, dp, dv = pim.deltaRij().matrix(), pim.deltaPij(), pim.deltaVij()
    by_bias = _by_bias(pim, bias.vector())
    length = float(dt.sum())
    return PartialPreintegration(
        length, dR, dp, dv, by_bias, bias.vector(), window.accel[last], window.gyro[last], gravity
    )


def _by_bias(pim: gtsam.PreintegratedImuMeasurements, base: Floats) -> Floats:
    """Derivative (9, 6) of the deltas by the bias: central differences of GTSAM's own first-order correction, seen in
    what a body at rest in the origin does without gravity."""
    by_bias = np.zeros((9, 6))
    for i, step in enumerate(_BIAS_STEP):
        up, down = (
            pim.predict(gtsam.NavState(), gtsam.imuBias.ConstantBias(moved[:3], moved[3:]))
            for moved in (base + sign * step * np.eye(6)[i] for sign in (1.0, -1.0))
        )
        turn = gtsam.Rot3.Logmap(down.attitude().between(up.attitude()))
        change = [turn, up.position() - down.position(), up.velocity() - down.velocity()]
        by_bias[:, i] = np.concatenate(change) / (2.0 * step)
    return by_bias


def _until(dt: Floats, length: float) -> Floats:
    """The intervals up to `length` s, the last one cut; none where it is nothing."""
    ends = np.cumsum(dt)
    count = int(np.searchsorted(ends, length - SHORTEST_S)) + 1
    part = dt[:count].copy()
    if len(part):
        part[-1] -= max(float(part.sum()) - length, 0.0)
    return part[part > 0.0] if length > SHORTEST_S else part[:0]


class AtInstant:
    """Row model of an observation at any time after a keyframe.

    Data: the observation's columns, then those of `PartialPreintegration.columns`. `timed` adds the time
    offset T of its sensor (s): the row is of IMU time t + T. `short` is for rows at
    their keyframe (`at_keyframe`), where the bias matters only through the offset: it is that of when the row
    was made, and is no state of the row.
    """

    def __init__(self, observation: Observation, *, timed: bool = False, short: bool = False) -> None:
        self.observation = observation
        self.timed, self.short = timed, short
        bias, clock = () if short else ("B",), ("T",) if timed else ()
        self.letters: tuple[str, ...] = ("X", "V", *bias, *clock, *observation.extra)

    def linearize(self, states: Sequence[Floats], data: Floats) -> tuple[Floats, list[Floats]]:
        pose, velocity, *rest = states
        at = _unpack(data[:, self.observation.width :])
        bias = at["bias"] if self.short else rest.pop(0)
        there = _present(pose, velocity) if self.short else propagate(pose, velocity, bias, at)
        clock: list[Floats] = []
        if self.timed:
            offset = rest.pop(0)
            there, by_clock = _delayed(there, bias, offset[:, 0] - at["offset"][:, 0], at)
            clock = [by_clock]
        own = data[:, : self.observation.width]
        residual, by, by_extra = self.observation.observe(there.R, there.p, there.v, rest, own)
        moved = there.by[:2] if self.short else there.by
        return residual, [*(by @ jacobian for jacobian in (*moved, *clock)), *by_extra]


@cache
def row_model(
    kind: Callable[[tuple[str, ...]], Observation], extra: tuple[str, ...], *, timed: bool = False, later: bool = False
) -> RowModel:
    """The one row model of a kind of observation with some `extra` states; later : than its keyframe."""
    return AtInstant(kind(extra), timed=timed, short=not later) if timed or later else AtKeyframe(kind(extra))


@dataclass(frozen=True)
class StateAt:
    """State at the instant; by : derivatives (m, 9, n) by pose, velocity and bias."""

    R: Floats
    p: Floats
    v: Floats
    by: tuple[Floats, Floats, Floats]


def _unpack(columns: Floats) -> dict[str, Floats]:
    out, start = {}, 0
    for name, width in _AT.items():
        out[name] = columns[:, start : start + width]
        start += width
    return out


def _present(pose: Floats, velocity: Floats) -> StateAt:
    """At the keyframe itself."""
    R, eye = pose[:, :3, :3], np.eye(3)
    by_pose, by_velocity, by_bias = (np.zeros((len(pose), 9, n)) for n in (6, 3, 6))
    by_pose[:, :3, :3], by_pose[:, 3:6, 3:], by_velocity[:, 6:9] = eye, R, eye
    return StateAt(R, pose[:, :3, 3], velocity, (by_pose, by_velocity, by_bias))


def propagate(pose: Floats, velocity: Floats, bias: Floats, at: dict[str, Floats]) -> StateAt:
    """By the partial preintegration, corrected to first order for the bias (m, 6), or for whatever its derivatives
    `by_bias` go by."""
    m, size = bias.shape
    by_bias = at["by_bias"].reshape(m, 9, size)
    change = rotate(by_bias, bias - at["bias"])
    turn = exp(change[:, :3])
    dR = at["dR"].reshape(m, 3, 3) @ turn
    dp, dv = at["dp"] + change[:, 3:6], at["dv"] + change[:, 6:9]
    Ri, dt = pose[:, :3, :3], at["dt"]
    fall = np.array([0.0, 0.0, -1.0]) * at["gravity"]
    p = pose[:, :3, 3] + velocity * dt + 0.5 * fall * dt**2 + rotate(Ri, dp)
    v = velocity + fall * dt + rotate(Ri, dv)
    by_pose, by_velocity, by_b = np.zeros((m, 9, 6)), np.zeros((m, 9, 3)), np.zeros((m, 9, size))
    by_pose[:, :3, :3] = dR.transpose(0, 2, 1)
    by_pose[:, 3:6, :3] = -Ri @ skew(dp)
    by_pose[:, 3:6, 3:] = Ri
    by_pose[:, 6:9, :3] = -Ri @ skew(dv)
    by_velocity[:, 3:6] = dt[:, :, None] * np.eye(3)
    by_velocity[:, 6:9] = np.eye(3)
    by_b[:, :3] = (np.eye(3) - 0.5 * skew(change[:, :3])) @ by_bias[:, :3]
    by_b[:, 3:6], by_b[:, 6:9] = Ri @ by_bias[:, 3:6], Ri @ by_bias[:, 6:9]
    return StateAt(Ri @ dR, p, v, (by_pose, by_velocity, by_b))


def _delayed(there: StateAt, bias: Floats, delta: Floats, at: dict[str, Floats]) -> tuple[StateAt, Floats]:
    """The state `delta` (m,) s later, and its derivative (m, 9, 1) by it."""
    m, d = len(delta), delta[:, None]
    rate, force = at["gyro"] - bias[:, 3:], at["accel"] - bias[:, :3]
    a = rotate(there.R, force) + np.array([0.0, 0.0, -1.0]) * at["gravity"]
    turn = exp(rate * d)
    onward = np.zeros((m, 9, 9))
    onward[:, :3, :3] = turn.transpose(0, 2, 1)
    lean = -there.R @ skew(force)
    onward[:, 3:6, :3] = 0.5 * d[:, :, None] ** 2 * lean
    onward[:, 6:9, :3] = d[:, :, None] * lean
    onward[:, 3:6, 3:6] = onward[:, 6:9, 6:9] = np.eye(3)
    onward[:, 3:6, 6:9] = d[:, :, None] * np.eye(3)
    by_pose, by_velocity, by_bias = (onward @ jacobian for jacobian in there.by)
    by_bias[:, :3, 3:] -= d[:, :, None] * (np.eye(3) - 0.5 * skew(rate * d))
    by_bias[:, 3:6, :3] -= 0.5 * d[:, :, None] ** 2 * there.R
    by_bias[:, 6:9, :3] -= d[:, :, None] * there.R
    p, v = there.p + there.v * d + 0.5 * a * d**2, there.v + a * d
    by_clock = np.concatenate([rate, v, a], axis=1)[:, :, None]
    return StateAt(there.R @ turn, p, v, (by_pose, by_velocity, by_bias)), by_clock
