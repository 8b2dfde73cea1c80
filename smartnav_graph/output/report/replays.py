"""How a replay went, update by update: what it cost, what it corrected, what it learned of the clocks."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core.arrays import Floats
from smartnav_graph.estimate.result.diagnostics import Updates
from smartnav_graph.graph.solution import Solution
from smartnav_graph.output.report.charts import Intervals, figure, over_time, shaded
from smartnav_graph.output.report.constants import parts_of
from smartnav_graph.output.report.svg import axis, finite, spread_axis
from smartnav_graph.output.report.text import Row, Table, count, metres, number, plural

CLOCK = "_time_offset_s"
SMALLEST_M = 1e-4  # corrections below are drawn as this


def table(updates: Updates) -> Table:
    """Median, 99 % and largest of what the updates did."""
    rows = [
        _row("Computing time", updates.latency_ms, lambda v: f"{number(v)} ms"),
        _row("States linearised anew", updates.relinearised, count),
        _row("Correction of the past", updates.corrected, metres),
    ]
    return Table((plural(len(updates.t_ns), "update"), "Median", "99 %", "Largest"), rows)


def _row(name: str, values: NDArray[Any], tell: Callable[[Any], str]) -> Row:
    return Row([name, *(tell(v) for v in (*np.percentile(values, [50, 99]), np.max(values)))])


def draw(updates: Updates, solution: Solution, gaps: Intervals) -> str:
    """Table and figures of the updates; empty for fewer than two."""
    if len(updates.t_ns) < 2 or len(solution) < 2:
        return ""
    t = (updates.t_ns - solution.t0_ns) / 1e9
    corrected = np.maximum(updates.corrected, SMALLEST_M)
    moved = over_time(solution, spread_axis(corrected), "Correction of the past [m]", gaps, 130)
    moved.line(t, corrected, "s0")
    both = np.concatenate([updates.solved, updates.relinearised])
    work = over_time(solution, axis(both, include=(0.0,), count=4), "States of an update [count]", gaps, 130)
    work.line(t, updates.solved.astype(float), "s1")
    work.line(t, updates.relinearised.astype(float), "s0")
    cost = over_time(
        solution, axis(_core(updates.latency_ms), include=(0.0,), count=4), "Computing time [ms]", gaps, 130
    )
    cost.line(t, updates.latency_ms, "s3")
    entries = [("line s1", "States solved for"), ("line s0", "States linearised anew, all iterations"), *shaded(gaps)]
    note = (
        "<p>An update takes in one keyframe. It moves the keyframes that are still in its window: the correction of "
        "the past is the farthest that one of them went.</p>"
    )
    return note + table(updates).html() + figure([moved, work, cost], entries) + _clocks(updates, solution, gaps)


def _clocks(updates: Updates, solution: Solution, gaps: Intervals) -> str:
    """Clock offsets as the updates learned them, with one sigma."""
    t, plots = (updates.t_ns - solution.t0_ns) / 1e9, []
    for name, rows in updates.states.items():
        if not name.endswith(CLOCK) or not len(finite(rows[:, 0])):
            continue
        value, sigma = 1e3 * rows.T
        (part,) = parts_of(name, 1)
        limits = axis(_core(np.concatenate([value - sigma, value + sigma])), count=4)
        plot = over_time(solution, limits, f"{part.label} [ms]", gaps, 130)
        plot.band(t, value - sigma, value + sigma, "s0")
        plot.line(t, value, "s0")
        plots.append(plot)
    marks = [("line s0", "Clock offset as known then"), ("band s0", "± 1 sigma"), *shaded(gaps)]
    return figure(plots, marks) if plots else ""


def _core(values: Floats) -> Floats:
    """All but the most extreme 2 % on either side."""
    v = finite(values)
    return np.percentile(v, [2, 98]) if len(v) else v
