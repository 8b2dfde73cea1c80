"""The first seconds of a session, as every aligner gets them, and the parts of a first state that they share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core import frames
from smartnav_graph.core.arrays import Floats, Times
from smartnav_graph.core.timebase import NS
from smartnav_graph.estimate.alignment.attitude import AttitudeStart
from smartnav_graph.estimate.alignment.initial_state import InitialiseConfig, InitialState, UserStart
from smartnav_graph.estimate.alignment.magnetic import FieldStart
from smartnav_graph.estimate.alignment.pedestrian import Walk
from smartnav_graph.estimate.alignment.static import LEAST_RATE_SIGMA, Rest, find_rest, rest_over
from smartnav_graph.estimate.alignment.visual import VisualStart
from smartnav_graph.factors.prior import PriorBuilder, PriorConfig
from smartnav_graph.graph.pass_state import PassState
from smartnav_graph.graph.states import State
from smartnav_graph.graph.windows import Window
from smartnav_graph.session.calibration.model import ImuNoise
from smartnav_graph.session.detect.stances import REST_SPEED
from smartnav_graph.session.streams import Imu, Magnetometer

# Tilt (rad) that levelling by the accelerometer may be off.
LEVELLED = 0.1
# Speed (m/s) of a start that is levelled in motion: unknown.
UNKNOWN_SPEED = 10.0
# Heading (rad) that iron nearby may turn a magnetometer by.
MAGNETIC_SIGMA = 0.35
# A heading (rad) with a larger sigma than this is unknown.
OPEN_SIGMA = 1.0


@dataclass(frozen=True)
class Fixes:
    """Absolute positions in time order.

    t_ns (m,); position (m, 3) nav m; available_ns (m,) : when each became known
    sources : sensor and row of each, by which it is rejected; None for one computed from several rows
    """

    t_ns: Times
    position: Floats
    available_ns: Times
    sources: Sequence[tuple[str, int] | None] = ()

    @classmethod
    def none(cls) -> Fixes:
        """No positions."""
        none = np.zeros(0, dtype=np.int64)
        return cls(none, np.zeros((0, 3)), none)

    @classmethod
    def sorted(cls, parts: Sequence[Fixes]) -> Fixes:
        """All positions of several parts."""
        t_ns, position, available_ns = (
            np.concatenate([getattr(part, name) for part in parts]) for name in ("t_ns", "position", "available_ns")
        )
        sources = [source for part in parts for source in (part.sources or [None] * len(part))]
        order = np.argsort(t_ns, kind="stable")
        return cls(t_ns[order], position[order], available_ns[order], [sources[i] for i in order])

    def __len__(self) -> int:
        return len(self.t_ns)


@dataclass(frozen=True)
class FirstStretch:
    """The first `count` windows of a session and what is known of them.

    fixes : absolute positions; fix_sigma : their typical sigma, m
    standstill : factors of their own hold a rest at the start; rest_end_ns : end of a standstill given for the start
    iron_sigma : hard iron (uT) that the magnetometer may still have; magnetic_stage : stage of its factors, None where
    they are not used; field_start, attitude_start, walk : alignments by magnetic field and gravity, by attitudes of
    pose fixes, by the steps of a pedestrian; visual : by images, where nothing else gives a start; user : given by the
    user
    pass_state : of the first pass
    """

    windows: Sequence[Window]
    imu: Imu
    fixes: Fixes
    gravity: float
    noise: ImuNoise
    forward: str
    config: InitialiseConfig
    up: str = "+z"
    fix_sigma: float = 1.0
    magnetometer: Magnetometer | None = None
    declination_deg: float = 0.0
    weak: PriorConfig = field(default_factory=PriorConfig)
    standstill: bool = False
    rest_end_ns: int | None = None
    iron_sigma: float = 0.0
    magnetic_stage: int | None = None
    field_start: FieldStart | None = None
    attitude_start: AttitudeStart | None = None
    walk: Walk | None = None
    visual: VisualStart | None = None
    user: UserStart | None = None
    pass_state: PassState = field(default_factory=PassState)
    count: int = 0

    # --- extent ---

    def until(self, stretch_s: float) -> FirstStretch:
        """The windows up to `stretch_s` after the first fix."""
        begin = max(int(self.fixes.available_ns.min()), self.start_ns)
        ends = np.array([w.t1_ns for w in self.windows])
        return replace(self, count=int(np.searchsorted(ends, begin + int(stretch_s * NS), side="right")))

    @property
    def start_ns(self) -> int:
        """Time of the first keyframe."""
        return self.windows[0].t1_ns

    @property
    def ends_ns(self) -> Times:
        """Ends (count,) of the windows."""
        return np.array([w.t1_ns for w in self.windows[: self.count]], dtype=np.int64)

    @property
    def length_s(self) -> float:
        """From the first keyframe to the last of the stretch."""
        return (self.windows[self.count - 1].t1_ns - self.start_ns) / NS

    @property
    def known(self) -> NDArray[np.intp]:
        """The fixes (k,) of the stretch that were known by its end."""
        now = self.windows[self.count - 1].t1_ns
        return np.flatnonzero((self.fixes.t_ns <= now) & (self.fixes.available_ns <= now))

    # --- what it shows ---

    @cached_property
    def rest(self) -> Rest | None:
        """The rest at the start."""
        rest = find_rest(self.imu, self.start_ns, self.gravity, self.config.rest_s)
        if rest is None and self.rest_end_ns is not None:
            rest = rest_over(self.imu, self.start_ns, self.rest_end_ns, self.gravity)
        return None if rest is None or self._moving(rest.length_s) else rest

    def _moving(self, length_s: float) -> bool:
        """Whether the fixes contradict a rest: a line through them with a significant slope, at walking speed."""
        t, p = self.fixes.t_ns, self.fixes.position
        chosen = (t >= self.start_ns) & (t <= self.start_ns + int((length_s + 2.0) * NS))
        if chosen.sum() < 2:
            return False
        x = (t[chosen] - t[chosen].mean()) / NS
        spread = float(np.sqrt((x**2).sum()))
        speed = float(np.linalg.norm(x @ p[chosen][:, :2]) / spread**2) if spread > 0 else 0.0
        return speed > 0.5 and speed > 3.0 * self.fix_sigma / spread

    @cached_property
    def body_up(self) -> Floats:
        """Body direction (3,) that points up: mean specific force of the rest, or of the first two seconds."""
        if self.rest is not None:
            return self.rest.accel
        first = int(np.searchsorted(self.imu.t_ns, self.start_ns))
        last = int(np.searchsorted(self.imu.t_ns, self.start_ns + 2 * NS))
        return np.asarray(self.imu.accel[first : max(last, first + 1)].mean(axis=0))

    @cached_property
    def magnetic_heading(self) -> tuple[float, float] | None:
        """Heading of the forward axis and its sigma, deg: by field and gravity of the first seconds, else by the mean
        field over the rest. None without a magnetometer, or where its reading may be its own iron."""
        if self.field_start is not None:
            return self.heading_deg(self.field_start.nav_R_body), float(np.degrees(self.field_start.heading_sigma))
        if self.magnetometer is None or self.rest is None:
            return None
        t_ns = self.magnetometer.t_ns
        chosen = (t_ns >= self.start_ns) & (t_ns <= self.start_ns + int(self.rest.length_s * NS))
        if not chosen.any():
            return None
        mean = self.magnetometer.field_ut[chosen].mean(axis=0)
        level = self.nav_R_body(0.0) @ mean
        sigma = float(np.hypot(MAGNETIC_SIGMA, self.iron_sigma / np.hypot(level[0], level[1])))
        heading = np.degrees(-np.arctan2(level[0], level[1])) + self.declination_deg
        return (float(heading) % 360.0, float(np.degrees(sigma))) if sigma < OPEN_SIGMA else None

    @cached_property
    def first_motion(self) -> tuple[Floats, Floats]:
        """Position and velocity (3,) at the start by the first two fixes; no velocity at rest."""
        t_ns, fixes = self.fixes.t_ns[self.known], self.fixes.position[self.known]
        t = (t_ns - self.start_ns) / NS
        later = np.flatnonzero(t > t[0])  # two sensors may share the first epoch
        if not len(later) or self.rest is not None:
            return fixes[0], np.zeros(3)
        velocity = (fixes[later[0]] - fixes[0]) / (t[later[0]] - t[0])
        return fixes[0] - velocity * t[0], velocity

    # --- parts of a first state ---

    def heading_deg(self, nav_R_body: Floats) -> float:
        """Heading of the forward axis."""
        return float(frames.heading_pitch_roll_deg(nav_R_body, self.forward, self.up)[0, 0])

    def nav_R_body(self, heading_deg: float) -> Floats:
        """Attitude (3, 3) levelled by the accelerometer."""
        return frames.nav_R_body_from_heading(heading_deg, self.body_up, self.forward)

    def state(self, R: Floats, p: Floats, v: Floats, gyro_bias: Floats | None = None) -> State:
        """First state; the gyro bias is that of the rest where there is one."""
        gyro = self.rest.gyro if self.rest is not None else np.zeros(3) if gyro_bias is None else gyro_bias
        return State.of(0, self.start_ns, (R, p, v), np.append(np.zeros(3), gyro))

    def prior(self, state: State, **sigmas: Any) -> PriorBuilder:
        """The weak prior on the initial state; `sigmas` replaces parts of it."""
        noise, rest = self.noise, self.rest
        bias = np.array([noise.accel_bias_sigma] * 3 + [noise.gyro_bias_sigma] * 3)
        mean = gtsam.imuBias.ConstantBias() if rest is None else gtsam.imuBias.ConstantBias(np.zeros(3), rest.gyro)
        velocity, rest_end_ns = np.full(3, self.weak.speed_sigma), None
        if rest is not None and not self.standstill:
            bias[3:] = max(rest.gyro_sigma, LEAST_RATE_SIGMA)
            velocity, rest_end_ns = np.full(3, REST_SPEED), self.start_ns + int(rest.length_s * NS)
        prior = PriorBuilder(
            start=state,
            sigma_rot=np.full(3, self.weak.angle_sigma),
            sigma_pos=None,
            sigma_vel=velocity,
            sigma_bias=bias,
            velocity_mean=np.zeros(3),
            bias_mean=mean,
            rest_end_ns=rest_end_ns,
        )
        if rest is not None and self.magnetic_heading is not None:
            heading, sigma = self.magnetic_heading
            soft = np.array([self.weak.angle_sigma, self.weak.angle_sigma, np.radians(sigma)])
            attitude = gtsam.Rot3(self.nav_R_body(heading))
            prior = replace(prior, attitude=attitude, sigma_rot=soft, magnetic_stage=self.magnetic_stage)
        return replace(prior, **sigmas)

    def levelled_prior(self, heading_deg: float, p: Floats, sigma_m: float, sigma_deg: float) -> PriorBuilder:
        """A prior that holds the start: levelled by the accelerometer, position and heading of the user."""
        return self.prior(
            self.state(self.nav_R_body(heading_deg), p, np.zeros(3)),
            attitude=None,
            sigma_rot=np.array([LEVELLED, LEVELLED, np.radians(sigma_deg)]),
            sigma_pos=np.full(3, sigma_m),
            **({} if self.rest is not None else {"sigma_vel": np.full(3, UNKNOWN_SPEED)}),
        )


@dataclass(frozen=True)
class Candidate:
    """A possible first state.

    final : the initial state, where nothing is to be refined
    values : initial values of so many keyframes, of at most `count`, where the trajectory after it is known roughly
    """

    state: State
    final: InitialState | None = None
    values: Callable[[int], gtsam.Values] | None = None
    count: int = 0
