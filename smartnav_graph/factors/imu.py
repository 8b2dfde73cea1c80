"""Inertial windows: GTSAM's ImuFactor on preintegrated measurements, and a bias random walk beside it.

ImuFactor with a separate walk rather than CombinedImuFactor: the noise of a group (accelerometer, gyroscope, the two
walks) can then be scaled on its own, and joint marginals of the chain are as cheap. Over windows of seconds the two
agree (see the tests).

Source: Forster, Carlone, Dellaert, Scaramuzza (2017), On-manifold preintegration, IEEE T-RO 33(1).
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import gtsam
import numpy as np

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.errors import ConfigError
from smartnav_graph.core.timebase import NS, Gap
from smartnav_graph.factors import gap_error, imu_intrinsics
from smartnav_graph.factors.context import FactorContext
from smartnav_graph.factors.gap_model import Bridge
from smartnav_graph.graph.pass_state import INITIALISATION_S, LAST_STAGE, PassState, PerPass
from smartnav_graph.graph.states import State, key
from smartnav_graph.graph.update import Builder, FactorId, GraphUpdate
from smartnav_graph.graph.windows import Window
from smartnav_graph.session.calibration.model import DEVICE_CLASSES, WHITE_ACCELERATION, ImuNoise
from smartnav_graph.session.detect.scatter import sampling_noise

Pim = gtsam.PreintegratedImuMeasurements
Bias = gtsam.imuBias.ConstantBias
# Bias steps, m/s^2 and rad/s, over which preintegration is repeated.
STALE_BIAS = np.array([0.1] * 3 + [1e-3] * 3)
# The same from one pass to the next: passes that come from elsewhere end at the same solution. Both together bend the
# velocity by 1.5e-5 m/s in a window of 1 s; either alone by 1e-7 m/s.
KEPT_BIAS = np.array([0.1] * 3 + [3e-4] * 3)

# What the noise known before counts beside residuals, in degrees of freedom: that of a class is right within a factor
# of two or so (its logarithm has sigma 1 / sqrt(2 nu) = 0.5), that of a calibrated device to 7 %.
CLASS_WEIGHT = 2.0
CALIBRATED_WEIGHT = 100.0
# Factor on the noise known before that its own samples must show to be taken instead.
NOISIER = 1.5


@dataclass(frozen=True)
class ImuConfig:
    """integration_sigma : error of the integration itself, m/sqrt(s); estimate_noise : find noise densities and
    bias walks from the kept data (batch); scale_sigma : prior of every element of scale and misalignment as a state, a
    ratio (0.01 is usual of phones; zero: calibrated, or none); scale_error_share : share of a window's turn that both
    may be off by in a replay, which neither has that state nor finds its noise.
    """

    integration_sigma: float = 1e-3
    estimate_noise: bool = True
    scale_sigma: float = 0.0
    scale_error_share: float = 0.005

    def __post_init__(self) -> None:
        if not self.integration_sigma > 0:
            raise ConfigError("config [imu]", f"integration_sigma = {self.integration_sigma}", "> 0")
        if self.scale_error_share < 0:
            raise ConfigError("config [imu]", f"scale_error_share = {self.scale_error_share}", ">= 0")
        if not 0 <= self.scale_sigma < 0.2:
            raise ConfigError("config [imu]", f"scale_sigma = {self.scale_sigma}", "between 0 and 0.2")


def accel_part(windows: Sequence[Window], density: float) -> Floats:
    """Covariance (m, 9, 9) of [rotation, position, velocity] by the accelerometer's white noise alone.

    It is the same on all axes, so no rotation inside the window changes it: sums over the intervals of
    dt (dt / 2 + rest)^2, dt (dt / 2 + rest) and dt, with `rest` the time to the window's end.
    """
    dt = np.concatenate([w.dt for w in windows])
    counts = np.array([len(w.dt) for w in windows])
    starts = np.cumsum(counts) - counts
    since = np.cumsum(dt)
    arm = np.repeat(since[starts + counts - 1], counts) - since + 0.5 * dt
    pp, pv, vv = (density**2 * np.add.reduceat(dt * arm**power, starts)[:, None] for power in (2, 1, 0))
    part = np.zeros((len(windows), 3, 3, 3, 3))  # which of the three, axis; twice
    axis = np.arange(3)
    part[:, 1, axis, 1, axis], part[:, 2, axis, 2, axis] = pp, vv
    part[:, 1, axis, 2, axis] = part[:, 2, axis, 1, axis] = pv
    return part.reshape(-1, 9, 9)


def integration_part(windows: Sequence[Window], sigma: float) -> Floats:
    """Covariance (m, 9, 9) by the error of the integration, in position; the rest is the gyroscope's."""
    part = np.zeros((len(windows), 9, 9))
    part[:, range(3, 6), range(3, 6)] = sigma**2 * np.array([[w.dt.sum()] for w in windows])
    return part


