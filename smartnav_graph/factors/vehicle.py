"""A wheeled vehicle goes where it points: no sideways and no vertical velocity of the points that its wheels hold.

    lateral    v_y + w_z x - w_x z + slip  f_y v_x = 0        at the rear axle, on the road
    vertical   v_z + w_x y - w_y h + squat f_x v_x = 0        between the axles

v, w and f are velocity, angular rate and specific force of the body in the vehicle's own axes (forward, left, up):
those that the session declares, turned by a mount pitch and yaw. The state M is: that pitch and
yaw (rad), the place (x, y, z) of the rear axle on the road and the lever arm h to where road and body pitch meet (m),
and two compliances (rad per m/s^2): tyres slip sideways in proportion to the force they bear, a body squats when
pushed.

Source: Dissanayake et al. (2001), IEEE T-RA 17(5), on the constraint; Gillespie (1992), Fundamentals of Vehicle
Dynamics, ch. 6, on cornering compliance.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from smartnav_graph.core import frames
from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.errors import ConfigError
from smartnav_graph.core.so3 import rotate, skew
from smartnav_graph.core.timebase import NS, Gap
from smartnav_graph.factors.context import FactorContext
from smartnav_graph.factors.observation import AtKeyframe, Observed
from smartnav_graph.graph.pass_state import PassState
from smartnav_graph.graph.robust import check_loss
from smartnav_graph.graph.states import STATES, SessionState, State, key
from smartnav_graph.graph.update import Builder, FactorBatch, GraphUpdate
from smartnav_graph.graph.windows import PerWindow, Window
from smartnav_graph.session.calibration.model import VEHICLE_CLASSES, VehicleNoise
from smartnav_graph.session.detect.standstills import LOOKAHEAD_S, Standstills

MOUNT_SIZE = STATES["M"].dim
# Seconds before a keyframe over which the rate of the lever arms and the force on tyres and springs are taken: a mean,
# and the end of a straight line. A delayed force would correlate with the slide that it is part of.
RATE_S = 0.05
FORCE_S = 0.6
COMPLIANCE_SIGMA = 0.01  # rad per m/s^2, prior of the compliances


@dataclass(frozen=True)
class VehicleConfig:
    """enabled : use the constraint where a vehicle is declared; period_s : time between two rows at least (slip and
    springs are not white); mount_sigma_deg : prior of mount pitch and yaw beyond the declared axes; lever_sigma :
    prior of the lever arms, around zero, m; loss : loss of a row, ``none``, ``huber`` or ``cauchy``.
    """

    enabled: bool = True
    period_s: float = 1.0
    mount_sigma_deg: float = 10.0
    lever_sigma: float = 1.5
    loss: str = "huber"

    def __post_init__(self) -> None:
        if not min(self.period_s, self.mount_sigma_deg, self.lever_sigma) > 0:
            raise ConfigError("config [vehicle]", "a period or sigma <= 0", "> 0")
        check_loss("vehicle", self.loss)

    @property
    def prior_sigma(self) -> Floats:
        """Sigma (8,) of the state M."""
        turn, arm, soft = np.radians(self.mount_sigma_deg), self.lever_sigma, COMPLIANCE_SIGMA
        return np.array([turn, turn, arm, arm, arm, arm, soft, soft])


class Turned(NamedTuple):
    """Vectors (m, 3) in the vehicle's own axes and their derivatives (m, 3, 2) by mount pitch and yaw."""

    rows: Floats
    by_mount: Floats


@dataclass(frozen=True)
class VehicleAxes:
    """The vehicle's own axes: vehicle = (Rz(yaw) Ry(pitch))^T declared, for m rows of the state M.

    rotation (m, 3, 3), by (m, 2, 3, 3) its derivatives by pitch and yaw
    """

    rotation: Floats
    by: Floats

    @classmethod
    def of(cls, mount: Floats) -> VehicleAxes:
        """Axes and derivatives for pitch and yaw (m, 2 and more) of a mount, rad."""
        sp, cp, sy, cy = np.sin(mount[:, 0]), np.cos(mount[:, 0]), np.sin(mount[:, 1]), np.cos(mount[:, 1])
        o = np.zeros(len(mount))

        def matrices(*elements: Floats) -> Floats:
            return np.stack(elements, axis=-1).reshape(-1, 3, 3)

        rotation = matrices(cp * cy, cp * sy, -sp, -sy, cy, o, sp * cy, sp * sy, cp)
        by_pitch = matrices(-sp * cy, -sp * sy, -cp, o, o, o, cp * cy, cp * sy, -sp)
        by_yaw = matrices(-cp * sy, cp * cy, o, -cy, -sy, o, -sp * sy, sp * cy, o)
        return cls(rotation, np.stack([by_pitch, by_yaw], axis=1))

    def turn(self, declared: Floats) -> Turned:
        """Vectors (m, 3) given in declared vehicle axes."""
        return Turned(rotate(self.rotation, declared), np.einsum("nkij,nj->nik", self.by, declared))


