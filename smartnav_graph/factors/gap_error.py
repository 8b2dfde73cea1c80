"""Error of the readings interpolated across a data gap: a Brownian bridge, a state at the keyframes inside.

The error is zero at the borders s and e of the gap, where readings were recorded. In between

    G_j = rho G_i + w,    rho = (e - t_j) / (e - t_i),    w ~ N(0, q rho (t_j - t_i))

and over a window the error goes from G_i to G_j in a straight line; the rest is white noise. So windows inside one gap
have correlated errors, and a fix inside determines force and rate on both sides of it.

Source: Karatzas, Shreve (1991), Brownian Motion and Stochastic Calculus, 5.6, on the bridge; `gap_model` on q.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import gtsam
import numpy as np

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.timebase import NS, Gap
from smartnav_graph.factors.gap_model import Bridge
from smartnav_graph.factors.gauss_markov import decay
from smartnav_graph.factors.preintegration import InertialRow, Integrated, integrated
from smartnav_graph.graph.states import key
from smartnav_graph.graph.update import FactorBatch, FactorId, GraphUpdate
from smartnav_graph.graph.windows import Window

Bias = gtsam.imuBias.ConstantBias
SIZE = 6
# By whether there is an error state at the keyframe before and after a window.
MODELS = {(False, True): InertialRow("G"), (True, True): InertialRow("GG"), (True, False): InertialRow("G")}
# A border shares the keyframe of a fix so close to it.
BORDER_NS = 200_000
# Least error of an axis over a gap, as a share of its white noise: keeps the covariance regular.
LEAST = 1e-3


@dataclass
class GapErrors:
    """Which keyframes of the present pass have a state G."""

    known: set[int] = field(default_factory=set)

    def add(self, update: GraphUpdate, window: Window, gap: Gap, bridge: Bridge) -> tuple[bool, bool]:
        """The state at the end of a window, tied to the one before; whether there is one before and after the window.

        None is needed where a gap is a single window, or has white noise alone.
        """
        i, j = window.index - 1, window.index
        before, after = i in self.known, bool(bridge.diffusion.any()) and window.t1_ns < gap.end_ns - BORDER_NS
        if not after:
            return before, after
        self.known.add(j)
        name, left = key("G", j), (gap.end_ns - window.t1_ns) / NS
        rho = left / (left + window.length_s)
        white = np.concatenate([bridge.accel, bridge.gyro])
        diffusion = bridge.diffusion + np.diag((LEAST * white / gap.length_s) ** 2)
        spread = diffusion * rho * window.length_s
        update.chain[name] = np.zeros(SIZE)
        update.add(FactorId("imu_gap_error", window.t1_ns), _tie(key("G", i) if before else None, name, rho, spread))
        return before, after


def largest(gap: Gap, bridge: Bridge) -> float:
    """Sigma of the force half-way through a gap, m/s^2, on the axis with the largest error."""
    return float(np.sqrt(np.diag(bridge.diffusion)[:3].max() * gap.length_s) / 2.0)


def _tie(before: int | None, name: int, rho: float, spread: Floats) -> gtsam.NonlinearFactor:
    """G_j ~ N(rho G_i, spread), or zero mean at the border of the gap."""
    if before is None:
        return gtsam.PriorFactorVector(name, np.zeros(SIZE), gtsam.noiseModel.Gaussian.Covariance(spread))
    return decay(before, name, rho, np.linalg.inv(np.linalg.cholesky(spread)))


def row(window: Window, ends: tuple[bool, bool], bias: Bias, covariance: Floats, gravity: float) -> FactorBatch:
    """The window as a row; covariance (9, 9) of its white noise."""
    i, j = window.index - 1, window.index
    before, after = ends
    errors = [key("G", i)] * before + [key("G", j)] * after
    model, vector = MODELS[ends], bias.vector()
    data = model.data(window, _integrated(window, vector, ends), vector, covariance, gravity)
    keys = (key("X", i), key("V", i), key("X", j), key("V", j), key("B", i), *errors)
    return FactorBatch("imu", model, [keys], data[None], window.t1_ns)


def _integrated(window: Window, bias: Floats, ends: tuple[bool, bool]) -> Integrated:
    """Preintegrated at a bias (6,) without gap error, with derivatives by the bias and the errors at the ends."""
    middle = np.cumsum(window.dt) - 0.5 * window.dt
    x = middle / window.dt.sum()
    weights = [-np.ones_like(x), *[w for w, there in zip((1.0 - x, x), ends, strict=True) if there]]
    force_by, rate_by = (
        np.concatenate([w[:, None, None] * columns for w in weights], axis=2)
        for columns in (np.eye(3, SIZE), np.eye(3, SIZE, k=3))
    )
    return integrated(window.dt, window.accel - bias[:3], window.gyro - bias[3:], force_by, rate_by)
