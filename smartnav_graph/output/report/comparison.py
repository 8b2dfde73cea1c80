"""A trajectory against a reference as a page of its own: `evaluate --report`."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path

from markupsafe import Markup

from smartnav_graph.core.files import replacing
from smartnav_graph.core.timebase import NS, unix_ns
from smartnav_graph.evaluation import Evaluation
from smartnav_graph.graph.solution import Solution
from smartnav_graph.output.report import reference, sections, track
from smartnav_graph.output.report.template import filled, whole_page
from smartnav_graph.output.summary_json import Summary, imu_gaps, table_of, text_of
from smartnav_graph.output.text import metres
from smartnav_graph.session.streams import Reference


def write_comparison_report(
    path: str | Path, name: str, solution: Solution, truth: Reference, evaluation: Evaluation, summary: Summary
) -> None:
    """Write the page; an older file at `path` is replaced.

    Parameters
    ----------
    name : of the trajectory
    truth : the reference, on its own clock
    summary : of the run, for its verdict and data gaps; empty for a trajectory of another program

    Raises
    ------
    SessionError
        The file cannot be written.
    """
    gaps = [(start, start + length) for start, length, _ in imu_gaps(summary)]
    estimate = evaluation.alignment.position(solution.nav_t_body)
    offset_ns = round(evaluation.time_offset_s * NS)
    at = truth.t_ns + offset_ns
    inside = (at >= solution.t_ns[0]) & (at <= solution.t_ns[-1])
    parts = [
        sections.verdict_section(summary),
        sections.section("map", "Trajectories", track.two_paths(estimate, solution.seconds, truth.enu[inside])),
        sections.against_reference(evaluation, solution, gaps),
    ]
    body = "\n".join(part for part in parts if part)
    ape = evaluation.ape_m
    begin = unix_ns(solution.t0_ns, text_of(table_of(summary, "session"), "clock_epoch"))
    tiles = [("Epochs compared", str(evaluation.matched))]
    tiles += [("RMS position", metres(ape.rmse)), ("Largest", metres(ape.max))]
    if evaluation.rotation_deg is not None:
        tiles.append(("RMS rotation", f"{evaluation.rotation_deg.rmse:.3f}°"))
    head = filled(
        "head",
        company="",
        logo="",
        kicker=f"smartnav comparison · smartnav-graph {version('smartnav-graph')}",
        name=f"{name} against {Path(evaluation.reference).name}",
        sentences=reference.matched_sentence(evaluation.to_dict()),
        tiles=tiles,
        sigma=Markup(""),
        contents=sections.contents(body),
    )
    utc_ms = None if begin is None else int(begin) // 1_000_000
    page = whole_page(f"{name}: comparison", head, body, footer=f"{name}, comparison", utc_ms=utc_ms)
    with replacing(path) as new:
        new.write_text(page, encoding="utf-8")
