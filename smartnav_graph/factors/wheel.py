"""Wheel speed: the forward velocity of the rear axle, with a scale (tyre radius) and a delay as states.

    (1 + scale) (v_x + w_y z - w_z y) - speed - delay dspeed/dt = 0

in the vehicle's own axes (see `vehicle`), (x, y, z) the rear axle's place. A straight line through the readings around
a keyframe gives speed and slope there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from smartnav_graph.core import frames
from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.errors import ConfigError
from smartnav_graph.core.timebase import NS
from smartnav_graph.factors.context import FactorContext
from smartnav_graph.factors.observation import AtKeyframe, Observed
from smartnav_graph.factors.vehicle import (
    RATE_S,
    DeclaredVelocity,
    VehicleAxes,
    VehicleConfig,
    due,
    mount_state,
    recent,
)
from smartnav_graph.graph.pass_state import PassState
from smartnav_graph.graph.robust import check_loss
from smartnav_graph.graph.states import SessionState, State, key
from smartnav_graph.graph.update import Builder, FactorBatch, GraphUpdate
from smartnav_graph.graph.windows import Window
from smartnav_graph.session.calibration.model import VEHICLE_CLASSES
from smartnav_graph.session.streams import WheelSpeed

# Readings this far (s) before and after a keyframe make its straight line: 1 cm/s of curvature when a car brakes hard.
HALF_LINE_S = 0.2
LEAST_ROWS = 3
# m/s backwards from which a speed without sign is taken as negative.
REVERSING = 0.5


@dataclass(frozen=True)
class WheelConfig:
    """period_s : time between two rows at least; scale_sigma : prior of the scale of the wheel, a ratio;
    delay_sigma : prior of the delay, s; loss : loss of a row, ``none``, ``huber`` or ``cauchy``.
    """

    period_s: float = 1.0
    scale_sigma: float = 0.03
    delay_sigma: float = 0.1
    loss: str = "huber"

    def __post_init__(self) -> None:
        if not min(self.scale_sigma, self.delay_sigma) > 0:
            raise ConfigError("config [wheel]", "a sigma <= 0", "> 0")
        if self.period_s < 2 * HALF_LINE_S:
            raise ConfigError("config [wheel]", f"period_s = {self.period_s}", f">= {2 * HALF_LINE_S} s")
        check_loss("wheel", self.loss)


class RearWheels:
    """Data: speed m/s, its slope m/s^2, angular rate (3) rad/s in declared vehicle axes, sigma m/s. Residual (m, 1).

    States: M the vehicle, W scale and delay (s).
    """

    extra: tuple[str, ...] = ("M", "W")
    width = 6

    def __init__(self, body_R_vehicle: Floats) -> None:
        self.body_R_vehicle = body_R_vehicle

    def observe(self, R: Floats, p: Floats, v: Floats, extra: Sequence[Floats], data: Floats) -> Observed:
        mount, wheel = extra
        axes, declared = VehicleAxes.of(mount), DeclaredVelocity.of(R, v, self.body_R_vehicle)
        vel, rate = axes.turn(declared.rows), axes.turn(data[:, 2:5])
        y, z, gain, delay = mount[:, 3], mount[:, 4], 1.0 + wheel[:, 0], wheel[:, 1]
        ahead = vel.rows[:, 0] + rate.rows[:, 1] * z - rate.rows[:, 2] * y
        weight = 1.0 / data[:, 5]
        residual = gain * ahead - data[:, 0] - delay * data[:, 1]
        by_state = axes.rotation[:, :1] @ declared.by_state
        by_mount = np.zeros((len(v), 1, mount.shape[1]))
        by_axes = vel.by_mount[:, 0] + rate.by_mount[:, 1] * z[:, None] - rate.by_mount[:, 2] * y[:, None]
        by_mount[:, 0, :2] = by_axes
        by_mount[:, 0, 3], by_mount[:, 0, 4] = -rate.rows[:, 2], rate.rows[:, 1]
        by_wheel = np.stack([ahead, -data[:, 1]], axis=1)[:, None]
        scaled, gained = weight[:, None, None], (weight * gain)[:, None, None]
        return (residual * weight)[:, None], by_state * gained, [by_mount * gained, by_wheel * scaled]


@dataclass
class WheelBuilder(Builder):
    """Adds one row a period where readings surround the keyframe.

    body_R_vehicle (3, 3) : declared axes; default_sigma : m/s, of readings that carry none. Such a sigma covers
    slip and quantisation, which do not average out; a reading's own is taken as white. causal : whether speeds have a
    sign is known from the readings so far, not from all.
    """

    stream: WheelSpeed
    body_R_vehicle: Floats
    default_sigma: float
    config: WheelConfig
    vehicle: VehicleConfig
    causal: bool = False
    name: str = "wheel"
    stage: int = 1
    lookahead_s: float = HALF_LINE_S

    def __post_init__(self) -> None:
        self.model = AtKeyframe(RearWheels(self.body_R_vehicle))
        negative = self.stream.t_ns[self.stream.speed < 0]
        self._first_negative_ns = int(negative[0]) if len(negative) else None

    @property
    def noise_groups(self) -> Mapping[str, float]:
        return {self.name: self.default_sigma} if self.stream.sigma is None else {}

    def add(self, update: GraphUpdate, window: Window, previous: State | None, pass_state: PassState) -> None:
        """One row at the end of the window, where one is due."""
        if not (len(window.dt) and due(window, self.config.period_s)):
            return
        line = self._line(window.t1_ns)
        if line is None:
            return
        speed, slope, sigma = line
        ahead = self.body_R_vehicle[:, 0] @ update.predicted.attitude().matrix().T @ update.predicted.velocity()
        sign = -1.0 if self._unsigned(window.t1_ns) and ahead < -REVERSING else 1.0
        rate = (recent(window, window.gyro, RATE_S) - update.bias.gyroscope()) @ self.body_R_vehicle
        data = np.array([sign * speed, sign * slope, *rate, sigma * pass_state.scale(self.name)])
        prior = np.array([self.config.scale_sigma, self.config.delay_sigma])
        wheel = update.use(SessionState("W", self.name, "wheel_scale_and_delay_s", np.zeros(2), prior))
        keys = (key("X", update.index), key("V", update.index), update.use(mount_state(self.vehicle)), wheel)
        update.blocks.append(FactorBatch(self.name, self.model, [keys], data[None], update.t_ns, loss=self.config.loss))

    def _unsigned(self, t_ns: int) -> bool:
        """Whether no reading that counts at a time is negative, as of a sensor without sign."""
        first = self._first_negative_ns
        return first is None or (self.causal and first > t_ns + round(HALF_LINE_S * NS))

    def _line(self, t_ns: int) -> tuple[float, float, float] | None:
        """Speed, slope and the sigma of the speed at one time; None where too few readings surround it."""
        half, stamps = round(HALF_LINE_S * NS), self.stream.t_ns
        near = slice(*np.searchsorted(stamps, [t_ns - half, t_ns + half + 1]))
        t = (stamps[near] - t_ns) / NS
        if len(t) < LEAST_ROWS or t[0] > 0 or t[-1] < 0:
            return None
        design = np.stack([np.ones(len(t)), t], axis=1)
        inverse = np.linalg.inv(design.T @ design)
        speed, slope = inverse @ design.T @ self.stream.speed[near]
        if self.stream.sigma is None:
            return speed, slope, self.default_sigma
        return speed, slope, float(np.sqrt(inverse[0, 0] * (self.stream.sigma[near] ** 2).mean()))


def build(context: FactorContext) -> WheelBuilder | None:
    """The builder of a session's wheel speeds; who has them has wheels."""
    stream, device = context.session.wheel, context.session.device
    if stream is None:
        return None
    noise = VEHICLE_CLASSES.get(context.vehicle, VEHICLE_CLASSES["car"])
    axes = frames.body_R_vehicle(device.forward, device.up)
    config, vehicle = context.options(WheelConfig), context.options(VehicleConfig)
    return WheelBuilder(stream, axes, noise.wheel_sigma, config, vehicle, context.causal)
