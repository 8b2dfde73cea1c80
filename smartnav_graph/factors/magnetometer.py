"""Magnetometer: the Earth's field seen from the body, with hard iron and strength of the field as states.

    r = (nav_R_body^T b(F) + A h - y) / sigma        b(F) = (F_h sin d, F_h cos d, F_v)        d declination

y is the mean of the corrected samples of a window, each turned by the gyro to the window's end, and A the same mean of
what turns the hard iron h (uT, body axes): a rotation separates h from the field. F holds the horizontal and
the vertical strength (uT). Where origin and date are known F is that of the World Magnetic Model; where not, all fields
on Earth are possible, and the magnetometer still gives north, up to the iron nearby.

The residual is linear in h and F, so their first values do not matter. What iron nearby adds stays alike for a while:
a row counts as much as that many independent ones.

Source: Gebre-Egziabher et al. (2006), Calibration of strapdown magnetometers in magnetic field domain, J. Aerosp. Eng.
19(2), on hard and soft iron; Afzal, Renaudin, Lachapelle (2011), Use of Earth's magnetic field for mitigating gyroscope
errors, Sensors 11(12), on disturbances seen by intensity and dip.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.errors import ConfigError
from smartnav_graph.core.so3 import exp, rotate, skew
from smartnav_graph.core.timebase import NS
from smartnav_graph.factors.context import FactorContext
from smartnav_graph.factors.observation import AtKeyframe, Observed
from smartnav_graph.graph.pass_state import LAST_STAGE, PassState, PerPass
from smartnav_graph.graph.robust import check_loss
from smartnav_graph.graph.states import SessionState, State, key
from smartnav_graph.graph.update import Builder, FactorBatch, GraphUpdate
from smartnav_graph.graph.windows import PerWindow, Window
from smartnav_graph.session.calibration.model import MagnetometerNoise
from smartnav_graph.session.streams import Magnetometer

# Names of the states.
IRON, STRENGTH = "magnetometer_hard_iron_ut", "magnetometer_field_ut"
# Horizontal and vertical strength (uT, mean and sigma) of the field anywhere on Earth, for sessions without origin.
SOMEWHERE = (np.array([25.0, 0.0]), np.array([12.0, 45.0]))
# Local anomalies of the crust and of buildings beside the model's field, uT.
MODEL_SIGMA_UT = 2.0
# Intensities (uT) that a reading without large hard iron can have: the Earth's field, give or take iron nearby.
EARTHLY_UT = (20.0, 70.0)
# Cauchy's constant that keeps 95 % efficiency on Gaussian residuals (Holland, Welsch 1977), for rows of three.
LOSS_SCALE = 2.385 * float(np.sqrt(3.0))
# More samples than this in a window add no information.
MOST_SAMPLES = 25
# A fixed hard iron with a larger sigma (uT) leaves no usable direction.
SURE_IRON_UT = 5.0
# Tilt (rad) error of a prediction where it is used for dip.
TILT = 0.05


@dataclass(frozen=True)
class MagnetometerConfig:
    """enabled : use the magnetometer; loss : loss of a row, ``none``, ``huber`` or ``cauchy``; gate_sigmas : where
    intensity or dip is further off than this, against field and hard iron as far as they are known, the row is not
    used.
    """

    enabled: bool = True
    loss: str = "cauchy"
    gate_sigmas: float = 4.0

    def __post_init__(self) -> None:
        check_loss("magnetometer", self.loss)
        if not self.gate_sigmas > 0:
            raise ConfigError("config [magnetometer]", f"gate_sigmas = {self.gate_sigmas}", "> 0")


class SeenField:
    """Data: mean corrected reading y (3) uT, A (9) row-major, (sin, cos) of the declination (2), sigma (1) uT."""

    extra: tuple[str, ...] = ("H", "F")
    width = 15

    def observe(self, R: Floats, p: Floats, v: Floats, extra: Sequence[Floats], data: Floats) -> Observed:
        iron, strength = extra
        y, A, north, weight = data[:, :3], data[:, 3:12].reshape(-1, 3, 3), data[:, 12:14], 1.0 / data[:, 14:15]
        body_R_nav = R.transpose(0, 2, 1)
        unit = np.zeros((len(R), 3, 2))
        unit[:, :2, 0], unit[:, 2, 1] = north, 1.0
        by_strength = body_R_nav @ unit
        seen = rotate(by_strength, strength)
        by_state = np.zeros((len(R), 3, 9))
        by_state[:, :, :3] = skew(seen)
        w = weight[:, :, None]
        return (seen + rotate(A, iron) - y) * weight, by_state * w, [A * w, by_strength * w]


MODEL = AtKeyframe(SeenField())


class TurnedSamples(NamedTuple):
    """Samples (m, 3) of a window in body axes, to be seen from its end; step_s (m,) and angle (m, 3) rad, time to the
    next one, or the window's end, and integral of the rate as read until then."""

    samples: Floats
    step_s: Floats
    angle: Floats

    @classmethod
    def of(cls, window: Window, t_ns: NDArray[np.int64], samples: Floats) -> TurnedSamples:
        """t_ns (m,) in [t0, t1], samples (m, 3)."""
        border = np.concatenate([[0.0], np.cumsum(window.dt)])
        angle = np.concatenate([np.zeros((1, 3)), np.cumsum(window.gyro * window.dt[:, None], axis=0)])
        at = np.minimum(np.append((t_ns - window.t0_ns) / NS, border[-1]), border[-1])
        interval = np.minimum(np.searchsorted(border, at, side="right"), len(window.dt)) - 1
        reached = angle[interval] + (at - border[interval])[:, None] * window.gyro[interval]
        return cls(samples, at[1:] - at[:-1], reached[1:] - reached[:-1])

    def mean(self, gyro_bias: Floats) -> tuple[Floats, Floats]:
        """Mean (3,) of the samples in the axes of the window's end, and the mean turn (3, 3) from their axes to these;
        gyro_bias (3,) rad/s."""
        turns = exp(self.angle - self.step_s[:, None] * gyro_bias).transpose(0, 2, 1)
        count, m = 1, len(turns)
        while count < m:  # each holds the product of `count` steps
            turns[: m - count] = turns[count:] @ turns[: m - count]
            count *= 2
        return rotate(turns, self.samples).sum(axis=0) / m, turns.sum(axis=0) / m


