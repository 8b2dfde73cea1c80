"""Drift between fixes (simulated outages).

For each spacing the fixes are thinned to it (or generated from the reference, with noise), the session is replayed and
then smoothed, and both are compared with the reference rows in between:

    smoothed     the final smoothed solution at every reference row that is not a fix
    causal       the real-time estimate at that time: inertial prediction from the latest keyframe
    causal_end   the same just before the next fix becomes available, once an interval

The causal kinds begin after the initialisation of the replay.

A reference from which the fixes were generated has the sensor model of these fixes: its rows are compared at
t + time offset, with the lever arm (see `assemble.score_holdout`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from smartnav_graph.core.arrays import Floats, Times
from smartnav_graph.core.errors import ConfigError, SessionError
from smartnav_graph.core.progress import Progress, silent, under
from smartnav_graph.core.so3 import exp, from_quaternion, quaternion
from smartnav_graph.core.timebase import NS, nearest
from smartnav_graph.estimate.config import Config
from smartnav_graph.estimate.replay import replay
from smartnav_graph.estimate.result.assemble import predict_sensor, sensor_positions
from smartnav_graph.estimate.run import Run
from smartnav_graph.evaluation.metrics import Statistics
from smartnav_graph.graph.interpolate import kinematics, predicted_at
from smartnav_graph.session.session import Session
from smartnav_graph.session.streams import ABSOLUTE, PoseFix, Reference

# Largest time between a fix and the reference row from which it is generated, s.
NEAR_S = 0.1
FIXES = "pose_fixes"


@dataclass(frozen=True)
class FixesFromReference:
    """Fixes generated from the reference: Gaussian errors of `sigma_m` and `sigma_deg` on each axis (no attitude where
    `sigma_deg` is None), available `latency_s` after their time of measurement."""

    sigma_m: float
    sigma_deg: float | None = None
    latency_s: float = 0.0

    def __post_init__(self) -> None:
        if not (self.sigma_m > 0 and (self.sigma_deg is None or self.sigma_deg > 0) and self.latency_s >= 0):
            raise ConfigError(
                "--fix-sigma, --latency",
                f"{self.sigma_m} m, {self.sigma_deg} deg, {self.latency_s} s",
                "sigmas > 0 and a latency >= 0",
            )


@dataclass(frozen=True)
class Interval:
    """Errors of one spacing, kind and seed over `n` rows: mean, percentiles and RMS, in space (``_m``) and in plan
    (``horizontal_..._m``)."""

    every_s: float
    kind: str
    seed: int
    n: int
    mean_m: float
    p67_m: float | None
    p95_m: float | None
    rmse_m: float
    horizontal_mean_m: float
    horizontal_p67_m: float | None
    horizontal_p95_m: float | None
    horizontal_rmse_m: float

    @classmethod
    def of(cls, every_s: float, kind: str, seed: int, error: Floats) -> Interval:
        """Of errors (n, 3) m, nav axes."""
        space, plan = (Statistics.of(np.linalg.norm(rows, axis=1)) for rows in (error, error[:, :2]))
        return cls(
            *(every_s, kind, seed, len(error)),
            *(space.mean, space.p67, space.p95, space.rmse),
            *(plan.mean, plan.p67, plan.p95, plan.rmse),
        )

    def to_dict(self) -> dict[str, float | int | str | None]:
        """As ``smartnav intervals --json`` prints it."""
        return asdict(self)


def intervals(
    session: Session,
    reference: Reference,
    every_s: Sequence[float],
    *,
    generated: FixesFromReference | None = None,
    seeds: int = 1,
    config: Config | None = None,
    progress: Progress = silent,
) -> Iterator[Interval]:
    """Three kinds of error for every spacing and seed, as they are computed.

    Parameters
    ----------
    session : with fixes of its own, or any with `generated`
    reference : trajectory in the same frame, on the session's clock
    every_s : spacings of the fixes, s
    generated : generate the fixes from the reference, one set a seed (0, 1, ...); the session's own are left out
    config : options of the replay

    Raises
    ------
    SessionError, ConfigError, SolverError
        No fixes, no common time, a spacing that leaves fewer than two fixes, or what `replay` raises.
    """
    wrong = [spacing for spacing in every_s if not spacing > 0]
    if wrong:
        raise ConfigError("--every", f"{wrong[0]}", "spacings > 0 s")
    config = config or Config()
    config = replace(config, run=replace(config.run, rate="keyframes"))
    runs = [(spacing, seed) for spacing in every_s for seed in range(seeds if generated else 1)]
    for count, (spacing, seed) in enumerate(runs, 1):
        fixed = with_fixes(session, reference, spacing, generated, seed) if generated else _thinned(session, spacing)
        watch = under(f"run {count} of {len(runs)}", progress)
        run = replay(fixed, config, progress=watch)
        yield from _scored(run, reference, spacing, seed, bool(generated))


def with_fixes(
    session: Session, reference: Reference, every_s: float, generated: FixesFromReference, seed: int
) -> Session:
    """The session with fixes generated from the reference as its only absolute stream."""
    imu = session.require_imu()
    inside = np.flatnonzero((reference.t_ns >= imu.t_ns[0]) & (reference.t_ns <= imu.t_ns[-1]))
    if not len(inside):
        raise SessionError("reference", "has no row inside the inertial span", "one clock for both")
    truth = reference.take(inside)
    grid = np.arange(int(truth.t_ns[0]), int(truth.t_ns[-1]) + 1, round(every_s * NS))
    rows = nearest(grid, truth.t_ns)
    rows = np.unique(rows[np.abs(truth.t_ns[rows] - grid) <= NEAR_S * NS])
    others = dict.fromkeys(set(ABSOLUTE) - {FIXES})
    return _checked(session.replace(**others, pose_fixes=_noisy(truth.take(rows), generated, seed)), every_s)


def _noisy(truth: Reference, generated: FixesFromReference, seed: int) -> PoseFix:
    rng, n = np.random.default_rng(seed), len(truth)
    position, attitude = rng.standard_normal((n, 3)), rng.standard_normal((n, 3))
    fixes = PoseFix(
        t_ns=truth.t_ns,
        enu=truth.enu + generated.sigma_m * position,
        sigma=np.full((n, 3), generated.sigma_m),
        arrival_ns=truth.t_ns + round(generated.latency_s * NS) if generated.latency_s > 0 else None,
    )
    if generated.sigma_deg is None:
        return fixes
    if truth.quat is None:
        raise SessionError("reference", "has no attitude", "qw, qx, qy, qz", "give --fix-sigma without degrees")
    sigma = np.radians(generated.sigma_deg)
    quat = quaternion(exp(sigma * attitude) @ from_quaternion(truth.quat))
    return replace(fixes, quat=quat, sigma_rot=np.full((n, 3), sigma))


def _thinned(session: Session, every_s: float) -> Session:
    """The session with the first row of each absolute stream in every stretch of `every_s`."""
    changes = {}
    for name, stream in session.absolute().items():
        slot = (stream.t_ns - session.t0_ns) // round(every_s * NS)
        changes[name] = stream.take(np.unique(slot, return_index=True)[1])
    return _checked(session.replace(**changes), every_s)


def _checked(session: Session, every_s: float) -> Session:
    count = len(_fix_times(session))
    if count < 2:
        raise SessionError(
            session.path or "session",
            f"{count} fixes with one in {every_s:g} s",
            "at least two",
            "give --fixes-from-reference, or a shorter --every",
        )
    return session


def _fix_times(session: Session) -> Times:
    """Stamps of all fixes, each once, in order."""
    stamps = (stream.t_ns for stream in session.absolute().values())
    return np.unique(np.concatenate([np.zeros(0, np.int64), *stamps]))


def _scored(run: Run, reference: Reference, every_s: float, seed: int, generated: bool) -> Iterator[Interval]:
    """The three rows of one replay."""
    sensor = ReferencePoint.of(run) if generated else ReferencePoint()
    times = _fix_times(run.session)
    between = (reference.t_ns > times[0]) & (reference.t_ns < times[-1]) & ~np.isin(reference.t_ns, times)
    rows = reference.take(between & (reference.t_ns <= run.solution.t_ns[-1]))
    ends = np.unique(np.concatenate([stream.available_ns for stream in run.session.absolute().values()]))
    ends = ends[(ends > times[0]) & (ends <= run.solution.t_ns[-1])]
    last = np.searchsorted(reference.t_ns, ends, side="right") - 1
    last = last[(last >= 0) & (reference.t_ns[last] > ends - NEAR_S * NS)]
    for kind, truth in (("smoothed", rows), ("causal", rows), ("causal_end", reference.take(last))):
        if kind != "smoothed":
            truth = truth.take(truth.t_ns > run.solution.t_ns[0] + round(run.summary["delay_s"] * NS))
        if not len(truth):
            raise SessionError("reference", f"has no row for {kind} between the fixes", "one clock for both")
        found = sensor.smoothed(run, truth.t_ns) if kind == "smoothed" else sensor.causal(run, truth.t_ns)
        yield Interval.of(every_s, kind, seed, found - truth.enu)


@dataclass(frozen=True)
class ReferencePoint:
    """The point of the body whose position the reference gives: at `lever` (3,) m body axes; a stamp t of the reference
    is IMU time t + `offset_s`."""

    offset_s: float = 0.0
    lever: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @classmethod
    def of(cls, run: Run) -> ReferencePoint:
        """The sensor that gave the pose fixes of a run."""
        states = run.summary["states"]
        offset = float(states.get(f"{FIXES}_time_offset_s", {"value": 0.0})["value"])
        correction = states.get(f"{FIXES}_lever_arm_correction_m", {"value": (0.0, 0.0, 0.0)})["value"]
        x, y, z = (float(v) for v in np.add(run.session.mount(FIXES).body_t, correction))
        return cls(offset, (x, y, z))

    def smoothed(self, run: Run, t_ns: Times) -> Floats:
        """Its position (n, 3) in the smoothed solution."""
        return predict_sensor(run.problem, run.solution, t_ns, self.offset_s, np.array(self.lever))

    def causal(self, run: Run, t_ns: Times) -> Floats:
        """Its position (n, 3) predicted from the keyframe before `t_ns`. No later data is used: the time offset is
        bridged with the velocity."""
        assert run.causal is not None  # of a replay
        there = predicted_at(run.causal_windows, kinematics(run.causal), run.session.gravity, t_ns)
        return sensor_positions(there, np.full(len(t_ns), self.offset_s), np.array(self.lever))
