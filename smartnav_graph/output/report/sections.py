"""The sections of the report in reading order, and the page around them."""

from __future__ import annotations

import re
from collections.abc import Mapping
from html import escape
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.estimate.result.diagnostics import Updates
from smartnav_graph.graph.solution import Solution
from smartnav_graph.output.report import charts, constants, facts, replays, statistics, timeline, track, usage
from smartnav_graph.output.report.text import as_float, attributes, fixed, metres, plural
from smartnav_graph.session.session import Session

Summary = Mapping[str, Any]

TEMPLATE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; style-src 'unsafe-inline'">
<title>{title}</title>
<style>{style}</style>
</head>
<body>
<main>
{body}
</main>
</body>
</html>
"""


def page(
    session: Session,
    solution: Solution,
    summary: Summary,
    evaluation: Any,
    causal: Solution | None,
    scored: Mapping[str, charts.Scored],
    updates: Updates | None = None,
) -> str:
    """The whole HTML text."""
    holes = facts.gaps(summary)
    shaded = [(start, start + length) for start, length, _ in holes]
    compared = facts.evaluation_facts(evaluation)
    parts = [
        warnings(solution, summary),
        section("map", "Trajectory", track.draw(session, solution, holes, causal)),
        section("timeline", "What happened when", timeline.draw(solution, summary, shaded, scored)),
        section("statistics", "The run in figures", statistics.table(session, solution, summary).html()),
        used(session, solution, summary),
        imu_holes(summary, holes),
        *over_time(solution, shaded, causal),
        section("updates", "While replaying", replays.draw(updates, solution, shaded) if updates is not None else ""),
        withheld(summary, scored, solution, shaded),
        against_reference(evaluation, compared, solution, shaded),
        *machinery(summary),
    ]
    body = "\n".join(part for part in parts if part)
    body = head(session, solution, summary) + contents(body) + body
    name = session.path.name if session.path else session.device.name
    style = files("smartnav_graph.output.report").joinpath("style.css").read_text(encoding="utf-8")
    return TEMPLATE.format(title=escape(f"{name}: run report"), style=style, body=body)


def section(name: str, title: str, body: str, data: Mapping[str, Any] | None = None) -> str:
    """A titled section; empty when it has no body."""
    if not body:
        return ""
    return f'<section id="{name}"{attributes(data or {})}><h2>{escape(title)}</h2>{body}</section>'


def contents(body: str) -> str:
    """Links to the sections that are there."""
    found = re.findall(r'<section id="([a-z-]+)"[^>]*><h2>([^<]+)</h2>', body)
    links = "".join(f'<a href="#{name}">{title}</a>' for name, title in found)
    return f'<nav aria-label="Contents">{links}</nav>'


def head(session: Session, solution: Solution, summary: Summary) -> str:
    """Title, headline sentences, the figures that matter most."""
    device = "" if session.device.name == "unknown" else session.device.name
    name = session.path.name if session.path else device or "Recorded session"
    sure = statistics.certainty(solution)
    sentences = " ".join(escape(s) for s in facts.headline(summary, sure))
    tiles = "".join(
        f"<div><dt>{escape(label)}</dt><dd>{escape(value)}</dd></div>"
        for label, value in statistics.key_figures(summary, sure)
    )
    kicker = f"smartnav run report · {device}" if session.path and device else "smartnav run report"
    return (
        f'<header id="headline"><p class="kicker">{escape(kicker)}</p><h1>{escape(name)}</h1>'
        f'<p class="lead">{sentences}</p><dl class="tiles">{tiles}</dl>{sigma_sentence(solution)}</header>'
    )


def sigma_sentence(solution: Solution) -> str:
    """How well the position is known at t = 300 s, or in the middle of a shorter run."""
    known = statistics.sigma_at(solution)
    if known is None:
        return '<p id="sigma-at">The run gives no position uncertainty.</p>'
    t, (e, n, u) = known
    horizontal = float(np.hypot(e, n))
    at = fixed(t, 0 if float(t).is_integer() else 1)
    data = {"t-s": t, "sigma-e-m": e, "sigma-n-m": n, "sigma-u-m": u, "sigma-horizontal-m": horizontal}
    return (
        f'<p id="sigma-at"{attributes(data)}>At t = {at} s the position is known to {metres(horizontal)} '
        f"(1 sigma, horizontal): {metres(e)} east, {metres(n)} north, and {metres(u)} in height.</p>"
        '<p class="fine">Horizontal means √(σ<sub>e</sub>² + σ<sub>n</sub>²), as for the errors below. '
        "Seconds count from the first IMU sample.</p>"
    )


def warnings(solution: Solution, summary: Summary) -> str:
    """What to be careful about, and what to do."""
    told = usage.lost_warnings(solution) + facts.warnings(summary)
    if not told:
        text = "No warnings." if "warnings" in summary else "The run did not record warnings."
        return section("warnings", "Warnings", f'<p class="calm">{text}</p>', {"count": 0})
    items = "".join(
        f"<li><strong>{escape(what)}</strong>{f'<span>{escape(remedy)}</span>' if remedy else ''}</li>"
        for what, remedy in told
    )
    return section("warnings", "Warnings", f'<ul class="warnings">{items}</ul>', {"count": len(told)})


def used(session: Session, solution: Solution, summary: Summary) -> str:
    """What was used, dropped, rejected, and why."""
    recorded = {name: len(stream) for name, stream in session.streams().items() if name != "reference"}
    lines = "".join(f"<li>{escape(line)}</li>" for line in usage.why_lines(summary))
    why = f'<ul class="plain">{lines}</ul>' if lines else '<p class="calm">Nothing was rejected or dropped.</p>'
    if not lines and not {"rejected", "dropped"} & set(summary):
        why = '<p class="calm">The run did not record what was rejected or dropped.</p>'
    careful = usage.careful_sentence(summary)
    parts = [
        usage.used_table(summary, recorded).html(),
        why,
        _silence(solution),
        _rejections(summary),
        *(
            table.html()
            for table in (
                usage.fates_table(summary, "image_pairs", "image pairs"),
                usage.fates_table(summary, "tracks", "tracked points in space"),
                usage.assumed_table(summary),
            )
            if table
        ),
        f"<p>{escape(careful)}</p>" if careful else "",
        '<p class="fine">χ² / dof: squared residuals over their sigmas, per redundant measurement; '
        "1 means the stated noise is right.</p>",
    ]
    return section("used", "What was used", "".join(parts))


def _silence(solution: Solution) -> str:
    """The longest stretch without a position."""
    silence = usage.longest_silence(solution)
    if silence is None:
        return ""
    data = {"start-s": silence.start_s, "length-s": silence.length_s}
    return f'<p id="silence"{attributes(data)}>{escape(usage.silence_sentence(silence))}</p>'


def _rejections(summary: Summary) -> str:
    """The rejected measurements one by one, folded away."""
    table = usage.rejections_table(summary)
    if not table.rows:
        return ""
    head = f"Each of the {plural(len(table.rows), 'rejected measurement')}"
    return f'<details class="rejections"><summary>{escape(head)}</summary>{table.html()}</details>'


def imu_holes(summary: Summary, holes: list[tuple[float, float, str]]) -> str:
    """Stretches without honest inertial data."""
    if not holes:
        known = "gaps" in summary
        text = "The IMU record has no holes." if known else "The run did not record IMU holes."
        return section("imu-holes", "IMU holes", f'<p class="calm">{text}</p>', {"count": 0 if known else None})
    items = "".join(
        f'<li class="hole"{attributes({"start-s": start, "length-s": length, "kind": kind})}>'
        f"{escape(facts.hole_sentence(start, length, kind))}</li>"
        for start, length, kind in holes
    )
    kinds = {kind for *_, kind in holes}
    why = {
        "bridged": "Bridged: on all six axes the samples follow an exact straight line, which no sensor measures; "
        "somebody filled the hole before import.",
        "missing": "No samples: the stamps leap.",
    }
    lead = " ".join(words for kind, words in why.items() if kind in kinds)
    tail = "Inside a hole the motion is carried on with raised noise, so the uncertainty grows there."
    body = f'<p>{escape(f"{lead} {tail}".strip())}</p><ul class="plain columns">{items}</ul>'
    return section("imu-holes", "IMU holes", body, {"count": len(holes), "total-s": round(sum(h[1] for h in holes), 6)})


def over_time(solution: Solution, gaps: charts.Intervals, causal: Solution | None) -> list[str]:
    """Everything drawn over time; nothing for a run of a single epoch."""
    if len(solution) < 2:
        return []
    sure = statistics.uncertainty_table(solution).html()
    sure += '<p class="fine">What determined the state at a time T: smartnav explain RUN --at T.</p>'
    parts = [
        section("uncertainty", "How sure", charts.uncertainty(solution, gaps, causal) + sure),
        section("motion", "Speed and height", charts.motion(solution, gaps)),
        section("attitude", "Attitude", charts.attitude(solution, gaps)),
        section("biases", "Sensor biases", charts.biases(solution, gaps)),
    ]
    if not len(solution.residuals):
        return [*parts, section("residuals", "Residuals", '<p class="calm">The run recorded no residuals.</p>')]
    note = (
        '<p class="fine">Residuals remain after the adjustment: where few measurements overlap they come out smaller '
        "than the standard normal curve. χ² / dof above allows for that.</p>"
    )
    both = note + charts.residual_histograms(solution) + charts.residuals_over_time(solution, gaps)
    return [*parts, section("residuals", "Residuals", both)]


def withheld(summary: Summary, scored: Mapping[str, charts.Scored], solution: Solution, gaps: charts.Intervals) -> str:
    """Measurements kept from the estimate and scored against it."""
    table = usage.withheld_table(summary)
    if not table:
        return ""
    pictures = [charts.withheld(name, rows, solution, gaps) for name, rows in scored.items()]
    lead = (
        "<p>These measurements were kept from the estimate, then compared with it; the differences hold the errors of "
        "both.</p>"
    )
    total = {"count": round(sum(as_float(n) or 0.0 for n in facts.withheld_counts(summary).values()))}
    return section("withheld", "Withheld measurements", lead + table.html() + "".join(pictures), total)


def against_reference(evaluation: Any, compared: Summary, solution: Solution, gaps: charts.Intervals) -> str:
    """Errors against an independent trajectory."""
    if not compared:
        return ""
    error = getattr(evaluation, "error_enu_m", None)
    horizontal: NDArray[Any] = np.zeros(0) if error is None else np.linalg.norm(np.asarray(error)[:, :2], axis=1)
    tables = [facts.evaluation_table(compared), facts.relative_table(compared), facts.nees_table(compared)]
    body = f"<p>{escape(facts.evaluation_sentence(compared))}</p>" + "".join(t.html() for t in tables if t)
    honest = facts.nees_sentence(compared)
    body += f"<p>{escape(honest)}</p>" if honest else ""
    body += "".join(f'<p class="fine">{escape(str(note))}</p>' for note in getattr(evaluation, "notes", ()))
    body += charts.distribution(horizontal, "errors against the reference")
    if len(solution) > 1:
        body += charts.errors_over_time(evaluation, solution, gaps)
    return section("reference", "Against the reference", body)


def machinery(summary: Summary) -> list[str]:
    """States, start, solver, timings, versions."""
    sentence, start = constants.initialisation(summary)
    said = f"<p>{escape(sentence)}</p>" if sentence else ""
    began = said + (start.html() if start else "")
    clocks = "".join(f'<p class="clock">{escape(told)}</p>' for told in constants.clock_sentences(summary))
    states = "".join(table.html() for _, table in constants.constants(summary))
    solver, versions = facts.solver_table(summary), facts.versions_table(summary)
    return [
        section("states", "Clocks, mounts and noise", clocks + states),
        section("start", "How the start was found", began or '<p class="calm">The run did not record it.</p>'),
        section("solver", "Solver", solver.html() if solver else ""),
        section("timings", "Computing time", timing_bars(facts.timings(summary))),
        section("versions", "Versions", versions.html() if versions else ""),
    ]


def timing_bars(timings: Mapping[str, float]) -> str:
    """Seconds of every step as a bar beside its number."""
    most = max((v for v in timings.values()), default=0.0)
    rows = "".join(
        f'<tr><th scope="row">{escape(facts.step_name(name, timings))}</th>'
        f'<td class="n">{fixed(value, 3)} s</td><td class="wide">'
        f'<svg class="meter" viewBox="0 0 1000 10" preserveAspectRatio="none" aria-hidden="true">'
        f'<rect class="{"total" if name == "total" else "part"}" width="{1000 * value / most if most else 0:.0f}" '
        f'height="10"/></svg></td></tr>'
        for name, value in timings.items()
    )
    return f'<div class="scroll"><table><tbody>{rows}</tbody></table></div>' if rows else ""
