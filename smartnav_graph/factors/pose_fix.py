"""Fixes from elsewhere: image recognition, a total station, WiFi. Position, and attitude where the row has one.

    position   nav_t_body + nav_R_body (body_t_sensor + L) - fix = 0                     `gnss.PositionBuilder`
    attitude   Log(nav_R_body body_R_sensor Exp(A) fix^T) = 0                            rad, nav axes

Both at the time t + T of a row stamped t. L and A correct the mount of the sensor, T its clock; they are
states. L and A have a prior only where the session does not state the mount.

Source: Sola, Deray, Atchuthan (2018), A micro Lie theory for state estimation in robotics, for the derivatives of Log.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.errors import ConfigError, SessionError
from smartnav_graph.core.so3 import exp, left_jacobian_inverse, log, right_jacobian
from smartnav_graph.core.timebase import NS
from smartnav_graph.factors.context import FactorContext
from smartnav_graph.factors.gnss import GnssConfig, PositionBuilder, clock_state
from smartnav_graph.factors.observation import Observed, PartialPreintegration, at_keyframe, preintegrated, row_model
from smartnav_graph.graph.pass_state import LAST_STAGE, PassState, Phase
from smartnav_graph.graph.states import SessionState, State
from smartnav_graph.graph.update import Builder, FactorBatch, GraphUpdate
from smartnav_graph.graph.windows import Window
from smartnav_graph.session.calibration.model import GnssNoise
from smartnav_graph.session.session import Session
from smartnav_graph.session.streams import PoseFix

NAME = "pose_fixes"
ATTITUDE = "pose_attitude"
# Where inertial data and fixes of millimetres differ by centimetres the inertial data are wrong: rows are tested with
# this sigma, m, at least when outliers are looked for.
LEAST_GATE_SIGMA = 0.05


@dataclass(frozen=True)
class PoseFixConfig:
    """loss : as for GNSS fixes, ``gate``, ``gnc``, ``huber`` or ``none``; gate_probability : share of good rows
    inside the gate; attitude : use the attitudes of rows that have one; latency_s : known delay of the stamps, a
    row stamped t is of t - latency_s and became known at t; time_offset_sigma : prior of what is left of the delay
    as a state, s (zero: none); lever_arm_sigma : prior of the lever arm where the session does not state the mount,
    m; mount_sigma_deg : prior of the attitude of the mount there.
    """

    loss: str = "gate"
    gate_probability: float = 0.999
    attitude: bool = True
    latency_s: float = 0.0
    time_offset_sigma: float = 0.2
    lever_arm_sigma: float = 0.1
    mount_sigma_deg: float = 3.0

    def __post_init__(self) -> None:
        GnssConfig(loss=self.loss, gate_probability=self.gate_probability)
        if min(self.latency_s, self.time_offset_sigma, self.lever_arm_sigma, self.mount_sigma_deg) < 0:
            raise ConfigError("config [pose_fixes]", "latency_s or a sigma < 0", ">= 0")


def undo_latency(session: Session, config: PoseFixConfig) -> Session:
    """The session with its pose fixes stamped with the time of measurement, where their latency is known."""
    fixes = session.pose_fixes
    if fixes is None or config.latency_s == 0:
        return session
    stamps = fixes.t_ns - round(config.latency_s * NS)
    return session.replace(pose_fixes=replace(fixes, t_ns=stamps, arrival_ns=fixes.available_ns))


class AttitudeFix:
    """Data: nav_R_sensor (9), body_R_sensor (9), sigma (3) rad nav axes. `extra`: A turns the sensor in its mount."""

    width = 21

    def __init__(self, extra: tuple[str, ...]) -> None:
        self.extra = extra

    def observe(self, R: Floats, p: Floats, v: Floats, extra: Sequence[Floats], data: Floats) -> Observed:
        fix, mount = data[:, :9].reshape(-1, 3, 3), data[:, 9:18].reshape(-1, 3, 3)
        weight = 1.0 / data[:, 18:21, None]
        predicted = R @ mount @ (exp(extra[0]) if extra else np.eye(3))
        theta = log(predicted @ fix.transpose(0, 2, 1))
        by_turn = weight * left_jacobian_inverse(theta)
        by_state = np.zeros((len(R), 3, 9))
        by_state[:, :, :3] = by_turn @ R
        return theta * weight[:, :, 0], by_state, [by_turn @ predicted @ right_jacobian(x) for x in extra]


@dataclass
class PoseFixBuilder(PositionBuilder):
    """`PositionBuilder` for fixes that may be far better than their prediction by inertial data.

    A redescending loss would believe the inertial data instead, for good: what it is asked for gets Huber's, with a
    sigma of `LEAST_GATE_SIGMA` at least.
    """

    def _softened(self, sigma: Floats, loss: str) -> tuple[Floats, str]:
        return (np.maximum(sigma, LEAST_GATE_SIGMA), "huber") if loss == "cauchy" else (sigma, loss)


@dataclass
class AttitudeBuilder(Builder):
    """Adds the attitude of every pose fix that has one, beside its position.

    attitude (n, 3, 3) nav_R_sensor, known (n,) which rows have one, mount (3, 3) body_R_sensor, sigma (n, 3) rad nav
    axes; `own_sigma` (n,) marks rows whose sigma came with the data; mount_sigma rad, zero for a mount that is known
    """

    attitude: Floats
    known: NDArray[np.bool_]
    mount: Floats
    sigma: Floats
    own_sigma: NDArray[np.bool_]
    mount_sigma: float
    config: PoseFixConfig
    gravity: float
    name: str = ATTITUDE
    stage: int = 0

    @property
    def gate_probability(self) -> float | None:
        """Share of good rows inside the gate that outliers fail; None where none are looked for."""
        return self.config.gate_probability if self.config.loss == "gate" else None

    def _states(self, pass_state: PassState) -> dict[str, SessionState]:
        if pass_state.stage < LAST_STAGE:
            return {}
        found = {}
        if self.config.time_offset_sigma > 0:
            found["T"] = clock_state(NAME, self.config.time_offset_sigma)
        if self.mount_sigma > 0:
            turn = np.full(3, self.mount_sigma)
            found["A"] = SessionState("A", NAME, f"{NAME}_mount_correction_rad", np.zeros(3), turn)
        return found

    def add(self, update: GraphUpdate, window: Window, previous: State | None, pass_state: PassState) -> None:
        """A row for every attitude that became known in the window."""
        states = self._states(pass_state)
        for row in window.rows.get(NAME, ()):
            if self.known[row]:
                partial = self._here(update, window) if "T" in states else None
                self._add_row(update, int(row), pass_state, states, update.index, partial)
        for delayed in window.delayed.get(NAME, ()):
            if self.known[delayed.row]:
                assert previous is not None
                partial = preintegrated(delayed.window, delayed.t_ns, previous.bias, self.gravity)
                self._add_row(update, delayed.row, pass_state, states, delayed.window.index - 1, partial)

    def _here(self, update: GraphUpdate, window: Window) -> PartialPreintegration:
        """The instant of the keyframe itself; only its rate matters to an attitude."""
        rate = window.gyro[-1] if len(window.dt) else update.bias.gyroscope()
        return at_keyframe(update.bias, np.zeros(3), rate, self.gravity)

    def _add_row(
        self,
        update: GraphUpdate,
        row: int,
        pass_state: PassState,
        states: Mapping[str, SessionState],
        index: int,
        partial: PartialPreintegration | None,
    ) -> None:
        sigma = self.sigma[row] * (1.0 if self.own_sigma[row] else pass_state.scale(self.name))
        data = np.concatenate([self.attitude[row].ravel(), self.mount.ravel(), sigma])
        if partial is not None:
            data = np.concatenate([data, partial.columns()])
        used = not (pass_state.is_rejected(self.name, row) or pass_state.is_rejected(NAME, row))
        model = row_model(AttitudeFix, ("A",) * ("A" in states), timed="T" in states, later=index != update.index)
        keys, loss = update.keys(model.letters, index, states), self._loss(pass_state)
        update.blocks.append(FactorBatch(self.name, model, [keys], data[None], update.t_ns, (row,), (used,), loss))

    def _loss(self, pass_state: PassState) -> str:
        if self.config.loss != "gate":
            return self.config.loss
        return "huber" if pass_state.phase in (Phase.ROBUST, Phase.CAUSAL) else "none"


def build(context: FactorContext) -> PoseFixBuilder | None:
    """The builder of the positions of a session's pose fixes."""
    stream, config = context.session.pose_fixes, context.options(PoseFixConfig)
    if stream is None:
        return None
    stated = NAME in context.session.sensors
    options = GnssConfig(
        loss=config.loss,
        gate_probability=config.gate_probability,
        correlated=False,
        time_offset_sigma=config.time_offset_sigma,
        lever_arm_sigma=0.0 if stated else config.lever_arm_sigma,
    )
    sigma = context.calibration.pose_fix_noise.position_sigma
    builder = PoseFixBuilder.of(context, NAME, stream, GnssNoise(sigma, sigma), options)
    assert isinstance(builder, PoseFixBuilder)
    return replace(builder, least_gate_sigma=LEAST_GATE_SIGMA)


