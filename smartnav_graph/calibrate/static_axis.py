"""One axis of a sensor at rest: regression on temperature and time, order by cross-validation, hysteresis."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from smartnav_graph.calibrate.regression import Regression, order_by_blocks, regress
from smartnav_graph.calibrate.rests import RestRows
from smartnav_graph.core.arrays import Floats, Mask

MEANS = 600  # short means for cross-validation and plots


@dataclass(frozen=True)
class AxisAtRest:
    """found : regression on powers 1 .. max(order, 1) of temperature less its mean, or on nothing; order : by
    cross-validation, 0 where temperature does not predict; ramp : slope by time beside temperature, unit/s, and its
    sigma; hysteresis : mean at rising less at falling temperature over the range that both have, nan if not both were;
    dt : s, between readings
    """

    found: Regression
    order: int
    ramp: tuple[float, float]
    hysteresis: float
    dt: float


def characterise(
    readings: Floats, rests: list[RestRows], beside: Floats | None, dt: float, highest: int, *, common: bool
) -> AxisAtRest:
    """One axis (n,) in its rests.

    beside : temperature (n,) less its mean at rest; common : all rests have one bias (gyro), else each has its own
    (gravity on an accelerometer)
    """
    rows = [np.arange(r.first, r.last) for r in rests]
    rows = [np.concatenate(rows)] if common else rows
    parts, times = [readings[r] for r in rows], [(r - rows[0][0])[:, None] * dt for r in rows]
    if beside is None:
        found, ramp = regress(parts, [np.zeros((len(r), 0)) for r in rows], dt), regress(parts, times, dt)
        return AxisAtRest(found, 0, (float(ramp.slopes[0]), float(ramp.sigmas[0])), np.nan, dt)
    size = max(sum(map(len, parts)) // MEANS, 1)
    mean_t = block_means(np.concatenate([beside[r] for r in rows]), size)
    order, _ = order_by_blocks(block_means(np.concatenate([y - y.mean() for y in parts]), size), mean_t, highest)
    powers = [beside[r][:, None] ** np.arange(1, max(order, 1) + 1) for r in rows]
    found = regress(parts, powers, dt)
    ramp = regress(parts, [np.column_stack([x, t]) for x, t in zip(powers, times, strict=True)], dt)
    left = block_means(np.concatenate(found.residuals), size)
    slope = float(ramp.slopes[-1]), float(ramp.sigmas[-1])
    return AxisAtRest(found, order, slope, _hysteresis(mean_t, left), dt)


def _hysteresis(temperature: Floats, left: Floats) -> float:
    rising = np.gradient(temperature) > 0
    both: tuple[Mask, Mask] = (rising, ~rising)
    if min(int(mask.sum()) for mask in both) < 10:
        return np.nan
    low, high = (max(temperature[m].min() for m in both), min(temperature[m].max() for m in both))
    shared = (temperature >= low) & (temperature <= high)
    if min(int((mask & shared).sum()) for mask in both) < 10:
        return np.nan
    return float(left[shared & rising].mean() - left[shared & ~rising].mean())


def block_means(x: Floats, size: int) -> Floats:
    """Means (n // size, ...) of `size` rows each."""
    count = len(x) // size
    return np.asarray(x[: count * size].reshape(count, size, *x.shape[1:]).mean(axis=1))
