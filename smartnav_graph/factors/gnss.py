"""Position fixes: r = (nav_t_body + nav_R_body * body_t_antenna - fix) / sigma, in nav axes.

GTSAM's GPSFactorArm where that is all; as rows of a model where the clock offset of the receiver, the lever arm or a
correlated error are states.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core import chi_square
from smartnav_graph.core.arrays import Floats, Mask
from smartnav_graph.core.errors import ConfigError
from smartnav_graph.core.frames import STANDARD_GRAVITY
from smartnav_graph.core.so3 import rotate, skew
from smartnav_graph.core.timebase import NS
from smartnav_graph.factors.context import FactorContext
from smartnav_graph.factors.gauss_markov import Ties, add_correlated_error, correlated_sigma
from smartnav_graph.factors.observation import Observed, PartialPreintegration, at_keyframe, preintegrated, row_model
from smartnav_graph.graph.pass_state import INITIALISATION_S, LAST_STAGE, PassState, PerPass, Phase
from smartnav_graph.graph.robust import PredictionLevel, check_loss, robust
from smartnav_graph.graph.states import SessionState, State, key
from smartnav_graph.graph.update import Builder, FactorBatch, FactorId, GraphUpdate
from smartnav_graph.graph.windows import PerWindow, Window
from smartnav_graph.session.calibration.model import CARRIER_PHASE_SIGMA, GnssNoise
from smartnav_graph.session.detect.interpolated import interpolation_error
from smartnav_graph.session.detect.scatter import Scatter, agrees_with_neighbours, scatter
from smartnav_graph.session.stream import Positioned

# Factor on the gate's square for fixes whose sigma was estimated.
ESTIMATED_TAIL = 4.0
# Where fixes are believed more than this (m) from the first, least squares follows outliers, and hides them.
FIRST_SIGMA = 0.03
UNKNOWN_HEIGHT_SIGMA = 1e4  # m, of a horizontal fix
LEAST_WEIGHT = 1e-4  # below it a row is left out


@dataclass(frozen=True)
class GnssConfig:
    """loss : ``gate`` (Cauchy to find outliers, chi-square gate with re-admission, then least squares), ``gnc``
    (truncated least squares by graduated non-convexity between Cauchy and gate), ``huber`` or ``none``;
    gate_probability : share of good fixes inside the gate; estimate_sigma : find the white sigma of fixes that
    carry none from the kept data; correlated : give the correlated error of code receivers a state;
    time_offset_sigma : prior of the receiver's clock offset as a state, s (zero: none); lever_arm_sigma : prior of
    the lever arm as a state, m (zero: taken as known).
    """

    loss: str = "gate"
    gate_probability: float = 0.999
    estimate_sigma: bool = True
    correlated: bool = True
    time_offset_sigma: float = 0.2
    lever_arm_sigma: float = 0.0

    def __post_init__(self) -> None:
        check_loss("gnss", self.loss, ("gate", "gnc", "huber", "none"))
        if not 0.5 < self.gate_probability < 1:
            raise ConfigError("config [gnss]", f"gate_probability = {self.gate_probability}", "between 0.5 and 1")
        if min(self.time_offset_sigma, self.lever_arm_sigma) < 0:
            raise ConfigError("config [gnss]", "time_offset_sigma or lever_arm_sigma < 0", ">= 0")


class PositionFix:
    """Data: fix (3) m, lever arm (3) m body axes, sigma (3) m. `extra`: C adds the correlated error of the fix, L to
    the lever arm, O the offset of its height."""

    width = 9

    def __init__(self, extra: tuple[str, ...]) -> None:
        self.extra = extra

    def observe(self, R: Floats, p: Floats, v: Floats, extra: Sequence[Floats], data: Floats) -> Observed:
        states = dict(zip(self.extra, extra, strict=True))
        lever = data[:, 3:6] + states.get("L", 0.0)
        weight = 1.0 / data[:, 6:9, None]
        up = np.array([[0.0, 0.0, 1.0]])
        offset = states.get("C", 0.0) + states.get("O", 0.0) * up
        residual = (p + rotate(R, lever) + offset - data[:, :3]) * weight[:, :, 0]
        by_state = np.zeros((len(p), 3, 9))
        by_state[:, :, :3] = -R @ skew(lever) * weight
        by_state[:, :, 3:6] = np.eye(3) * weight
        by = {"C": np.eye(3) * weight, "L": R * weight, "O": up.T * weight}
        return residual, by_state, [by[letter] for letter in self.extra]


def clock_state(sensor: str, sigma: float, initial: float = 0.0) -> SessionState:
    """Time offset (s) of a sensor's clock: its rows are of IMU time t + offset."""
    return SessionState("T", sensor, f"{sensor}_time_offset_s", np.array([initial]), np.array([sigma]))


