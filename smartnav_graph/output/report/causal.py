"""Real-time performance of a replay, update by update: computing time, change of earlier states, clock offsets."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from smartnav_graph.core.arrays import Floats, Times
from smartnav_graph.estimate.result.diagnostics import Updates
from smartnav_graph.graph.solution import Solution
from smartnav_graph.output.report.charts import Intervals, core, figure, over_time, shaded
from smartnav_graph.output.report.session_states import CLOCK, parts_of
from smartnav_graph.output.report.svg import axis, finite_values, spread_axis
from smartnav_graph.output.text import Row, Table, count, metres, number, plural

SMALLEST_M = 1e-4  # smaller changes are drawn as this


def updates_table(updates: Updates) -> Table:
    """Median, 99 % and largest of each figure of the updates."""
    rows = [
        _row("Computing time", updates.latency_ms, lambda v: f"{number(v)} ms"),
        _row("States relinearised", updates.relinearised, count),
        _row("Change of earlier states", updates.corrected, metres),
    ]
    return Table((plural(len(updates.t_ns), "update"), "Median", "99 %", "Largest"), rows)


def _row(name: str, values: Floats | Times, shown: Callable[[object], str]) -> Row:
    return Row([name, *(shown(v) for v in (*np.percentile(values, [50, 99]), np.max(values)))])


def draw(updates: Updates, solution: Solution, gaps: Intervals) -> str:
    """Table and figures of the updates; empty for fewer than two."""
    if len(updates.t_ns) < 2 or len(solution) < 2:
        return ""
    t = (updates.t_ns - solution.t0_ns) / 1e9
    changed = np.maximum(updates.corrected, SMALLEST_M)
    change = over_time(solution, spread_axis(changed), "Change of earlier states [m]", gaps, 130)
    change.line(t, changed, "s0")
    both = np.concatenate([updates.solved, updates.relinearised])
    work = over_time(solution, axis(both, include=(0.0,), count=4), "States of an update [count]", gaps, 130)
    work.line(t, updates.solved.astype(float), "s1")
    work.line(t, updates.relinearised.astype(float), "s0")
    cost = over_time(
        solution, axis(core(updates.latency_ms, 2.0), include=(0.0,), count=4), "Computing time [ms]", gaps, 130
    )
    cost.line(t, updates.latency_ms, "s3")
    entries = [("line s1", "States solved for"), ("line s0", "States relinearised, all iterations"), *shaded(gaps)]
    note = (
        "<p>Each update adds one keyframe and corrects the keyframes that are still in its window. The change of "
        "earlier states is the largest distance by which one of them moved.</p>"
    )
    return (
        note + updates_table(updates).html() + figure([change, work, cost], entries) + _clocks(updates, solution, gaps)
    )


def _clocks(updates: Updates, solution: Solution, gaps: Intervals) -> str:
    """Clock offsets as estimated at each update, with one sigma."""
    t, plots = (updates.t_ns - solution.t0_ns) / 1e9, []
    for name, rows in updates.states.items():
        if not name.endswith(CLOCK) or not len(finite_values(rows[:, 0])):
            continue
        value, sigma = 1e3 * rows.T
        (part,) = parts_of(name, 1)
        limits = axis(core(np.concatenate([value - sigma, value + sigma]), 2.0), count=4)
        plot = over_time(solution, limits, f"{part.label} [ms]", gaps, 130)
        plot.band(t, value - sigma, value + sigma, "s0")
        plot.line(t, value, "s0")
        plots.append(plot)
    marks = [("line s0", "Clock offset, causal"), ("band s0", "± 1 sigma"), *shaded(gaps)]
    return figure(plots, marks) if plots else ""
