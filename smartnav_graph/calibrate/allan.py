"""Overlapping Allan deviation with confidence limits.

    sigma^2(tau) = sum_i (x_{i+2m} - 2 x_{i+m} + x_i)^2 / (2 tau^2 (N - 2m + 1)),  tau = m dt

of N readings whose integral is x. Source: Riley (2008), Handbook of frequency stability analysis, NIST SP 1065, 5.2.5
and Table 5 (degrees of freedom by kind of noise). The same numbers as allantools.oadev.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from smartnav_graph.core import chi_square
from smartnav_graph.core.arrays import Floats, Indices

BLOCK = 1 << 15  # differences at a time: they stay in the cache of the processor
PER_DECADE = 8


def cluster_sizes(count: int) -> Indices:
    """Numbers of readings m of the clusters, evenly on a logarithmic scale up to a third of `count`."""
    last = max(count // 3, 1)
    return np.unique(np.round(np.logspace(0, np.log10(last), int(PER_DECADE * np.log10(last)) + 2)).astype(np.intp))


def allan_deviation(readings: Floats, sizes: Indices) -> Floats:
    """Overlapping Allan deviation (k, c), in the unit of the readings, at tau = sizes (k,) times the interval.

    readings : (n, c) at even intervals; c axes, each in a thread of its own
    """
    with ThreadPoolExecutor() as pool:
        return np.stack(list(pool.map(lambda column: _one_axis(column, sizes), readings.T)), axis=1)


def _one_axis(readings: Floats, sizes: Indices) -> Floats:
    """In units of dt = 1."""
    x = np.concatenate([[0.0], np.cumsum(readings - readings.mean())])
    second, twice = np.empty(BLOCK), np.empty(BLOCK)
    found = np.empty(len(sizes))
    for k, m in enumerate(sizes):
        total, rows = 0.0, len(x) - 2 * int(m)
        for first in range(0, rows, BLOCK):
            last = min(first + BLOCK, rows)
            d, w = second[: last - first], twice[: last - first]
            np.multiply(x[first + m : last + m], 2.0, out=w)
            np.add(x[first + 2 * m : last + 2 * m], x[first:last], out=d)
            d -= w
            total += float(d @ d)
        found[k] = np.sqrt(total / (2.0 * rows)) / m
    return found


def confidence_limits(deviation: Floats, sizes: Indices, count: int, level: float = 0.95) -> tuple[Floats, Floats]:
    """Limits (k,) of the Allan deviation (k,) of `count` readings.

    The degrees of freedom are those of white noise, flicker or random walk, by the slope of the deviation at each tau.
    """
    m, n = sizes.astype(np.float64), float(count)
    slope = np.gradient(np.log(deviation), np.log(m)) if len(m) > 1 else np.full(1, -0.5)
    white = (3 * n / (2 * m) - 2) * 4 * m**2 / (4 * m**2 + 5)
    flicker = np.where(m == 1, 2 * n**2 / (2.3 * n + 4.9), 5 * n**2 / (4 * m * (n + 3 * m)))
    walk = n / m * ((n - 1) ** 2 - 3 * m * (n - 1) + 4 * m**2) / (n - 2) ** 2
    freedom = np.maximum(np.select([slope < -0.25, slope < 0.25], [white, flicker], walk), 1.0)
    low, high = chi_square.ppf([[0.5 + level / 2], [0.5 - level / 2]], freedom)
    return deviation * np.sqrt(freedom / low), deviation * np.sqrt(freedom / high)
