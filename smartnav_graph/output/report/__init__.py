"""One run on one page: a self-contained HTML report, and the same facts as Markdown.

The page has inline SVG figures, inline CSS and one inline script (values under the pointer), and no network address: it
opens offline and prints. Lines are thinned by `smartnav_graph.output.report.thin`.

``data-`` attributes hold the figures in full precision: ``#imu-gaps[data-count]`` with ``.imu-gap[data-start-s]
[data-length-s][data-kind]``, ``tr[data-sensor][data-rejected]``, ``tr[data-withheld][data-rms-horizontal-m]``,
``#sigma-at[data-t-s][data-sigma-horizontal-m]``, ``#outage[data-start-s][data-length-s]``,
``tr[data-state][data-value][data-sigma]``.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from smartnav_graph.core.files import replacing
from smartnav_graph.estimate.both_ways import BothWays
from smartnav_graph.estimate.config import Config
from smartnav_graph.estimate.result.diagnostics import Updates
from smartnav_graph.evaluation import Evaluation
from smartnav_graph.graph.solution import Solution
from smartnav_graph.output.report import facts, reference, session_states, usage
from smartnav_graph.output.report.charts import Scored
from smartnav_graph.output.report.sections import page
from smartnav_graph.output.summary_json import Summary, imu_gaps, verdict_lines
from smartnav_graph.session.session import Session

__all__ = ["report_markdown", "write_report"]


def write_report(
    path: str | Path,
    *,
    session: Session,
    solution: Solution,
    summary: Summary,
    evaluation: Evaluation | None = None,
    causal: Solution | None = None,
    withheld: Mapping[str, Scored] | None = None,
    updates: Updates | None = None,
    config: Config | None = None,
    ways: BothWays | None = None,
) -> None:
    """Write the report of one run as a single HTML file; an older file at `path` is replaced.

    Parameters
    ----------
    path : the file
    session : what was recorded
    solution : the smoothed states
    summary : the table of summary.json; missing parts are left out or reported as not recorded
    evaluation : comparison with a reference
    causal : the causal states of a replay
    withheld : by sensor, errors at withheld measurements: ``t_ns`` (n,) int64 and ``error`` (n, 3) m east, north, up
    updates : of a replay
    ways : the filter forward and backward
    config : options of the run, and company, logo, time zone and coordinate system of the report

    Raises
    ------
    SessionError
        The file cannot be written.
    """
    text = page(session, solution, summary, evaluation, causal, withheld or {}, updates, config, ways)
    with replacing(path) as new:
        new.write_text(text, encoding="utf-8")


def report_markdown(summary: Summary, evaluation: Evaluation | None = None) -> str:
    """The headline, warnings and tables of the report as Markdown."""
    parts = ["# Run report", " ".join(facts.headline(summary))]
    if lines := verdict_lines(summary):
        parts += ["## Verdict", "\n".join(f"- {line}" for line in lines)]
    warnings = facts.warnings(summary)
    if warnings:
        parts += ["## Warnings", "\n".join(f"- **{what}** {remedy}".rstrip() for what, remedy in warnings)]
    why = "\n".join(f"- {line}" for line in usage.why_lines(summary))
    gaps = "\n".join(f"- {facts.gap_sentence(gap)}" for gap in imu_gaps(summary))
    start, start_table = session_states.initialisation(summary)
    tables = [
        ("Measurements used", why, usage.used_table(summary, {})),
        ("Image pairs", "", usage.outcomes_table(summary, "image_pairs", "image pairs")),
        ("Camera beside the gyroscope", "\n".join(f"- {line}" for line in usage.camera_lines(summary)), None),
        ("IMU data gaps", gaps, None),
        ("Withheld measurements", "", usage.withheld_table(summary)),
    ]
    if evaluation is not None:
        compared = evaluation.to_dict()
        title, sentence = "Comparison with the reference", reference.matched_sentence(compared)
        tables.append((title, sentence, reference.absolute_table(compared)))
    tables += [
        *((title, "", table) for title, table in session_states.tables(summary)),
        ("Initialisation", start, start_table),
        ("Solver", "", facts.solver_table(summary)),
        ("Computing time", "", facts.timings_table(summary)),
        ("Versions", "", facts.versions_table(summary)),
    ]
    for title, lead, table in tables:
        body = [part for part in (lead, table.markdown() if table else "") if part]
        parts += [f"## {title}", *body] if body else []
    return "\n\n".join(parts) + "\n"
