"""Ranges to anchors at known places (UWB, WiFi round-trip time, acoustic), with a bias for each anchor.

    r = (|nav_t_body + nav_R_body body_t_sensor - nav_t_anchor| + b_anchor - range) / sigma

b is a state with a prior: what antennas and electronics of an anchor add. A range without line of sight is too long: an
outlier, found and left out as those among position fixes.

Source: Groves (2013), Principles of GNSS, inertial and multisensor integrated navigation systems, 7.1.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core import chi_square
from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.errors import ConfigError
from smartnav_graph.core.so3 import rotate, skew
from smartnav_graph.factors.context import FactorContext
from smartnav_graph.factors.observation import Observed, PartialPreintegration, preintegrated, row_model
from smartnav_graph.graph.pass_state import LAST_STAGE, PassState, Phase
from smartnav_graph.graph.robust import PredictionLevel, check_loss
from smartnav_graph.graph.states import SessionState, State
from smartnav_graph.graph.update import Builder, FactorBatch, GraphUpdate
from smartnav_graph.graph.windows import Window

NAME = "ranges"
SHORTEST_M = 1e-6  # a range has no direction at the anchor itself


@dataclass(frozen=True)
class RangeConfig:
    """loss : ``gate`` (a redescending loss finds outliers, a chi-square gate leaves them out), ``huber`` or ``none``;
    gate_probability : share of good ranges inside the gate; bias : give each anchor a bias as a state."""

    loss: str = "gate"
    gate_probability: float = 0.999
    bias: bool = True

    def __post_init__(self) -> None:
        check_loss(NAME, self.loss, ("gate", "huber", "none"))
        if not 0.5 < self.gate_probability < 1:
            raise ConfigError(f"config [{NAME}]", f"gate_probability = {self.gate_probability}", "between 0.5 and 1")


class AnchorRange:
    """Data: anchor (3) m nav axes, lever arm (3) m body axes, range m, sigma m. Residual (m, 1). `extra`: R the bias of
    the anchor, m."""

    width = 8

    def __init__(self, extra: tuple[str, ...]) -> None:
        self.extra = extra

    def observe(self, R: Floats, p: Floats, v: Floats, extra: Sequence[Floats], data: Floats) -> Observed:
        lever, weight = data[:, 3:6], 1.0 / data[:, 7:8]
        way = p + rotate(R, lever) - data[:, :3]
        distance = np.maximum(np.linalg.norm(way, axis=1, keepdims=True), SHORTEST_M)
        direction = (way / distance)[:, None]
        by_state = np.zeros((len(p), 1, 9))
        by_state[:, :, :3] = -direction @ R @ skew(lever) * weight[:, :, None]
        by_state[:, :, 3:6] = direction * weight[:, :, None]
        expected = distance + (extra[0] if extra else 0.0)
        return (expected - data[:, 6:7]) * weight, by_state, [weight[:, :, None] for _ in extra]


@dataclass
class RangeBuilder(Builder):
    """Adds one row for each range.

    anchor_id (n,); anchor (n, 3) m nav axes; distance, sigma (n,) m; lever (3,) m body axes; bias_sigma m, of the prior
    of an anchor's bias, zero for none
    """

    anchor_id: NDArray[np.object_]
    anchor: Floats
    distance: Floats
    sigma: Floats
    lever: Floats
    bias_sigma: float
    gravity: float
    config: RangeConfig = field(default_factory=RangeConfig)
    name: str = NAME
    stage: int = 0
    _level: PredictionLevel = field(default_factory=lambda: PredictionLevel(1))

    def begin(self) -> RangeBuilder:
        return replace(self, _level=PredictionLevel(1))

    @property
    def gate_probability(self) -> float | None:
        return self.config.gate_probability if self.config.loss == "gate" else None

    def has_second_stage(self, pass_state: PassState) -> bool:
        return self.bias_sigma > 0

    def bias(self, row: int) -> SessionState:
        """The bias of the anchor of a row."""
        anchor = str(self.anchor_id[row])
        name = f"ranges_bias_{anchor}_m"
        return SessionState("R", self.name, name, np.zeros(1), np.full(1, self.bias_sigma), anchor)

    def add(self, update: GraphUpdate, window: Window, previous: State | None, pass_state: PassState) -> None:
        """A row for every range that became known in the window."""
        for row in window.rows.get(self.name, ()):
            loss = self._loss(int(row), update, pass_state)
            self._add_row(update, int(row), pass_state, loss, update.index)
        for delayed in window.delayed.get(self.name, ()):
            assert previous is not None
            partial = preintegrated(delayed.window, delayed.t_ns, previous.bias, self.gravity)
            loss = "none" if self.config.loss == "none" else "huber"
            self._add_row(update, delayed.row, pass_state, loss, delayed.window.index - 1, partial)

    def _loss(self, row: int, update: GraphUpdate, pass_state: PassState) -> str:
        """Loss of a range in the phase at hand; in a replay, where it is inconsistent with its prediction."""
        if self.config.loss != "gate":
            return self.config.loss
        if not pass_state.causal or update.variance is None:
            return "cauchy" if pass_state.phase is Phase.ROBUST else "none"
        way = update.predicted.position() + update.predicted.attitude().matrix() @ self.lever - self.anchor[row]
        distance = max(float(np.linalg.norm(way)), SHORTEST_M)
        variance = float((way / distance) ** 2 @ update.variance) + self.sigma[row] ** 2 + self.bias_sigma**2
        square = (distance - self.distance[row]) ** 2 / variance
        limit = float(chi_square.ppf(self.config.gate_probability, 1)) * max(1.0, self._level.before(square))
        return "cauchy" if square > limit else "none"

    def _add_row(
        self,
        update: GraphUpdate,
        row: int,
        pass_state: PassState,
        loss: str,
        index: int,
        partial: PartialPreintegration | None = None,
    ) -> None:
        """One range, at a keyframe or after it by a partial preintegration."""
        states: Mapping[str, SessionState] = {}
        if self.bias_sigma > 0 and pass_state.stage == LAST_STAGE:
            states = {"R": self.bias(row)}
        data = np.concatenate([self.anchor[row], self.lever, [self.distance[row], self.sigma[row]]])
        if partial is not None:
            data = np.concatenate([data, partial.columns()])
        model = row_model(AnchorRange, tuple(states), later=partial is not None)
        keys, used = update.keys(model.letters, index, states), not pass_state.is_rejected(self.name, row)
        update.blocks.append(FactorBatch(self.name, model, [keys], data[None], update.t_ns, (row,), (used,), loss))


def build(context: FactorContext) -> RangeBuilder | None:
    """The builder of a session's ranges."""
    stream, config, noise = context.session.ranges, context.options(RangeConfig), context.calibration.range_noise
    if stream is None:
        return None
    return RangeBuilder(
        anchor_id=stream.anchor_id,
        anchor=context.session.nav_position(stream),
        distance=stream.range_m,
        sigma=stream.sigmas(noise.sigma),
        lever=np.asarray(context.session.mount(NAME).body_t, dtype=np.float64),
        bias_sigma=noise.bias_sigma if config.bias else 0.0,
        gravity=context.session.gravity,
        config=config,
    )
