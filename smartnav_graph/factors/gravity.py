"""Tilt from gravity where nothing else holds it: over some seconds the mean specific force points up.

    r = [nav_R_body (f - b_a)]_(east, north) / sigma        and        r = nav_v_body / speed

f is the mean of the specific force over a stretch, turned by the gyro to its end: what is left of it beside gravity is
the change of velocity over the stretch divided by its length. Its sigma grows with the motion: a device may turn round
in a stretch, a share of the scatter of the force does not average out, and a mean whose size is not that of gravity
means a lasting acceleration. A device in the hand is as slow as a walker, which bounds the velocity where nothing else
does.

The inertial factors use the same force; they do not determine tilt unless velocity or position is held, and their noise
is far below this sigma.

Source: Mahony, Hamel, Pflimlin (2008), Nonlinear complementary filters on SO(3), IEEE TAC 53(5), V.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.errors import ConfigError
from smartnav_graph.core.so3 import rotate, skew
from smartnav_graph.core.timebase import NS, ns_from_seconds
from smartnav_graph.factors.context import FactorContext
from smartnav_graph.factors.magnetometer import TurnedSamples
from smartnav_graph.factors.observation import AtKeyframe, Observed
from smartnav_graph.graph.pass_state import PassState
from smartnav_graph.graph.states import State, key
from smartnav_graph.graph.update import Builder, FactorBatch, FactorId, GraphUpdate
from smartnav_graph.graph.windows import Window
from smartnav_graph.session.streams import ABSOLUTE

# Streams that determine tilt: those of position or velocity.
HOLDS_TILT = (*ABSOLUTE, "velocity", "wheel")
ALONE_S = 60.0  # time without any of them from which the force is used
LEAST_SIGMA = 0.05  # m/s^2, of the mean force of a device at rest
CLIMB = 0.5  # m/s, vertical speed of a person
SHARE = 0.1  # of the scatter of the force: what does not average out


@dataclass(frozen=True)
class GravityConfig:
    """enabled : ``auto`` (on foot, where no position, velocity or rest has come for a minute), ``on``, ``off``;
    stretch_s : time over which the force is averaged; speed : speed of a person along one horizontal axis, m/s.
    """

    enabled: str = "auto"
    stretch_s: float = 4.0
    speed: float = 1.4

    def __post_init__(self) -> None:
        if self.enabled not in ("auto", "on", "off"):
            raise ConfigError("config [gravity]", f"enabled = {self.enabled!r}", "auto, on or off")
        if not min(self.stretch_s, self.speed) > 0:
            raise ConfigError("config [gravity]", f"stretch_s = {self.stretch_s}, speed = {self.speed}", "> 0")


class Upright:
    """Data: mean specific force (3) m/s^2 in body axes at the keyframe, sigma (1) m/s^2. Residual (m, 2)."""

    extra: tuple[str, ...] = ("B",)
    width = 4

    def observe(self, R: Floats, p: Floats, v: Floats, extra: Sequence[Floats], data: Floats) -> Observed:
        (bias,) = extra
        force, weight = data[:, :3] - bias[:, :3], 1.0 / data[:, 3:4]
        level = R[:, :2] * weight[:, :, None]
        by_state, by_bias = np.zeros((len(R), 2, 9)), np.zeros((len(R), 2, 6))
        by_state[:, :, :3] = -level @ skew(force)
        by_bias[:, :, :3] = -level
        return rotate(R, force)[:, :2] * weight, by_state, [by_bias]


MODEL = AtKeyframe(Upright())


@dataclass
class Stretch:
    """Sums over windows, seen from their end: force times dt (3,) m/s, its size and square times dt, length s."""

    force: Floats = field(default_factory=lambda: np.zeros(3))
    size: float = 0.0
    square: float = 0.0
    length_s: float = 0.0
    end_ns: int = 0

    def add(self, window: Window, gyro_bias: Floats) -> None:
        """Append one window."""
        starts = window.t0_ns + ns_from_seconds(np.concatenate([[0.0], np.cumsum(window.dt)[:-1]]))
        size = np.linalg.norm(window.accel, axis=1)
        weighted = window.accel * window.dt[:, None]
        mean, _ = TurnedSamples.of(window, starts, weighted).mean(gyro_bias)
        _, whole = TurnedSamples.of(window, starts[:1], weighted[:1]).mean(gyro_bias)
        self.force = whole @ self.force + mean * len(starts)
        self.size += float(size @ window.dt)
        self.square += float(size**2 @ window.dt)
        self.length_s += window.length_s
        self.end_ns = window.t1_ns

    @property
    def scatter(self) -> float:
        """Standard deviation of the size of the force, m/s^2."""
        return float(np.sqrt(max(self.square / self.length_s - (self.size / self.length_s) ** 2, 0.0)))


@dataclass
class GravityBuilder(Builder):
    """Adds one row a stretch. held_ns (n,) : stamps of everything that holds tilt; gravity m/s^2."""

    gravity: float
    held_ns: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    config: GravityConfig = field(default_factory=GravityConfig)
    name: str = "gravity"
    stage: int = 0
    _stretch: Stretch = field(default_factory=Stretch)
    _begin_ns: int = 0

    def begin(self) -> GravityBuilder:
        return replace(self, _stretch=Stretch(), _begin_ns=0)

    def add(self, update: GraphUpdate, window: Window, previous: State | None, pass_state: PassState) -> None:
        """Take the window into the stretch; a row where the stretch is long enough."""
        if window.kind == "first":
            self._begin_ns = window.t1_ns
        soon = window.t0_ns + round(self.config.stretch_s * NS)  # a stretch that begins now ends then
        if window.kind in ("first", "gap") or window.t0_ns != self._stretch.end_ns or not self._alone(soon):
            self._stretch = Stretch(end_ns=window.t1_ns)
            return
        self._stretch.add(window, update.bias.gyroscope())
        if self._stretch.length_s < self.config.stretch_s - 1e-6:
            return
        done, self._stretch = self._stretch, Stretch(end_ns=window.t1_ns)
        if not self._alone(window.t1_ns):
            return
        mean = done.force / done.length_s
        data = np.append(mean, self.sigma(mean - update.bias.accelerometer(), done.scatter, done.length_s))[None]
        keys = [(key("X", update.index), key("V", update.index), key("B", update.index))]
        update.blocks.append(FactorBatch(self.name, MODEL, keys, data, update.t_ns, loss="huber"))
        pace = gtsam.noiseModel.Diagonal.Sigmas(np.array([self.config.speed, self.config.speed, CLIMB]))
        update.add(FactorId("pace", update.t_ns), gtsam.PriorFactorVector(key("V", update.index), np.zeros(3), pace))

    def _alone(self, t_ns: int) -> bool:
        if self.config.enabled == "on" or not len(self.held_ns):
            return True
        before = int(np.searchsorted(self.held_ns, t_ns, side="right"))
        since = self._begin_ns if before == 0 else int(self.held_ns[before - 1])
        return t_ns - since > ALONE_S * NS

    def sigma(self, mean: Floats, scatter: float, length_s: float) -> float:
        """Sigma (m/s^2) of a mean force (3,) less bias, over `length_s` s, whose size scattered by `scatter` m/s^2.

        A force longer than gravity, sqrt(g^2 + a^2), means an acceleration a; a small difference may be bias.
        """
        excess = max(abs(float(np.linalg.norm(mean)) - self.gravity) - BIAS_SLACK, 0.0)
        parts = [LEAST_SIGMA, SHARE * scatter, np.sqrt(2.0 * self.gravity * excess)]
        if scatter > REST_SCATTER:
            parts.append(np.sqrt(2.0) * self.config.speed / length_s)
        return float(np.linalg.norm(parts))


# Size of the mean force (m/s^2) that an accelerometer bias may be off by without a detected acceleration.
BIAS_SLACK = 0.2
# Scatter of the force's size (m/s^2) that a sensor at rest may have.
REST_SCATTER = 0.1


def build(context: FactorContext) -> GravityBuilder | None:
    """The builder where nothing else observes the tilt."""
    config = context.options(GravityConfig)
    carried = context.vehicle == "foot" and not context.on_foot  # a car nobody declared is no walker
    if config.enabled == "off" or (config.enabled == "auto" and not carried):
        return None
    stamps = [stream.t_ns for name, stream in context.session.streams().items() if name in HOLDS_TILT]
    if context.rests is not None:  # after a rest the gyroscope keeps it for a while
        stamps.append(np.array(context.rests.rests(), dtype=np.int64).ravel())
    held_ns = np.sort(np.concatenate([np.zeros(0, np.int64), *stamps]))
    return GravityBuilder(context.session.gravity, held_ns, config)