@dataclass(frozen=True)
class DeclaredVelocity:
    """nav velocity seen in declared vehicle axes (m, 3), and its derivative (m, 3, 9) by the state."""

    rows: Floats
    by_state: Floats

    @classmethod
    def of(cls, R: Floats, v: Floats, body_R_vehicle: Floats) -> DeclaredVelocity:
        """Velocity in the declared axes, by attitudes R (m, 3, 3) and velocities v (m, 3) in nav; its derivatives."""
        nav_R_vehicle = R @ body_R_vehicle
        vehicle_R_nav = nav_R_vehicle.transpose(0, 2, 1)
        by_state = np.zeros((len(v), 3, 9))
        by_state[:, :, :3] = body_R_vehicle.T @ skew(rotate(R.transpose(0, 2, 1), v))
        by_state[:, :, 6:] = vehicle_R_nav
        return cls(rotate(vehicle_R_nav, v), by_state)


class NonHolonomic:
    """Data: angular rate (3) rad/s and specific force (3) m/s^2 in declared vehicle axes, sigma (2) m/s lateral and
    vertical. Residual (m, 2). in_gap : inside a data gap, with the error of both as state G."""

    width = 8

    def __init__(self, body_R_vehicle: Floats, *, in_gap: bool = False) -> None:
        self.body_R_vehicle = body_R_vehicle
        self.extra: tuple[str, ...] = ("M", "G") if in_gap else ("M",)

    def observe(self, R: Floats, p: Floats, v: Floats, extra: Sequence[Floats], data: Floats) -> Observed:
        mount, *gap_error = extra
        measured = data[:, :6].reshape(-1, 2, 3)
        for error in gap_error:
            measured = measured + error.reshape(-1, 2, 3)[:, ::-1] @ self.body_R_vehicle
        axes, declared = VehicleAxes.of(mount), DeclaredVelocity.of(R, v, self.body_R_vehicle)
        x, y, z, h, slip, squat = mount[:, 2:].T
        vel, rate, force = axes.turn(declared.rows), axes.turn(measured[:, 0]), axes.turn(measured[:, 1])
        (vx, vy, vz), (wx, wy, wz), (fx, fy, _) = vel.rows.T, rate.rows.T, force.rows.T
        residual = np.stack([vy + wz * x - wx * z + slip * fy * vx, vz + wx * y - wy * h + squat * fx * vx], axis=1)
        o, one = np.zeros(len(v)), np.ones(len(v))

        def two_rows(*elements: Floats) -> Floats:
            return np.stack(elements, axis=-1).reshape(len(v), 2, -1)

        by_velocity = two_rows(slip * fy, one, o, squat * fx, o, one)
        by_rate = two_rows(-z, o, x, y, -h, o)
        by_force = two_rows(o, slip * vx, o, squat * vx, o, o)
        by_axes = by_velocity @ vel.by_mount + by_rate @ rate.by_mount + by_force @ force.by_mount
        by_rest = two_rows(wz, o, -wx, o, fy * vx, o, o, wx, o, -wy, o, fx * vx)
        weight = 1.0 / data[:, 6:8, None]
        by_state = by_velocity @ axes.rotation @ declared.by_state
        by_mount = np.concatenate([by_axes, by_rest], axis=2)
        read = axes.rotation @ self.body_R_vehicle.T
        by_error = [np.concatenate([by_force @ read, by_rate @ read], axis=2) for _ in gap_error]
        return residual * weight[:, :, 0], by_state * weight, [by * weight for by in (by_mount, *by_error)]


