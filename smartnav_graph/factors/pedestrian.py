"""Steps of a walker: how far, and which way, a device is carried in one window.

    r = (Rz(yaw_i)^T (p_j - p_i)_xy - S K) / (sigma sqrt(t_j - t_i))        S = sum_k l_k Rot(yaw_k - yaw_i)

l_k is the part of Weinberg's step length that falls to the k-th inertial interval (`steps`), yaw_k - yaw_i the turn
since the window's start by the gyroscope, K = (k cos a, k sin a) the factor k of the steps and the angle a from the
device's forward axis to the way it goes, counter-clockwise. Yaw is that of the forward axis once the device is levelled
the shortest way: it has no poles but upside down, where no row is made. With R = nav_R_vehicle

    yaw = atan2(R_21 - R_12, R_11 + R_22)        d yaw = (R_31 w_1 + R_32 w_2) / (1 + R_33) + w_3,  R <- R Exp(w)

Source: Weinberg (2002), AN-602; the factor as a state after Shin, Park, Hong, Lee (2007), Adaptive step length
estimation algorithm using low-cost MEMS inertial sensors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core import frames
from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.errors import ConfigError
from smartnav_graph.core.so3 import exp
from smartnav_graph.core.timebase import NS, ns_from_seconds
from smartnav_graph.factors.context import FactorContext
from smartnav_graph.graph.pass_state import PassState
from smartnav_graph.graph.states import SessionState, State, key
from smartnav_graph.graph.update import Builder, FactorBatch, GraphUpdate
from smartnav_graph.graph.windows import Window
from smartnav_graph.session.calibration.model import StepNoise
from smartnav_graph.session.detect.steps import LOOKAHEAD_S, Steps, find_steps

WALK = 0.3  # share of regular steps from which a device that nothing is said of is in the hand of a walker
GOOD_FIX_M = 0.3
LEAST_UPRIGHT = 0.3  # least 1 + R_33: further from upright than 134 deg, yaw says little


@dataclass(frozen=True)
class StepConfig:
    """enabled : ``auto`` (in the hand of people on foot, or of a walker where no vehicle is declared), ``on`` or
    ``off``; spacing_s : fixes better than 0.3 m and closer together than that determine the trajectory by themselves.
    """

    enabled: str = "auto"
    spacing_s: float = 5.0

    def __post_init__(self) -> None:
        if self.enabled not in ("auto", "on", "off"):
            raise ConfigError("config [steps]", f"enabled = {self.enabled!r}", "auto, on or off")
        if self.spacing_s < 0:
            raise ConfigError("config [steps]", f"spacing_s = {self.spacing_s}", ">= 0 s")


def level_yaw(R: Floats) -> Floats:
    """Yaw (m,) rad, counter-clockwise from nav x, of the first axis of R (m, 3, 3) levelled the shortest way."""
    return np.asarray(np.arctan2(R[:, 1, 0] - R[:, 0, 1], R[:, 0, 0] + R[:, 1, 1]))


def _turn(complex_: NDArray[np.complex128]) -> Floats:
    """Complex numbers (m,) as matrices (m, 2, 2) of plane vectors."""
    re, im = complex_.real, complex_.imag
    return np.stack([re, -im, im, re], axis=-1).reshape(-1, 2, 2)


class Stride:
    """Data: S (2) real and imaginary, sigma m. States: pose at the window's start and end, step factor."""

    letters: tuple[str, ...] = ("X", "X", "K")

    def __init__(self, body_R_vehicle: Floats) -> None:
        self.body_R_vehicle = body_R_vehicle

    def linearize(self, states: Sequence[Floats], data: Floats) -> tuple[Floats, list[Floats]]:
        """See `graph.RowModel`; the pose tangent is [rotation, translation] on the body side."""
        (start, end, factor), B = states, self.body_R_vehicle
        weight = 1.0 / data[:, 2]
        R = start[:, :3, :3] @ B
        back = _turn(np.exp(-1j * level_yaw(R)))
        length = _turn(data[:, 0] + 1j * data[:, 1])
        moved = np.einsum("nij,nj->ni", back, (end - start)[:, :2, 3])
        residual = (moved - np.einsum("nij,nj->ni", length, factor)) * weight[:, None]
        by_yaw = np.stack([moved[:, 1], -moved[:, 0]], axis=-1)
        yaw_by_turn = np.concatenate([R[:, 2, :2] / (1.0 + R[:, 2, 2, None]), np.ones((len(R), 1))], axis=1) @ B.T
        by_start = np.concatenate([by_yaw[:, :, None] * yaw_by_turn[:, None], -back @ start[:, :2, :3]], axis=2)
        by_end = np.concatenate([np.zeros((len(R), 2, 3)), back @ end[:, :2, :3]], axis=2)
        return residual, [jacobian * weight[:, None, None] for jacobian in (by_start, by_end, -length)]


@cache
def stride_model(forward: str, up: str) -> Stride:
    """The one row model of a device's axes."""
    return Stride(frames.body_R_vehicle(forward, up))


