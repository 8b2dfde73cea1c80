"""What is done to a session before the graph is built: named steps, each (session, notes) -> session."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from smartnav_graph.core.arrays import runs
from smartnav_graph.core.errors import ConfigError, SessionError
from smartnav_graph.core.timebase import NS, Gap, find_gaps
from smartnav_graph.estimate.notes import Notes, PreparationStep
from smartnav_graph.estimate.pictures import compare_camera, match_pictures, pair_images
from smartnav_graph.factors.pose_fix import undo_latency
from smartnav_graph.graph.pass_state import INITIALISATION_S
from smartnav_graph.session import health
from smartnav_graph.session.calibration.model import Calibration, ImuErrors
from smartnav_graph.session.detect.heights import HeightLevels, control_offset, height_steps, least_step, levels
from smartnav_graph.session.detect.motion import levelled_motion
from smartnav_graph.session.detect.moving import Moving, find_moving, without_moving
from smartnav_graph.session.detect.out_of_reach import out_of_reach
from smartnav_graph.session.detect.scatter import scatter
from smartnav_graph.session.detect.standstills import find_standstills
from smartnav_graph.session.health.clocks import apply_offsets, compare_clocks
from smartnav_graph.session.health.facts import Finding
from smartnav_graph.session.health.inertial import spikes
from smartnav_graph.session.health.positions import reach_finding
from smartnav_graph.session.health.units import without_wrong_units
from smartnav_graph.session.holdout import split
from smartnav_graph.session.session import Session
from smartnav_graph.session.stream import Stream
from smartnav_graph.vision.map import SOURCE as OF_A_MODEL
from smartnav_graph.vision.zero_motion import moving_spans, static_periods

# Scatter of positions, in units of their sigmas, beyond which these are not believed; smaller scatter may be a motion.
CLAIM, LEAST_SCATTER_M, LEAST_SCATTERED = 2.0, 0.5, 20
# Heights lie off surveyed points by another datum where they do by so many times what that varies.
OTHER_DATUM = 4.0


def choose_span(session: Session, notes: Notes) -> Session:
    """The stretch asked for, inside the inertial data."""
    imu, run = session.require_imu(), notes.config.run
    t0, last = session.t0_ns, int(imu.t_ns[-1])
    start = t0 if run.start_s is None else t0 + round(run.start_s * NS)
    end = last if run.end_s is None else t0 + round(run.end_s * NS)
    notes.span = max(start, t0), min(end, last)
    if notes.span[0] >= notes.span[1]:
        raise ConfigError(
            "--from, --to",
            f"nothing between {run.start_s} and {run.end_s} s",
            f"a stretch inside 0 to {(last - t0) / NS:.2f} s",
        )
    return session


def drop_spikes(session: Session, notes: Notes) -> Session:
    """Inertial data without single readings far from their neighbours; the health names them."""
    imu = session.require_imu()
    found = spikes(imu)
    rows = np.unique(np.concatenate([np.zeros(0, dtype=np.intp), *found.values()]))
    notes.drop("far from their neighbours", {"imu": len(rows)} if len(rows) else {})
    return session.replace(imu=imu.take(np.setdiff1d(np.arange(len(imu)), rows))) if len(rows) else session


def find_imu_gaps(session: Session, notes: Notes) -> Session:
    """Gaps of the inertial data inside the span."""
    imu, rule = session.require_imu(), notes.config.gaps
    signal = np.concatenate([imu.gyro, imu.accel], axis=1)
    gaps = find_gaps(imu.t_ns, signal, missing_s=rule.missing_s, bridged_rows=rule.bridged_rows)
    notes.gaps = _inside(gaps, notes.span)
    return session


def drop_out_of_reach(session: Session, notes: Notes) -> Session:
    """Positions without those that the device cannot have visited beside the others; in a replay the set that counts is
    found by what is known at first."""
    changes: dict[str, Stream | None] = {}
    for name, stream in session.positions().items():
        known = None
        if notes.causal and len(stream):
            first = max(notes.span[0] + round(INITIALISATION_S * NS), int(stream.available_ns.min()))
            known = stream.available_ns <= first
        out = out_of_reach(stream, session.nav_position(stream), known)
        if out.any():
            changes[name] = stream.take(~out)
            notes.drop("out of reach of the others", {name: int(out.sum())})
            notes.findings = [*notes.findings, reach_finding(session, name, out)]
            notes.warnings.append(str(notes.findings[-1]))
    return session.replace(**changes) if changes else session


def align_clocks(session: Session, notes: Notes) -> Session:
    """Fixes on the clock of the inertial data, where both show that they are not, by more than the state of a clock
    takes. By rows that are not withheld; in a replay by what is known when it begins, and what all rows show of an
    offset is only said."""
    imu = session.require_imu()
    kept, _ = split(session, notes.config.run.withhold)
    first, last = notes.span
    kept = kept.replace(imu=imu.take((imu.t_ns >= first) & (imu.t_ns <= last)))
    found = kept if not notes.causal else _known_by(kept, first + round(INITIALISATION_S * NS))
    session, notes.clocks = apply_offsets(session, compare_clocks(found))
    if notes.causal and not any(offset.applied for offset in notes.clocks.offsets):
        notes.clocks = compare_clocks(kept)
    return session


def _known_by(session: Session, last_ns: int) -> Session:
    """Inertial data and positions that are known at a time."""
    streams = {"imu": session.require_imu(), **session.positions()}
    known: dict[str, Stream] = {name: stream.take(stream.available_ns <= last_ns) for name, stream in streams.items()}
    return session.replace(**known)


def check_health(session: Session, notes: Notes) -> Session:
    """Errors of the recording stop, warnings are noted."""
    checked = health.inspect(session, notes.gaps, notes.clocks)
    checked.raise_errors()
    notes.warnings += checked.warnings()
    notes.findings = [*notes.findings, *(found for found in checked.findings if found.level == "warning")]
    session, wrong = without_wrong_units(session, checked.findings)
    notes.warnings += [f"{name}: not used, because it is in another unit" for name in wrong]
    return session


def calibrate(session: Session, notes: Notes) -> Session:
    """Inertial readings without the errors that the calibration knows, which it then no longer names."""
    known = session.calibration
    notes.calibration = known or Calibration()
    if known is None or known.imu_errors == ImuErrors():
        return session
    imu = known.imu_errors.corrected(session.require_imu(), session.temperature)
    return session.replace(imu=imu, calibration=replace(known, imu_errors=ImuErrors()))


def choose_sensors(session: Session, notes: Notes) -> Session:
    """Only the named sensors, or all but those with a leading minus; the inertial data always stay. `images` means
    all that they gave: matches, tracks, and the pose fixes of a model."""
    chosen = notes.config.run.sensors
    if not chosen:
        return session
    there = session.streams()
    unknown = sorted({name.lstrip("-") for name in chosen} - set(there))
    if unknown:
        raise ConfigError("--sensors", f"{', '.join(unknown)} not in this session", f"some of {', '.join(there)}")
    also = {"matches": ("images",), "tracks": ("images",)}
    keep = {name for name in there if notes.uses(name, *also.get(name, ()))} | {"imu", "reference", "images"}
    session = session.replace(**{name: None for name in there if name not in keep})
    fixes = session.pose_fixes
    if "-images" not in chosen or fixes is None or fixes.source is None:
        return session
    own = fixes.source.astype(str) != OF_A_MODEL
    notes.drop("of images", {"pose_fixes": int((~own).sum())})
    return session.replace(pose_fixes=fixes.take(own) if own.any() else None)


def check_sigmas(session: Session, notes: Notes) -> Session:
    """Sigmas of positions that their own scatter exceeds by far are multiplied by that factor. In a replay by what is
    known at first. On a swinging foot scatter says nothing: no fix follows its motion."""
    changes: dict[str, Stream | None] = {}
    for name, stream in session.positions().items():
        if stream.sigma is None or session.device.mounting == "foot":
            continue
        late = notes.causal & (stream.available_ns > notes.span[0] + round(INITIALISATION_S * NS))
        t_ns, position = stream.t_ns[~late], session.nav_position(stream)[~late, :2]
        found, relative = scatter(t_ns, position), scatter(t_ns, position, stream.sigma[~late, :2])
        if found is None or relative is None or not found.is_noise or found.rows < LEAST_SCATTERED:
            continue
        if found.sigma > LEAST_SCATTER_M and relative.sigma > CLAIM:
            changes[name] = replace(stream, sigma=stream.sigma * relative.sigma)
            notes.warnings.append(
                f"{name}: positions scatter by {found.sigma:.2g} m, {relative.sigma:.2g} times their sigmas, which are "
                "multiplied by it; correct the sigma columns"
            )
    return session.replace(**changes) if changes else session


def undo_latencies(session: Session, notes: Notes) -> Session:
    """Pose fixes at the time they were measured."""
    return undo_latency(session, notes.config.pose_fixes)


def level_heights(session: Session, notes: Notes) -> Session:
    """GNSS heights on one datum: those of another level than most, or of another datum than surveyed points, are
    shifted, and the offset is a state. By rows that are not withheld; in a replay, where steps are found later, only
    for the last solution."""
    kept, _ = split(session, notes.config.run.withhold)
    gnss, motion = kept.gnss, levelled_motion(kept.require_imu())
    if gnss is None or motion is None or session.device.mounting == "foot":
        return session
    known, noise = gnss.has_height, notes.calibration.gnss_noise
    t_ns, position = gnss.t_ns[known], kept.nav_position(gnss)[known]
    least = least_step(gnss, noise)
    steps = height_steps(t_ns, position, motion, least)
    for step in steps:
        at = float(session.seconds(step.t_ns))
        text = f"heights step by {step.size:+.1f} m at {at:.1f} s, and nothing else does"
        remedy = "bring all heights to one datum; the offset is estimated"
        finding = Finding("gnss", text, remedy, size=step.size, start_ns=step.before_ns, end_ns=step.t_ns)
        notes.findings, notes.warnings = [*notes.findings, finding], [*notes.warnings, str(finding)]
    found = levels(steps, t_ns, least)
    middle, spread = control_offset(kept.replace(gnss=found.shifted(gnss))) or (0.0, 0.0)
    if abs(middle) > max(least, OTHER_DATUM * spread):
        notes.warnings.append(
            f"gnss: heights lie {middle:+.1f} m off those of the surveyed points: the offset is a state"
        )
        found = replace(found, offset=found.offset + middle)
    if found.offset.any():
        notes.heights["gnss"] = found
    return session if notes.causal else on_one_datum(session, notes.heights)


def on_one_datum(session: Session, heights: Mapping[str, HeightLevels]) -> Session:
    """The session with the heights of these streams on the datum of the solution."""
    positions = session.positions()
    return session.replace(**{name: found.shifted(positions[name]) for name, found in heights.items()})


def withhold(session: Session, notes: Notes) -> Session:
    """Rows held out to test the solution with."""
    session, notes.withheld = split(session, notes.config.run.withhold)
    return session


def drop_outside(session: Session, notes: Notes) -> Session:
    """Absolute streams inside the span. Rows outside the inertial data are counted, those outside --from, --to not."""
    imu = session.require_imu()
    changes: dict[str, Stream | None] = {}
    for name, stream in session.absolute().items():
        outside = int(((stream.t_ns < imu.t_ns[0]) | (stream.t_ns > imu.t_ns[-1])).sum())
        if outside:
            notes.drop("outside the inertial span", {name: outside})
        inside = (stream.t_ns >= notes.span[0]) & (stream.t_ns <= notes.span[1])
        changes[name] = stream.take(inside) if inside.any() else None
        if outside == len(stream):
            raise SessionError(
                name,
                f"all {outside} rows lie outside the inertial span",
                f"stamps between {imu.t_ns[0]} and {imu.t_ns[-1]} ns",
                "bring both on one clock",
                stream=name,
            )
    return session.replace(**changes)


def trim_span(session: Session, notes: Notes) -> Session:
    """The span cut to `lead_s` before the first and after the last aiding: dead reckoning beyond is of little use. To
    what both cover where an offset of their clocks was applied: what lies beyond is of another part of the motion."""
    aiding, lead_s = session.absolute().values(), notes.config.keyframes.lead_s
    if not aiding:
        return session
    shifted = [offset.sensor for offset in notes.clocks.offsets if offset.applied]
    lead_s = 0.0 if shifted else lead_s
    first = min(int(stream.t_ns[0]) for stream in aiding) - round(lead_s * NS)
    last = max(int(stream.t_ns[-1]) for stream in aiding) + round(lead_s * NS)
    span = max(notes.span[0], first), min(notes.span[1], last)
    if span != notes.span and (lead_s > 0.0 or shifted):
        begin, end = ((t_ns - session.t0_ns) / NS for t_ns in span)
        why = f"{lead_s:g} s around the first and last absolute measurement; raise keyframes.lead_s to reckon further"
        if shifted:
            why = f"where {', '.join(shifted)} is on the corrected clock; correct its stamps to reckon further"
        notes.warnings.append(f"keyframes: smoothed from {begin:.1f} to {end:.1f} s only, {why}")
    notes.span, notes.gaps = span, _inside(notes.gaps, span)
    return session


def detect_standstills(session: Session, notes: Notes) -> Session:
    """Standstills and stances by inertial data, listed spans and images."""
    vehicle = notes.config.run.vehicle or session.device.vehicle
    noise, options = notes.calibration.imu_noise, notes.config.standstill
    if options.mounting == "auto":
        options = replace(options, mounting=session.device.mounting)
    seen = None if notes.pairs is None else static_periods(notes.pairs)
    imu, gravity = session.require_imu(), session.gravity
    available_ns = notes.span[0] + round(INITIALISATION_S * NS) if notes.causal else None
    notes.rests = find_standstills(
        imu, session.static, notes.gaps, vehicle, noise, gravity, options, seen, available_ns
    )
    if options.mounting == "foot" and options.detect and not notes.rests.still.any():
        raise SessionError(
            "imu",
            "the device is declared to be mounted on a foot, and no stance was found",
            "a foot on the ground once in each stride, sampled at 50 Hz or more",
            "check the units of the inertial data with `smartnav info`, or give --standstill.mounting body",
            stream="imu",
        )
    return session


def refute_standstills(session: Session, notes: Notes) -> Session:
    """Standstills without the parts in which positions, speeds or images show motion."""
    rests = notes.rests
    if rests is None or not rests.still.any():
        return session
    spans = [] if notes.pairs is None else moving_spans(notes.pairs, rests.rests()).tolist()
    available_ns = notes.span[0] + round(INITIALISATION_S * NS) if notes.causal else None
    images = [Moving("images", *span) for span in spans]
    moving = find_moving(session, rests, notes.calibration.gnss_noise, images, available_ns)
    notes.rests = without_moving(rests, moving)
    lost = runs(rests.still & ~notes.rests.still)
    if len(lost):
        first, last = (float(t - session.t0_ns) / NS for t in (rests.t_ns[lost[0, 0]], rests.t_ns[lost[-1, 1] - 1]))
        length_s = float((rests.t_ns[lost[:, 1] - 1] - rests.t_ns[lost[:, 0]]).sum()) / NS
        names, speed = " and ".join(sorted({one.sensor for one in moving})), max(one.speed for one in moving)
        fast = "" if np.isnan(speed) else f" at up to {speed:.1f} m/s"
        notes.warnings.append(
            f"standstill: {length_s:.1f} s between {first:.1f} and {last:.1f} s are listed or look like a standstill "
            f"to the inertial data, but {names} show motion{fast}: not used as a standstill; if the device did rest, "
            "check clock and outliers of that sensor"
        )
    return session


PREPARE: Mapping[str, PreparationStep] = {
    "span": choose_span,
    "gaps": find_imu_gaps,
    "reach": drop_out_of_reach,
    "clocks": align_clocks,
    "health": check_health,
    "spikes": drop_spikes,
    "calibration": calibrate,
    "sensors": choose_sensors,
    "pictures": match_pictures,
    "latency": undo_latencies,
    "heights": level_heights,
    "holdout": withhold,
    "sigmas": check_sigmas,
    "outside": drop_outside,
    "lead": trim_span,
    "images": pair_images,
    "camera": compare_camera,
    "standstills": detect_standstills,
    "moving": refute_standstills,
}


def _inside(gaps: Sequence[Gap], span: tuple[int, int]) -> list[Gap]:
    return [gap for gap in gaps if gap.end_ns > span[0] and gap.start_ns < span[1]]
