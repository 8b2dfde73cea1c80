"""First windows -> first state, without being told anything.

Given: the user's position and heading. Static: a rest at the start gives the vertical and the gyro bias, the first
fixes or a magnetometer the heading. Dynamic: the integrated specific force, seen from the first body frame, must lie
on the curve of the fixes once position, velocity and gravity are taken out; the rotation between the two curves is
the first attitude (Wahba's problem, Kabsch 1976), refined by the factor graph of the first windows. Where the data
leave the heading open, the refinement is started from headings all round and the cheapest solution is taken.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core import frames
from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.errors import SolverError
from smartnav_graph.core.timebase import NS
from smartnav_graph.estimate.alignment.attitude import AttitudeStart
from smartnav_graph.estimate.alignment.in_motion import Alignment, Known, starts_agreed
from smartnav_graph.estimate.alignment.initial_state import InitialiseConfig, InitialState, UserStart
from smartnav_graph.estimate.alignment.magnetic import FieldStart
from smartnav_graph.estimate.alignment.pedestrian import Walk
from smartnav_graph.estimate.alignment.static import (
    LEAST_RATE_SIGMA,
    Rest,
    find_rest,
    inertial_curve,
    kabsch_attitude,
    rest_over,
)
from smartnav_graph.factors.prior import REST_SPEED, PriorBuilder, PriorConfig
from smartnav_graph.graph.pass_state import PassState, Phase
from smartnav_graph.graph.states import State
from smartnav_graph.graph.windows import Window
from smartnav_graph.session.calibration.model import ImuNoise
from smartnav_graph.session.streams import Imu, Magnetometer
from smartnav_graph.smoothers.estimate import Estimate

# Cost a keyframe above which a fit of the first stretch is bad (a good one has 1.5), and what a rejected fix costs:
# a start must not look good because it rejects what contradicts it.
GOOD_COST = 2.5
REJECTION_COST = 10.0
# Share of the keyframes whose fixes a good start may reject beyond those that disagreed with it before.
MORE_REJECTED = 0.05
# Tilt (rad) that levelling by the accelerometer may be off.
LEVELLED = 0.1
# Heading (rad) that iron nearby may turn a magnetometer by.
MAGNETIC_SIGMA = 0.35
# A heading (rad) less sure than this is open.
OPEN_SIGMA = 1.0
GOOD_HEADING_DEG = 10.0  # a heading this sure is known
KABSCH_S = (12.0, np.inf)


# Solves the first windows (so many) from a prior, a memory and values if there are any: the loop of estimate.py.
Solve = Callable[[PriorBuilder, int, PassState, Any], tuple[Estimate, PassState]]


def _rejections(pass_state: PassState) -> int:
    return sum(len(rows) for rows in pass_state.rejected.values())


@dataclass(frozen=True)
class Initialiser:
    """Everything `run` needs.

    fixes : absolute positions as (t_ns (m,), nav_p (m, 3)), in time order; fix_sigma : their typical sigma, m
    sources : sensor and row of each fix; arrival_ns (m,) : when each became known, where that is later
    standstill : factors of their own say that a rest at the start does not move and does not turn
    iron_sigma : hard iron (uT) that the magnetometer may still hold; magnetic_stage : from which its factor speaks;
    field_start : where north is by the first seconds, where they tell; attitude_start : the attitude that fixes bring;
    walk : a walker's way at first sight; rest_end_ns : end of a standstill at the start that others told of
    """

    windows: Sequence[Window]
    imu: Imu
    fixes: tuple[NDArray[np.int64], Floats]
    fix_sigma: float
    gravity: float
    noise: ImuNoise
    forward: str
    magnetometer: Magnetometer | None
    declination_deg: float
    config: InitialiseConfig
    weak: PriorConfig = field(default_factory=PriorConfig)
    standstill: bool = False
    iron_sigma: float = 0.0
    magnetic_stage: int | None = None
    field_start: FieldStart | None = None
    attitude_start: AttitudeStart | None = None
    walk: Walk | None = None
    rest_end_ns: int | None = None
    sources: Sequence[tuple[str, int]] = ()
    arrival_ns: NDArray[np.int64] | None = None

    def run(self, solve: Solve, given: UserStart | None) -> InitialState:
        """The first state.

        Raises
        ------
        SolverError
            No absolute sensor, no given start and no rest: nothing to begin from.
        """
        start_ns = self.windows[0].t1_ns
        rest = find_rest(self.imu, start_ns, self.gravity, self.config.rest_s)
        if rest is None and self.rest_end_ns is not None:
            rest = rest_over(self.imu, start_ns, self.rest_end_ns, self.gravity)
        if rest is not None and self._moving(start_ns, rest.length_s):
            rest = None
        if given is not None:
            return self._from_given(given, rest)
        if len(self.fixes[0]) == 0:
            if rest is None:
                raise SolverError(
                    "initialisation",
                    "no absolute sensor (no position fix, no control point) and no rest at the start",
                    "position fixes, control points, or a device at rest for a second",
                    'add a gnss or control stream, or give --initial "e,n,u,heading_deg"',
                )
            return self._dead_reckoning(rest)
        return self._walked(solve, rest) or self._search(solve, rest)

    def _walked(self, solve: Solve, rest: Rest | None) -> InitialState | None:
        """The start of a walker's way, where the fixes and the inertial data agree with it."""
        if self.walk is None:
            return None
        count = min(self._count(self.config.max_stretch_s), len(self.walk.windows))
        found, fits = self._attempt(solve, self.walk.state(), PassState(), rest, count, self.walk.values(count))
        if not fits:
            return None
        sentence = found[0][1].sentence.replace("from the fixes", "from the steps, the fixes")
        whole = self.walk.values() if len(self.walk.windows) == len(self.windows) else None
        return replace(found[0][1], sentence=sentence, initial_values=whole)

    def _moving(self, start_ns: int, length_s: float) -> bool:
        """Whether the fixes contradict a rest: a line through them with a significant slope, and the slope a walk."""
        t, p = self.fixes
        chosen = (t >= start_ns) & (t <= start_ns + int((length_s + 2.0) * NS))
        if chosen.sum() < 2:
            return False
        x = (t[chosen] - t[chosen].mean()) / NS
        spread = float(np.sqrt((x**2).sum()))
        speed = float(np.linalg.norm(x @ p[chosen][:, :2]) / spread**2) if spread > 0 else 0.0
        return speed > 0.5 and speed > 3.0 * self.fix_sigma / spread

    def _level(self, rest: Rest | None) -> Floats:
        """Body direction (3,) that points up: mean specific force of the rest, or of the first two seconds."""
        if rest is not None:
            return rest.accel
        first = int(np.searchsorted(self.imu.t_ns, self.windows[0].t1_ns))
        last = int(np.searchsorted(self.imu.t_ns, self.windows[0].t1_ns + 2 * NS))
        return np.asarray(self.imu.accel[first : max(last, first + 1)].mean(axis=0))

    def _magnetic_heading(self, rest: Rest | None) -> tuple[float, float] | None:
        """Heading of the forward axis and its sigma, deg: by field and gravity of the first seconds, else by the mean
        field over the rest. None without a magnetometer, or where what it reads may be its own iron."""
        if self.field_start is not None:
            heading = frames.heading_pitch_roll_deg(self.field_start.nav_R_body, self.forward)[0, 0]
            return float(heading), float(np.degrees(self.field_start.heading_sigma))
        if self.magnetometer is None or rest is None:
            return None
        start = self.windows[0].t1_ns
        chosen = (self.magnetometer.t_ns >= start) & (self.magnetometer.t_ns <= start + int(rest.length_s * NS))
        if not chosen.any():
            return None
        mean = self.magnetometer.field_ut[chosen].mean(axis=0)
        level = frames.nav_R_body_from_heading(0.0, rest.accel, self.forward) @ mean
        sigma = float(np.hypot(MAGNETIC_SIGMA, self.iron_sigma / np.hypot(level[0], level[1])))
        heading = np.degrees(-np.arctan2(level[0], level[1])) + self.declination_deg
        return (float(heading) % 360.0, float(np.degrees(sigma))) if sigma < OPEN_SIGMA else None

    def _prior(self, state: State, rest: Rest | None, **sigmas: Any) -> PriorBuilder:
        noise = self.noise
        bias = np.array([noise.accel_bias_sigma] * 3 + [noise.gyro_bias_sigma] * 3)
        mean = gtsam.imuBias.ConstantBias()
        velocity = np.full(3, self.weak.speed_sigma)
        if rest is not None:
            mean = gtsam.imuBias.ConstantBias(np.zeros(3), rest.gyro)
        held = rest is not None and not self.standstill
        if rest is not None and held:
            bias[3:] = max(rest.gyro_sigma, LEAST_RATE_SIGMA)
            velocity = np.full(3, REST_SPEED)
        prior = PriorBuilder(
            start=state,
            sigma_rot=np.full(3, self.weak.angle_sigma),
            sigma_pos=None,
            sigma_vel=velocity,
            sigma_bias=bias,
            velocity_mean=np.zeros(3),
            bias_mean=mean,
            rest_end_ns=self.windows[0].t1_ns + int(rest.length_s * NS) if rest is not None and held else None,
        )
        magnetic = self._magnetic_heading(rest)
        if rest is not None and magnetic is not None:
            attitude = frames.nav_R_body_from_heading(magnetic[0], rest.accel, self.forward)
            soft = np.array([self.weak.angle_sigma, self.weak.angle_sigma, np.radians(magnetic[1])])
            prior = replace(prior, attitude=gtsam.Rot3(attitude), sigma_rot=soft, magnetic_stage=self.magnetic_stage)
        return replace(prior, **sigmas)

    def _state(self, R: Floats, p: Floats, v: Floats, rest: Rest | None, gyro_bias: Floats | None = None) -> State:
        gyro = rest.gyro if rest is not None else np.zeros(3) if gyro_bias is None else gyro_bias
        return State.of(0, self.windows[0].t1_ns, (R, p, v), np.append(np.zeros(3), gyro))

    def _levelled(
        self, heading_deg: float, p: Floats, sigma_m: float, sigma_deg: float, rest: Rest | None
    ) -> PriorBuilder:
        """A held start: levelled by the accelerometer, position and heading as told."""
        up = self._level(rest)
        R = frames.nav_R_body_from_heading(heading_deg, up, self.forward)
        return self._prior(
            self._state(R, p, np.zeros(3), rest),
            rest,
            attitude=None,
            sigma_rot=np.array([LEVELLED, LEVELLED, np.radians(sigma_deg)]),
            sigma_pos=np.full(3, sigma_m),
            **({} if rest is not None else {"sigma_vel": np.full(3, 10.0)}),
        )

    def _from_given(self, given: UserStart, rest: Rest | None) -> InitialState:
        prior = self._levelled(given.heading_deg, np.array(given.position), given.sigma_m, given.sigma_deg, rest)
        how, stretch = "levelled over a rest" if rest is not None else "levelled by the first two seconds", 0.0
        magnetic = self.field_start
        if magnetic is not None and np.radians(given.sigma_deg) > OPEN_SIGMA:
            position = prior.start.nav.position()
            state = self._state(magnetic.nav_R_body, position, np.zeros(3), rest, magnetic.gyro_bias)
            sigma = np.array([*prior.sigma_rot[:2], magnetic.heading_sigma])
            prior = replace(prior, start=state, sigma_rot=sigma, magnetic_stage=self.magnetic_stage)
            how, stretch = f"{how}; turned to magnetic north", magnetic.length_s
        sentence = (
            f"Start given: heading {given.heading_deg:.1f} deg +- {given.sigma_deg:g} deg, position +- "
            f"{given.sigma_m:g} m; {how}."
        )
        return InitialState(prior, "given", sentence, given.heading_deg, given.sigma_deg, stretch, 1, PassState())

    def _dead_reckoning(self, rest: Rest) -> InitialState:
        magnetic = self._magnetic_heading(rest)
        heading, sigma = magnetic if magnetic is not None else (0.0, 1e-3)
        prior = self._levelled(heading, np.zeros(3), 1e-3, sigma, rest)
        prior = replace(prior, magnetic_stage=None if magnetic is None else self.magnetic_stage)
        told = (
            f"heading {heading:.1f} deg from the magnetometer"
            if magnetic is not None
            else "heading and position set to zero (local frame)"
        )
        sentence = f"No absolute sensor: started from a rest of {rest.length_s:.1f} s; {told}."
        stretch = max(rest.length_s, self.field_start.length_s if self.field_start is not None else 0.0)
        return InitialState(prior, "static", sentence, heading, sigma, stretch, 1, PassState())

    def _search(self, solve: Solve, rest: Rest | None) -> InitialState:
        """Refine the start on which most fixes of the first stretch agree; others where it fits badly; a longer stretch
        while the heading stays open."""
        stretch, tried = self.config.stretch_s, 0
        before: list[State] = []
        while True:
            count = self._count(stretch)
            last = stretch >= self.config.max_stretch_s or count >= len(self.windows)
            results: list[tuple[float, InitialState]] = []
            for state, pass_state in self._candidates(count, rest, before):
                tried += 1
                found, fits = self._attempt(solve, state, pass_state, rest, count)
                results += found
                if fits and (last <= self._sure(found[0][1])):
                    break
            if results:
                best = min(results, key=lambda item: item[0])[1]
                if last or self._sure(best):
                    return replace(best, starts=tried)
                before = [best.prior.start]
            elif last:
                raise SolverError(
                    "initialisation",
                    f"no start converges on the first {count} keyframes",
                    "inertial data and fixes of the same motion",
                    'check units, axes and clocks with `smartnav info`, or give --initial "e,n,u,heading_deg"',
                )
            stretch *= 2.0

    def _sure(self, initial: InitialState) -> bool:
        return initial.sigma_heading_deg < GOOD_HEADING_DEG

    def _attempt(
        self,
        solve: Solve,
        state: State,
        pass_state: PassState,
        rest: Rest | None,
        count: int,
        initial_values: Any = None,
    ) -> tuple[list[tuple[float, InitialState]], bool]:
        """Cost and start refined from `state`, nothing where it does not converge; whether the kept fixes fit, and
        hardly any was rejected that did not disagree before."""
        outside = _rejections(pass_state)
        try:
            estimate, learnt = solve(self._prior(state, rest), count, pass_state, initial_values)
        except SolverError:
            return [], False
        rejected = _rejections(learnt)
        fits = estimate.cost < GOOD_COST * count and rejected <= outside + max(1.0, MORE_REJECTED * count)
        return [(estimate.cost + REJECTION_COST * rejected, self._found(estimate, learnt, rest, count))], fits

    def _count(self, stretch_s: float) -> int:
        """Windows up to `stretch_s` after the first fix."""
        begin = max(int(self._arrival().min()), self.windows[0].t1_ns)
        ends = np.array([w.t1_ns for w in self.windows])
        return int(np.searchsorted(ends, begin + int(stretch_s * NS), side="right"))

    def _known(self, now_ns: int) -> NDArray[np.bool_]:
        """Mask of the fixes that speak of, and were known by, this time."""
        return np.asarray((self.fixes[0] <= now_ns) & (self._arrival() <= now_ns))

    def _arrival(self) -> NDArray[np.int64]:
        return self.fixes[0] if self.arrival_ns is None else self.arrival_ns

    def _candidates(self, count: int, rest: Rest | None, before: Sequence[State]) -> list[tuple[State, PassState]]:
        """First states to try, those that most fixes agree on first, with the rows that do not."""
        windows = self.windows[:count]
        ends = np.array([w.t1_ns for w in windows])
        used = self._known(int(ends[-1]))
        t_ns, fixes = self.fixes[0][used], self.fixes[1][used]
        mean, sigma = np.zeros(6), np.array([self.noise.accel_bias_sigma] * 3 + [self.noise.gyro_bias_sigma] * 3)
        if rest is not None:
            mean[3:], sigma[3:] = rest.gyro, max(rest.gyro_sigma, LEAST_RATE_SIGMA)
        known = Known(mean, sigma, self.noise, self.gravity, self.fix_sigma)
        states = [*before, *self._starts(count, rest)]
        starts = [(s.nav.attitude().matrix(), s.nav.position(), s.nav.velocity()) for s in states]
        bias = states[0].bias.vector() if before or self.field_start is not None else None
        chosen = starts_agreed(windows, t_ns, fixes, starts, known, bias)[: self.config.starts]
        begin = self.windows[0].t1_ns
        return [
            (State.of(0, begin, (a.R, a.p, a.v), a.found[:6]), self._memory_of(a, np.flatnonzero(used))) for a in chosen
        ]

    def _memory_of(self, align_in_motion: Alignment, used: NDArray[np.intp]) -> PassState:
        """The rows that disagree as rejected; none where the start explains less than half of them."""
        outside = used[align_in_motion.outside]
        if not len(outside) or 2 * len(outside) > len(used) or not self.sources:
            return PassState()
        rejected: dict[str, set[int]] = {}
        for name, row in (self.sources[i] for i in outside):
            rejected.setdefault(name, set()).add(row)
        return PassState(phase=Phase.GATED, rejected={name: frozenset(rows) for name, rows in rejected.items()})

    def _starts(self, count: int, rest: Rest | None) -> list[State]:
        """First states to try: the inertial curve laid on the fixes, then headings all round."""
        windows = self.windows[:count]
        magnetic = self._magnetic_heading(rest)
        t_ns, fixes = self.fixes
        used = self._known(windows[-1].t1_ns)
        t_ns, fixes = t_ns[used], fixes[used]
        bias = gtsam.imuBias.ConstantBias() if rest is None else gtsam.imuBias.ConstantBias(np.zeros(3), rest.gyro)
        ends = np.array([w.t1_ns for w in windows])
        t = (t_ns - ends[0]) / NS
        starts: list[State] = []
        p0, v0 = fixes[0], np.zeros(3)
        up = self._level(rest)
        later = np.flatnonzero(t > t[0])  # two sensors may share the first epoch
        if len(later) and rest is None:
            v0 = (fixes[later[0]] - fixes[0]) / (t[later[0]] - t[0])
            p0 = fixes[0] - v0 * t[0]
        curve = inertial_curve(windows, bias)[np.minimum(np.searchsorted(ends, t_ns), count - 1)]
        for length in KABSCH_S:  # the shorter curve suffers less from an unknown gyro bias, the longer from noise
            near = t <= t[0] + length
            if near.sum() >= 4 and not (starts and near.all()):
                R, p, v = kabsch_attitude(curve[near], fixes[near], t[near], self.gravity)
                starts.append(self._state(R, p, v, rest))
        if self.field_start is not None:
            starts.insert(0, self._state(self.field_start.nav_R_body, p0, v0, rest, self.field_start.gyro_bias))
        elif magnetic is not None:
            starts.insert(0, self._state(frames.nav_R_body_from_heading(magnetic[0], up, self.forward), p0, v0, rest))
        if self.attitude_start is not None:
            oriented = self.attitude_start
            starts.insert(0, self._state(oriented.nav_R_body, p0, v0, rest, oriented.gyro_bias))
        course = np.degrees(np.arctan2(v0[0], v0[1])) if np.linalg.norm(v0[:2]) > 1.0 else 0.0
        for heading in course + np.arange(self.config.starts) * 360.0 / self.config.starts:
            R = frames.nav_R_body_from_heading(float(heading), up, self.forward)
            starts.append(self._state(R, p0, v0, rest))
        return starts

    def _found(self, estimate: Estimate, pass_state: PassState, rest: Rest | None, count: int) -> InitialState:
        """The refined start: its values, under the weak prior (the fixes are used again by the smoother)."""
        R, p, v, bias = (rows[0] for rows in estimate.states())
        state = State.of(0, self.windows[0].t1_ns, (R, p, v), bias)
        heading = float(frames.heading_pitch_roll_deg(R, self.forward)[0, 0])
        sigma = float(np.degrees(np.sqrt(estimate.covariance[0, 2, 2])))
        stretch = (self.windows[count - 1].t1_ns - self.windows[0].t1_ns) / NS
        method = "static" if rest is not None else "dynamic"
        magnetic = self._magnetic_heading(rest) is not None
        source = "the magnetometer and the fixes" if magnetic else "the fixes and the inertial data"
        vertical = (
            f"vertical and gyro bias from a rest of {rest.length_s:.1f} s"
            if rest is not None
            else "no rest at the start"
        )
        sentence = (
            f"Heading {heading:.1f} deg +- {min(sigma, 180.0):.1f} deg found from {source} of the first "
            f"{stretch:.0f} s; {vertical}."
        )
        if _rejections(pass_state):
            pass_state = replace(pass_state, phase=Phase.ROBUST)  # there will be more of them
        return InitialState(
            self._prior(state, rest), method, sentence, heading, min(sigma, 180.0), stretch, 1, pass_state
        )
