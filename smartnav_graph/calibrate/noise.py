"""Noise terms of readings at rest, by maximum likelihood on their cosine transform; used as weights of a regression.

The coefficients c_k of the orthonormal DCT-II of n readings every dt s are independent with the variance

    S_k = N^2 / dt  +  B^2 / l_k  +  K^2 dt / l_k^2  +  Q^2 l_k^2 / dt^2,   l_k = 2 sin(pi k / 2 n)

exactly for white noise N and random walk K, closely for bias instability (flicker) B and quantisation Q of the
integral: the coefficients of IEEE Std 952 in continuous-time densities, with Allan variances N^2 / tau, 2 ln 2 / pi
B^2, K^2 tau / 3 and 3 Q^2 / tau^2. All four are estimated together, so that a sigma covers that two terms are alike; a
term counts where its square exceeds `SIGNIFICANT` sigmas. Source: Whittle (1953), Estimation and information in
stationary time series, Arkiv foer Matematik 2(23); Strang (1999), The discrete cosine transform, SIAM Review 41(1), for
the eigenvectors of the random walk.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from smartnav_graph.core.arrays import Floats, Indices

TERMS = ("white", "flicker", "walk", "quantisation")
SIGNIFICANT = 2.5  # sigmas of a squared coefficient: 0.6 % by noise alone
SINGLE = 100  # lowest coefficients that are taken one by one; those above in bins
BINS_PER_DECADE = 40
LEAST_SHARE = 0.01  # of a coefficient that a regression leaves
LEAST_COUNT = 30.0  # coefficients in a band that is compared with the model
OCTAVES = 6  # down to which part of the spectrum is looked for a band without filter
MISFIT = 0.15  # of the log variance in a band of a third of an octave, beyond which the model is not that of the data


@dataclass(frozen=True)
class Spectrum:
    """Mean squares of DCT coefficients in bins.

    power (b,) : mean c_k^2; count (b,) : coefficients; shapes (b, 4) : mean of what multiplies each term;
    frequency_hz (b,) ; first (b,) : lowest k of the bin
    """

    power: Floats
    count: Floats
    shapes: Floats
    frequency_hz: Floats

    def below(self, hz: float) -> Spectrum:
        """The bins up to a frequency."""
        kept = self.frequency_hz <= hz
        return Spectrum(self.power[kept], self.count[kept], self.shapes[kept], self.frequency_hz[kept])


@dataclass(frozen=True)
class NoiseModel:
    """Coefficients N, B, K, Q by name with sigmas, where they are significant, and where the model holds.

    squares (4,), covariance (4, 4) : squared coefficients in the order of `TERMS`, >= 0
    band_hz : frequency up to which the readings follow the model; the Nyquist frequency unless they are filtered
    limits : by term that is not significant, the upper limit (95 %) of its coefficient
    """

    coefficients: dict[str, tuple[float, float]]
    squares: Floats
    covariance: Floats
    band_hz: float
    limits: dict[str, float]

    def variances(self, count: int, dt: float) -> Floats:
        """S_k (n,) of the coefficients k = 0 .. n - 1 of `count` readings; that of k = 0 is taken at k = 1/2."""
        return shapes_of(np.maximum(np.arange(count), 0.5), count, dt) @ self.squares

    def allan_variance(self, tau: Floats) -> Floats:
        """Allan variance (k,) of the model at tau (k,) s."""
        white, flicker, walk, quantisation = self.squares
        return np.asarray(white / tau + 2 * np.log(2) / np.pi * flicker + walk * tau / 3 + 3 * quantisation / tau**2)


def shapes_of(k: Floats, count: int, dt: float) -> Floats:
    """What multiplies N^2, B^2, K^2, Q^2 in S_k: (len(k), 4)."""
    length = 2 * np.sin(np.pi * k / (2 * count))
    return np.stack([np.full(len(k), 1 / dt), 1 / length, dt / length**2, length**2 / dt**2], axis=1)


def spectrum_of(readings: Floats, dt: float, leverage: Floats | None = None) -> Spectrum:
    """The spectrum of readings (n,) at rest.

    leverage : (n,) of the coefficients, where the readings are residuals: the share of each that a regression took
    """
    from scipy.fft import dct

    squares = dct(readings, norm="ortho")[1:] ** 2
    edges = bin_edges(len(readings))
    count = np.diff(edges).astype(np.float64)
    free = count if leverage is None else count - np.add.reduceat(leverage[1:], edges[:-1] - 1)
    share = np.maximum(free / count, LEAST_SHARE)
    shapes = shapes_of(np.arange(1.0, len(readings)), len(readings), dt)
    mean = np.add.reduceat(np.column_stack([squares, shapes]), edges[:-1] - 1, axis=0) / count[:, None]
    middle = (edges[:-1] + edges[1:] - 1) / 2
    return Spectrum(mean[:, 0] / share, count * share, mean[:, 1:], middle / (2 * len(readings) * dt))


def bin_edges(count: int) -> Indices:
    """First k of each bin of the coefficients 1 .. count - 1, and `count`."""
    single = min(SINGLE, count)
    decades = np.log10(count / single)
    above = np.logspace(np.log10(single), np.log10(count), max(int(BINS_PER_DECADE * decades), 1) + 1)
    return np.unique(np.concatenate([np.arange(1, single), np.round(above).astype(np.intp), [count]])).astype(np.intp)


def fit_noise(spectrum: Spectrum) -> NoiseModel:
    """The noise terms of a spectrum: in the widest band, by octaves, in which the model is that of the data."""
    nyquist, tried = float(spectrum.frequency_hz[-1]), []
    for octave in range(OCTAVES + 1):
        part = spectrum.below(nyquist / 2**octave * 1.001)
        if octave and len(part.power) < SINGLE:
            break
        model = _in_band(part, nyquist / 2**octave)
        tried.append((_misfit(part, model), model))
        if tried[-1][0] < MISFIT:
            return model
    return min(tried, key=lambda pair: pair[0])[1]


def _misfit(part: Spectrum, model: NoiseModel) -> float:
    """Largest difference of log variance from the model, beyond its own noise, in thirds of an octave."""
    expected = part.shapes @ model.squares
    third = np.floor(3 * np.log2(part.frequency_hz[-1] / part.frequency_hz)).astype(int)
    worst = 0.0
    for index in np.unique(third):
        rows = third == index
        count = float(part.count[rows].sum())
        if count >= LEAST_COUNT:
            ratio = float(part.count[rows] @ (part.power[rows] / expected[rows])) / count
            worst = max(worst, abs(np.log(ratio)) - 4 * np.sqrt(2.0 / count))
    return worst


def _in_band(part: Spectrum, band_hz: float) -> NoiseModel:
    squares, covariance = _maximum(part)
    sigmas = np.sqrt(np.diag(covariance))
    if squares[-1] < SIGNIFICANT * sigmas[-1]:  # what noise alone gives to it, never below zero, white noise lacks
        squares[:-1], covariance[:-1, :-1] = _maximum(replace(part, shapes=part.shapes[:, :-1]))
        squares[-1], covariance[-1, :-1], covariance[:-1, -1] = 0.0, 0.0, 0.0
        sigmas = np.sqrt(np.diag(covariance))
    significant = squares > SIGNIFICANT * sigmas
    values = np.sqrt(squares)
    found = {t: (float(values[i]), float(sigmas[i] / (2 * values[i]))) for i, t in enumerate(TERMS) if significant[i]}
    limits = {t: float(np.sqrt(squares[i] + 1.645 * sigmas[i])) for i, t in enumerate(TERMS) if not significant[i]}
    return NoiseModel(found, squares, covariance, band_hz, limits)


def _maximum(part: Spectrum) -> tuple[Floats, Floats]:
    """Squared coefficients (c,) >= 0 of maximum likelihood, and their covariance (c, c), by Fisher scoring: repeated
    non-negative least squares with the weights of the model before."""
    from scipy.optimize import nnls

    scale = np.median(part.power[:, None] / part.shapes, axis=0)
    shapes = part.shapes * scale

    def likelihood(variance: Floats) -> float:
        return -float(part.count @ (np.log(variance) + part.power / variance))

    squares, variance = np.zeros(shapes.shape[1]), part.power
    for _ in range(60):
        root = np.sqrt(part.count) / variance
        step = nnls(shapes * root[:, None], part.power * root)[0] - squares
        share, now = 1.0, likelihood(shapes @ squares) if squares.any() else -np.inf
        while share > 1e-6 and likelihood(shapes @ (squares + share * step)) < now:
            share /= 2
        squares = squares + share * step
        variance = shapes @ squares
        if float(np.abs(share * step).max()) < 1e-9 * float(squares.max()):
            break
    weighted = shapes / variance[:, None]
    information = 0.5 * (weighted * part.count[:, None]).T @ weighted
    return squares * scale, np.linalg.inv(information) * np.outer(scale, scale)
