"""Bias of a sensor by temperature and time: readings at rest with coloured noise.

Least squares, with the covariance that the noise of the residuals gives it: in the cosine transform that noise is
independent (`noise`), so that the sigma of a slope covers bias instability and random walk, of which the formula for
white noise knows nothing. Weights by the spectrum are not used: a thermometer lags behind a sensor, and they would
prefer fast changes. Source: White (1980), A heteroskedasticity-consistent covariance matrix estimator, Econometrica 48.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from smartnav_graph.calibrate.noise import NoiseModel, fit_noise, shapes_of, spectrum_of
from smartnav_graph.core import chi_square
from smartnav_graph.core.arrays import Floats

LEAST_FREEDOM = 2.0  # degrees of freedom of a variance


@dataclass(frozen=True)
class Regression:
    """Slopes (p,) with covariance (p, p); mean of each stretch at regressors of zero, with its sigma; residuals of each
    stretch, and the noise of the longest."""

    slopes: Floats
    covariance: Floats
    noise: NoiseModel
    residuals: tuple[Floats, ...]
    means: Floats
    mean_sigmas: Floats

    @property
    def sigmas(self) -> Floats:
        """Of the slopes (p,)."""
        return np.sqrt(np.diag(self.covariance))


def regress(readings: Sequence[Floats], regressors: Sequence[Floats], dt: float) -> Regression:
    """Regression of stretches of readings (n_i,) on regressors (n_i, p), each stretch with its own mean."""
    from scipy.fft import dct

    centres = np.array([x.mean(axis=0) for x in regressors])
    centred = [x - centre for x, centre in zip(regressors, centres, strict=True)]
    normal = np.linalg.pinv(sum((x.T @ x for x in centred), np.zeros((centres.shape[1],) * 2)))
    right = sum((x.T @ (y - y.mean()) for x, y in zip(centred, readings, strict=True)), np.zeros(centres.shape[1]))
    slopes = normal @ right
    left = [y - x @ slopes for y, x in zip(readings, regressors, strict=True)]
    means = np.array([part.mean() for part in left])
    residuals = tuple(part - mean for part, mean in zip(left, means, strict=True))
    longest = int(np.argmax([len(part) for part in residuals]))
    root = np.linalg.cholesky(normal + 1e-12 * np.trace(normal) * np.eye(len(normal))) if len(normal) else normal
    transformed = [dct(x, norm="ortho", axis=0) for x in centred]
    leverage = np.sum((transformed[longest] @ root) ** 2, axis=1)
    noise = fit_noise(spectrum_of(residuals[longest], dt, leverage))
    covariance = _covariance([x @ normal for x in transformed], noise, dt)
    own = np.array([noise.variances(len(y), dt)[0] / len(y) for y in readings])
    sigmas = np.sqrt(own + np.einsum("ij,jk,ik->i", centres, covariance, centres))
    return Regression(slopes, covariance, noise, residuals, means, sigmas)


def _covariance(weights: list[Floats], noise: NoiseModel, dt: float) -> Floats:
    """Covariance (p, p) of sums of noise with `weights` (n_i, p), in the cosine transform.

    The variances of the noise are themselves estimated, with few degrees of freedom where they are of slow changes:
    sigmas are widened so that +- 1.96 of them is the 95 % interval of Student's distribution.
    """
    shapes = [shapes_of(np.maximum(np.arange(len(w)), 0.5), len(w), dt) for w in weights]
    parts = sum(np.einsum("np,nt,nq->tpq", w, s, w, optimize=True) for w, s in zip(weights, shapes, strict=True))
    if not weights or not weights[0].shape[1]:
        return np.zeros((0, 0))
    covariance = np.einsum("t,tpq->pq", noise.squares, parts)
    own = np.einsum("tpp->tp", parts)
    variance = np.maximum(np.diag(covariance), 1e-300)
    freedom = np.maximum(2 * variance**2 / np.einsum("tp,tu,up->p", own, noise.covariance, own), LEAST_FREEDOM)
    wider = chi_square.student_ratio(freedom)
    return np.asarray(covariance * np.outer(wider, wider))


def order_by_blocks(
    readings: Floats, temperature: Floats, highest: int, blocks: int = 6, gain: float = 0.9
) -> tuple[int, Floats]:
    """Order of a polynomial in temperature that predicts left-out blocks of temperature best, and the RMS by order.

    readings, temperature : (n,) means over short times; a higher order counts where it lowers the RMS to `gain`
    times that of a lower one
    """
    edges = np.quantile(temperature, np.linspace(0, 1, blocks + 1))
    block = np.clip(np.searchsorted(edges, temperature, side="right") - 1, 0, blocks - 1)
    scaled = (temperature - temperature.mean()) / max(np.ptp(temperature), 1e-9)
    rms = np.zeros(highest + 1)
    for order in range(highest + 1):
        powers = scaled[:, None] ** np.arange(order + 1)
        errors = np.zeros(len(readings))
        for left_out in range(blocks):
            rows = block != left_out
            found, *_ = np.linalg.lstsq(powers[rows], readings[rows], rcond=None)
            errors[~rows] = readings[~rows] - powers[~rows] @ found
        rms[order] = np.sqrt(np.mean(errors**2))
    best = 0
    for order in range(1, highest + 1):
        if rms[order] < gain * rms[best]:
            best = order
    return best, rms