def mount_state(config: VehicleConfig) -> SessionState:
    """The vehicle state, shared by all factors in the vehicle's own axes."""
    return SessionState("M", "vehicle", "vehicle_mount", np.zeros(MOUNT_SIZE), config.prior_sigma)


def recent(window: Window, values: Floats, seconds: float) -> Floats:
    """Mean (3,) of inertial intervals (m, 3) over the last `seconds` of the window."""
    before_end = np.cumsum(window.dt[::-1])[::-1]
    weight = np.where(before_end <= seconds + 1e-9, window.dt, 0.0)
    weight[-1] = window.dt[-1]
    return np.asarray(weight @ values / weight.sum())


def latest(window: Window, values: Floats, seconds: float) -> Floats:
    """Value (3,) at the window's end of inertial intervals (m, 3): a straight line through their means over the last
    `seconds`, or all of the window where it is shorter, and over half of that."""
    span = min(seconds, float(window.dt.sum()))
    whole, half = recent(window, values, span), recent(window, values, 0.5 * span)
    return np.asarray(half + (half - whole))


def _read_at_end(window: Window) -> tuple[Floats, Floats]:
    """Rate (3,) and specific force (3,) as read at the window's end."""
    return recent(window, window.gyro, RATE_S), latest(window, window.accel, FORCE_S)


def due(window: Window, period_s: float) -> bool:
    """Whether a border of the clock's periods lies in the window: at most one row a period, the same in every pass."""
    period = round(period_s * NS)
    return window.t1_ns // period != window.t0_ns // period


@dataclass
class VehicleBuilder(Builder):
    """Adds one row of the constraint a period, outside standstills, and in gaps where rate and force have a state.

    body_R_vehicle (3, 3) : declared axes; gaps : where rate and force were not recorded; rests : where zero velocity
    updates are used
    """

    body_R_vehicle: Floats
    noise: VehicleNoise
    gaps: Sequence[Gap] = ()
    rests: Standstills | None = None
    config: VehicleConfig = VehicleConfig()
    name: str = "vehicle"
    stage: int = 1
    lookahead_s: float = LOOKAHEAD_S
    _read: PerWindow[tuple[Floats, Floats]] = field(default_factory=PerWindow)

    def __post_init__(self) -> None:
        self.model = AtKeyframe(NonHolonomic(self.body_R_vehicle))
        self.model_in_gap = AtKeyframe(NonHolonomic(self.body_R_vehicle, in_gap=True))

    @property
    def noise_groups(self) -> Mapping[str, float]:
        return {"vehicle_lateral": self.noise.lateral_sigma, "vehicle_vertical": self.noise.vertical_sigma}

    def add(self, update: GraphUpdate, window: Window, previous: State | None, pass_state: PassState) -> None:
        """One row at the end of the window, where one is due."""
        if not len(window.dt) or not due(window, self.config.period_s) or self._silent(update):
            return
        rate, force = self._read.of(window, _read_at_end)
        rate, force = rate - update.bias.gyroscope(), force - update.bias.accelerometer()
        sigma = [known * pass_state.scale(group) for group, known in self.noise_groups.items()]
        data = np.concatenate([rate @ self.body_R_vehicle, force @ self.body_R_vehicle, sigma])
        keys = [key("X", update.index), key("V", update.index), update.use(mount_state(self.config))]
        in_gap = key("G", update.index) in update.chain
        model = self.model_in_gap if in_gap else self.model
        keys += [key("G", update.index)] * in_gap
        update.blocks.append(
            FactorBatch(self.name, model, [tuple(keys)], data[None], update.t_ns, loss=self.config.loss)
        )

    def _silent(self, update: GraphUpdate) -> bool:
        still = self.rests is not None and np.isfinite(self.rests.speed_at(update.t_ns))
        unknown = any(gap.start_ns < update.t_ns < gap.end_ns for gap in self.gaps)
        return bool(still) or (unknown and key("G", update.index) not in update.chain)


def build(context: FactorContext) -> VehicleBuilder | None:
    """The constraint of a declared vehicle on wheels."""
    noise, config = VEHICLE_CLASSES.get(context.vehicle), context.options(VehicleConfig)
    if noise is None or not config.enabled:
        return None
    device = context.session.device
    axes = frames.body_R_vehicle(device.forward, device.up)
    return VehicleBuilder(axes, noise, context.gaps, context.rests, config)