def build_attitude(context: FactorContext) -> AttitudeBuilder | None:
    """The builder of the attitudes of a session's pose fixes."""
    stream, config = context.session.pose_fixes, context.options(PoseFixConfig)
    if stream is None or stream.quat is None or not config.attitude:
        return None
    attitude, known = attitudes(stream)
    given = np.full((len(stream), 3), np.nan) if stream.sigma_rot is None else stream.sigma_rot
    sigma = np.where(np.isfinite(given), given, context.calibration.pose_fix_noise.attitude_sigma)
    stated = NAME in context.session.sensors
    return AttitudeBuilder(
        attitude=attitude,
        known=known,
        mount=np.asarray(context.session.mount(NAME).body_R, dtype=np.float64),
        sigma=sigma,
        own_sigma=np.asarray(np.isfinite(given).all(axis=1)),
        mount_sigma=0.0 if stated else float(np.radians(config.mount_sigma_deg)),
        config=config,
        gravity=context.session.gravity,
    )


def attitudes(stream: PoseFix) -> tuple[Floats, NDArray[np.bool_]]:
    """nav_R_sensor (n, 3, 3) of the rows, and which (n,) have one.

    Raises
    ------
    SessionError
        A quaternion is not of unit norm.
    """
    from scipy.spatial.transform import Rotation

    rows = np.full((len(stream), 4), np.nan) if stream.quat is None else np.asarray(stream.quat)
    known = np.isfinite(rows).all(axis=1)
    norm = np.linalg.norm(rows, axis=1)
    bad = np.flatnonzero(known & ~(np.abs(norm - 1.0) < 1e-2))
    if len(bad):
        row = int(bad[0])
        raise SessionError(
            NAME, f"quaternion norm {norm[row]:.6g} at row {row}", "1 within 0.01", "check the columns", row=row
        )
    xyzw = np.where(known[:, None], rows, np.array([1.0, 0.0, 0.0, 0.0]))[:, [1, 2, 3, 0]]
    return np.asarray(Rotation.from_quat(xyzw).as_matrix()), known
