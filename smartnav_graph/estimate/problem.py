"""Session + config -> everything the loop needs: windows, builders, gaps, and what was left out on the way."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from smartnav_graph.core.display import Summarised
from smartnav_graph.core.errors import ConfigError
from smartnav_graph.core.progress import Progress, silent
from smartnav_graph.core.tables import check
from smartnav_graph.core.timebase import NS, Gap
from smartnav_graph.estimate.config import Config
from smartnav_graph.estimate.constant_velocity import PREPARE_POSITIONS
from smartnav_graph.estimate.notes import Notes
from smartnav_graph.estimate.preparation import PREPARE, on_one_datum
from smartnav_graph.factors import FACTORS, make_builders
from smartnav_graph.factors.context import FactorContext
from smartnav_graph.graph import delayed
from smartnav_graph.graph.keyframes import KeyframeConfig, keyframe_times, make_windows, turn_times
from smartnav_graph.graph.update import Builder
from smartnav_graph.graph.windows import Window
from smartnav_graph.session.calibration.model import WHITE_ACCELERATION, Calibration
from smartnav_graph.session.detect.heights import HeightLevels
from smartnav_graph.session.detect.stances import STANCE_SPACING_S, SWING_S
from smartnav_graph.session.detect.standstills import Standstills
from smartnav_graph.session.health.clocks import ClockReport
from smartnav_graph.session.health.facts import Finding
from smartnav_graph.session.session import Session
from smartnav_graph.session.stream import Positioned
from smartnav_graph.session.streams import Imu
from smartnav_graph.vision.front_end import FrontEndReport
from smartnav_graph.vision.gyro_comparison import GyroComparison
from smartnav_graph.vision.pairs import Pairs

# Why a row is not in the solution of a replay.
TOO_LATE = "older than the lag"


@dataclass(frozen=True)
class Problem(Summarised):
    """One estimation problem. `session` lacks the withheld rows; rows of a stream keep their numbers in it. `imu` is
    the inertial stream of the windows, with its gaps bridged."""

    session: Session
    config: Config
    calibration: Calibration
    imu: Imu
    windows: Sequence[Window]
    gaps: Sequence[Gap]
    builders: Sequence[Builder]
    withheld: Mapping[str, Positioned]
    dropped: Mapping[str, Mapping[str, int]] = field(default_factory=dict)
    warnings: Sequence[str] = ()
    rests: Standstills | None = None
    pairs: Pairs | None = None
    clocks: ClockReport = ClockReport()
    findings: Sequence[Finding] = ()
    heights: Mapping[str, HeightLevels] = field(default_factory=dict)
    camera_turns: GyroComparison | None = None
    pictures: FrontEndReport | None = None

    def facts(self) -> dict[str, str]:
        """Windows, data gaps, builders."""
        names = ", ".join(builder.name for builder in self.builders)
        return {"windows": str(len(self.windows)), "gaps": str(len(self.gaps)), "builders": names}

    @property
    def vehicle(self) -> str:
        """What carries the device: of the options, else of the session."""
        return self.config.run.vehicle or self.session.device.vehicle

    def with_dropped(self, reason: str, counts: Mapping[str, int]) -> Problem:
        """The same with more rows counted as dropped, and a warning."""
        if not counts:
            return self
        dropped = {**self.dropped}
        for name, count in counts.items():
            dropped[name] = {**dropped.get(name, {}), reason: count}
        texts = [dropped_text(name, {reason: count}) for name, count in counts.items()]
        return replace(self, dropped=dropped, warnings=[*self.warnings, *texts])

    @property
    def positions_only(self) -> bool:
        """Whether a motion model replaces the inertial data; see `constant_velocity`."""
        return self.calibration.imu_noise is WHITE_ACCELERATION

    def label(self, sensor: str) -> str:
        """Name of a sensor in results: what is in place of inertial data is none."""
        return sensor.replace("imu", "motion_model") if self.positions_only else sensor

    @property
    def rests_at_start(self) -> bool:
        """Whether the first keyframe lies in a rest that has standstill factors of its own."""
        options, rests = self.config.standstill, self.rests
        at = self.windows[0].t1_ns
        if rests is None or not (options.zupt and options.zaru):
            return False
        return bool(np.isfinite(rests.over(rests.turn_sigma, at, at)))


def prepare(session: Session, config: Config, *, causal: bool = False, progress: Progress = silent) -> Problem:
    """The steps of `PREPARE`, or of `PREPARE_POSITIONS` where there are no inertial data, then windows and builders.

    causal : a row is used when it becomes known (replay); otherwise at its measurement time

    Raises
    ------
    SessionError
        No inertial data, a dead stream, or nothing of an aiding stream inside the inertial span.
    ConfigError
        An option names what is not there.
    """
    notes = Notes(check(config, ConfigError, "options"), causal, progress)
    positions_only = session.imu is None and bool(session.positions())
    for step in (PREPARE_POSITIONS if positions_only else PREPARE).values():
        session = step(session, notes)
    config = notes.config
    context = FactorContext(
        *(session, notes.calibration, notes.gaps, config.run.vehicle or session.device.vehicle, config),
        *(notes.rests, causal, notes.pairs),
        heights={} if causal else notes.heights,
        session_states_fixed=config.replay.smoother == "isam2",
        polished=config.replay.polish,
        camera_turns=notes.camera_turns,
    )
    windows, lost = session_windows(context, notes.span)
    builders = make_builders(context)
    notes.drop("arrived after the end", lost)
    for name, counts in session.dropped.items():
        notes.dropped[name] = {**notes.dropped.get(name, {}), **counts}
    notes.warnings += [builder.note for builder in builders if builder.note] + unused_streams(session)
    notes.warnings += [dropped_text(name, counts) for name, counts in notes.dropped.items()]
    return Problem(
        *(session, config, notes.calibration, context.bridged_imu, windows, notes.gaps, builders),
        *(notes.withheld, notes.dropped, notes.warnings, notes.rests, notes.pairs, notes.clocks, notes.findings),
        *(notes.heights, notes.camera_turns, notes.pictures),
    )


def session_windows(context: FactorContext, span: tuple[int, int]) -> tuple[list[Window], dict[str, int]]:
    """The windows of a stretch, and how many rows of each stream are unknown until its end."""
    session, causal = context.session, context.causal
    spacing = context.options(KeyframeConfig)
    rests = context.rests or Standstills.none(session.require_imu().t_ns)
    if rests.on_foot:  # a foot swings fast: between keyframes too far apart its motion is lost
        spacing = replace(spacing, max_spacing_s=min(spacing.max_spacing_s, SWING_S))
    standing = rests.keyframes(STANCE_SPACING_S if rests.on_foot else None, causal=causal)
    merge = round(spacing.merge_s * NS)
    streams = session.absolute()
    aiding = {name: stream.t_ns for name, stream in streams.items()}
    epochs = [stream.available_ns if causal else stream.t_ns for stream in streams.values()] + [context.image_ns]
    times = keyframe_times(span, epochs, context.gaps, spacing, standing, causal=causal)
    times = np.union1d(times, turn_times(times, context.bridged_imu))
    windows = make_windows(context.bridged_imu, times, context.gaps, aiding, spacing, rests.spans())
    return delayed.assign(windows, streams, merge) if causal else (windows, {})


def batch_problem(problem: Problem, available_ns: int | None = None) -> Problem:
    """The problem of a replay for a batch solution: every row at its measurement time, keyframes, gaps and builders by
    all that was recorded. Only rows known by `available_ns` where that is given; the problem itself where there is no
    difference."""
    session = on_one_datum(problem.session, problem.heights)
    context = FactorContext(
        *(session, problem.calibration, problem.gaps, problem.vehicle, problem.config, problem.rests),
        pairs=problem.pairs,
        heights=problem.heights,
        camera_turns=problem.camera_turns,
    )
    windows, _ = session_windows(context, (problem.windows[0].t1_ns, problem.windows[-1].t1_ns))
    merge = round(problem.config.keyframes.merge_s * NS)
    delays = any(delayed.is_delayed(stream, merge).any() for stream in problem.session.absolute().values())
    if not (problem.gaps or delays or problem.heights) and [w.t1_ns for w in windows] == [
        w.t1_ns for w in problem.windows
    ]:
        if not any(builder.causal for builder in problem.builders):
            return problem
        made = {builder.name: builder for builder in make_builders(context)}
        kept = [made.get(b.name) if b.causal else b for b in problem.builders]
        return replace(problem, builders=[builder for builder in kept if builder is not None])
    if available_ns is not None:
        windows = delayed.drop_unknown(windows, problem.session.streams(), available_ns)
    return replace(problem, session=session, imu=context.bridged_imu, windows=windows, builders=make_builders(context))


def unused_streams(session: Session) -> list[str]:
    """Warnings of streams that no factor uses."""
    used = {factor.stream for factor in FACTORS.values()} | {"reference", "images"}
    idle = [name for name in session.streams() if name not in used]
    return [f"{name}: present, not used by the estimator" for name in idle]


def dropped_text(name: str, counts: Mapping[str, int]) -> str:
    """Warning of rows of a stream that are not used, by reason."""
    reasons = ", ".join(f"{count} rows {reason}" for reason, count in counts.items())
    return f"{name}: {reasons}; not used as recorded"
