"""Measured velocity: of a receiver in nav axes, or of an odometer or flow sensor in body axes.

    gnss       nav_v_body + nav_R_body (w x body_t_antenna) - v_measured = 0
    velocity   nav_R_body^T nav_v_body + w x body_t_sensor - v_measured = 0

w is the angular rate, bias removed, that the inertial sensor read at that time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.so3 import rotate, skew
from smartnav_graph.core.timebase import NS
from smartnav_graph.factors.context import FactorContext
from smartnav_graph.factors.gnss import GnssConfig, clock_state
from smartnav_graph.factors.observation import AtInstant, AtKeyframe, Observed, at_keyframe
from smartnav_graph.graph.pass_state import LAST_STAGE, PassState
from smartnav_graph.graph.robust import check_loss
from smartnav_graph.graph.states import State, key
from smartnav_graph.graph.update import Builder, FactorBatch, GraphUpdate
from smartnav_graph.graph.windows import Window
from smartnav_graph.session.streams import Velocity

# A velocity at a keyframe is interpolated between readings no further apart than this, s.
APART_S = 0.5


@dataclass(frozen=True)
class VelocityConfig:
    """gnss : use the velocities that come with GNSS fixes; loss : loss of a row, ``none``, ``huber`` or ``cauchy``."""

    gnss: bool = True
    loss: str = "huber"

    def __post_init__(self) -> None:
        check_loss("velocity", self.loss)


class NavVelocity:
    """Data: velocity (3) m/s nav axes, w x lever (3) m/s body axes, sigma (3) m/s. Residual (m, 3)."""

    extra: tuple[str, ...] = ()
    width = 9

    def observe(self, R: Floats, p: Floats, v: Floats, extra: Sequence[Floats], data: Floats) -> Observed:
        arm, weight = data[:, 3:6], 1.0 / data[:, 6:9]
        by_state = np.zeros((len(v), 3, 9))
        by_state[:, :, :3] = -R @ skew(arm)
        by_state[:, :, 6:] = np.eye(3)
        return (v + rotate(R, arm) - data[:, :3]) * weight, by_state * weight[:, :, None], []


class BodyVelocity:
    """Data: velocity (3) m/s body axes, w x lever (3) m/s body axes, sigma (3) m/s. Residual (m, 3)."""

    extra: tuple[str, ...] = ()
    width = 9

    def observe(self, R: Floats, p: Floats, v: Floats, extra: Sequence[Floats], data: Floats) -> Observed:
        weight = 1.0 / data[:, 6:9]
        body_R_nav = R.transpose(0, 2, 1)
        body = rotate(body_R_nav, v)
        by_state = np.zeros((len(v), 3, 9))
        by_state[:, :, :3] = skew(body)
        by_state[:, :, 6:] = body_R_nav
        return (body + data[:, 3:6] - data[:, :3]) * weight, by_state * weight[:, :, None], []


NAV_MODEL = AtKeyframe(NavVelocity())
NAV_MODEL_TIMED = AtInstant(NavVelocity(), timed=True)
BODY_MODEL = AtKeyframe(BodyVelocity())


def rate_at_end(window: Window, bias: gtsam.imuBias.ConstantBias) -> Floats:
    """Angular rate (3,) rad/s, bias removed, at the window's end; zero where it has no samples."""
    return np.asarray(window.gyro[-1] - bias.gyroscope()) if len(window.dt) else np.zeros(3)