def fix_sigmas(stream: Positioned, default: GnssNoise) -> Floats:
    """Sigmas (n, 3) m: the stream's own where given, the class default elsewhere; `UNKNOWN_HEIGHT_SIGMA` where the row
    has no height."""
    h, v = default.horizontal_sigma, default.vertical_sigma
    sigma = np.tile(np.array([h, h, v]), (len(stream), 1))
    if stream.sigma is not None:
        known = np.isfinite(stream.sigma)
        sigma[known] = stream.sigma[known]
    sigma[~stream.has_height, 2] = UNKNOWN_HEIGHT_SIGMA
    return sigma


def noise_model(sigmas: Floats, loss: str) -> gtsam.noiseModel.Base:
    """Diagonal noise under a loss applied to the whole fix: ``none``, ``huber`` or ``cauchy``."""
    return robust(gtsam.noiseModel.Diagonal.Sigmas(sigmas), loss)


@dataclass
class PositionBuilder(Builder):
    """Adds one position factor a fix.

    position (n, 3) nav m, sigma (n, 3) m, lever (3,) or (n, 3) m body axes; `own_sigma` (n,) marks rows whose sigma
    came with the data and is never scaled, `typical` (n,) those whose median sigma counts: in a replay, those known at
    first. `scatter` of the fixes by themselves, horizontal and vertical, which `agrees` (n,) with its neighbours, and
    how far (m) each is off where it was `interpolated` (n,). `height_offset` (n,) m was taken from the heights of rows
    of another datum: what is left of it is a state of each. Rows are tested with `least_gate_sigma` m at
    least when outliers are looked for.
    """

    name: str
    position: Floats
    sigma: Floats
    own_sigma: NDArray[np.bool_]
    lever: Floats
    config: GnssConfig = field(default_factory=GnssConfig)
    noise: GnssNoise = field(default_factory=GnssNoise)
    gravity: float = STANDARD_GRAVITY
    least_gate_sigma: float = 0.0
    typical: NDArray[np.bool_] | slice = field(default_factory=lambda: slice(None))
    scatter: tuple[Scatter | None, Scatter | None] = (None, None)
    agrees: Mask = field(default_factory=lambda: np.zeros(0, dtype=bool))
    height_offset: Floats = field(default_factory=lambda: np.zeros(0))
    interpolated: Floats = field(default_factory=lambda: np.zeros(1))
    stage: int = 0
    _ties: Ties = field(default_factory=PerWindow)
    _sigmas: PerPass[Floats] = field(default_factory=PerPass, init=False)
    _level: PredictionLevel = field(default_factory=lambda: PredictionLevel(3))

    def __post_init__(self) -> None:
        self.lever = np.broadcast_to(self.lever, self.position.shape)
        if not len(self.height_offset):
            self.height_offset = np.zeros(len(self.position))
        self.interpolated = np.broadcast_to(self.interpolated, len(self.position))

    def begin(self) -> PositionBuilder:
        return replace(self, _level=PredictionLevel(3))

    @classmethod
    def of(
        cls, context: FactorContext, name: str, stream: Positioned, noise: GnssNoise, config: GnssConfig
    ) -> PositionBuilder:
        """Builder of a session's stream of positions."""
        session = context.session
        given = np.full((len(stream), 3), np.nan) if stream.sigma is None else stream.sigma
        own = np.asarray(np.isfinite(given).all(axis=1))
        lever = session.lever_arms(stream)
        position, sigma = session.nav_position(stream), fix_sigmas(stream, noise)
        typical = np.ones(len(stream), dtype=bool)
        if context.causal:
            first = max(session.t0_ns + round(INITIALISATION_S * NS), int(stream.available_ns.min()))
            typical = stream.available_ns <= first
        t_ns, known = stream.t_ns[typical], position[typical]
        parts = scatter(t_ns, known[:, :2]), scatter(t_ns, known[:, 2:])
        agrees = np.zeros(len(stream), dtype=bool)
        agrees[typical] = agrees_with_neighbours(t_ns, known[:, :2])
        return cls(
            name,
            position,
            sigma,
            own,
            lever,
            config,
            noise,
            session.gravity,
            typical=typical,
            scatter=parts,
            agrees=agrees,
            height_offset=context.height_offsets(name, stream.t_ns),
            interpolated=interpolation_error(stream.t_ns, session.require_imu(), context.gaps),
        )

    def has_correlated_error(self, pass_state: PassState, *, doubtful: bool = False) -> bool:
        """Whether these fixes are of a code receiver: by the device's noise, unless they are better than
        `CARRIER_PHASE_SIGMA`. Better ones are of carrier phase, without correlated errors of metres. A receiver
        that filters its fixes appears to be better too: without sigmas of their own that counts only where nothing
        else is `doubtful`."""
        if not (self.noise.is_correlated and self.config.correlated):
            return False
        typical = float(np.median(self.scaled_sigma(pass_state)[self.typical, :2]))
        known = self.name in pass_state.correlated
        return known or typical >= CARRIER_PHASE_SIGMA or (doubtful and not self.has_sigmas)

    @property
    def has_sigmas(self) -> bool:
        """Whether most rows came with a sigma of their own."""
        return float(self.own_sigma[self.typical].mean()) > 0.5

    @property
    def measures_height(self) -> Mask:
        """Mask (n,) of the rows whose height counts."""
        return np.asarray(self.sigma[:, 2] < UNKNOWN_HEIGHT_SIGMA)

    @property
    def noise_names(self) -> tuple[str, str]:
        """Groups of noise: horizontal and vertical."""
        return self.name, f"{self.name}_vertical"

    @property
    def stated_name(self) -> str:
        """Group of noise of the rows with a sigma of their own."""
        return f"{self.name}_stated"

    def scaled_sigma(self, pass_state: PassState) -> Floats:
        """Sigmas (n, 3) m after the noise scales of this sensor, with the error of interpolated rows; those found are
        `FIRST_SIGMA` at least until outliers have been looked for."""
        return self._sigmas.of(pass_state, self._scaled_sigma)

    def _scaled_sigma(self, pass_state: PassState) -> Floats:
        least = 0.0 if pass_state.stage == LAST_STAGE else FIRST_SIGMA
        found = np.maximum(self.sigma * self._scale(pass_state), least)
        sigma = np.where(self.own_sigma[:, None], self.sigma * pass_state.scale(self.stated_name), found)
        return np.hypot(sigma, self.interpolated[:, None])

    def _scale(self, pass_state: PassState) -> Floats:
        horizontal, vertical = (pass_state.scale(name) for name in self.noise_names)
        return np.array([horizontal, horizontal, vertical])

    def gate(
        self, square: Floats, level: float, rows: NDArray[np.intp], probability: float | None = None
    ) -> NDArray[np.bool_]:
        """Which rows, of normalised squares (m,), lie outside the chi-square gate; see `limit`."""
        return np.asarray(square > self.limit(level, rows, probability))

    def limit(self, level: float, rows: NDArray[np.intp], probability: float | None = None) -> Floats:
        """Largest normalised square (m,) inside the chi-square gate (of the configured probability).

        `level` widens it with the robust level of all rows, so that optimistic sigmas reject nothing wholesale; rows
        whose sigma was estimated get twice the sigma: what tails the noise of such fixes has is part of it.
        """
        limit = float(chi_square.ppf(probability or self.config.gate_probability, 3)) * max(1.0, level)
        return np.asarray(limit * np.where(self.own_sigma[rows], 1.0, ESTIMATED_TAIL))

    @property
    def gated(self) -> bool:
        """Whether outliers are looked for."""
        return self.config.loss in ("gate", "gnc")

    def _loss_of(self, row: int, sigma: Floats, update: GraphUpdate, pass_state: PassState) -> str:
        """Loss of one fix in the phase at hand; see `PassState`."""
        if not self.gated:
            return self.config.loss
        if not pass_state.causal or update.variance is None:
            return "cauchy" if pass_state.phase is Phase.ROBUST else "none"
        predicted = update.predicted.position() + update.predicted.attitude().matrix() @ self.lever[row]
        correlated = correlated_sigma(self.noise) ** 2 if self.name in pass_state.correlated else 0.0
        square = float(((predicted - self.position[row]) ** 2 / (sigma**2 + update.variance + correlated)).sum())
        outside = self.gate(np.array([square]), self._level.before(square), np.array([row]))
        return "cauchy" if outside[0] else "none"

    def has_second_stage(self, pass_state: PassState) -> bool:
        """See `Builder`: the states of these fixes."""
        return bool(self._states(replace(pass_state, stage=LAST_STAGE))) or self.has_correlated_error(pass_state)

    def _states(self, pass_state: PassState) -> dict[str, SessionState]:
        if pass_state.stage < LAST_STAGE:
            return {}
        clock, lever = self.config.time_offset_sigma, self.config.lever_arm_sigma
        found = {}
        if clock > 0:
            found["T"] = clock_state(self.name, clock)
        if lever > 0:
            name = f"{self.name}_lever_arm_correction_m"
            found["L"] = SessionState("L", self.name, name, np.zeros(3), np.full(3, lever))
        return found

    def height_state(self, row: int) -> dict[str, SessionState]:
        """The state of a row of another datum, by its letter."""
        offset = self.height_offset[row]
        if not offset:
            return {}
        name = f"{self.name}_height_offset_{offset:+.1f}_m"
        return {"O": SessionState("O", self.name, name, np.zeros(1), np.array([abs(offset)]), f"{offset:+.1f}")}

    def add(self, update: GraphUpdate, window: Window, previous: State | None, pass_state: PassState) -> None:
        """A factor for every row of this stream that became known in the window."""
        if self.name in pass_state.correlated:
            add_correlated_error(update, window, previous, self.noise, self._ties)
        states = self._states(pass_state)
        for row in window.rows.get(self.name, ()):
            self._add_row(update, int(row), pass_state, states, self._at_keyframe(update, window, states))
        for delayed in window.delayed.get(self.name, ()):
            assert previous is not None
            partial = preintegrated(delayed.window, delayed.t_ns, previous.bias, self.gravity)
            self._add_row(update, delayed.row, pass_state, states, (delayed.window.index - 1, partial))

    def force(self, window: Window, nav_R_body: Floats, bias: Floats) -> Floats:
        """Accelerometer reading (3,) at the window's end; of a body not accelerated where the window has no samples."""
        if len(window.dt):
            return np.asarray(window.accel[-1])
        return np.asarray(nav_R_body.T @ np.array([0.0, 0.0, self.gravity]) + bias[:3])

    def _at_keyframe(
        self, update: GraphUpdate, window: Window, states: Mapping[str, SessionState]
    ) -> tuple[int, PartialPreintegration | None]:
        if "T" not in states:
            return update.index, None
        rate = window.gyro[-1] if len(window.dt) else update.bias.gyroscope()
        accel = self.force(window, update.predicted.attitude().matrix(), update.bias.vector())
        return update.index, at_keyframe(update.bias, accel, rate, self.gravity)

    def _add_row(
        self,
        update: GraphUpdate,
        row: int,
        pass_state: PassState,
        states: Mapping[str, SessionState],
        at: tuple[int, PartialPreintegration | None],
    ) -> None:
        """One fix, at a keyframe or after it by a partial preintegration."""
        index, partial = at
        sigma = self.scaled_sigma(pass_state)[row]
        weight = pass_state.weight(self.name, row)
        used = not pass_state.is_rejected(self.name, row) and weight > LEAST_WEIGHT
        if index == update.index:
            loss = self._loss_of(row, sigma, update, pass_state)
        else:  # a late fix in replay: no prediction of its own time is at hand to gate it with
            loss = "none" if self.config.loss == "none" else "huber"
        if pass_state.narrowing and loss == "cauchy":
            sigma = np.maximum(sigma, pass_state.robust_floor_m)
        sigma, loss = self._softened(sigma / np.sqrt(max(weight, LEAST_WEIGHT)), loss)
        chain, states = self.name in pass_state.correlated, {**states, **self.height_state(row)}
        if partial is None and not (states or chain):
            if used:
                self._add_native(update, row, noise_model(sigma, loss))
            return
        extra = ("C",) * chain + tuple(letter for letter in "LO" if letter in states)
        data = np.concatenate([self.position[row], self.lever[row], sigma])
        if partial is not None:
            data = np.concatenate([data, partial.columns()])
        model = row_model(PositionFix, extra, timed="T" in states, later=index != update.index)
        keys = update.keys(model.letters, index, states)
        update.blocks.append(FactorBatch(self.name, model, [keys], data[None], update.t_ns, (row,), (used,), loss))

    def _softened(self, sigma: Floats, loss: str) -> tuple[Floats, str]:
        """Sigma (3,) and loss of a row as they are used."""
        return sigma, loss

    def _add_native(self, update: GraphUpdate, row: int, model: gtsam.noiseModel.Base) -> None:
        pose, tag = key("X", update.index), FactorId(self.name, update.t_ns, row)
        if self.lever[row].any():
            update.add(tag, gtsam.GPSFactorArm(pose, self.position[row], self.lever[row], model))
        else:
            update.add(tag, gtsam.GPSFactor(pose, self.position[row], model))


def build(context: FactorContext) -> PositionBuilder | None:
    """The builder of a session's GNSS fixes."""
    stream = context.session.gnss
    if stream is None:
        return None
    return PositionBuilder.of(context, "gnss", stream, context.calibration.gnss_noise, context.options(GnssConfig))
