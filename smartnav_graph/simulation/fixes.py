"""Position fixes and their errors: white noise, Gauss-Markov process, outliers, outages; pose fixes; control points;
ranges to anchors: white noise, a bias for each anchor, detours of radio waves.

Horizontal sigmas are per axis; the vertical ones are 1.5 times as large.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from smartnav_graph.core.arrays import Floats, Mask, Times
from smartnav_graph.core.errors import ConfigError
from smartnav_graph.core.frames import LocalFrame
from smartnav_graph.core.so3 import exp, quaternion, rotate
from smartnav_graph.core.timebase import NS
from smartnav_graph.session.streams import ControlPoint, GnssFix, PoseFix, Ranges
from smartnav_graph.simulation.trajectory import Truth

AXES = np.array([1.0, 1.0, 1.5])
BURST_S = (4.0, 9.0)
# Corners of a hall, two metres and more over the device.
HALL = ((-16.0, -8.0, 2.0), (5.0, -8.0, 3.0), (5.0, 8.0, 2.0), (-16.0, 8.0, 3.0))


@dataclass(frozen=True)
class Outliers:
    """`share` of the fixes is off by `low_m` .. `high_m` in a random horizontal direction.

    kind ``isolated``: single fixes, never two in a row. kind ``burst``: runs of 4 to 9 s that share one offset.
    """

    kind: str
    share: float
    low_m: float
    high_m: float

    def __post_init__(self) -> None:
        if self.kind not in ("isolated", "burst"):
            raise ConfigError("--outliers", f"kind {self.kind!r}", "isolated or burst")
        if not 0.0 < self.share <= 0.45:
            raise ConfigError("--outliers", f"share {self.share}", "a share above 0, up to 0.45")
        if not 0.0 < self.low_m <= self.high_m:
            raise ConfigError("--outliers", f"size {self.low_m}-{self.high_m} m", "0 < smallest <= largest")


@dataclass(frozen=True)
class GnssModel:
    """A receiver: `rate_hz`, white sigma, Gauss-Markov sigma and correlation time, lever arm, outages (start s,
    length s) and outliers; `velocity_m_s` > 0 is the sigma of velocities that come with the fixes; a fix stamped t is
    valid at the time t + `offset_s`."""

    rate_hz: float = 1.0
    white_m: float = 3.0
    markov_m: float = 0.0
    markov_s: float = 60.0
    body_t_antenna: tuple[float, float, float] = (0.0, 0.0, 0.0)
    outages: tuple[tuple[float, float], ...] = ()
    outliers: Outliers | None = None
    velocity_m_s: float = 0.0
    offset_s: float = 0.0


@dataclass(frozen=True)
class PoseFixModel:
    """Pose fixes every `every_s` seconds from `first_s` on, position sigma m and attitude sigma rad per axis (0: no
    attitude), arriving `latency_s` after their stamp."""

    every_s: float = 5.0
    first_s: float = 2.0
    sigma_m: float = 0.3
    sigma_rad: float = 0.035
    latency_s: float = 0.0


@dataclass(frozen=True)
class RangeModel:
    """Two-way ranging at `rate_hz` with all `anchors` (e, n, u m) at once: white noise and bias of an anchor, sigma m;
    a share of `detours` is longer by `detour_m` (least, most)."""

    anchors: tuple[tuple[float, float, float], ...] = HALL
    rate_hz: float = 2.0
    sigma_m: float = 0.1
    bias_sigma_m: float = 0.2
    detours: float = 0.0
    detour_m: tuple[float, float] = (2.0, 8.0)
    body_t_sensor: tuple[float, float, float] = (0.0, 0.0, 0.0)


def white(n: int, sigma: float, rng: np.random.Generator) -> Floats:
    """(n, 3) m: independent errors, `sigma` per horizontal axis."""
    return np.asarray(sigma * AXES * rng.standard_normal((n, 3)))


def gauss_markov(t_ns: Times, sigma: float, tau_s: float, rng: np.random.Generator) -> Floats:
    """(n, 3) m: stationary first-order Gauss-Markov errors with E[x(t) x(t + d)] = sigma^2 exp(-|d| / tau).

    x_k+1 = phi x_k + sigma sqrt(1 - phi^2) n, phi = exp(-dt / tau), x_0 = sigma n (Gelb 1974, ch. 3.6).
    """
    drive = rng.standard_normal((len(t_ns), 3))
    phi = np.exp(-np.diff(t_ns) / NS / tau_s)
    rows = [drive[0]] if len(drive) else []
    for k, p in enumerate(phi):
        rows.append(p * rows[-1] + np.sqrt(1.0 - p * p) * drive[k + 1])
    return np.asarray(sigma * AXES * np.array(rows).reshape(-1, 3))


def place_runs(n: int, lengths: Sequence[int], rng: np.random.Generator, *, apart: bool) -> list[int]:
    """First rows of runs of these lengths, put at random without overlap into n rows, in this order.

    `apart` keeps at least one free row between two runs.

    Raises
    ------
    ConfigError
        There are too few rows.
    """
    free = n - sum(lengths)
    slots = free + 1 if apart else free + len(lengths)
    if free < 0 or len(lengths) > slots:
        raise ConfigError("degrade", f"{sum(lengths)} faulty rows of {n}", "fewer faults than rows", "lower the share")
    chosen = np.sort(rng.choice(slots, len(lengths), replace=False))
    before = np.cumsum([0, *lengths[:-1]])[: len(lengths)]
    return [int(row) for row in (chosen + before if apart else chosen + before - np.arange(len(lengths)))]


def outlier_errors(t_ns: Times, outliers: Outliers, rng: np.random.Generator) -> tuple[Floats, Mask]:
    """Errors (n, 3) m, zero but for the outliers, and their mask (n,): exactly round(share n) of them.

    The last burst is cut to keep the count.
    """
    n = len(t_ns)
    left = round(outliers.share * n)
    period = float(np.median(np.diff(t_ns))) / NS if n > 1 else 1.0
    lengths: list[int] = []
    while left > 0:
        wanted = 1 if outliers.kind == "isolated" else max(1, round(float(rng.uniform(*BURST_S)) / period))
        lengths.append(min(wanted, left))
        left -= lengths[-1]
    errors, mask = np.zeros((n, 3)), np.zeros(n, dtype=bool)
    for row, length in zip(place_runs(n, lengths, rng, apart=True), lengths, strict=True):
        size, angle = rng.uniform(outliers.low_m, outliers.high_m), rng.uniform(0.0, 2 * np.pi)
        errors[row : row + length] = size * np.array([np.cos(angle), np.sin(angle), 0.0])
        mask[row : row + length] = True
    return errors, mask


def gnss(truth: Truth, t_ns: Times, model: GnssModel, frame: LocalFrame, rng: np.random.Generator) -> GnssFix:
    """Fixes of the antenna at `truth` (one row per fix); the sigma columns hold the white part only.

    Column `is_outlier` (kept in `extra`) marks outliers with 1.
    """
    received = np.ones(len(truth), dtype=bool)
    for start, length in model.outages:
        received &= ~((truth.t >= start) & (truth.t < start + length))
    truth, t_ns = truth.take(received), t_ns[received]
    n = len(t_ns)
    enu = truth.nav_t_body + truth.nav_R_body @ np.asarray(model.body_t_antenna) + white(n, model.white_m, rng)
    if model.markov_m > 0:
        enu = enu + gauss_markov(t_ns, model.markov_m, model.markov_s, rng)
    mask = np.zeros(n, dtype=bool)
    if model.outliers is not None:
        errors, mask = outlier_errors(t_ns, model.outliers, rng)
        enu = enu + errors
    sigma = np.tile(model.white_m * AXES, (n, 1))
    extra = {"is_outlier": mask.astype(np.int64)} if model.outliers is not None else {}
    fix = GnssFix(t_ns=t_ns, lla=frame.lla_from_nav(enu), sigma=sigma, extra=extra)
    if model.velocity_m_s > 0:
        arm = np.cross(truth.body_rate, model.body_t_antenna)
        velocity = truth.nav_v_body + rotate(truth.nav_R_body, arm)
        velocity = velocity + white(n, model.velocity_m_s, rng)
        fix = replace(fix, velocity=velocity, sigma_velocity=np.tile(model.velocity_m_s * AXES, (n, 1)))
    return fix


def simulate_pose_fixes(
    truth: Truth, t_ns: Times, model: PoseFixModel, frame: LocalFrame, rng: np.random.Generator
) -> PoseFix:
    """Pose fixes of the body at `truth` (one row per fix): the attitude is Exp(error) nav_R_body, error in nav axes."""
    n = len(t_ns)
    enu = truth.nav_t_body + model.sigma_m * rng.standard_normal((n, 3))
    turn = exp(model.sigma_rad * rng.standard_normal((n, 3)))
    fix = PoseFix(
        t_ns=t_ns,
        lla=frame.lla_from_nav(enu),
        sigma=np.full((n, 3), model.sigma_m),
        arrival_ns=t_ns + round(model.latency_s * NS) if model.latency_s else None,
        source=np.full(n, "simulation", dtype=object),
    )
    if model.sigma_rad > 0:
        quat = quaternion(turn @ truth.nav_R_body)
        fix = replace(fix, quat=quat, sigma_rot=np.full((n, 3), model.sigma_rad))
    return fix


def control(
    truth: Truth, t_ns: Times, names: Sequence[str], sigma_m: float, frame: LocalFrame, rng: np.random.Generator
) -> ControlPoint:
    """Surveyed points under the device at `truth` (one row per point), off by `sigma_m` per axis."""
    n = len(t_ns)
    enu = truth.nav_t_body + sigma_m * rng.standard_normal((n, 3))
    sigma = np.full((n, 3), sigma_m)
    return ControlPoint(t_ns=t_ns, lla=frame.lla_from_nav(enu), point_id=np.array(names, dtype=object), sigma=sigma)


def ranges(truth: Truth, t_ns: Times, model: RangeModel, frame: LocalFrame, rng: np.random.Generator) -> Ranges:
    """Ranges at `truth`, one row an epoch and anchor. Column `is_outlier` (kept in `extra`) marks detours with 1."""
    anchors, n = np.array(model.anchors), len(model.anchors)
    bias = model.bias_sigma_m * rng.standard_normal(n)
    sensor = truth.nav_t_body + truth.nav_R_body @ np.asarray(model.body_t_sensor)
    distance = np.linalg.norm(sensor[:, None] - anchors, axis=2)
    detour = rng.random(distance.shape) < model.detours
    error = (
        bias
        + model.sigma_m * rng.standard_normal(distance.shape)
        + detour * rng.uniform(*model.detour_m, distance.shape)
    )
    return Ranges(
        t_ns=np.repeat(t_ns, n),
        anchor_id=np.tile(np.array([f"A{i}" for i in range(n)], dtype=object), len(t_ns)),
        range_m=np.maximum(distance + error, 0.0).ravel(),
        sigma=np.full(distance.size, model.sigma_m),
        lla=np.tile(frame.lla_from_nav(anchors), (len(t_ns), 1)),
        extra={"is_outlier": detour.ravel().astype(np.int64)} if model.detours else {},
    )
