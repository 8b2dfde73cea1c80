"""One run on one page: a self-contained HTML report, and the same facts as Markdown.

The page holds its pictures as inline SVG and its style as inline CSS; it has no script and names no address, so that
it opens anywhere, offline, and prints. How lines are thinned stands in `smartnav_graph.output.report.thin`.

``data-`` attributes carry the figures in full precision: ``#imu-holes[data-count]`` with ``.hole[data-start-s]
[data-length-s][data-kind]``, ``tr[data-sensor][data-rejected]``, ``tr[data-withheld][data-rms-horizontal-m]``,
``#sigma-at[data-t-s][data-sigma-horizontal-m]``, ``#silence[data-start-s][data-length-s]``,
``tr[data-state][data-value][data-sigma]``.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from smartnav_graph.core.files import replacing
from smartnav_graph.estimate.result.diagnostics import Updates
from smartnav_graph.graph.solution import Solution
from smartnav_graph.output.report import constants, facts, usage
from smartnav_graph.output.report.charts import Scored
from smartnav_graph.output.report.sections import page
from smartnav_graph.session.session import Session

__all__ = ["report_markdown", "write_report"]


def write_report(
    path: str | Path,
    *,
    session: Session,
    solution: Solution,
    summary: Mapping[str, Any],
    evaluation: Any = None,
    causal: Solution | None = None,
    withheld: Mapping[str, Scored] | None = None,
    updates: Updates | None = None,
) -> None:
    """Write the report of one run as a single HTML file; what stood at `path` is replaced.

    Parameters
    ----------
    path : the file
    session : what was recorded
    solution : the smoothed states
    summary : the table of summary.json; a part that is missing is left out, or said to be missing
    evaluation : comparison with a reference: ``to_dict()``, and per epoch ``t_ns`` (n,), ``error_enu_m`` (n, 3),
        ``rotation_error_deg`` (n,), ``sigma_enu`` (n, 3)
    causal : the states as each became known while replaying
    withheld : by sensor, errors at withheld measurements: ``t_ns`` (n,) int64 and ``error`` (n, 3) m east, north, up
    updates : of a replay

    Raises
    ------
    SessionError
        The file cannot be written.
    """
    text = page(session, solution, summary, evaluation, causal, withheld or {}, updates)
    with replacing(path) as new:
        new.write_text(text, encoding="utf-8")


def report_markdown(summary: Mapping[str, Any], evaluation: Any = None) -> str:
    """The headline, warnings and tables of the report as Markdown."""
    parts = ["# Run report", " ".join(facts.headline(summary))]
    told = facts.warnings(summary)
    parts += ["## Warnings", "\n".join(f"- **{what}** {remedy}".rstrip() for what, remedy in told)] if told else []
    compared = facts.evaluation_facts(evaluation)
    start, start_table = constants.initialisation(summary)
    holes = [f"- {facts.hole_sentence(*hole)}" for hole in facts.gaps(summary)]
    used = ("What was used", "\n".join(f"- {line}" for line in usage.why_lines(summary)), usage.used_table(summary, {}))
    tables = [
        used,
        ("Image pairs", "", usage.fates_table(summary, "image_pairs", "image pairs")),
        ("IMU holes", "\n".join(holes), None),
        ("Withheld measurements", "", usage.withheld_table(summary)),
        ("Against the reference", facts.evaluation_sentence(compared), facts.evaluation_table(compared)),
        *((title, "", table) for title, table in constants.constants(summary)),
        ("Start", start, start_table),
        ("Solver", "", facts.solver_table(summary)),
        ("Timings", "", facts.timings_table(summary)),
        ("Versions", "", facts.versions_table(summary)),
    ]
    for title, lead, table in tables:
        if title == "Against the reference" and not compared:
            continue
        body = [part for part in (lead, table.markdown() if table else "") if part]
        parts += [f"## {title}", *body] if body else []
    return "\n\n".join(parts) + "\n"
