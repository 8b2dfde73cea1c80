"""Zero velocity at standstills, no turn where the device is truly at rest, one level under all stances of a foot.

    velocity    nav_v_body = 0                                  sigma from the detector, metres a second
    turn        nav_R_body(t1) = nav_R_body(t0)                 over windows wholly at rest
    level       u(t) - U = 0                                    stances of a foot-mounted IMU on a declared flat floor

The second is what is called a zero angular rate update: with the inertial factor beside it the gyro's mean reading is
its bias. Written as a pair of attitudes it also keeps the heading, which a prior on the bias does not.
A false standstill must not bend the trajectory. Steady travel looks like rest: there a row that is inconsistent with
the other sensors has a redescending loss (Geman, McClure: the force falls with the cube of the residual). Its scale
grows with the sigma of the predicted speed: a speed that is unknown, as after a minute of dead reckoning in a replay,
is no inconsistency. A false stance of a foot is a slow one: beyond `TAIL` sigmas the force is constant.

Source: Foxlin (2005), Pedestrian tracking with shoe-mounted inertial sensors, IEEE CG&A 25(6); Skog et al. (2010).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np

from smartnav_graph.core.arrays import Floats
from smartnav_graph.factors.context import FactorContext
from smartnav_graph.factors.observation import AtKeyframe, Observed
from smartnav_graph.graph.pass_state import PassState
from smartnav_graph.graph.states import SessionState, State, key
from smartnav_graph.graph.update import Builder, FactorBatch, FactorId, GraphUpdate
from smartnav_graph.graph.windows import PerWindow, Window
from smartnav_graph.session.detect.standstills import LOOKAHEAD_S, StandstillConfig, Standstills

TAIL = 4.0
# Scale of the redescending loss, in sigmas (0.3 m/s of a rest with a sigma of 1 cm/s), and in m/s.
LOSS_SCALE, LOSS_SCALE_SPEED = 30.0, 0.3
# A speed this many times its sigma is inconsistent with a standstill.
INCONSISTENT = 5.0
# Position sigma of the pair of attitudes, m: none.
ANYWHERE = 1e4
# Prior sigma (m) of the floor's height.
UNKNOWN_LEVEL = 1000.0


class Level:
    """Data: sigma (1) m. Residual (m, 1): height above the floor state U."""

    extra: tuple[str, ...] = ("U",)
    width = 1

    def observe(self, R: Floats, p: Floats, v: Floats, extra: Sequence[Floats], data: Floats) -> Observed:
        (floor,) = extra
        weight = 1.0 / data[:, :1]
        by_state = np.zeros((len(p), 1, 9))
        by_state[:, 0, 5] = weight[:, 0]
        return (p[:, 2:] - floor) * weight, by_state, [-weight[:, :, None]]


MODEL = AtKeyframe(Level())


@dataclass
class StandstillBuilder(Builder):
    """Adds the factors of a standstill at each keyframe inside one.

    rests : the standstills of the recording; _floor : the floor's state, once a stance has been seen; _stance : stamp
    of the last one whose level is in the graph
    """

    rests: Standstills
    config: StandstillConfig = field(default_factory=StandstillConfig)
    name: str = "static"
    stage: int = 0
    lookahead_s: float = LOOKAHEAD_S
    _floor: SessionState | None = None
    _stance: int | None = None
    _sigmas: PerWindow[tuple[float, float]] = field(default_factory=PerWindow)

    def begin(self) -> StandstillBuilder:
        return replace(self, _floor=None, _stance=None)

    def add(self, update: GraphUpdate, window: Window, previous: State | None, pass_state: PassState) -> None:
        """Factors at the keyframe that ends `window`."""
        speed, turn = self._sigmas.of(window, self._sigmas_of)
        if np.isfinite(speed) and pass_state.refuted and self.rests.start_of(window.t1_ns) in pass_state.refuted:
            return
        if np.isfinite(speed):
            if self.config.zupt:
                self._add_speed(update, speed, _unknown(previous))
            if self.config.flat_floor and self.rests.on_foot:
                self._add_level(update)
        if self.config.zaru and previous is not None and window.kind != "gap" and np.isfinite(turn):
            self._add_turn(update, turn)

    def _sigmas_of(self, window: Window) -> tuple[float, float]:
        """Of the speed at a window's end, and of the turn in it; NaN in motion."""
        turn = self.rests.over(self.rests.turn_sigma, window.t0_ns, window.t1_ns)
        return self.rests.speed_at(window.t1_ns), turn

    def _add_speed(self, update: GraphUpdate, sigma: float, unknown: float) -> None:
        loss_scale = max(LOSS_SCALE_SPEED / sigma, INCONSISTENT * unknown / sigma, TAIL)
        zero = gtsam.PriorFactorVector(key("V", update.index), np.zeros(3), self._noise(np.full(3, sigma), loss_scale))
        update.add(FactorId(self.name, update.t_ns), zero)

    def _add_turn(self, update: GraphUpdate, sigma: float) -> None:
        before, after = key("X", update.index - 1), key("X", update.index)
        model = self._noise(np.array([sigma] * 3 + [ANYWHERE] * 3), LOSS_SCALE)
        update.add(FactorId("static_turn", update.t_ns), gtsam.BetweenFactorPose3(before, after, gtsam.Pose3(), model))

    def _noise(self, sigmas: Floats, loss_scale: float) -> gtsam.noiseModel.Base:
        """Diagonal noise under the loss of a rest or of a stance."""
        losses = gtsam.noiseModel.mEstimator
        loss = losses.Huber.Create(TAIL) if self.rests.on_foot else losses.GemanMcClure.Create(loss_scale)
        return gtsam.noiseModel.Robust.Create(loss, gtsam.noiseModel.Diagonal.Sigmas(sigmas))

    def _add_level(self, update: GraphUpdate) -> None:
        """Once a stance: at all of its keyframes the floor is as far from its level."""
        stance = self.rests.start_of(update.t_ns)
        if stance == self._stance:
            return
        self._stance = stance
        if self._floor is None:
            height = np.array([update.predicted.position()[2]])
            self._floor = SessionState("U", self.name, "floor_height_m", height, np.array([UNKNOWN_LEVEL]))
        keys = (key("X", update.index), key("V", update.index), update.use(self._floor))
        data = np.array([[self.config.floor_sigma]])
        update.blocks.append(FactorBatch("static_level", MODEL, [keys], data, update.t_ns, loss="huber"))


def _unknown(previous: State | None) -> float:
    """Sigma (m/s) of the speed at the keyframe before, where it is known; zero otherwise."""
    if previous is None or previous.covariance is None:
        return 0.0
    return float(np.sqrt(np.trace(previous.covariance[6:9, 6:9])))


def build(context: FactorContext) -> StandstillBuilder | None:
    """The builder, where a session has standstills."""
    if context.rests is None or not context.rests.still.any():
        return None
    return StandstillBuilder(context.rests, context.options(StandstillConfig))
