"""Losses of measurements: least squares, Huber, Cauchy. On the norm of a row, in units of its sigma.

Source: Huber (1964), Robust estimation of a location parameter; Holland, Welsch (1977), Robust regression using
iteratively reweighted least-squares, for the constants.
"""

from __future__ import annotations

from collections import deque
from functools import lru_cache

import gtsam
import numpy as np

from smartnav_graph.core import chi_square
from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.errors import ConfigError

# Until so many measurements were compared with their predictions, only gross faults count: clocks and noise are not
# known yet. Level (of normalised squares) assumed until then, and how many are remembered.
FIRST_LEVEL, ENOUGH, REMEMBERED = 9.0, 10, 30
LOSSES = ("none", "huber", "cauchy")
HUBER = 1.345  # keeps 95 % efficiency on Gaussian residuals of one component


@lru_cache
def huber_limit(dim: int) -> float:
    """Norm beyond which Huber's loss is linear: as many good rows of `dim` components lie outside as do of one, 18 %.

    Three components have a norm of 1.6 by nature. Under the limit of one component most good rows would count less
    than they should, the solution would keep to them less than their sigma says, and the noise of what it keeps to
    instead would be found too small.
    """
    return float(np.sqrt(chi_square.isf(chi_square.sf(HUBER**2, 1), dim)))


def check_loss(section: str, loss: str, known: tuple[str, ...] = LOSSES) -> None:
    """Refuse the loss of a section of the configuration that is none of `known`.

    Raises
    ------
    ConfigError
        It is not.
    """
    if loss not in known:
        raise ConfigError(f"config [{section}]", f"loss = {loss!r}", f"{', '.join(known[:-1])} or {known[-1]}")


def loss_weights(square: Floats, loss: str, loss_scale: Floats | float = 1.0, dim: int = 1) -> tuple[Floats, Floats]:
    """Weight (m,) and cost (m,) of rows with squared norm `square` (m,) under a loss: none, huber or cauchy(1), for
    norms of `dim` components in units of `loss_scale` (m,)."""
    if loss == "none":
        return np.ones_like(square), 0.5 * square
    scale = np.square(loss_scale)
    square = square / scale
    if loss == "cauchy":
        return 1.0 / (1.0 + square), 0.5 * scale * np.log1p(square)
    norm = np.sqrt(np.maximum(square, 1e-300))
    limit = huber_limit(dim)
    outside = norm > limit
    cost = np.where(outside, limit * norm - 0.5 * limit**2, 0.5 * square)
    return np.where(outside, limit / norm, 1.0), scale * cost


@lru_cache
def expected_weighted_square(loss: str, dim: int) -> float:
    """E[w r^2] / dim of a standard normal row of `dim` components under a loss: what its weighted square is on average
    where its sigma is right."""
    square = chi_square.ppf((np.arange(10_000) + 0.5) / 10_000, dim)
    return float((loss_weights(square, loss, 1.0, dim)[0] * square).mean() / dim)


def robust(model: gtsam.noiseModel.Base, loss: str, loss_scale: float = 1.0) -> gtsam.noiseModel.Base:
    """A GTSAM noise model under a loss, as `loss_weights` has it."""
    if loss == "none":
        return model
    estimators = gtsam.noiseModel.mEstimator
    limit = huber_limit(model.dim())
    estimator = estimators.Huber.Create(limit * loss_scale) if loss == "huber" else estimators.Cauchy.Create(loss_scale)
    return gtsam.noiseModel.Robust.Create(estimator, model)


class PredictionLevel:
    """How far measurements of `dim` components are from their predictions in a replay, beside what their sigmas say:
    an outlier hardly moves the median, and a solution that diverged soon accepts measurements again."""

    def __init__(self, dim: int) -> None:
        self._median = float(chi_square.ppf(0.5, dim))
        self._squares: deque[float] = deque(maxlen=REMEMBERED)

    def before(self, square: float) -> float:
        """Level of the measurements before one with this normalised square, which is remembered; 1 is as expected."""
        known = self._squares
        level = float(np.median(known)) / self._median if len(known) >= ENOUGH else FIRST_LEVEL
        known.append(square)
        return level