@dataclass
class MagnetometerBuilder(Builder):
    """Adds one row a window: the mean of its samples.

    reading (n, 3) uT as recorded, t_ns (n,); field_ut (2,) horizontal and vertical strength with field_sigma (2,);
    declination rad; iron_sigma uT; held_in_replay : the smoother of a replay keeps session states at their first values
    """

    t_ns: NDArray[np.int64]
    reading: Floats
    field_ut: Floats
    field_sigma: Floats
    declination: float
    iron_sigma: float
    noise: MagnetometerNoise = field(default_factory=MagnetometerNoise)
    config: MagnetometerConfig = field(default_factory=MagnetometerConfig)
    name: str = "magnetometer"
    stage: int = LAST_STAGE
    held_in_replay: bool = False
    _samples: PerWindow[tuple[int, TurnedSamples | None]] = field(default_factory=PerWindow)
    _iron: PerPass[tuple[SessionState, float]] = field(default_factory=PerPass, init=False)

    def __post_init__(self) -> None:
        self.soft_iron = np.reshape(self.noise.soft_iron, (3, 3))
        iron = np.asarray(self.noise.hard_iron_ut, dtype=np.float64)
        self.iron = SessionState("H", self.name, IRON, iron, np.full(3, self.iron_sigma))
        self.field = SessionState("F", self.name, STRENGTH, self.field_ut, self.field_sigma)

    def iron_at_start(self, pass_state: PassState) -> tuple[SessionState, float]:
        """Hard iron as a state that begins where the alignment found it, and the sigma (uT) that it is known to. The
        sigma of its prior stays as it was before: the same samples are used again."""
        found = pass_state.aligned_states.get(IRON)
        if found is None:
            return self.iron, self.iron_sigma
        return replace(self.iron, initial=found[0]), min(found[1], self.iron_sigma)

    def add(self, update: GraphUpdate, window: Window, previous: State | None, pass_state: PassState) -> None:
        """One row at the end of the window, where it has samples and the gyro their rotation."""
        if window.kind in ("first", "gap") or previous is None:
            return
        last, samples = self._samples.of(window, self._samples_of)
        if samples is None:
            return
        y, turn = samples.mean(previous.bias.gyroscope())
        A = turn @ self.soft_iron
        sigma, shared = self.sigma(window.length_s, len(samples.step_s)), self.shared(window.length_s)
        iron, iron_sigma = self._iron.of(pass_state, self.iron_at_start)
        known = sigma**2 + self.field_sigma**2 + iron_sigma**2
        level = update.predicted.attitude().matrix() @ (y - A @ iron.initial)
        used = self.usable(pass_state) and not self.disturbed(level, known)
        data = np.concatenate([y, A.ravel(), [np.sin(self.declination), np.cos(self.declination), sigma]])
        keys = (key("X", update.index), key("V", update.index), update.use(iron), update.use(self.field))
        loss, loss_scale = self.config.loss, LOSS_SCALE / float(np.sqrt(shared))
        update.blocks.append(
            FactorBatch(self.name, MODEL, [keys], data[None], update.t_ns, (last - 1,), (used,), loss, loss_scale)
        )

    def _samples_of(self, window: Window) -> tuple[int, TurnedSamples | None]:
        """The samples of a window, some of them where they are many, and the row after the last."""
        last = int(np.searchsorted(self.t_ns, window.t1_ns, side="right"))
        first = int(np.searchsorted(self.t_ns, window.t0_ns, side="right"))
        if last == first:
            return last, None
        rows = np.arange(first, last)[:: -(-(last - first) // MOST_SAMPLES)]
        return last, TurnedSamples.of(window, self.t_ns[rows], self.reading[rows] @ self.soft_iron.T)

    def sigma(self, length_s: float, count: int) -> float:
        """Sigma (uT) of a row of `count` samples over `length_s` s.

        The mean of a disturbance that stays alike for tau has over a long time the information of one independent value
        in 2 tau: rows closer in time share it.
        """
        return float(np.sqrt(self.noise.sigma_ut**2 / count + self.noise.disturbance_ut**2 * self.shared(length_s)))

    def shared(self, length_s: float) -> float:
        """How many rows of `length_s` s share the information of one disturbance; 1 where there are none. The loss acts
        on what one row is off by itself."""
        return max(1.0, 2.0 * self.noise.disturbance_s / length_s) if self.noise.disturbance_ut > 0 else 1.0

    def usable(self, pass_state: PassState) -> bool:
        """Whether rows are used: a hard iron that is fixed although it is unknown would pass for north."""
        fixed = IRON in pass_state.fixed_states or (pass_state.causal and self.held_in_replay)
        return not fixed or self.iron_at_start(pass_state)[1] <= SURE_IRON_UT

    def disturbed(self, level: Floats, variance: Floats) -> bool:
        """Whether a field (3,) uT in level axes contradicts intensity and dip, as horizontal and vertical strength with
        a variance (2,) uT^2 by sigmas of row, field and hard iron. Whatever its heading, which is tested last."""
        found = np.array([np.hypot(level[0], level[1]), level[2]])
        known = variance + (TILT * np.linalg.norm(level)) ** 2
        return bool((np.abs(found - self.field_ut) > self.config.gate_sigmas * np.sqrt(known)).any())


def unearthly(reading: Floats) -> float:
    """By how much (uT) the median intensity of readings (n, 3) lies outside of what the Earth's field has."""
    size = float(np.median(np.linalg.norm(reading, axis=1)))
    return max(EARTHLY_UT[0] - size, size - EARTHLY_UT[1], 0.0)


def build(context: FactorContext) -> MagnetometerBuilder | None:
    """Builder of the session's magnetometer.

    Readings whose first second is stronger than any field on Earth hold an uncalibrated hard iron of that size. Where
    there are no positions to determine the heading, the magnetometer is used from the first pass on.
    """
    stream, config = context.session.magnetometer, context.options(MagnetometerConfig)
    if stream is None or not config.enabled:
        return None
    noise, nav_field = context.calibration.magnetometer_noise, context.session.magnetic_field_ut
    strength, sigma = SOMEWHERE
    if nav_field is not None:
        strength = np.array([np.hypot(nav_field[0], nav_field[1]), nav_field[2]])
        sigma = np.full(2, MODEL_SIGMA_UT)
    return MagnetometerBuilder(
        stream.t_ns,
        stream.field_ut,
        strength,
        sigma,
        float(np.radians(context.session.declination_deg)),
        float(np.hypot(noise.hard_iron_sigma_ut, unearthly(first_second(stream) - np.array(noise.hard_iron_ut)))),
        noise,
        config,
        stage=LAST_STAGE if context.session.absolute() else 0,
        held_in_replay=context.session_states_fixed,
    )


def first_second(stream: Magnetometer) -> Floats:
    """Readings (n, 3) of the first second."""
    return np.asarray(stream.field_ut[stream.t_ns <= stream.t_ns[0] + NS])
