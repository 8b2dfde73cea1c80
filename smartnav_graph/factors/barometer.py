"""Barometer: relative height with a bias that walks.

    r = (u + v_u d + b - (h(p) - h_0)) / sigma        b_j = b_i + q
    h(p) = 288.15 / 0.0065 (1 - (p / p_0)^(1 / 5.25588))

u is the height of the body in nav, d the time from the keyframe to the mean of its samples, h the height of the
ICAO standard atmosphere. The bias b holds the weather, the undulation of the geoid and the sensor's own offset. Samples
up to `HALF_S` around a keyframe are taken as one, none twice where keyframes are evenly spaced.

Source: ICAO Doc 7488 (1993), Manual of the ICAO standard atmosphere; below 11 km.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np
from numpy.typing import ArrayLike, NDArray

from smartnav_graph.core import chi_square
from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.errors import ConfigError
from smartnav_graph.core.timebase import NS
from smartnav_graph.factors.context import FactorContext
from smartnav_graph.factors.observation import AtKeyframe, Observed
from smartnav_graph.graph.pass_state import PassState
from smartnav_graph.graph.robust import check_loss
from smartnav_graph.graph.states import State, key
from smartnav_graph.graph.update import Builder, FactorBatch, FactorId, GraphUpdate
from smartnav_graph.graph.windows import PerWindow, Window
from smartnav_graph.session.calibration.model import BarometerNoise
from smartnav_graph.session.streams import Barometer

SEA_LEVEL_HPA = 1013.25
SEA_LEVEL_K, LAPSE_K_M, EXPONENT = 288.15, 0.0065, 5.25588
HALF_S = 0.5  # samples this long after a keyframe are used: the look-ahead
# Means of samples that show their noise: least number, and how much more than that of the class counts.
LEAST_MEANS, CLEARLY_MORE = 12, 1.5
UNKNOWN_HEIGHT = 1000.0  # m, of a local frame over the pressure at its start


@dataclass(frozen=True)
class BarometerConfig:
    """reference_hpa : the day's pressure at sea level, where it is known (else the first samples set the height);
    reference_sigma : sigma of heights from it, m (the geoid undulates by so much); loss : ``huber`` (short peaks) or
    ``none``.
    """

    reference_hpa: float | None = None
    reference_sigma: float = 50.0
    loss: str = "huber"

    def __post_init__(self) -> None:
        check_loss("barometer", self.loss, ("huber", "none"))
        if self.reference_hpa is not None and not 850.0 < self.reference_hpa < 1100.0:
            raise ConfigError("config [barometer]", f"reference_hpa = {self.reference_hpa}", "850 to 1100 hPa")
        if not self.reference_sigma > 0:
            raise ConfigError("config [barometer]", f"reference_sigma = {self.reference_sigma}", "> 0 m")


def icao_height(pressure_hpa: ArrayLike, reference_hpa: float = SEA_LEVEL_HPA) -> Floats:
    """Height m of the ICAO standard atmosphere with `reference_hpa` at sea level, of pressures in hPa."""
    ratio = np.asarray(pressure_hpa, dtype=np.float64) / reference_hpa
    return np.asarray(SEA_LEVEL_K / LAPSE_K_M * (1.0 - ratio ** (1.0 / EXPONENT)))


def metres_a_hpa(pressure_hpa: float) -> float:
    """By how much the height falls where the pressure rises by 1 hPa: 8.3 m at sea level."""
    ratio = (pressure_hpa / SEA_LEVEL_HPA) ** (1.0 / EXPONENT)
    return float(SEA_LEVEL_K / LAPSE_K_M / EXPONENT * ratio / pressure_hpa)


class Height:
    """Data: height m over that of the first samples, time s after the keyframe, sigma m. State: D, the bias m."""

    extra: tuple[str, ...] = ("D",)
    width = 3

    def observe(self, R: Floats, p: Floats, v: Floats, extra: Sequence[Floats], data: Floats) -> Observed:
        height, later, weight = data[:, 0], data[:, 1], 1.0 / data[:, 2]
        residual = (p[:, 2] + v[:, 2] * later + extra[0][:, 0] - height) * weight
        by_state = np.zeros((len(p), 1, 9))
        by_state[:, 0, 5] = weight
        by_state[:, 0, 8] = later * weight
        return residual[:, None], by_state, [weight[:, None, None]]


MODEL = AtKeyframe(Height())


@dataclass
class BarometerBuilder(Builder):
    """Adds the bias of every keyframe, and its height where samples are near.

    t_ns (n,), height (n,) m over nav zero but for the bias, scale m/hPa; bias_sigma m, of the bias at first;
    least_sigma m, of the mean around a keyframe; causal : made for a replay
    """

    t_ns: NDArray[np.int64]
    height: Floats
    scale: float
    bias_sigma: float
    noise: BarometerNoise
    loss: str
    name: str = "barometer"
    stage: int = 0
    lookahead_s: float = HALF_S
    least_sigma: float = 0.0
    causal: bool = False
    _start: float = 0.0
    _means: PerWindow[tuple[float, float, float] | None] = field(default_factory=PerWindow)

    def begin(self) -> BarometerBuilder:
        return replace(self, _start=0.0)

    def add(self, update: GraphUpdate, window: Window, previous: State | None, pass_state: PassState) -> None:
        """The bias at the keyframe, tied to the one before, and the mean height around the keyframe."""
        bias = key("D", window.index)
        measured = self._means.of(window, self._around)
        if previous is None and measured is not None and update.predicted is not None:
            self._start = measured[0] - float(update.predicted.position()[2])
        update.chain[bias] = np.array([self._start])
        tag = FactorId("barometer_bias", window.t1_ns)
        if previous is None:
            model = gtsam.noiseModel.Isotropic.Sigma(1, self.bias_sigma)
            update.add(tag, gtsam.PriorFactorVector(bias, np.zeros(1), model))
        else:
            walk = self.scale * self.noise.pressure_walk * np.sqrt(window.length_s)
            model = gtsam.noiseModel.Isotropic.Sigma(1, walk)
            update.add(tag, gtsam.BetweenFactorVector(key("D", window.index - 1), bias, np.zeros(1), model))
        if measured is not None:
            keys = (key("X", window.index), key("V", window.index), bias)
            data = np.array([measured])
            update.blocks.append(FactorBatch(self.name, MODEL, [keys], data, window.t1_ns, loss=self.loss))

    def _around(self, window: Window) -> tuple[float, float, float] | None:
        """Mean height m, its time after the keyframe s, and its sigma m."""
        half = int(min(HALF_S, 0.5 * window.length_s or HALF_S) * NS)
        rows = slice(*np.searchsorted(self.t_ns, (window.t1_ns - half, window.t1_ns + half), side="right"))
        count = rows.stop - rows.start
        if count == 0:
            return None
        later = float((self.t_ns[rows] - window.t1_ns).mean() / NS)
        sigma = max(self.scale * self.noise.pressure_sigma / np.sqrt(count), self.least_sigma)
        return float(self.height[rows].mean()), later, float(sigma)


def build(context: FactorContext) -> BarometerBuilder | None:
    """The builder of a session's barometer.

    Raises
    ------
    ConfigError
        A pressure reference for a session that does not know where its nav zero is.
    """
    stream, options = context.session.barometer, context.options(BarometerConfig)
    if stream is None:
        return None
    height, sigma = _heights(stream, context), UNKNOWN_HEIGHT
    if options.reference_hpa is not None:
        sigma = options.reference_sigma
    scale, noise = metres_a_hpa(float(stream.pressure_hpa[0])), context.calibration.barometer_noise
    least = 0.0 if context.causal else scale * scatter_hpa(stream, noise)  # a replay does not know what comes later
    return BarometerBuilder(
        stream.t_ns, height, scale, sigma, noise, options.loss, least_sigma=least, causal=context.causal
    )


def scatter_hpa(stream: Barometer, noise: BarometerNoise) -> float:
    """Standard deviation (hPa) of the means over twice `HALF_S` by the median of their second differences, which have
    six times their variance: draughts do not average out as white noise does. Zero where that is about what the noise
    of the samples makes, or where there are too few."""
    second = np.asarray((stream.t_ns - stream.t_ns[0]) // round(2.0 * HALF_S * NS))
    first = np.flatnonzero(np.diff(second, prepend=-1))
    counts = np.diff(np.append(first, len(second)))
    means = np.add.reduceat(stream.pressure_hpa, first) / counts
    together = np.diff(second[first], n=2) == 0
    if together.sum() < LEAST_MEANS:
        return 0.0
    found = float(np.median(np.abs(np.diff(means, n=2)[together])) / (chi_square.normal_ppf(0.75) * np.sqrt(6.0)))
    return found if found > CLEARLY_MORE * noise.pressure_sigma / np.sqrt(np.median(counts)) else 0.0


def _heights(stream: Barometer, context: FactorContext) -> Floats:
    """Heights (n,) m over nav zero by the pressure reference, or over the first sample without one."""
    reference, origin = context.options(BarometerConfig).reference_hpa, context.session.origin
    if reference is None:
        height = icao_height(stream.pressure_hpa)
        return np.asarray(height - height[0])
    if origin is None:
        raise ConfigError(
            "config [barometer]",
            f"reference_hpa = {reference} in a session without origin",
            "a session whose height above the sea is known",
            "give height_m of the [origin] in session.toml, or leave reference_hpa out",
        )
    return np.asarray(icao_height(stream.pressure_hpa, reference) - origin.height_m)
