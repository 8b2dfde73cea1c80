"""The sections of the report in reading order, and the page around them."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from html import escape

import numpy as np
from markupsafe import Markup

from smartnav_graph.estimate.both_ways import BothWays
from smartnav_graph.estimate.config import Config
from smartnav_graph.estimate.result.diagnostics import Updates
from smartnav_graph.evaluation import Evaluation
from smartnav_graph.graph.solution import Solution
from smartnav_graph.output.report import (
    causal,
    charts,
    facts,
    reference,
    session_states,
    statistics,
    timeline,
    track,
    usage,
)
from smartnav_graph.output.report.about import changed_options, facts_of, logo_uri, options_of, utc_of
from smartnav_graph.output.report.control_points import (
    CONTRARY,
    ControlRow,
    control_rows,
    control_summary,
    control_table,
)
from smartnav_graph.output.report.template import filled, whole_page
from smartnav_graph.output.summary_json import ImuGap, Summary, imu_gaps, numbers_of, verdict_lines
from smartnav_graph.output.text import Table, attributes, fixed, listed, metres, plural
from smartnav_graph.session.session import Session


def page(
    session: Session,
    solution: Solution,
    summary: Summary,
    evaluation: Evaluation | None,
    causal_solution: Solution | None,
    scored: Mapping[str, charts.Scored],
    updates: Updates | None = None,
    config: Config | None = None,
    ways: BothWays | None = None,
) -> str:
    """The whole HTML text."""
    gaps = imu_gaps(summary)
    shaded = [(start, start + length) for start, length, _ in gaps]
    points = control_rows(session, solution, summary, "" if config is None else config.report.crs)
    both = charts.forward_backward(ways, solution, shaded) if ways is not None and len(ways.t_ns) else ""
    parts = [
        verdict_section(summary),
        filled(
            "first",
            trajectory=Markup(section("map", "Trajectory", track.draw(session, solution, gaps, causal_solution))),
            about=filled("about", facts=facts_of(session, solution, summary, config)),
        ),
        control_section(points),
        warnings_section(solution, summary),
        section("timeline", "Timeline", timeline.draw(solution, summary, shaded, scored)),
        section("statistics", "Summary", statistics.statistics_table(session, solution, summary).html()),
        used(session, solution, summary),
        gap_section(summary, gaps),
        *plots_over_time(solution, shaded, causal_solution),
        section("updates", "Real-time (causal) performance", causal.draw(updates, solution, shaded) if updates else ""),
        section("both-ways", "Forward and backward", both),
        withheld_section(summary, scored, solution, shaded),
        against_reference(evaluation, solution, shaded),
        *estimation(summary),
        "" if config is None else filled("settings", options=options_of(config), changed=changed_options(config)),
    ]
    body = "\n".join(part for part in parts if part)
    name = session.path.name if session.path else session.device.name
    begin = utc_of(session, solution.t0_ns)
    return whole_page(
        f"{name}: run report",
        head(session, solution, summary, config, contents(body)),
        body,
        footer=" · ".join([name, *([f"{begin:%Y-%m-%d}"] if begin else []), *_company(config)]),
        utc_ms=round(begin.timestamp() * 1000) if begin else None,
    )


def _company(config: Config | None) -> list[str]:
    return [config.report.company] if config is not None and config.report.company else []


def section(name: str, title: str, body: str, data: Mapping[str, object] | None = None) -> str:
    """A titled section; empty when it has no body."""
    if not body:
        return ""
    return f'<section id="{name}"{attributes(data or {})}><h2>{escape(title)}</h2>{body}</section>'


def contents(body: str) -> list[tuple[str, str]]:
    """Name and title of the sections of the page."""
    return re.findall(r'<section id="([a-z-]+)"[^>]*><h2>([^<]+)</h2>', body)


def head(
    session: Session, solution: Solution, summary: Summary, config: Config | None, links: list[tuple[str, str]]
) -> str:
    """Company, title, headline sentences, key figures, links."""
    device = "" if session.device.name == "unknown" else session.device.name
    uncertainty = statistics.horizontal_uncertainty(solution)
    return filled(
        "head",
        company="".join(_company(config)),
        logo="" if config is None else logo_uri(config.report.logo),
        kicker=f"smartnav run report · {device}" if session.path and device else "smartnav run report",
        name=session.path.name if session.path else device or "Recorded session",
        sentences=" ".join(facts.headline(summary, uncertainty)),
        tiles=statistics.key_figures(summary, uncertainty),
        sigma=Markup(sigma_sentence(solution)),
        contents=links,
    )


def sigma_sentence(solution: Solution) -> str:
    """Position sigmas at t = 300 s, or in the middle of a shorter run."""
    known = statistics.sigma_at(solution)
    if known is None:
        return '<p id="sigma-at">The position uncertainty is unknown.</p>'
    t, (e, n, u) = known
    horizontal = float(np.hypot(e, n))
    at = fixed(t, 0 if float(t).is_integer() else 1)
    data = {"t-s": t, "sigma-e-m": e, "sigma-n-m": n, "sigma-u-m": u, "sigma-horizontal-m": horizontal}
    return (
        f'<p id="sigma-at"{attributes(data)}>Position, 1 sigma at t = {at} s: {metres(horizontal)} horizontal '
        f"({metres(e)} east, {metres(n)} north), {metres(u)} vertical.</p>"
        '<p class="fine">Horizontal: √(σ<sub>e</sub>² + σ<sub>n</sub>²), as for the errors below. '
        "Seconds count from the first IMU sample.</p>"
    )


def verdict_section(summary: Summary) -> str:
    """Whether the run can be trusted, and why not."""
    if not verdict_lines(summary):
        return ""
    level, *reasons = verdict_lines(summary)
    return filled("verdict", level=level.removeprefix("verdict: "), reasons=reasons)


def control_section(rows: Sequence[ControlRow]) -> str:
    """Every visit of a control point; empty without one."""
    if not rows:
        return ""
    note = (
        '<p class="fine">dE, dN, dU: computed less given. In: used in the estimate; σ of the solution then contains '
        "the point itself. Withheld: an independent check.</p>"
    )
    contrary = [f"{row.point_id} at {fixed(row.t_s, 1)} s" for row in rows if row.is_contrary]
    warning = (
        f'<ul class="warnings"><li><strong>Withheld, and more than {CONTRARY:g} sigma off: {escape(listed(contrary))}'
        "</strong><span>Check the point and its time; or the sigmas of the solution are too small.</span></li></ul>"
        if contrary
        else ""
    )
    body = warning + control_summary(rows).html() + control_table(rows).html() + note
    return section("control", "Control points", body, {"count": len(rows)})


def warnings_section(solution: Solution, summary: Summary) -> str:
    """What may be wrong, and what to do."""
    found = usage.lost_warnings(solution) + facts.warnings(summary)
    if not found:
        text = "No warnings." if "warnings" in summary else "The run did not record warnings."
        return section("warnings", "Warnings", f'<p class="calm">{text}</p>', {"count": 0})
    items = "".join(
        f"<li><strong>{escape(what)}</strong>{f'<span>{escape(remedy)}</span>' if remedy else ''}</li>"
        for what, remedy in found
    )
    return section("warnings", "Warnings", f'<ul class="warnings">{items}</ul>', {"count": len(found)})


def used(session: Session, solution: Solution, summary: Summary) -> str:
    """Measurements used, dropped and rejected, and why."""
    recorded = {name: len(stream) for name, stream in session.streams().items() if name != "reference"}
    lines = "".join(f"<li>{escape(line)}</li>" for line in usage.why_lines(summary))
    why = f'<ul class="plain">{lines}</ul>' if lines else '<p class="calm">Nothing was rejected or dropped.</p>'
    if not lines and not {"rejected", "dropped"} & set(summary):
        why = '<p class="calm">The run did not record what was rejected or dropped.</p>'
    small = usage.small_residuals_sentence(summary)
    parts = [
        usage.used_table(summary, recorded).html(),
        why,
        _outage(solution),
        _rejections(summary),
        *(
            table.html()
            for table in (
                usage.outcomes_table(summary, "image_pairs", "image pairs"),
                usage.outcomes_table(summary, "tracks", "tracked points"),
                usage.models_table(summary),
            )
            if table
        ),
        *(f"<p>{escape(line)}</p>" for line in usage.camera_lines(summary)),
        f"<p>{escape(small)}</p>" if small else "",
        '<p class="fine">χ² / dof: sum of the squared residuals over their sigmas, divided by the redundancy; '
        "expected 1.</p>",
    ]
    return section("used", "Measurements used", "".join(parts))


def _outage(solution: Solution) -> str:
    """The longest time without a position."""
    outage = usage.longest_outage(solution)
    if outage is None:
        return ""
    data = {"start-s": outage.start_s, "length-s": outage.length_s}
    return f'<p id="outage"{attributes(data)}>{escape(usage.outage_sentence(outage))}</p>'


def _rejections(summary: Summary) -> str:
    """The rejected measurements one by one, collapsed."""
    table = usage.rejections_table(summary)
    if not table.rows:
        return ""
    head = f"{plural(len(table.rows), 'rejected measurement')}"
    return f'<details class="rejections"><summary>{escape(head)}</summary>{table.html()}</details>'


def gap_section(summary: Summary, gaps: list[ImuGap]) -> str:
    """The IMU data gaps."""
    title = "IMU data gaps"
    if not gaps:
        known = "gaps" in summary
        text = "No IMU data gaps." if known else "The run did not record IMU data gaps."
        return section("imu-gaps", title, f'<p class="calm">{text}</p>', {"count": 0 if known else None})
    items = "".join(
        f'<li class="imu-gap"{attributes({"start-s": gap.start_s, "length-s": gap.length_s, "kind": gap.kind})}>'
        f"{escape(facts.gap_sentence(gap))}</li>"
        for gap in gaps
    )
    meaning = {
        "bridged": "Linearly interpolated: on all six axes the samples follow an exact straight line, which no sensor "
        "measures; they were made before the import.",
        "missing": "No samples: timestamps jump.",
    }
    lead = " ".join(text for kind, text in meaning.items() if any(gap.kind == kind for gap in gaps))
    tail = "The gap error model raises the uncertainty of the motion inside a gap."
    body = f'<p>{escape(f"{lead} {tail}".strip())}</p><ul class="plain columns">{items}</ul>'
    total = round(sum(gap.length_s for gap in gaps), 6)
    return section("imu-gaps", title, body, {"count": len(gaps), "total-s": total})


def plots_over_time(solution: Solution, gaps: charts.Intervals, causal_solution: Solution | None) -> list[str]:
    """The plots over time; none for a run of a single epoch."""
    if len(solution) < 2:
        return []
    sigmas = statistics.uncertainty_table(solution).html()
    sigmas += '<p class="fine">Which measurements determine the state at a time T: smartnav explain RUN --at T.</p>'
    parts = [
        section("uncertainty", "Uncertainty", charts.uncertainty(solution, gaps, causal_solution) + sigmas),
        section("motion", "Speed and height", charts.motion(solution, gaps)),
        section("attitude", "Attitude", charts.attitude(solution, gaps)),
        section("biases", "Sensor biases", charts.biases(solution, gaps)),
    ]
    if not len(solution.residuals):
        return [*parts, section("residuals", "Residuals", '<p class="calm">The run recorded no residuals.</p>')]
    note = (
        '<p class="fine">Residuals after the adjustment: with little redundancy they are smaller than the standard '
        "normal curve; χ² / dof above takes this into account.</p>"
    )
    both = note + charts.residual_histograms(solution) + charts.residuals_over_time(solution, gaps)
    return [*parts, section("residuals", "Residuals", both)]


def withheld_section(
    summary: Summary, scored: Mapping[str, charts.Scored], solution: Solution, gaps: charts.Intervals
) -> str:
    """Measurements withheld from the estimate and compared with it."""
    table = usage.withheld_table(summary)
    if not table:
        return ""
    pictures = [charts.withheld(name, rows, solution, gaps) for name, rows in scored.items()]
    lead = (
        "<p>These measurements were not used in the estimate; the differences contain the errors of both, measurement "
        "and estimate.</p>"
    )
    total = {"count": round(sum(facts.withheld_counts(summary).values()))}
    return section("withheld", "Withheld measurements", lead + table.html() + "".join(pictures), total)


def against_reference(evaluation: Evaluation | None, solution: Solution, gaps: charts.Intervals) -> str:
    """Errors against a reference trajectory."""
    if evaluation is None:
        return ""
    compared = evaluation.to_dict()
    horizontal = np.linalg.norm(evaluation.error_enu_m[:, :2], axis=1)
    tables = [reference.absolute_table(compared), reference.relative_table(compared), reference.nees_table(compared)]
    body = f"<p>{escape(reference.matched_sentence(compared))}</p>" + "".join(t.html() for t in tables if t)
    consistency = reference.nees_sentence(compared)
    body += f"<p>{escape(consistency)}</p>" if consistency else ""
    body += "".join(f'<p class="fine">{escape(note)}</p>' for note in evaluation.notes)
    body += charts.distribution(horizontal, "errors against the reference")
    if len(solution) > 1:
        body += charts.errors_over_time(evaluation, solution, gaps)
    return section("reference", "Comparison with the reference", body)


def estimation(summary: Summary) -> list[str]:
    """Session states, initialisation, solver, timings, versions."""
    sentence, start = session_states.initialisation(summary)
    began = (f"<p>{escape(sentence)}</p>" if sentence else "") + _html(start)
    clocks = "".join(f'<p class="clock">{escape(text)}</p>' for text in session_states.clock_sentences(summary))
    states = "".join(table.html() for _, table in session_states.tables(summary))
    return [
        section("states", "Estimated calibration and noise", clocks + states),
        section("start", "Initialisation", began or '<p class="calm">The run did not record it.</p>'),
        section("solver", "Solver", _html(facts.solver_table(summary))),
        section("timings", "Computing time", timing_bars(numbers_of(summary, "timings_s"))),
        section("versions", "Versions", _html(facts.versions_table(summary))),
    ]


def _html(table: Table) -> str:
    """The HTML of a table; empty without rows."""
    return table.html() if table else ""


def timing_bars(timings: Mapping[str, float]) -> str:
    """Seconds of each part of the computation, with bars."""
    most = max((v for v in timings.values()), default=0.0)
    rows = "".join(
        f'<tr><th scope="row">{escape(facts.timing_name(name, timings))}</th>'
        f'<td class="n">{fixed(value, 3)} s</td><td class="wide">'
        f'<svg class="meter" viewBox="0 0 1000 10" preserveAspectRatio="none" aria-hidden="true">'
        f'<rect class="{"total" if name == "total" else "part"}" width="{1000 * value / most if most else 0:.0f}" '
        f'height="10"/></svg></td></tr>'
        for name, value in timings.items()
    )
    return f'<div class="scroll"><table><tbody>{rows}</tbody></table></div>' if rows else ""
