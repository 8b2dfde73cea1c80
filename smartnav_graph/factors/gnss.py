"""Position fixes: r = nav_t_body + nav_R_body * body_t_antenna - fix, in nav metres (GTSAM's GPSFactorArm)."""

from __future__ import annotations

from dataclasses import dataclass, field

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from smartnav_graph.calibration.model import GnssNoise
from smartnav_graph.errors import ConfigError
from smartnav_graph.factors import correlated
from smartnav_graph.factors.correlated import add_wander, wander_sigma
from smartnav_graph.graph import Block, Memory, State, Step, Tag, Window, key
from smartnav_graph.session import Session
from smartnav_graph.streams import Positioned

Floats = NDArray[np.float64]

LEAST_WANDERING_SIGMA = 0.5  # m

# Factor on the gate's square for fixes whose sigma was estimated.
ESTIMATED_TAIL = 4.0
# The same for a fix against its prediction: the clock and the noise are not settled yet, only gross faults count.
CAUSAL_TAIL = 9.0


@dataclass(frozen=True)
class GnssConfig:
    """loss : ``gate`` (Cauchy to find outliers, chi-square gate with re-admission, then least squares), ``huber`` or
    ``none``; gate_probability : share of good fixes inside the gate; estimate_sigma : find the white sigma of fixes
    that carry none from the kept data; correlated : give the wandering error of code receivers a state."""

    loss: str = "gate"
    gate_probability: float = 0.999
    estimate_sigma: bool = True
    correlated: bool = True

    def __post_init__(self) -> None:
        if self.loss not in ("gate", "huber", "none"):
            raise ConfigError("config [gnss]", f"loss = {self.loss!r}", "gate, huber or none")
        if not 0.5 < self.gate_probability < 1:
            raise ConfigError("config [gnss]", f"gate_probability = {self.gate_probability}", "between 0.5 and 1")


def fix_sigmas(stream: Positioned, default: GnssNoise) -> Floats:
    """Sigmas (n, 3) m: the stream's own where given, the class default elsewhere."""
    h, v = default.horizontal_sigma, default.vertical_sigma
    sigma = np.tile(np.array([h, h, v]), (len(stream), 1))
    if stream.sigma is not None:
        known = np.isfinite(stream.sigma)
        sigma[known] = stream.sigma[known]
    return sigma


def noise_model(sigmas: Floats, loss: str) -> gtsam.noiseModel.Base:
    """Diagonal noise under a loss applied to the whole fix: ``none``, ``huber`` or ``cauchy``."""
    model = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
    estimators = gtsam.noiseModel.mEstimator
    if loss == "none":
        return model
    estimator = estimators.Huber.Create(1.345) if loss == "huber" else estimators.Cauchy.Create(1.0)
    return gtsam.noiseModel.Robust.Create(estimator, model)


@dataclass
class PositionBuilder:
    """Adds one position factor a fix.

    position (n, 3) nav m, sigma (n, 3) m, lever (3,) m body axes; `own_sigma` (n,) marks rows whose sigma came with
    the data and is never scaled.
    """

    name: str
    position: Floats
    sigma: Floats
    own_sigma: NDArray[np.bool_]
    lever: Floats
    config: GnssConfig = field(default_factory=GnssConfig)
    noise: GnssNoise = field(default_factory=GnssNoise)

    @classmethod
    def of(
        cls, session: Session, name: str, stream: Positioned, noise: GnssNoise, config: GnssConfig
    ) -> PositionBuilder:
        """Builder of a session's stream of positions."""
        given = np.full((len(stream), 3), np.nan) if stream.sigma is None else stream.sigma
        own = np.asarray(np.isfinite(given).all(axis=1))
        lever = np.asarray(session.mount(name).body_t, dtype=np.float64)
        return cls(name, session.nav_position(stream), fix_sigmas(stream, noise), own, lever, config, noise)

    def wanders(self, memory: Memory) -> bool:
        """Whether these fixes are a code receiver's: the device's noise says so and they are not better than
        `LEAST_WANDERING_SIGMA`. Better ones come from carrier phase, whose errors do not wander by metres."""
        typical = float(np.median(self.scaled_sigma(memory)[:, :2]))
        return self.noise.wanders and self.config.correlated and typical >= LEAST_WANDERING_SIGMA

    def scaled_sigma(self, memory: Memory) -> Floats:
        """Sigmas (n, 3) m after the noise scale of this sensor."""
        return np.where(self.own_sigma[:, None], self.sigma, self.sigma * memory.scale(self.name))

    def gate(
        self, square: Floats, level: float, rows: NDArray[np.intp], probability: float | None = None
    ) -> NDArray[np.bool_]:
        """Which rows, of normalised squares (m,), lie outside the chi-square gate (of the configured probability).

        `level` widens it with the robust level of all rows, so that optimistic sigmas reject nothing wholesale; rows
        whose sigma was estimated get twice the sigma: what tails the noise of such fixes has is part of it.
        """
        limit = float(chi2(3).ppf(probability or self.config.gate_probability)) * max(1.0, level)
        return np.asarray(square > limit * np.where(self.own_sigma[rows], 1.0, ESTIMATED_TAIL))

    def _loss_of(self, row: int, sigma: Floats, step: Step, memory: Memory) -> str:
        """Loss of one fix in the phase at hand; see `Memory`."""
        if self.config.loss != "gate":
            return self.config.loss
        if memory.phase != "causal" or step.variance is None:
            return "cauchy" if memory.phase == "robust" else "none"
        foretold = step.predicted.position() + step.predicted.attitude().matrix() @ self.lever
        wander = wander_sigma(self.noise) ** 2 if self.name in memory.correlated else 0.0
        square = ((foretold - self.position[row]) ** 2 / (sigma**2 + step.variance + wander)).sum()
        return "cauchy" if self.gate(np.array([square]), CAUSAL_TAIL, np.array([row]))[0] else "none"

    def add(self, step: Step, window: Window, previous: State | None, memory: Memory) -> None:
        """A factor for every row of this stream at the keyframe."""
        wanders = self.name in memory.correlated
        if wanders:
            add_wander(step, window, previous, self.noise)
        rows = window.rows.get(self.name, ())
        for row in rows:
            sigma = self.sigma[row] * (1.0 if self.own_sigma[row] else memory.scale(self.name))
            if memory.is_rejected(self.name, int(row)):
                continue
            loss = self._loss_of(int(row), sigma, step, memory)
            if wanders and loss == "none":
                self._add_wandering(step, int(row), sigma)
            else:
                self._add_native(step, int(row), noise_model(sigma, loss))

    def _add_native(self, step: Step, row: int, model: gtsam.noiseModel.Base) -> None:
        pose, tag = key("X", step.index), Tag(self.name, step.t_ns, row)
        if self.lever.any():
            step.add(tag, gtsam.GPSFactorArm(pose, self.position[row], self.lever, model))
        else:
            step.add(tag, gtsam.GPSFactor(pose, self.position[row], model))

    def _add_wandering(self, step: Step, row: int, sigma: Floats) -> None:
        keys = (key("X", step.index), key("C", step.index))
        data = np.concatenate([self.position[row], self.lever, sigma])[None]
        step.blocks.append(Block(self.name, correlated.MODEL, [keys], data))