@dataclass
class StepBuilder(Builder):
    """Adds one row a window in which steps are known and fixes are far apart.

    fixes_ns : stamps of good fixes, in time order; start_ns : of the recording; causal : see `walks`; note : a warning
    for the run
    """

    steps: Steps
    fixes_ns: NDArray[np.int64]
    model: Stride
    noise: StepNoise
    config: StepConfig = field(default_factory=StepConfig)
    note: str = ""
    start_ns: int = 0
    causal: bool = False
    name: str = "steps"
    stage: int = 0
    lookahead_s: float = LOOKAHEAD_S

    @property
    def state(self) -> SessionState:
        """The step factor with its prior."""
        noise = self.noise
        sigma = np.array([noise.factor_sigma, noise.sideways_sigma])
        return SessionState("K", "steps", "step_factor", np.array([noise.factor, 0.0]), sigma)

    def add(self, update: GraphUpdate, window: Window, previous: State | None, pass_state: PassState) -> None:
        """The row of one window; none in gaps, upside down, or between dense fixes."""
        if previous is None or window.kind == "gap" or not self._sparse(window, pass_state):
            return
        if not self.walks(window.t1_ns):
            return
        R = previous.nav.attitude().matrix() @ self.model.body_R_vehicle
        if 1.0 + R[2, 2] < LEAST_UPRIGHT:
            return
        length = self._length(window, R, previous.bias.gyroscope())
        sigma = self.noise.step_sigma * np.sqrt(window.length_s)
        keys = (key("X", window.index - 1), key("X", window.index), update.use(self.state))
        data = np.array([[length.real, length.imag, sigma]])
        update.blocks.append(FactorBatch(self.name, self.model, [keys], data, window.t1_ns, loss="huber"))

    def walks(self, t_ns: int) -> bool:
        """Whether the steps up to a time show a walk; always where it is declared, or shown by the whole recording."""
        if not self.causal:
            return True
        count = int(np.searchsorted(self.steps.end_ns, t_ns, side="right"))
        return count > 0 and bool(self.steps.regular_seconds[count - 1] >= WALK * (t_ns - self.start_ns) / NS)

    def _length(self, window: Window, R: Floats, gyro_bias: Floats) -> complex:
        """S of one window."""
        ends = window.t0_ns + ns_from_seconds(np.cumsum(window.dt))
        part = np.diff(self.steps.travelled(np.concatenate([[window.t0_ns], ends])))
        if not part.any():
            return 0j
        rate = (window.gyro - gyro_bias) @ self.model.body_R_vehicle
        turns = exp(rate * window.dt[:, None])
        attitude = [R]
        for turn in turns:
            attitude.append(attitude[-1] @ turn)
        yaw = np.unwrap(level_yaw(np.array(attitude)))
        middle = 0.5 * (yaw[1:] + yaw[:-1]) - yaw[0]
        return complex((part * np.exp(1j * middle)).sum())

    def _sparse(self, window: Window, pass_state: PassState) -> bool:
        """Whether the good fixes around a window are `spacing_s` apart; a replay knows those before it."""
        fixes, spacing = self.fixes_ns, round(self.config.spacing_s * NS)
        after = int(np.searchsorted(fixes, window.t1_ns))
        before = int(np.searchsorted(fixes, window.t0_ns, side="right")) - 1
        if pass_state.causal:
            since = window.t1_ns - int(fixes[before]) if before >= 0 else spacing
            last = int(fixes[before] - fixes[before - 1]) if before >= 1 else 0
            return max(since, last) >= spacing
        if before < 0 or after >= len(fixes):
            return True
        return int(fixes[after] - fixes[before]) >= spacing


def build(context: FactorContext) -> StepBuilder | None:
    """The builder of a walker's steps; none for a foot-mounted device, whose stances say more."""
    config, session = context.options(StepConfig), context.session
    by_hand = context.vehicle in ("foot", "none") and not context.on_foot
    if config.enabled == "off" or (config.enabled == "auto" and not by_hand):
        return None
    imu = session.require_imu()
    steps = find_steps(imu)
    declared = config.enabled == "on" or context.vehicle == "foot"
    share = steps.regular_seconds / session.seconds(steps.end_ns if context.causal else imu.t_ns[-1])
    if not (declared or share.max(initial=0.0) >= WALK):
        return None
    note = "" if declared else _note(len(steps), float(share[-1]))
    model = stride_model(session.device.forward, session.device.up)
    noise = context.calibration.step_noise
    causal = context.causal and not declared
    return StepBuilder(steps, _good_fixes(context), model, noise, config, note, session.t0_ns, causal)


def _note(count: int, share: float) -> str:
    return (
        f"steps: a walk ({count} steps, {100 * share:.0f} % of the time regular); used between fixes that are far "
        "apart, give --vehicle if it is none, or --steps.enabled off"
    )


def _good_fixes(context: FactorContext) -> NDArray[np.int64]:
    """Stamps (n,) of the fixes that are better than `GOOD_FIX_M`; those without a sigma have their class's."""
    session = context.session
    found = [np.zeros(0, np.int64)]
    for stream, usual in (
        (session.gnss, context.calibration.gnss_noise.horizontal_sigma),
        (session.control, context.calibration.control_noise.position_sigma),
        (session.pose_fixes, context.calibration.pose_fix_noise.position_sigma),
    ):
        if stream is not None:
            sigma = np.full((len(stream), 2), usual) if stream.sigma is None else stream.sigma[:, :2]
            found.append(stream.t_ns[np.where(np.isfinite(sigma), sigma, usual).max(axis=1) < GOOD_FIX_M])
    return np.sort(np.concatenate(found))
