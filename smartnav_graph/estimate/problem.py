"""Session + config -> everything the loop needs: windows, builders, gaps, and what was left out on the way."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core.errors import ConfigError, SessionError
from smartnav_graph.core.timebase import NS, Gap, find_gaps
from smartnav_graph.estimate.config import Config
from smartnav_graph.factors import FACTORS, make_builders
from smartnav_graph.factors.context import FactorContext
from smartnav_graph.factors.coplanarity import pairs_of
from smartnav_graph.factors.gap_model import bridged
from smartnav_graph.factors.pose_fix import undo_latency
from smartnav_graph.graph import delayed
from smartnav_graph.graph.keyframes import KeyframeConfig, keyframe_times, make_windows
from smartnav_graph.graph.update import Builder
from smartnav_graph.graph.windows import Window
from smartnav_graph.session import health
from smartnav_graph.session.calibration.apply import corrected
from smartnav_graph.session.calibration.model import Calibration, ImuErrors
from smartnav_graph.session.detect.stances import STANCE_SPACING_S, SWING_S
from smartnav_graph.session.detect.standstills import Standstills, find_standstills
from smartnav_graph.session.holdout import split
from smartnav_graph.session.session import Session
from smartnav_graph.session.stream import Positioned, Stream
from smartnav_graph.vision.pairs import Pairs
from smartnav_graph.vision.zero_motion import static_periods

# Why a row that replay was handed is not in its solution.
TOO_LATE = "older than the lag"


@dataclass(frozen=True)
class Problem:
    """One estimation problem. `session` lacks the withheld rows; rows of a stream keep their numbers in it."""

    session: Session
    config: Config
    calibration: Calibration
    windows: Sequence[Window]
    gaps: Sequence[Gap]
    builders: Sequence[Builder]
    withheld: Mapping[str, Positioned]
    dropped: Mapping[str, Mapping[str, int]] = field(default_factory=dict)
    warnings: Sequence[str] = ()
    rests: Standstills | None = None
    pairs: Pairs | None = None

    @property
    def vehicle(self) -> str:
        return self.config.run.vehicle or self.session.device.vehicle

    def with_dropped(self, reason: str, counts: Mapping[str, int]) -> Problem:
        """The same with more rows counted as dropped, and told."""
        if not counts:
            return self
        dropped = {**self.dropped}
        for name, count in counts.items():
            dropped[name] = {**dropped.get(name, {}), reason: count}
        told = [_dropped_text(name, {reason: count}) for name, count in counts.items()]
        return replace(self, dropped=dropped, warnings=[*self.warnings, *told])

    @property
    def rests_at_start(self) -> bool:
        """Whether the first keyframe lies in a true rest that standstill factors speak for."""
        options, rests = self.config.standstill, self.rests
        at = self.windows[0].t1_ns
        return (
            rests is not None
            and options.zupt
            and options.zaru
            and bool(np.isfinite(rests.over(rests.turn_sigma, at, at)))
        )


def prepare(session: Session, config: Config, *, causal: bool = False) -> Problem:
    """Check the session, choose sensors and stretch, find gaps, cut windows, make builders.

    `causal` : a row is used when it becomes known (replay); otherwise at the time it speaks of.

    Raises
    ------
    SessionError
        No inertial data, a dead stream, or nothing of an aiding stream inside the inertial span.
    ConfigError
        An option names what is not there.
    """
    imu = session.require_imu()
    signal = np.concatenate([imu.gyro, imu.accel], axis=1)
    rule = config.gaps
    gaps = find_gaps(imu.t_ns, signal, missing_s=rule.missing_s, bridged_rows=rule.bridged_rows)
    asked = _span(session, config)
    gaps = [gap for gap in gaps if gap.end_ns > asked[0] and gap.start_ns < asked[1]]
    checked = health.inspect(session, gaps)
    checked.raise_errors()
    warnings = checked.warnings()
    calibration = session.calibration or Calibration()
    session = _calibrated(session)
    imu = session.require_imu()
    session = _choose_sensors(session, config.run.sensors)
    session, withheld = split(undo_latency(session, config.pose_fixes), config.run.withhold)
    session, dropped = _inside_span(session, asked)
    aiding = {name: stream.t_ns for name, stream in session.absolute().items()}
    span, told = _trimmed(asked, aiding, config.keyframes.lead_s, session.t0_ns)
    gaps = [gap for gap in gaps if gap.end_ns > span[0] and gap.start_ns < span[1]]
    vehicle = config.run.vehicle or session.device.vehicle
    noise, still = calibration.imu_noise, config.standstill
    pairs = pairs_of(session, config.image_pairs, smart=config.smart.enabled)
    seen = None if pairs is None else static_periods(pairs)
    rests = find_standstills(imu, session.static, gaps, vehicle, noise, session.gravity, still, seen)
    context = FactorContext(
        *(session, calibration, gaps, vehicle, config, rests, causal, pairs),
        session_states_fixed=config.replay.smoother == "isam2",
        polished=config.replay.polish,
    )
    windows, lost = cut(context, span)
    for name, count in lost.items():
        dropped.setdefault(name, {})["arrived after the end"] = count
    builders = make_builders(context)
    for name, counts in session.dropped.items():
        dropped[name] = {**dropped.get(name, {}), **counts}
    notes = [builder.note for builder in builders if builder.note]
    warnings = [*warnings, *told, *notes, *_unused(session), *(_dropped_text(name, c) for name, c in dropped.items())]
    return Problem(session, config, calibration, windows, gaps, builders, withheld, dropped, warnings, rests, pairs)


def _calibrated(session: Session) -> Session:
    """Inertial readings without the errors that the calibration knows, which it then no longer names."""
    known = session.calibration
    if known is None or known.imu_errors == ImuErrors():
        return session
    imu = corrected(session.require_imu(), known.imu_errors)
    return session.replace(imu=imu, calibration=replace(known, imu_errors=ImuErrors()))


def cut(context: FactorContext, span: tuple[int, int]) -> tuple[list[Window], dict[str, int]]:
    """The windows of a stretch, and how many rows of each stream are not known by its end."""
    session, causal = context.session, context.causal
    spacing = context.options(KeyframeConfig)
    rests = context.rests or Standstills.none(session.require_imu().t_ns)
    if rests.on_foot:  # a foot swings fast: what happens between keyframes would be told poorly
        spacing = replace(spacing, max_spacing_s=min(spacing.max_spacing_s, SWING_S))
    standing = rests.keyframes(STANCE_SPACING_S if rests.on_foot else None)
    merge = round(spacing.merge_s * NS)
    streams = session.absolute()
    aiding = {name: stream.t_ns for name, stream in streams.items()}
    epochs = [stream.available_ns if causal else stream.t_ns for stream in streams.values()] + [context.image_ns]
    times = keyframe_times(span, epochs, context.gaps, spacing, standing)
    imu = bridged(session.require_imu(), context.gaps, context.bridges)
    windows = make_windows(imu, times, context.gaps, aiding, spacing, rests.spans())
    return delayed.assign(windows, streams, merge) if causal else (windows, {})


def batch_problem(problem: Problem, available_ns: int | None = None) -> Problem:
    """The same stretch as batch sees it: every row at the time it speaks of, gaps bridged by all that was recorded.
    Only rows known by `available_ns` where that is given; the problem itself where there is no difference."""
    session, config, gaps = problem.session, problem.config, problem.gaps
    merge = round(config.keyframes.merge_s * NS)
    if not gaps and not any(delayed.is_delayed(stream, merge).any() for stream in session.absolute().values()):
        return problem
    context = FactorContext(
        session, problem.calibration, gaps, problem.vehicle, config, problem.rests, pairs=problem.pairs
    )
    windows, _ = cut(context, (problem.windows[0].t1_ns, problem.windows[-1].t1_ns))
    if available_ns is not None:
        windows = delayed.drop_unknown(windows, session.streams(), available_ns)
    return replace(problem, windows=windows, builders=make_builders(context))


def _choose_sensors(session: Session, chosen: Sequence[str]) -> Session:
    """Only the named sensors, or all but those with a leading minus; the inertial data always stay."""
    if not chosen:
        return session
    there = session.streams()
    names = {name.lstrip("-") for name in chosen}
    unknown = sorted(names - set(there))
    if unknown:
        raise ConfigError("--sensors", f"{', '.join(unknown)} not in this session", f"some of {', '.join(there)}")
    wanted = {name for name in chosen if not name.startswith("-")}
    unwanted = {name[1:] for name in chosen if name.startswith("-")}
    keep = (wanted or set(there)) - unwanted | {"imu", "reference", "images"}
    return session.replace(**{name: None for name in there if name not in keep})


def _span(session: Session, config: Config) -> tuple[int, int]:
    """Stretch asked for, inside the inertial span."""
    imu = session.require_imu()
    t0, last = session.t0_ns, int(imu.t_ns[-1])
    run = config.run
    start = t0 if run.start_s is None else t0 + round(run.start_s * NS)
    end = last if run.end_s is None else t0 + round(run.end_s * NS)
    start, end = max(start, t0), min(end, last)
    if start >= end:
        raise ConfigError(
            "--from, --to",
            f"nothing between {run.start_s} and {run.end_s} s",
            f"a stretch inside 0 to {(last - t0) / NS:.2f} s",
        )
    return start, end


def _inside_span(session: Session, span: tuple[int, int]) -> tuple[Session, dict[str, dict[str, int]]]:
    """Absolute streams cut to the span. Rows beyond the inertial data are counted, rows beyond --from/--to are not."""
    imu = session.require_imu()
    dropped: dict[str, dict[str, int]] = {}
    changes: dict[str, Stream | None] = {}
    for name, stream in session.absolute().items():
        outside = int(((stream.t_ns < imu.t_ns[0]) | (stream.t_ns > imu.t_ns[-1])).sum())
        if outside:
            dropped[name] = {"outside the inertial span": outside}
        inside = (stream.t_ns >= span[0]) & (stream.t_ns <= span[1])
        changes[name] = stream.take(inside) if inside.any() else None
        if outside == len(stream):
            raise SessionError(
                name,
                f"all {outside} rows lie outside the inertial span",
                f"stamps between {imu.t_ns[0]} and {imu.t_ns[-1]} ns",
                "bring both on one clock",
                stream=name,
            )
    return session.replace(**changes), dropped


def _trimmed(
    span: tuple[int, int], aiding: Mapping[str, NDArray[np.int64]], lead_s: float, t0_ns: int
) -> tuple[tuple[int, int], list[str]]:
    """The span, cut to `lead_s` before the first and after the last aiding: dead reckoning beyond says little."""
    if not aiding:
        return span, []
    lead = round(lead_s * NS)
    first = min(int(t[0]) for t in aiding.values()) - lead
    last = max(int(t[-1]) for t in aiding.values()) + lead
    new = max(span[0], first), min(span[1], last)
    if new == span:
        return span, []
    text = (
        f"keyframes: smoothed from {(new[0] - t0_ns) / NS:.1f} to {(new[1] - t0_ns) / NS:.1f} s only, {lead_s:g} s "
        "around the first and last absolute measurement; raise keyframes.lead_s to reckon further"
    )
    return new, [text]


def _unused(session: Session) -> list[str]:
    """Streams that are there but have no factor."""
    used = {factor.stream for factor in FACTORS.values()} | {"reference", "images"}
    idle = [name for name in session.streams() if name not in used]
    told = [f"{name}: present, not used by the estimator" for name in idle]
    images = session.images
    if images is not None and session.matches is None and session.tracks is None and images.file.astype(bool).any():
        told.append(f"images: {len(images)} pictures are not matched yet, and not used; run `smartnav match` first")
    return told


def _dropped_text(name: str, counts: Mapping[str, int]) -> str:
    return (
        f"{name}: " + ", ".join(f"{count} rows {reason}" for reason, count in counts.items()) + "; not used as recorded"
    )
