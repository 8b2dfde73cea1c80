"""Status over time and the log: gaps, outages, standstills, rejections, warnings."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import rerun as rr

from smartnav_graph.core.timebase import NS, Gap, seconds_since
from smartnav_graph.output.rerun_log.events import REJECTED, WITHHELD, Events, switches
from smartnav_graph.output.rerun_log.recorder import Recorder
from smartnav_graph.output.summary_json import (
    Summary,
    as_float,
    other_warnings,
    rows_of,
    table_of,
    text_of,
    verdict_lines,
)
from smartnav_graph.session.session import Session
from smartnav_graph.session.stream import Stream

MOST_OF_A_KIND = 200

_LEGEND = {
    "/world/est/path": "**blue line**, the smoothed path",
    "/world/est/body": "**axes**, the body at the chosen time: x red, y green, z blue",
    "/world/est/velocity": "**light green arrow**, the path of one second at the velocity of the chosen time",
    "/world/est/covariance": "**orange, filled**, 3σ ellipsoid of the position at the chosen time, true size",
    "/world/est/covariances": "**orange, wire**, 3σ ellipsoids along the path, magnified as the view's name says",
    "/world/causal/path": "**gold line**, the causal estimate: each keyframe when it became known",
    "/world/causal/now": "**gold point**, the causal estimate at the chosen time",
    "/world/causal/covariance": "**gold, filled**, its 3σ ellipsoid, true size",
    "/world/causal/window": "**magenta line**, the window: the keyframes that the update at the chosen time corrects",
    "/world/reference/path": "**thin grey line**, the reference",
    "/world/gnss/fixes": "**green points**, GNSS fixes; large: the latest one",
    "/world/gnss/withheld": "**violet points**, fixes not in the solution (withheld, or outside its time span)",
    "/world/gnss/rejected": "**red points**, rejected fixes",
    "/world/rejected": "**red points**, rejected positions of other kinds",
    "/world/pose_fixes": "**cyan points**, pose fixes",
    "/world/control": "**pink points**, control points",
    "/error/position": "**bands**, one sigma of the run, and three in the views of one axis. If the run was aligned to "
    "the reference, errors are not zero at the start, but sigmas may be",
}

_IMAGE_LEGEND = {
    "/matches": "**lines** from a point in the first image of a pair to the same in the second: **green**, in use; "
    "**red**, rejected; **amber**, in a pair with insufficient baseline or too few matches; **light blue**, not tested",
    "/tracks": "**points**, tracked features, one colour for each track",
}

Line = tuple[int, str, str]


def log_status(recorder: Recorder, session: Session, events: Events) -> None:
    """/status/imu, /status/gnss, /status/motion, and /status/<sensor>_gate where rows of positions were rejected."""
    if session.imu is not None:
        _log_state(recorder, "/status/imu", events, events.gaps, "recorded")
    if session.gnss is not None:
        _log_state(recorder, "/status/gnss", events, events.outages, "fix")
    for name, stream in session.absolute().items():
        rejections = _rejections(stream, events)
        if rejections:
            _log_state(recorder, f"/status/{name}_gate", events, rejections, "accepted")
    if events.standstills:
        _log_state(recorder, "/status/motion", events, events.standstills, "moving")


def _rejections(stream: Stream, events: Events) -> list[Gap]:
    """From each rejected row to the next row."""
    t = np.concatenate([stream.t_ns, [max(events.end_ns, int(stream.t_ns[-1]))]])
    rejected = np.flatnonzero(events.use[stream.NAME] == REJECTED)
    return [Gap(int(t[i]), int(t[i + 1]), "rejected") for i in rejected]


def _log_state(recorder: Recorder, path: str, events: Events, spans: list[Gap], between: str) -> None:
    recorder.states(path, *switches(events.start_ns, spans, between))


def log_lines(recorder: Recorder, session: Session, events: Events, summary: Summary, notes: list[str]) -> None:
    """The log at /log: streams of the session, initialisation, warnings, gaps, outages, rejected fixes."""
    lines = [*_first_lines(session, events, summary, notes), *_event_lines(session, events)]
    lines.sort(key=lambda line: line[0])
    columns = rr.TextLog.columns(text=[text for _, _, text in lines], level=[level for _, level, _ in lines])
    recorder.rows("/log", [t for t, _, _ in lines], columns)


def _first_lines(session: Session, events: Events, summary: Summary, notes: list[str]) -> list[Line]:
    start = events.start_ns
    found = table_of(summary, "verdict")
    level = "INFO" if text_of(found, "level") == "good" else "WARN"
    lines = [(start, level, line) for line in verdict_lines(summary)]
    lines += [
        (start, "INFO", f"{name}: {len(stream)} rows{_rate(stream)}") for name, stream in session.streams().items()
    ]
    for stream, counts in session.dropped.items():
        lines += [
            (start, "WARN", f"{stream}: {count} rows dropped or repaired ({why})") for why, count in counts.items()
        ]
    sentence = text_of(table_of(summary, "initialisation"), "sentence")
    lines += [(start, "INFO", f"initialisation: {sentence}")] if sentence else []
    lines += [(start, "WARN", text) for text in other_warnings(summary)]
    return lines + [(start, "INFO", text) for text in notes]


def _rate(stream: Stream) -> str:
    if len(stream) < 2:
        return ""
    step = float(np.median(np.diff(stream.t_ns))) / 1e9
    return f", {1 / step:.4g} Hz" if step > 0 else ""


def _event_lines(session: Session, events: Events) -> list[Line]:
    kinds: list[list[Line]] = [
        [(g.start_ns, "WARN", f"IMU data gap: {g.kind} for {g.length_s:.2f} s") for g in events.gaps],
        [(g.start_ns, "WARN", f"gnss: no fix used for {g.length_s:.1f} s") for g in events.outages],
        [(g.start_ns, "INFO", f"standstill of {g.length_s:.1f} s") for g in events.standstills],
    ]
    for name, stream in session.absolute().items():
        for use, level, what in ((REJECTED, "WARN", "fix rejected"), (WITHHELD, "INFO", "fix not in the solution")):
            times = stream.t_ns[events.use[name] == use]
            seconds = seconds_since(times, session.t0_ns)
            kinds.append([(int(t), level, f"{name}: {what} at {s:.2f} s") for t, s in zip(times, seconds, strict=True)])
    return [line for lines in kinds for line in _capped(lines)]


def _capped(lines: list[Line]) -> list[Line]:
    """At most MOST_OF_A_KIND of one kind; the last line says how many more there are."""
    if len(lines) <= MOST_OF_A_KIND:
        return lines
    t, level, text = lines[MOST_OF_A_KIND]
    return [*lines[:MOST_OF_A_KIND], (t, level, f"{text}; {len(lines) - MOST_OF_A_KIND - 1} more like this")]


def _of_images(path: str) -> str:
    """The meaning of what is drawn in an image; empty for anything else."""
    return next((text for end, text in _IMAGE_LEGEND.items() if path.endswith(end) and path != "/pairs/matches"), "")


def log_verdict(recorder: Recorder, session: Session, summary: Summary, events: Events) -> None:
    """The verdict at /verdict, and where its reasons have a time, what it is there at /status/verdict."""
    lines = verdict_lines(summary)
    if not lines:
        return
    level, *reasons = lines
    text = "\n".join([f"**{level.capitalize()}**", "", *(f"- {reason}" for reason in reasons)])
    recorder.static("/verdict", rr.TextDocument(text, media_type="text/markdown"))
    found, spans = table_of(summary, "verdict"), list[Gap]()
    for reason in rows_of(found, "reasons"):
        start, end = as_float(reason.get("start_s")), as_float(reason.get("end_s"))
        if start is not None and end is not None:
            first, last = (session.t0_ns + round(t * NS) for t in (start, end))
            spans.append(Gap(max(first, events.start_ns), min(last, events.end_ns), text_of(reason, "sensor")))
    spans = _apart([span for span in spans if span.end_ns > span.start_ns])
    if spans:
        _log_state(recorder, "/status/verdict", events, spans, "no objection")


def _apart(spans: list[Gap]) -> list[Gap]:
    """Spans in time order, each ended where the next begins."""
    spans = sorted(spans, key=lambda span: span.start_ns)
    cut = [Gap(one.start_ns, min(one.end_ns, after.start_ns), one.kind) for one, after in pairwise(spans)]
    return [span for span in [*cut, *spans[-1:]] if span.end_ns > span.start_ns]


def log_report(recorder: Recorder, markdown: str | None) -> None:
    """The report at /report, and the meaning of the colours at /legend."""
    if markdown:
        recorder.static("/report", rr.TextDocument(markdown, media_type="text/markdown"))
    meaning = {path: text for path, text in _LEGEND.items() if recorder.has(path)}
    meaning |= {path: text for path in sorted(recorder.paths) if (text := _of_images(path))}
    lines = [f"* [{path}](recording:/{path}): {text}" for path, text in meaning.items()]
    if lines:
        document = "# Legend\n\n" + "\n".join(lines) + "\n"
        recorder.static("/legend", rr.TextDocument(document, media_type="text/markdown"))
