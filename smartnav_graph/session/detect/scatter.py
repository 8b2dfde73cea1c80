"""Noise of a stream by itself, before any model of the motion.

Position fixes: each against the cubic through its four neighbours.

A cubic follows the motion over a few fixes, and every correlated error that is slower than these: what is left is the
white part of the fixes and the motion that no cubic follows. With weights w_j of the cubic at the fix,

    r = p - sum_j w_j p_j        var r = sigma^2 (1 + sum_j w_j^2)

and a low quantile of the normalised squares gives sigma. An outlier spoils five residuals, its own most: the
worst are left out one after the other, and were outliers if far less scatter is left. At twice the spacing white noise
leaves the same sigma, motion a larger one; and neighbouring r of white noise are of opposite sign (their correlation is
-0.8), those of a motion are not. Fixes too far apart follow no motion, and their scatter is an upper bound.

Inertial samples: at high frequencies their spectrum is that of the white noise; vibration and motion have peaks, which
a low quantile over the frequencies leaves out (Welch 1967, IEEE Trans. Audio Electroacoust. 15(2)).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from smartnav_graph.core import chi_square
from smartnav_graph.core.arrays import Floats, Indices, Mask, Times
from smartnav_graph.core.timebase import NS
from smartnav_graph.session.streams import Imu

LEAST_FIXES = 12
# An outlier spoils five residuals: among a fifth of outliers this share of the smallest residuals has none.
QUANTILE = 0.25
# Share of good fixes that agree with their neighbours.
AGREES = 0.999
# Fixes outside this share of good ones may be outliers; they are, where this share of the scatter is left without them.
SUSPECT, OUTLYING = 0.95, 0.5
# Where the rest is no noise, share that must be left for that, or share of the scatter.
LEAST_KEPT, CLEARLY_OUTLYING = 0.6, 0.2
# Noise, not motion: growth of the scatter at twice the spacing, mean sign of neighbouring products (-0.59 if white),
# and longest median spacing.
NOISE_GROWTH, NOISE_SIGN, NOISE_SPACING_S = 1.5, -0.3, 2.5
# Samples of one piece of the spectrum, pieces at least, and the frequencies looked at, as a share of the rate.
SPECTRUM_ROWS, LEAST_PIECES, HIGH_FREQUENCY = 64, 8, 0.1


@dataclass(frozen=True)
class Scatter:
    """Standard deviation (m) of the white part of one component, and whether it is noise: otherwise it holds motion
    and is an upper bound. rows : fixes that it was found from."""

    sigma: float
    is_noise: bool
    rows: int


def normalised_residuals(t_ns: Times, position: Floats, spacing: int = 1) -> Floats:
    """Fixes less the cubic through the neighbours `spacing` and twice `spacing` rows before and after, over the square
    root of 1 + sum w^2 (n, d); NaN where there are none. t_ns (n,) increasing, position (n, d) m."""
    out = np.full(position.shape, np.nan)
    middle = np.arange(2 * spacing, len(t_ns) - 2 * spacing)
    if not len(middle):
        return out
    around = middle[:, None] + spacing * np.array([-2, -1, 1, 2])
    t = (t_ns[around] - t_ns[middle][:, None]) / NS
    weights = np.ones(t.shape)
    for j in range(4):
        for k in range(4):
            if k != j:
                weights[:, j] *= t[:, k] / (t[:, k] - t[:, j])
    residual = position[middle] - np.einsum("nj,njd->nd", weights, position[around])
    out[middle] = residual / np.sqrt(1.0 + (weights**2).sum(axis=1, keepdims=True))
    return out


def apart_from_before(t: Floats | Times, position: Floats) -> Mask:
    """Rows (n,) that are later than the row before, and elsewhere."""
    return np.concatenate([[True], (np.diff(t) > 0) & np.diff(position, axis=0).any(axis=1)])[: len(t)]


def scatter(t_ns: Times, position: Floats, unit: Floats | None = None) -> Scatter | None:
    """Scatter of fixes (n, d), m; None where there are too few. Rows with the same stamp or position as the row before
    are one fix. `unit` (n,) or (n, d) m: the scatter in units of these sigmas."""
    units = np.broadcast_to(1.0 if unit is None else np.atleast_2d(np.asarray(unit).T).T, position.shape)
    used = np.isfinite(position).all(axis=1) & np.isfinite(units).all(axis=1)
    t_ns, position, units = t_ns[used], position[used], units[used]
    new = apart_from_before(t_ns, position)
    t_ns, position, units = t_ns[new], position[new], units[new]
    if len(t_ns) < LEAST_FIXES:
        return None
    found = _scatter(t_ns, position, units)
    kept = _without_outliers(t_ns, position, units) if found.is_noise else np.arange(len(t_ns))
    cleaned = _scatter(t_ns[kept], position[kept], units[kept])
    few = len(kept) > LEAST_KEPT * len(t_ns)  # more are no outliers: the scatter changes with time
    most = OUTLYING if few or cleaned.is_noise else CLEARLY_OUTLYING
    outlying = cleaned.sigma < most * found.sigma
    return replace(cleaned, rows=found.rows) if outlying else found


def _scatter(t_ns: Times, position: Floats, units: Floats) -> Scatter:
    near, far = (normalised_residuals(t_ns, position, spacing) / units for spacing in (1, 2))
    sigma, sign = _sigma(near), float(np.nanmean(np.sign(near[1:] * near[:-1])))
    close = float(np.median(np.diff(t_ns))) / NS < NOISE_SPACING_S
    return Scatter(sigma, close and sign < NOISE_SIGN and _sigma(far) < NOISE_GROWTH * sigma, len(t_ns))


def _without_outliers(t_ns: Times, position: Floats, units: Floats) -> Indices:
    """Rows without those that disagree with their neighbours most, one among neighbours at a time; at least half."""
    kept, limit = np.arange(len(t_ns)), float(chi_square.ppf(SUSPECT, position.shape[1]))
    while True:
        residual = normalised_residuals(t_ns[kept], position[kept]) / units[kept]
        square = np.pad(np.nan_to_num((residual**2).sum(axis=1)), 2)
        off = square[2:-2] > limit * max(_sigma(residual), 1e-9) ** 2
        off &= square[2:-2] >= sliding_window_view(square, 5).max(axis=1)
        if not off.any() or 2 * (len(kept) - int(off.sum())) < len(t_ns) or len(kept) - off.sum() < LEAST_FIXES:
            return kept
        kept = kept[~off]


def agrees_with_neighbours(t_ns: Times, position: Floats) -> Mask:
    """Which fixes (n,) lie no farther from the cubic through their neighbours than the scatter of all allows; the first
    and last two, and repeated stamps, agree with nothing."""
    out = np.zeros(len(t_ns), dtype=bool)
    first = np.flatnonzero(np.concatenate([[True], np.diff(t_ns) > 0])[: len(t_ns)])
    if len(first) >= LEAST_FIXES:
        residual = normalised_residuals(t_ns[first], position[first])
        limit = chi_square.ppf(AGREES, position.shape[1]) * max(_sigma(residual), 1e-9) ** 2
        out[first] = np.nan_to_num((residual**2).sum(axis=1), nan=np.inf) < limit
    return out


def _sigma(residual: Floats) -> float:
    square = (residual**2).sum(axis=1)
    dim = residual.shape[1]
    return float(np.sqrt(np.quantile(square[np.isfinite(square)], QUANTILE) / chi_square.ppf(QUANTILE, dim)))


def sampling_noise(imu: Imu) -> tuple[float, float]:
    """Density of the white noise of inertial samples, m/s^2/sqrt(Hz) and rad/s/sqrt(Hz), mean square of the axes; zeros
    where there are too few."""
    if len(imu) < LEAST_PIECES * LEAST_FIXES:
        return 0.0, 0.0
    rate_hz = NS / float(np.median(np.diff(imu.t_ns)))
    rows = min(SPECTRUM_ROWS, len(imu) // LEAST_PIECES)
    high = np.fft.rfftfreq(rows) > HIGH_FREQUENCY

    def density(values: Floats) -> float:
        floor = np.quantile(_spectrum(values, rows)[:, high], QUANTILE, axis=1)
        return float(np.sqrt(0.5 * floor.mean() / rate_hz))

    return density(imu.accel), density(imu.gyro)


def _spectrum(values: Floats, rows: int) -> Floats:
    """One-sided power density (d, rows // 2 + 1) of columns of samples (n, d) at a rate of one: median over pieces of
    that many rows, each half of which overlaps the next; linear trends removed, Hann weights.

    Source: Welch (1967), IEEE Trans. Audio Electroacoust. 15(2), 70; Allen et al. (2012), Phys. Rev. D 85, 122006, B,
    for the median. All pieces at once: `scipy.signal.welch` takes them one by one.
    """
    pieces = sliding_window_view(values, rows, axis=0)[:: rows - rows // 2]
    line = np.linalg.qr(np.vander(np.arange(rows), 2))[0]
    window = 0.5 - 0.5 * np.cos(2.0 * np.pi / rows * np.arange(rows))  # Hann
    power = np.abs(np.fft.rfft(window * (pieces - (pieces @ line) @ line.T))) ** 2 / (window**2).sum()
    power[..., 1 : (rows + 1) // 2] *= 2.0
    even = 2.0 * np.arange(1.0, (len(pieces) - 1) // 2 + 1)
    bias = 1.0 + float((1.0 / (even + 1.0) - 1.0 / even).sum())
    return np.asarray(np.median(power, axis=0) / bias)
