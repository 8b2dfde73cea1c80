"""Standstills of a device: listed periods, periods found in the inertial data, and the stances of a foot-mounted IMU.

At rest, means over a tenth of a second scatter little within a window of a second: sensor noise averages out, the
motion of a device on wheels, in a hand or on a leg does not. Steady travel turns and shakes a vehicle by more than the
limits. A device at rest does not turn either.

Stances: see `stances`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from smartnav_graph.core.arrays import Floats, Mask, Times, runs
from smartnav_graph.core.errors import ConfigError
from smartnav_graph.core.timebase import NS, Gap
from smartnav_graph.session.calibration.model import ImuNoise
from smartnav_graph.session.detect.blocks import BLOCK_S, Blocks
from smartnav_graph.session.detect.stances import DETECTORS, REST_SPEED, is_foot_mounted, stance_speed
from smartnav_graph.session.session import MOUNTINGS
from smartnav_graph.session.streams import Imu, StaticPeriod

# Nothing that is found at t depends on data later than t + this.
LOOKAHEAD_S = 1.0

# Blocks in a window, blocks at its ends that are left out where it borders on motion, limits of the scatter of block
# means (rad/s, m/s^2): wheels on the smoothest road turn a device by more, and a hand or a walking foot by far.
REST_BLOCKS, REST_MARGIN, REST_RATE, REST_FORCE = 10, 2, 3e-3, 0.05
# A foot at rest differs from a walking one by orders of magnitude; under the weight of the body it moves a little.
FOOT_BLOCKS, FOOT_MARGIN, FOOT_RATE = 7, 1, 12e-3
# Factor on the noise of block means that the scatter of a window at rest stays below.
NOISE_FACTOR = 1.35
# Specific force at rest is gravity, but for the accelerometer's bias (m/s^2); rate is bias, so many sigmas at most.
FORCE_ERROR, BIAS_SIGMAS = 1.0, 4.0
# Turn of a device at rest between two keyframes, rad: at least, and as the time over which its scatter acts.
LEAST_TURN, TURN_TIME = 2e-4, 0.1
# A pedestrian at rest with the device in the hand: scatter of block means, speed (m/s) of the hand. Walking shakes
# by twice that.
STAND_IN_HAND, HAND_SPEED = (0.12, 0.15), 0.1


@dataclass(frozen=True)
class StandstillConfig:
    """Zero velocity at standstills, and zero angular rate where the device is at rest.

    use_listed : use the periods of static.parquet; detect : find standstills in the inertial data
    standing : a pedestrian at rest with the device in the hand has zero velocity, within that of the hand; never on
    wheels
    detector : detector of stances, ``shoe``, ``are`` or ``amv``; mounting : ``foot``, ``body``, or ``auto`` (as the
    session declares it, else by the data)
    zupt : zero velocity at standstills; zaru : zero angular rate at rest; flat_floor : all stances are on one level
    floor_sigma : sigma of a stance's level, m
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
    keyframes, NaN where the device is not at rest; on_foot : the device is mounted on a foot; confirmed : first and
    last stamp of the standstills that are listed or seen by a camera
    """

    t_ns: Times
    speed_sigma: Floats
    turn_sigma: Floats
    on_foot: bool = False
    confirmed: tuple[tuple[int, int], ...] = ()

    @classmethod
    def none(cls, t_ns: Times) -> Standstills:
        """A recording without standstills."""
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
        """First and last stamp of every standstill at rest: without velocity and without turn."""
        return [(int(self.t_ns[i]), int(self.t_ns[j - 1])) for i, j in runs(np.isfinite(self.turn_sigma))]

    def speed_at(self, t_ns: int) -> float:
        """Sigma m/s of the zero velocity at a stamp; NaN in motion."""
        after = int(np.searchsorted(self.t_ns, t_ns))
        before = max(after - (after == len(self.t_ns) or self.t_ns[after] != t_ns), 0)
        one, other = float(self.speed_sigma[before]), float(self.speed_sigma[min(after, len(self.t_ns) - 1)])
        return np.nan if np.isnan(one + other) else max(one, other)

    def over(self, values: Floats, t0_ns: int, t1_ns: int) -> float:
        """Largest of `values` (n,) from t0 to t1; NaN where one is, or where there is no sample."""
        i, j = np.searchsorted(self.t_ns, [t0_ns, t1_ns], side="left")
        part = values[i : j + 1]
        return float(part.max()) if len(part) else np.nan

    def start_of(self, t_ns: int) -> int | None:
        """First stamp of the standstill that a stamp lies in."""
        return next((first for first, last in self.spans() if first <= t_ns <= last), None)

    def share(self, t0_ns: int, t1_ns: int) -> float:
        """Share of the samples from t0 to t1 without velocity."""
        i, j = np.searchsorted(self.t_ns, [t0_ns, t1_ns + 1])
        return float(self.still[i:j].mean()) if j > i else 0.0

    def keyframes(self, inner_s: float | None = None, *, causal: bool = False) -> Times:
        """Borders of all standstills, and stamps at most `inner_s` apart inside them: evenly, or `inner_s` after each
        other where it is not known yet when one ends (`causal`)."""
        stamps = [np.zeros(0, dtype=np.int64)]
        for start, end in self.spans():
            parts = 1 if inner_s is None else max(1, int(np.ceil((end - start) / NS / inner_s - 1e-9)))
            apart = inner_s * NS if causal and inner_s is not None else (end - start) / parts
            stamps += [start + np.rint(np.arange(parts) * apart).astype(np.int64), np.array([end])]
        return np.unique(np.concatenate(stamps))


def find_standstills(
    imu: Imu,
    listed: StaticPeriod | None,
    gaps: Sequence[Gap],
    vehicle: str,
    noise: ImuNoise,
    gravity: float,
    config: StandstillConfig,
    seen: StaticPeriod | None = None,
    available_ns: int | None = None,
) -> Standstills:
    """The standstills of a recording.

    In listed periods the velocity is zero; where the inertial data show that the device is at rest it does not turn
    either. There are no standstills in gaps.

    Parameters
    ----------
    vehicle : none, car, trolley or foot: only on foot, or where nothing is known, can the device be foot-mounted
    noise : of the sensor, densities; gravity m/s^2
    seen : periods in which a camera was at rest
    available_ns : end of the data that show whether the device is mounted on a foot; all of them by default
    """
    found = Standstills.none(imu.t_ns)
    if config.detect and len(imu) > 2:
        blocks = Blocks.of_samples(imu, gaps, gravity)
        known = blocks if available_ns is None else Blocks.of_samples(imu.take(imu.t_ns <= available_ns), gaps, gravity)
        on_foot = config.mounting == "foot" or (config.mounting == "auto" and is_foot_mounted(known, vehicle))
        found = _rests(blocks, imu.t_ns, noise, gravity, on_foot)
        if config.standing and vehicle == "foot" and not on_foot:
            found = replace(found, speed_sigma=np.fmin(found.speed_sigma, _hand_speed(blocks)))
        if on_foot:
            speed = stance_speed(imu, gravity, config.detector)
            found = replace(found, speed_sigma=np.where(np.isnan(speed), found.speed_sigma, speed))
    speed, turn = found.speed_sigma.copy(), found.turn_sigma.copy()
    confirmed: list[tuple[int, int]] = []
    for periods, wanted in ((listed, config.use_listed), (seen, config.detect)):
        if wanted and periods is not None:
            _add(speed, imu.t_ns, periods)
            confirmed += zip(periods.t_ns.tolist(), periods.t_end_ns.tolist(), strict=True)
    for gap in gaps:
        inside = slice(*np.searchsorted(imu.t_ns, [gap.start_ns, gap.end_ns + 1]))
        speed[inside] = turn[inside] = np.nan
    return Standstills(imu.t_ns, speed, turn, found.on_foot, tuple(confirmed))


def _add(speed: Floats, t_ns: Times, periods: StaticPeriod) -> None:
    """Lower the sigmas (n,) m/s of the zero velocity to those of the periods."""
    sigma = np.full(len(periods), REST_SPEED) if periods.sigma_v is None else periods.sigma_v
    for start, end, value in zip(periods.t_ns, periods.t_end_ns, sigma, strict=True):
        inside = slice(np.searchsorted(t_ns, start), np.searchsorted(t_ns, end, side="right"))
        speed[inside] = np.fmin(speed[inside], value)


def _rests(blocks: Blocks, t_ns: Times, noise: ImuNoise, gravity: float, on_foot: bool) -> Standstills:
    """Periods at rest: windows of block means that scatter little, less a margin where they border on motion."""
    width, margin = (FOOT_BLOCKS, FOOT_MARGIN) if on_foot else (REST_BLOCKS, REST_MARGIN)
    if len(blocks.whole) < width:
        return replace(Standstills.none(t_ns), on_foot=on_foot)
    rate, force = (sliding_window_view(x, width, axis=0) for x in (blocks.gyro, blocks.accel))
    per_block = NOISE_FACTOR / np.sqrt(BLOCK_S)
    slow = max(FOOT_RATE if on_foot else REST_RATE, per_block * noise.gyro_noise_density)
    soft = max(REST_FORCE, per_block * noise.accel_noise_density)
    level = np.abs(np.linalg.norm(force.mean(axis=-1), axis=1) - gravity) < FORCE_ERROR
    level &= np.abs(rate.mean(axis=-1)).max(axis=1) < BIAS_SIGMAS * noise.gyro_bias_sigma
    scatter = _quiet_scatter(blocks, width, margin, slow, soft, level)
    turn = np.where(np.isfinite(scatter), np.maximum(LEAST_TURN, TURN_TIME * scatter), np.nan)[blocks.of]
    return Standstills(t_ns, np.where(np.isnan(turn), np.nan, REST_SPEED), turn, on_foot)


def _hand_speed(blocks: Blocks) -> Floats:
    """Sigma (n,) m/s of the hand of a pedestrian at rest; NaN elsewhere."""
    if len(blocks.whole) < REST_BLOCKS:
        return np.full(len(blocks.of), np.nan)
    found = _quiet_scatter(blocks, REST_BLOCKS, REST_MARGIN, *STAND_IN_HAND)
    return np.where(np.isfinite(found), HAND_SPEED, np.nan)[blocks.of]


def _quiet_scatter(
    blocks: Blocks, width: int, margin: int, slow: float, soft: float, where: Mask | bool = True
) -> Floats:
    """Smallest scatter (b,) rad/s of the rate in the quiet windows of `width` blocks that hold each block, infinite
    where there is none.

    Quiet: whole, `where` (k,) is true, and the block means scatter by less than `slow` rad/s and `soft` m/s^2 on every
    axis. Windows that hold the block in their margin do not count; nothing lies before the first and after the last
    block of a recording.
    """
    turning, shaking = (
        sliding_window_view(x, width, axis=0).std(axis=-1).max(axis=1) for x in (blocks.gyro, blocks.accel)
    )
    whole = sliding_window_view(blocks.whole, width).all(axis=1)
    scatter = np.where(whole & where & (turning < slow) & (shaking < soft), turning, np.inf)
    kept = width - 2 * margin
    padded = np.concatenate([np.full(kept - 1, np.inf), scatter, np.full(kept - 1, np.inf)])
    inner = sliding_window_view(padded, kept).min(axis=1)
    return np.concatenate([np.full(margin, scatter[0]), inner, np.full(margin, scatter[-1])])
