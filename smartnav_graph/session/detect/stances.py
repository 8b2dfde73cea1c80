"""The stances of a foot-mounted IMU: is the device on a foot, and when is the foot on the ground?

In each step a foot is on the ground for some tenths of a second while it rolls from heel to toe. It is not at rest, but
its velocity is a few centimetres a second. A statistic of a few samples, selected by name:

    SHOE  sum |a - g mean(a) / |mean(a)||^2 / sa^2 + |w|^2 / sw^2     stance hypothesis optimal detector (GLRT)
    ARE   sum |w|^2 / sw^2                                            angular rate energy
    AMV   sum |a - mean(a)|^2 / sa^2                                  acceleration moving variance

all over the number of samples, is compared on a logarithmic scale with a threshold that follows the smallest value
within a second around: feet of slow walkers are quieter than those of runners. The statistic also bounds the speed of a
sensor above a rolling foot, which gives the sigma of its zero velocity.

Source: Skog, Handel, Nilsson, Rantakokko (2010), Zero-velocity detection, IEEE T-BME 57(11).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from smartnav_graph.core.arrays import Floats, runs
from smartnav_graph.core.timebase import NS
from smartnav_graph.session.detect.blocks import BLOCK_S, Blocks
from smartnav_graph.session.streams import Imu

REST_SPEED = 0.01  # m/s, sigma of the zero velocity of a device at rest; no stance has a smaller one
FORCE_UNIT, RATE_UNIT = 0.01, float(np.radians(0.1))  # sa m/s^2, sw rad/s
STANCE_S = 0.025
AROUND_S = 1.0
# Decades above the smallest value around, and bounds of the threshold (decades).
ABOVE, LOWEST, HIGHEST = 1.3, 4.2, 6.6
SHORTEST_S = 0.03
ARM = 0.03  # m from the point the foot turns about to the sensor
# In a stride a foot swings (rad/s) and hits the ground (m/s^2 beside gravity), and in between it is quiet for a block
# of samples. What is carried swings like that in a pocket or a runner's hand, and is hardly ever quiet: at most 1.1 %
# of the blocks of phones carried in 32 ways, 3.6 % of those of a running foot.
SWING_RATE, IMPACT, STAND_RATE, STAND_FORCE, STRIDE_S, STAND_SHARE = 2.5, 6.0, 0.4, 1.0, 1.5, 0.02
# Longest windows (s) of a foot-mounted IMU in and between stances.
STANCE_SPACING_S, SWING_S = 0.1, 0.2


def is_foot_mounted(blocks: Blocks, vehicle: str) -> bool:
    """Whether the device is mounted on a walking foot: it swings, hits the ground hard, and is at rest in between.

    A property of the whole recording, like the vehicle; `StandstillConfig.mounting` declares it.
    """
    stride = round(STRIDE_S / BLOCK_S)
    if vehicle not in ("none", "foot") or len(blocks.rate) < stride:
        return False
    rate, force = (
        np.nan_to_num(np.nanmax(sliding_window_view(np.nan_to_num(x), stride), axis=1))
        for x in (blocks.rate, blocks.norm)
    )
    walking = (rate > SWING_RATE) & (force > IMPACT)
    middle = slice(stride // 2, stride // 2 + len(walking))
    stands = (blocks.rms_rate[middle] < STAND_RATE) & (blocks.rms_norm[middle] < STAND_FORCE)
    return bool(walking.sum() > 2 * stride and stands[walking].mean() > STAND_SHARE)


def _mean(rows: Floats, width: int) -> Floats:
    from scipy.ndimage import uniform_filter1d

    return np.asarray(uniform_filter1d(rows, width, axis=0, mode="nearest"))


def _rate_energy(imu: Imu, width: int) -> Floats:
    return _mean((imu.gyro**2).sum(axis=1), width) / RATE_UNIT**2


def shoe(imu: Imu, width: int, gravity: float) -> Floats:
    """Statistic (n,) of the stance hypothesis over `width` samples around each."""
    mean = _mean(imu.accel, width)
    size = np.linalg.norm(mean, axis=1)
    force = _mean((imu.accel**2).sum(axis=1), width) - 2.0 * gravity * size + gravity**2
    return np.asarray(force / FORCE_UNIT**2 + _rate_energy(imu, width))


def acceleration_variance(imu: Imu, width: int, gravity: float) -> Floats:
    """Statistic (n,) of the variance of the specific force alone."""
    centred = imu.accel - imu.accel.mean(axis=0)
    variance = (_mean(centred**2, width) - _mean(centred, width) ** 2).sum(axis=1)
    return np.asarray(np.maximum(variance, 0.0) / FORCE_UNIT**2)


DETECTORS: dict[str, Callable[[Imu, int, float], Floats]] = {
    "shoe": shoe,
    "are": lambda imu, width, gravity: _rate_energy(imu, width),
    "amv": acceleration_variance,
}


def stance_speed(imu: Imu, gravity: float, detector: str = "shoe") -> Floats:
    """Sigma (n,) m/s of the zero velocity of a sensor on a standing foot; NaN while it swings.

    sigma = ARM sqrt(T) RATE_UNIT: if all of the statistic T were rate, the speed at `ARM` from the turning point.
    """
    from scipy.ndimage import minimum_filter1d

    period = float(np.median(np.diff(imu.t_ns))) / NS
    width = max(3, round(STANCE_S / period) | 1)
    statistic = np.maximum(DETECTORS[detector](imu, width, gravity), 1e-12)
    decades = np.log10(statistic)
    quietest = minimum_filter1d(decades, round(AROUND_S / period) | 1, mode="nearest")
    stands = decades < np.clip(quietest + ABOVE, LOWEST, HIGHEST)
    shortest = SHORTEST_S / period
    for first, last in runs(~stands):
        stands[first:last] = last - first <= shortest and first > 0 and last < len(stands)
    for first, last in runs(stands):
        stands[first:last] = last - first >= shortest
    return np.where(stands, np.maximum(REST_SPEED, ARM * RATE_UNIT * np.sqrt(statistic)), np.nan)
