"""When a device stands still: listed periods, rests found in the inertial data, and the stances of a foot-mounted IMU.

Rest. Means over a tenth of a second hardly scatter within a window of a second: sensor noise averages out, and what
carries a moving device (wheels on a road, a hand, a leg) does not. Steady travel turns and shakes a vehicle by more
than the limits. Truly at rest, the device does not turn either.

Stance. Each step a foot stands for some tenths of a second while the rest of it rolls: no rest, but a velocity of
centimetres a second. A statistic of a few samples, by name:

    SHOE  sum |a - g mean(a) / |mean(a)||^2 / sa^2 + |w|^2 / sw^2     stance hypothesis optimal detector (GLRT)
    ARE   sum |w|^2 / sw^2                                            angular rate energy
    AMV   sum |a - mean(a)|^2 / sa^2                                  acceleration moving variance

all over the number of samples, is compared on a logarithmic scale with a threshold that follows the quietest moment
of the second around: slow walkers stand more quietly than runners. The statistic also tells how fast a sensor above a
rolling foot can be, and that is the sigma of its zero velocity.

Source: Skog, Handel, Nilsson, Rantakokko (2010), Zero-velocity detection, IEEE T-BME 57(11).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter1d, uniform_filter1d

from smartnav_graph.core.arrays import Floats, Mask, Times
from smartnav_graph.core.errors import ConfigError
from smartnav_graph.core.timebase import NS, Gap
from smartnav_graph.session.calibration.model import ImuNoise
from smartnav_graph.session.streams import Imu, StaticPeriod

# Nothing that is found at t rests on data later than t + this.
LOOKAHEAD_S = 1.0
MOUNTINGS = ("auto", "foot", "body")

# --- rest ---
BLOCK_S = 0.1
# Blocks in a window, blocks at its ends that are left out where it borders on motion, limits of the scatter of block
# means (rad/s, m/s^2): wheels on the smoothest road turn a device by more, and a hand or a walking foot by far.
REST_BLOCKS, REST_MARGIN, REST_RATE, REST_FORCE = 10, 2, 3e-3, 0.05
# A foot's rest is told from its walking by orders of magnitude; who stands on it shifts his weight.
FOOT_BLOCKS, FOOT_MARGIN, FOOT_RATE = 7, 1, 12e-3
# Factor on the noise of block means that the scatter of a window at rest stays below.
NOISE_FACTOR = 1.35
# Specific force at rest is gravity, but for the accelerometer's bias (m/s^2); rate is bias, so many sigmas at most.
FORCE_ERROR, BIAS_SIGMAS = 1.0, 4.0
REST_SPEED = 0.01  # m/s
# Turn of a device at rest between two keyframes, rad: at least, and as the time over which its scatter acts.
LEAST_TURN, TURN_TIME = 2e-4, 0.1

# Who stands with a device in the hand: scatter of block means, speed (m/s) of the hand. Walking shakes by twice that.
STAND_IN_HAND, HAND_SPEED = (0.12, 0.15), 0.1

# --- stance ---
FORCE_UNIT, RATE_UNIT = 0.01, float(np.radians(0.1))  # sa m/s^2, sw rad/s
STANCE_S = 0.025
AROUND_S = 1.0
# Decades above the quietest moment, and bounds of the threshold (decades).
ABOVE, LOWEST, HIGHEST = 1.3, 4.2, 6.6
SHORTEST_S = 0.03
ARM = 0.03  # m from the point the foot turns about to the sensor
# A foot swings faster (rad/s) and is set down harder (m/s^2 beside gravity) than what is carried; it stands in between.
SWING_RATE, IMPACT, STAND_RATE, STAND_FORCE, STRIDE_S, STAND_SHARE = 4.0, 15.0, 1.0, 2.0, 1.5, 0.08
# Longest windows (s) of a foot-mounted IMU in and between stances.
STANCE_SPACING_S, SWING_S = 0.1, 0.2


@dataclass(frozen=True)
class StandstillConfig:
    """Zero velocity at standstills, and no turn where the device is truly at rest.

    use_listed : use the periods of static.parquet; detect : find standstills in the inertial data
    standing : a walker who stands with the device in the hand has no velocity, within the hand's; never on wheels
    detector : ``shoe``, ``are`` or ``amv``, for stances; mounting : ``foot``, ``body``, or ``auto`` (by the data)
    zupt, zaru : zero velocity, zero turn; flat_floor : all stances are on one level, to floor_sigma m
    """

    use_listed: bool = True
    detect: bool = True
    standing: bool = True
    detector: str = "shoe"
    mounting: str = "auto"
    zupt: bool = True
    zaru: bool = True
    flat_floor: bool = False
    floor_sigma: float = 0.02

    def __post_init__(self) -> None:
        for name, value, known in (
            ("detector", self.detector, tuple(DETECTORS)),
            ("mounting", self.mounting, MOUNTINGS),
        ):
            if value not in known:
                raise ConfigError("config [standstill]", f"{name} = {value!r}", f"one of {', '.join(known)}")
        if not self.floor_sigma > 0:
            raise ConfigError("config [standstill]", f"floor_sigma = {self.floor_sigma}", "> 0 m")


@dataclass(frozen=True)
class Standstills:
    """Standstills of a recording, at its inertial samples.

    t_ns (n,); speed_sigma (n,) m/s of the zero velocity, NaN in motion; turn_sigma (n,) rad of the turn between two
    keyframes, NaN where not truly at rest; on_foot : the device is mounted on a foot; told : first and last stamp of
    the standstills that are listed or that a camera saw
    """

    t_ns: Times
    speed_sigma: Floats
    turn_sigma: Floats
    on_foot: bool = False
    told: tuple[tuple[int, int], ...] = ()

    @classmethod
    def none(cls, t_ns: Times) -> Standstills:
        """A recording that never stands still."""
        unknown = np.full(len(t_ns), np.nan)
        return cls(t_ns, unknown, unknown)

    @property
    def still(self) -> Mask:
        """Mask (n,) of the samples without velocity."""
        return np.isfinite(self.speed_sigma)

    def spans(self) -> list[tuple[int, int]]:
        """First and last stamp of every standstill."""
        return [(int(self.t_ns[i]), int(self.t_ns[j - 1])) for i, j in runs(self.still)]

    def rests(self) -> list[tuple[int, int]]:
        """First and last stamp of every true rest."""
        return [(int(self.t_ns[i]), int(self.t_ns[j - 1])) for i, j in runs(np.isfinite(self.turn_sigma))]

    def speed_at(self, t_ns: int) -> float:
        """Sigma m/s of the zero velocity at a stamp; NaN in motion."""
        after = int(np.searchsorted(self.t_ns, t_ns))
        before = max(after - (after == len(self.t_ns) or self.t_ns[after] != t_ns), 0)
        pair = self.speed_sigma[[before, min(after, len(self.t_ns) - 1)]]
        return float(pair.max())  # NaN where either is

    def over(self, values: Floats, t0_ns: int, t1_ns: int) -> float:
        """Largest of `values` (n,) from t0 to t1; NaN where one is, or where there is no sample."""
        i, j = np.searchsorted(self.t_ns, [t0_ns, t1_ns], side="left")
        part = values[i : j + 1]
        return float(part.max()) if len(part) else np.nan

    def keyframes(self, inner_s: float | None = None) -> Times:
        """Borders of all standstills, and stamps at most `inner_s` apart inside them."""
        stamps = [np.zeros(0, dtype=np.int64)]
        for start, end in self.spans():
            parts = 1 if inner_s is None else max(1, int(np.ceil((end - start) / NS / inner_s - 1e-9)))
            stamps.append(start + np.rint(np.arange(parts + 1) / parts * (end - start)).astype(np.int64))
        return np.unique(np.concatenate(stamps))


def runs(mask: Mask) -> NDArray[np.intp]:
    """First row and row after the last (k, 2) of every run of true values."""
    edges = np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8))
    return np.stack([np.flatnonzero(edges > 0), np.flatnonzero(edges < 0)], axis=1)


def find_standstills(
    imu: Imu,
    use_listed: StaticPeriod | None,
    gaps: Sequence[Gap],
    vehicle: str,
    noise: ImuNoise,
    gravity: float,
    config: StandstillConfig,
    seen: StaticPeriod | None = None,
) -> Standstills:
    """The standstills of a recording.

    Listed periods hold for the velocity; where the inertial data show that the device is truly at rest it does not
    turn either. Gaps hold nothing.

    Parameters
    ----------
    vehicle : none, car, trolley or foot: only on foot, or where nothing is known, can the device be foot-mounted
    noise : of the sensor, densities; gravity m/s^2
    seen : periods in which a camera stood still
    """
    found = Standstills.none(imu.t_ns)
    if config.detect and len(imu) > 2:
        blocks = _Blocks.cut(imu, gaps, gravity)
        on_foot = config.mounting == "foot" or (config.mounting == "auto" and _walks(blocks, vehicle))
        found = _rests(blocks, imu.t_ns, noise, gravity, on_foot)
        if config.standing and vehicle == "foot" and not on_foot:
            found = replace(found, speed_sigma=np.fmin(found.speed_sigma, _standing(blocks)))
        if on_foot:
            speed = stance_speed(imu, gravity, config.detector)
            speed = np.where(np.isnan(speed), found.speed_sigma, speed)
            found = Standstills(imu.t_ns, speed, found.turn_sigma, True)
    told: list[tuple[int, int]] = []
    for periods, wanted in ((use_listed, config.use_listed), (seen, config.detect)):
        if wanted and periods is not None:
            found = _with_listed(found, periods)
            told += zip(periods.t_ns.tolist(), periods.t_end_ns.tolist(), strict=True)
    speed, turn = found.speed_sigma.copy(), found.turn_sigma.copy()
    for gap in gaps:
        inside = slice(*np.searchsorted(imu.t_ns, [gap.start_ns, gap.end_ns + 1]))
        speed[inside] = turn[inside] = np.nan
    return Standstills(imu.t_ns, speed, turn, found.on_foot, tuple(told))


def _with_listed(found: Standstills, use_listed: StaticPeriod) -> Standstills:
    speed = found.speed_sigma.copy()
    sigma = np.full(len(use_listed), REST_SPEED) if use_listed.sigma_v is None else use_listed.sigma_v
    for start, end, value in zip(use_listed.t_ns, use_listed.t_end_ns, sigma, strict=True):
        inside = slice(np.searchsorted(found.t_ns, start), np.searchsorted(found.t_ns, end, side="right"))
        speed[inside] = np.fmin(speed[inside], value)
    return Standstills(found.t_ns, speed, found.turn_sigma, found.on_foot)


# --- rest -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Blocks:
    """The inertial data by tenths of a second from the first sample on.

    accel, gyro (b, 3) means; norm, rate (b,) largest | |a| - g | and |w|; calm_norm, calm_rate (b,) their root mean
    squares; whole (b,) has samples and no gap; of (n,) block of each sample
    """

    accel: Floats
    gyro: Floats
    norm: Floats
    rate: Floats
    calm_norm: Floats
    calm_rate: Floats
    whole: Mask
    of: NDArray[np.intp]

    @classmethod
    def cut(cls, imu: Imu, gaps: Sequence[Gap], gravity: float) -> _Blocks:
        of = (imu.t_ns - imu.t_ns[0]) // round(BLOCK_S * NS)
        used, starts, count = np.unique(of, return_index=True, return_counts=True)
        norm, rate = np.abs(np.linalg.norm(imu.accel, axis=1) - gravity), np.linalg.norm(imu.gyro, axis=1)
        size = int(used[-1]) + 1

        def spread(values: Floats) -> Floats:
            out = np.full((size, *values.shape[1:]), np.nan)
            out[used] = values
            return out

        def mean(rows: Floats) -> Floats:
            return np.asarray((np.add.reduceat(rows, starts).T / count).T)

        whole = np.zeros(size, dtype=bool)
        whole[used] = True
        for gap in gaps:
            first, last = (np.array([gap.start_ns, gap.end_ns]) - imu.t_ns[0]) // round(BLOCK_S * NS)
            whole[first : last + 1] = False
        return cls(
            accel=spread(mean(imu.accel)),
            gyro=spread(mean(imu.gyro)),
            norm=spread(np.maximum.reduceat(norm, starts)),
            rate=spread(np.maximum.reduceat(rate, starts)),
            calm_norm=spread(np.sqrt(mean(norm**2))),
            calm_rate=spread(np.sqrt(mean(rate**2))),
            whole=whole,
            of=of,
        )


def _walks(blocks: _Blocks, vehicle: str) -> bool:
    """Whether the device is mounted on a walking foot: it swings and is set down hard, and stands in between.

    A fact of the whole recording, like the vehicle; `StandstillConfig.mounting` declares it.
    """
    stride = round(STRIDE_S / BLOCK_S)
    if vehicle not in ("none", "foot") or len(blocks.rate) < stride:
        return False
    around = [
        np.nan_to_num(np.nanmax(sliding_window_view(np.nan_to_num(x), stride), axis=1))
        for x in (blocks.rate, blocks.norm)
    ]
    walking = (around[0] > SWING_RATE) & (around[1] > IMPACT)
    middle = slice(stride // 2, stride // 2 + len(walking))
    stands = (blocks.calm_rate[middle] < STAND_RATE) & (blocks.calm_norm[middle] < STAND_FORCE)
    return bool(walking.sum() > 2 * stride and stands[walking].mean() > STAND_SHARE)


def _rests(blocks: _Blocks, t_ns: Times, noise: ImuNoise, gravity: float, on_foot: bool) -> Standstills:
    """True rests: windows of block means that hardly scatter, less a margin where they border on motion."""
    width, margin = (FOOT_BLOCKS, FOOT_MARGIN) if on_foot else (REST_BLOCKS, REST_MARGIN)
    if len(blocks.whole) < width:
        return Standstills.none(t_ns)
    rate, force = (sliding_window_view(x, width, axis=0) for x in (blocks.gyro, blocks.accel))
    turning, shaking = _scatter(rate), _scatter(force)
    per_block = NOISE_FACTOR / np.sqrt(BLOCK_S)
    slow = max(FOOT_RATE if on_foot else REST_RATE, per_block * noise.gyro_noise_density)
    soft = max(REST_FORCE, per_block * noise.accel_noise_density)
    level = np.abs(np.linalg.norm(force.mean(axis=-1), axis=1) - gravity) < FORCE_ERROR
    level &= np.abs(rate.mean(axis=-1)).max(axis=1) < BIAS_SIGMAS * noise.gyro_bias_sigma
    whole = sliding_window_view(blocks.whole, width).all(axis=1)
    quiet = whole & (turning < slow) & (shaking < soft) & level
    scatter = _spread(np.where(quiet, turning, np.inf), width, margin)
    turn = np.where(np.isfinite(scatter), np.maximum(LEAST_TURN, TURN_TIME * scatter), np.nan)[blocks.of]
    return Standstills(t_ns, np.where(np.isnan(turn), np.nan, REST_SPEED), turn, on_foot)


def _scatter(windows: Floats) -> Floats:
    """Largest standard deviation (k,) over the axes of windows (k, 3, width)."""
    return np.asarray(windows.std(axis=-1).max(axis=1))


def _standing(blocks: _Blocks) -> Floats:
    """Sigma (n,) m/s of the hand of somebody who stands; NaN where nobody does."""
    if len(blocks.whole) < REST_BLOCKS:
        return np.full(len(blocks.of), np.nan)
    turning, shaking = (_scatter(sliding_window_view(x, REST_BLOCKS, axis=0)) for x in (blocks.gyro, blocks.accel))
    whole = sliding_window_view(blocks.whole, REST_BLOCKS).all(axis=1)
    quiet = whole & (turning < STAND_IN_HAND[0]) & (shaking < STAND_IN_HAND[1])
    found = _spread(np.where(quiet, turning, np.inf), REST_BLOCKS, REST_MARGIN)
    return np.where(np.isfinite(found), HAND_SPEED, np.nan)[blocks.of]


def _spread(scatter: Floats, width: int, margin: int) -> Floats:
    """Smallest scatter (b,) of the windows (b - width + 1,) around each block, those that hold it in their margin left
    out; nothing lies before the first and after the last block of a recording."""
    kept = width - 2 * margin
    padded = np.concatenate([np.full(kept - 1, np.inf), scatter, np.full(kept - 1, np.inf)])
    inner = sliding_window_view(padded, kept).min(axis=1)
    return np.concatenate([np.full(margin, scatter[0]), inner, np.full(margin, scatter[-1])])


# --- stance -----------------------------------------------------------------------------------------------------------


def _mean(rows: Floats, width: int) -> Floats:
    return np.asarray(uniform_filter1d(rows, width, axis=0, mode="nearest"))


def _rate_energy(imu: Imu, width: int) -> Floats:
    return _mean((imu.gyro**2).sum(axis=1), width) / RATE_UNIT**2


def shoe(imu: Imu, width: int, gravity: float) -> Floats:
    """Statistic (n,) of the stance hypothesis over `width` samples around each."""
    mean = _mean(imu.accel, width)
    size = np.linalg.norm(mean, axis=1)
    force = _mean((imu.accel**2).sum(axis=1), width) - 2.0 * gravity * size + gravity**2
    return np.asarray(force / FORCE_UNIT**2 + _rate_energy(imu, width))


def angular_rate_energy(imu: Imu, width: int, gravity: float) -> Floats:
    """Statistic (n,) of the rate alone."""
    return _rate_energy(imu, width)


def acceleration_variance(imu: Imu, width: int, gravity: float) -> Floats:
    """Statistic (n,) of the force's variance alone."""
    centred = imu.accel - imu.accel.mean(axis=0)
    variance = (_mean(centred**2, width) - _mean(centred, width) ** 2).sum(axis=1)
    return np.asarray(np.maximum(variance, 0.0) / FORCE_UNIT**2)


DETECTORS: dict[str, Callable[[Imu, int, float], Floats]] = {
    "shoe": shoe,
    "are": angular_rate_energy,
    "amv": acceleration_variance,
}


def stance_speed(imu: Imu, gravity: float, detector: str = "shoe") -> Floats:
    """Sigma (n,) m/s of a standing foot's velocity at its sensor; NaN while it swings.

    sigma = ARM sqrt(T) RATE_UNIT: if all of the statistic T were rate, the speed at `ARM` from the turning point.
    """
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