class Kept(NamedTuple):
    """A window preintegrated in an earlier pass: at this bias (6,), with noise of these scales."""

    window: Window
    bias: Floats
    scales: tuple[float, float]
    pim: Pim


class _Parts(NamedTuple):
    """Parts (9, 9) of the covariance of `pim`: of accelerometer and gyroscope at scale one, and of the integration."""

    pim: Pim
    accel: Floats
    gyro: Floats
    integration: Floats


@dataclass
class Preintegrated:
    """Windows preintegrated in earlier passes, by index, with the parts of their covariances; and the wall seconds that
    all of it took."""

    windows: dict[int, Kept] = field(default_factory=dict)
    parts: dict[int, _Parts] = field(default_factory=dict)
    seconds: float = 0.0


@dataclass
class ImuBuilder(Builder):
    """Adds `ImuFactor` and the bias walk, and predicts the state at the window's end.

    gravity m/s^2; `bridges` gives the noise of each gap by its start stamp; weight : degrees of freedom that `noise`
    counts for where the data are asked for it; sampling_noise : densities of accelerometer and gyroscope by their
    samples alone, see `session.detect.scatter`.
    """

    noise: ImuNoise
    gravity: float
    gaps: Sequence[Gap] = ()
    bridges: Mapping[int, Bridge] = field(default_factory=dict)
    config: ImuConfig = field(default_factory=ImuConfig)
    name: str = "imu"
    stage: int = 0
    weight: float = CLASS_WEIGHT
    sampling_noise: tuple[float, float] = (0.0, 0.0)
    cache: Preintegrated = field(default_factory=Preintegrated)
    _gap_errors: gap_error.GapErrors = field(default_factory=gap_error.GapErrors)
    _params: PerPass[gtsam.PreintegrationParams] = field(default_factory=PerPass, init=False)
    _walk: PerPass[Floats] = field(default_factory=PerPass, init=False)

    def has_second_stage(self, pass_state: PassState) -> bool:
        """See `Builder`: noise and scale factors are estimated."""
        return self.config.estimate_noise or self.config.scale_sigma > 0

    @property
    def is_known(self) -> bool:
        """Whether more is known of the device than its class: by a calibration, or by scale factors as states."""
        return self.weight != CLASS_WEIGHT or self.config.scale_sigma > 0

    def sampling_scales(self) -> dict[str, float]:
        """The noise between samples over that of `noise`, of accelerometer and gyroscope."""
        accel, gyro = self.sampling_noise
        return {"accel": accel / self.noise.accel_noise_density, "gyro": gyro / self.noise.gyro_noise_density}

    def prior_scales(self) -> dict[str, float]:
        """Scales of the noise before anything is estimated: of groups whose samples alone are noisier than known."""
        known = self.sampling_scales() if self.config.estimate_noise else {}
        return {name: scale for name, scale in known.items() if scale > NOISIER}

    def params(self, pass_state: PassState, bridge: Bridge | None = None) -> gtsam.PreintegrationParams:
        """Preintegration parameters in continuous-time units; nav z up."""
        scale_a, scale_g = pass_state.scale("accel"), pass_state.scale("gyro")
        accel = np.full(3, self.noise.accel_noise_density * scale_a)
        gyro = np.full(3, self.noise.gyro_noise_density * scale_g)
        if bridge is not None:
            accel = np.maximum(accel, bridge.accel)
            gyro = np.maximum(gyro, bridge.gyro)
        params = gtsam.PreintegrationParams.MakeSharedU(self.gravity)
        params.setAccelerometerCovariance(np.diag(accel**2))
        params.setGyroscopeCovariance(np.diag(gyro**2))
        params.setIntegrationCovariance(np.eye(3) * self.config.integration_sigma**2)
        return params

    def _gap(self, window: Window) -> Gap | None:
        if window.kind != "gap":
            return None
        middle = (window.t0_ns + window.t1_ns) // 2
        return next(gap for gap in self.gaps if gap.start_ns <= middle <= gap.end_ns)

    def turning(self, window: Window, bias: Bias, pass_state: PassState) -> PassState:
        """The memory with the gyro's noise of this window raised by what its turn may be off by.

        sigma^2 T = (density^2 T) + (share |turn|)^2, for a device of which no more than its class is known, in replay.
        """
        if not pass_state.causal or self.is_known or window.kind == "gap" or not self.config.scale_error_share:
            return pass_state
        turn = float(np.linalg.norm(window.dt @ (window.gyro - bias.gyroscope())))
        own = self.noise.gyro_noise_density * np.sqrt(window.length_s)
        scale = float(np.hypot(pass_state.scale("gyro"), self.config.scale_error_share * turn / own))
        return replace(pass_state, noise_scales={**pass_state.noise_scales, "gyro": scale})

    def walk_sigma(self, pass_state: PassState) -> Floats:
        """Random walk (6,) of the biases over one second, accelerometer then gyroscope."""
        accel = self.noise.accel_bias_walk * pass_state.scale("accel_walk")
        return np.array([accel] * 3 + [self.noise.gyro_bias_walk * pass_state.scale("gyro_walk")] * 3)

    def preintegrate(self, window: Window, bias: Bias, pass_state: PassState) -> Pim:
        """GTSAM preintegrated measurements of one window, linearised at `bias` or, where that is good enough, as an
        earlier pass left them."""
        scales, vector = (pass_state.scale("accel"), pass_state.scale("gyro")), bias.vector()
        kept = self.cache.windows.get(window.index)
        fresh = kept is not None and kept.window is window and (np.abs(vector - kept.bias) < KEPT_BIAS).all()
        if kept is not None and fresh and (kept.scales == scales or window.kind != "gap"):
            return kept.pim
        pim = self._integrated(window, bias, pass_state)
        self.cache.windows[window.index] = Kept(window, vector, scales, pim)
        return pim

    def _integrated(self, window: Window, bias: Bias, pass_state: PassState) -> Pim:
        begin = time.perf_counter()
        pim = gtsam.PreintegratedImuMeasurements(self._params_of(window, pass_state), bias)
        integrate = pim.integrateMeasurement
        for accel, gyro, dt in zip(window.accel, window.gyro, window.dt.tolist(), strict=True):
            integrate(accel, gyro, dt)
        self.cache.seconds += time.perf_counter() - begin
        return pim

    def _covariance(self, window: Window, pim: Pim, pass_state: PassState) -> Floats:
        """Covariance (9, 9) of a window with the noise of `pass_state`, whatever noise it was preintegrated with."""
        scales, old = (pass_state.scale("accel"), pass_state.scale("gyro")), self.cache.windows[window.index].scales
        if scales == old:
            return np.asarray(pim.preintMeasCov())
        parts = self.cache.parts.get(window.index)
        if parts is None or parts.pim is not pim:
            accel = accel_part([window], self.noise.accel_noise_density)[0]
            integration = integration_part([window], self.config.integration_sigma)[0]
            gyro = (pim.preintMeasCov() - old[0] ** 2 * accel - integration) / old[1] ** 2
            parts = self.cache.parts[window.index] = _Parts(pim, accel, gyro, integration)
        return scales[0] ** 2 * parts.accel + scales[1] ** 2 * parts.gyro + parts.integration

    def _factor(self, window: Window, pim: Pim, pass_state: PassState) -> gtsam.NoiseModelFactor:
        i, j = window.index - 1, window.index
        factor = gtsam.ImuFactor(key("X", i), key("V", i), key("X", j), key("V", j), key("B", i), pim)
        if (pass_state.scale("accel"), pass_state.scale("gyro")) == self.cache.windows[j].scales:
            return factor
        model = gtsam.noiseModel.Gaussian.Covariance(self._covariance(window, pim, pass_state))
        return factor.cloneWithNewNoiseModel(model)

    def _params_of(self, window: Window, pass_state: PassState) -> gtsam.PreintegrationParams:
        gap = self._gap(window)
        if gap is not None:
            return self.params(pass_state, self.bridges[gap.start_ns].over(window.length_s))
        return self._params.of(pass_state, self.params)

    def _variance(self, pim: Pim, window: Window, previous: State, covariance: Floats) -> Floats:
        """Variance (3,) m^2 of the predicted position: the state's before, carried over, and the window's own."""
        gap, length_s = self._gap(window), window.length_s
        gap_sigma = 0.0 if gap is None else gap_error.largest(gap, self.bridges[gap.start_ns])
        nav_R_body = previous.nav.attitude().matrix()
        own = np.diag(nav_R_body @ pim.preintMeasCov()[3:6, 3:6] @ nav_R_body.T)
        before = np.diag(covariance)
        lean = self.gravity**2 * before[:3].max() + gap_sigma**2
        return np.asarray(before[3:6] + length_s**2 * before[6:9] + (0.5 * length_s**2) ** 2 * lean + own)

    def begin(self) -> ImuBuilder:
        """See `Builder.begin`; windows preintegrated before stay at hand."""
        return replace(self, _gap_errors=gap_error.GapErrors())

    def add(self, update: GraphUpdate, window: Window, previous: State | None, pass_state: PassState) -> None:
        """Factors of one window; nothing at the first keyframe."""
        if previous is None:
            return
        pass_state = self.turning(window, previous.bias, pass_state)
        pim = self.preintegrate(window, previous.bias, pass_state)
        update.predicted = pim.predict(previous.nav, previous.bias)
        update.bias = previous.bias
        update.predict = pim.predict
        if previous.covariance is not None:
            update.variance = self._variance(pim, window, previous, previous.covariance)
        self._add_inertial(update, window, previous, pim, pass_state)
        i, j = window.index - 1, window.index
        sigmas = self._walk.of(pass_state, self.walk_sigma) * np.sqrt(window.length_s)
        walk = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
        same = gtsam.BetweenFactorConstantBias(key("B", i), key("B", j), gtsam.imuBias.ConstantBias(), walk)
        update.add(FactorId("imu_bias", window.t1_ns), same)

    def _add_inertial(
        self,
        update: GraphUpdate,
        window: Window,
        previous: State,
        pim: Pim,
        pass_state: PassState,
    ) -> None:
        """The window as GTSAM's factor, or as a row where further states change what was read."""
        gap = self._gap(window)
        if gap is not None:
            ends = self._gap_errors.add(update, window, gap, self.bridges[gap.start_ns])
            if any(ends):
                update.blocks.append(gap_error.row(window, ends, previous.bias, pim.preintMeasCov(), self.gravity))
                return
        elif self.config.scale_sigma > 0 and pass_state.stage == LAST_STAGE:
            covariance = self._covariance(window, pim, pass_state)
            imu_intrinsics.add(update, window, previous.bias, covariance, self.gravity, self.config.scale_sigma)
            return
        used = pim.biasHat().vector()

        def refresh(bias: Bias) -> gtsam.NonlinearFactor | None:
            if (np.abs(bias.vector() - used) < STALE_BIAS).all():
                return None
            return self._factor(window, self.preintegrate(window, bias, pass_state), pass_state)

        update.refresh = refresh
        update.add(FactorId("imu", window.t1_ns), self._factor(window, pim, pass_state))


def build(context: FactorContext) -> ImuBuilder:
    """The builder of a session's inertial data."""
    noise = context.calibration.imu_noise
    known = noise not in (DEVICE_CLASSES[context.calibration.device_class], WHITE_ACCELERATION)
    weight = CALIBRATED_WEIGHT if known else CLASS_WEIGHT
    gravity, options = context.session.gravity, context.options(ImuConfig)
    imu = context.session.require_imu()
    own = sampling_noise(imu.take(imu.t_ns <= imu.t_ns[0] + round(INITIALISATION_S * NS)) if context.causal else imu)
    return ImuBuilder(noise, gravity, context.gaps, context.bridges, options, weight=weight, sampling_noise=own)