@dataclass
class GnssVelocityBuilder(Builder):
    """Adds the velocities that come with position fixes, at their keyframes and on their clock.

    velocity (n, 3) m/s nav axes, rows that are not known NaN; sigma (n, 3) m/s; lever (3,) m body axes; gravity m/s^2
    """

    velocity: Floats
    sigma: Floats
    lever: Floats
    gravity: float
    gnss: GnssConfig
    config: VelocityConfig
    name: str = "gnss_velocity"
    stage: int = 0

    def add(self, update: GraphUpdate, window: Window, previous: State | None, pass_state: PassState) -> None:
        """A row for every known velocity at the keyframe."""
        rows = [int(row) for row in window.rows.get("gnss", ()) if np.isfinite(self.velocity[row]).all()]
        if not rows:
            return
        states: tuple[int, ...] = (key("X", update.index), key("V", update.index))
        arm = np.cross(rate_at_end(window, update.bias), self.lever)
        tail = np.zeros(0)
        timed = pass_state.stage >= LAST_STAGE and self.gnss.time_offset_sigma > 0 and len(window.dt) > 0
        if timed:
            states = (*states, key("B", update.index), update.use(clock_state("gnss", self.gnss.time_offset_sigma)))
            tail = at_keyframe(update.bias, window.accel[-1], window.gyro[-1], self.gravity).columns()
        data = np.array([np.concatenate([self.velocity[row], arm, self.sigma[row], tail]) for row in rows])
        used = tuple(bool(known) for known in pass_state.used("gnss", np.array(rows, dtype=np.intp)))
        model = NAV_MODEL_TIMED if timed else NAV_MODEL
        block = FactorBatch(self.name, model, [states] * len(rows), data, update.t_ns, rows, used, self.config.loss)
        update.blocks.append(block)


@dataclass
class BodyVelocityBuilder(Builder):
    """Adds one body velocity a keyframe, interpolated between the readings around it.

    default_sigma : m/s, of readings without sigma
    """

    stream: Velocity
    lever: Floats
    default_sigma: float
    config: VelocityConfig
    name: str = "velocity"
    stage: int = 0
    lookahead_s: float = APART_S

    def add(self, update: GraphUpdate, window: Window, previous: State | None, pass_state: PassState) -> None:
        """One row at the window's end where readings surround it."""
        found = self._at(window.t1_ns)
        if found is None:
            return
        velocity, sigma = found
        arm = np.cross(rate_at_end(window, update.bias), self.lever)
        data = np.concatenate([velocity, arm, sigma * pass_state.scale(self.name)])[None]
        keys = (key("X", update.index), key("V", update.index))
        update.blocks.append(FactorBatch(self.name, BODY_MODEL, [keys], data, update.t_ns, loss=self.config.loss))

    def _at(self, t_ns: int) -> tuple[Floats, Floats] | None:
        """Velocity (3,) and its sigma (3,); neighbours with a share s and 1 - s in it have (s^2 + (1 - s)^2) of the
        variance of one."""
        stamps = self.stream.t_ns
        after = int(np.searchsorted(stamps, t_ns))
        before = after if after < len(stamps) and stamps[after] == t_ns else after - 1
        if before < 0 or after >= len(stamps) or stamps[after] - stamps[before] > APART_S * NS:
            return None
        share = 0.0 if after == before else float((t_ns - stamps[before]) / (stamps[after] - stamps[before]))
        mix = np.array([1.0 - share, share])
        own = np.full(3, self.default_sigma) if self.stream.sigma is None else self.stream.sigma[before]
        return mix @ self.stream.velocity[[before, after]], own * float(np.sqrt((mix**2).sum()))


def build_gnss(context: FactorContext) -> GnssVelocityBuilder | None:
    """The builder of velocities in a session's GNSS fixes."""
    fixes, config, noise = context.session.gnss, context.options(VelocityConfig), context.calibration.gnss_noise
    if fixes is None or fixes.velocity is None or not config.gnss:
        return None
    h, v = noise.velocity_horizontal_sigma, noise.velocity_vertical_sigma
    sigma = np.tile(np.array([h, h, v]), (len(fixes), 1))
    if fixes.sigma_velocity is not None:
        sigma = np.where(np.isfinite(fixes.sigma_velocity), fixes.sigma_velocity, sigma)
    lever = np.asarray(context.session.mount("gnss").body_t, dtype=np.float64)
    gnss, gravity = context.options(GnssConfig), context.session.gravity
    return GnssVelocityBuilder(np.asarray(fixes.velocity), sigma, lever, gravity, gnss, config)


def build(context: FactorContext) -> BodyVelocityBuilder | None:
    """The builder of a session's body velocities."""
    stream = context.session.velocity
    if stream is None:
        return None
    lever = np.asarray(context.session.mount("velocity").body_t, dtype=np.float64)
    sigma = context.calibration.velocity_noise.velocity_sigma
    return BodyVelocityBuilder(stream, lever, sigma, context.options(VelocityConfig))
