"""Timeline: one lane for each sensor or event."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from smartnav_graph.core.arrays import Floats
from smartnav_graph.factors import title_of
from smartnav_graph.graph.solution import Solution
from smartnav_graph.output.report.charts import Intervals, Scored, figure, time_of
from smartnav_graph.output.report.svg import Axis, Plot
from smartnav_graph.output.report.thin import thin_dots
from smartnav_graph.output.summary_json import Summary, as_float, numbers_of, rows_of, standstill_spans, text_of
from smartnav_graph.output.text import count
from smartnav_graph.session.streams import POSITIONS

LANE_PX = 34
BAR, OUT = (0.14, 0.44), (0.05, 0.53)  # shares of its lane that a bar and a rejected event fill, from below
NARROWEST = 1 / 500  # of the whole width
SINGLE = 150  # up to so many events are drawn one by one, more as spans
IMAGES = ("image_pairs", "smart")


@dataclass(frozen=True)
class Lane:
    """Name, spans s, their CSS class, and single rejected events s (class ``out``)."""

    name: str
    spans: Intervals
    cls: str
    out: Floats


def lanes(solution: Solution, summary: Summary, gaps: Intervals, withheld: Mapping[str, Scored]) -> list[Lane]:
    """The lanes that are not empty."""
    none = np.zeros(0)
    found = []
    for name in (*POSITIONS, *IMAGES):
        used, out = _times(solution, name, True), _rejected(solution, summary, name)
        if len(used) or len(out):
            number = int(numbers_of(summary, "rejected").get(name) or len(out))
            rejected = f", {count(number)} rejected" if number else ""
            found.append(Lane(f"{title_of(name)} in use{rejected}", event_spans(used), "used", out))
    for name, rows in withheld.items():
        t = np.unique((np.asarray(rows.t_ns) - solution.t0_ns) / 1e9)
        found.append(Lane(f"{title_of(name)} withheld", event_spans(t), "withheld", none))
    standstills = standstill_spans(summary)
    if standstills:
        found.append(Lane("Standstills", standstills, "standstill", none))
    if gaps:
        found.append(Lane("IMU data gaps", gaps, "imu-gap", none))
    return found


def _rejected(solution: Solution, summary: Summary, sensor: str) -> Floats:
    """Times s of the rejections in the summary, else of rows that were not used: two image pairs may share an epoch."""
    rows = [as_float(row.get("t_s")) for row in rows_of(summary, "rejections") if text_of(row, "sensor") == sensor]
    times = [t for t in rows if t is not None]
    return np.unique(times) if times else _times(solution, sensor, False)


def _times(solution: Solution, sensor: str, used: bool) -> Floats:
    """Times s of the rows of a sensor: of those used, or of those of which nothing was used."""
    r = solution.residuals
    rows = r.of(sensor) if len(r) else np.zeros(0, dtype=bool)
    of_used = np.unique(r.t_ns[rows & r.used]) if rows.any() else np.zeros(0, dtype=np.int64)
    if used or not rows.any():
        return np.asarray((of_used - solution.t0_ns) / 1e9)
    rest = np.setdiff1d(r.t_ns[rows], of_used)
    return np.asarray((rest - solution.t0_ns) / 1e9)


def event_spans(t: Floats) -> list[tuple[float, float]]:
    """Few events one by one; many as spans, split where three median spacings pass without an event."""
    if len(t) <= SINGLE:
        return [(float(x), float(x)) for x in t]
    step = np.diff(t)
    breaks = np.flatnonzero(step > max(3.0 * float(np.median(step)), 1.0))
    first, last = np.concatenate([[0], breaks + 1]), np.concatenate([breaks, [len(t) - 1]])
    return [(float(t[a]), float(t[b])) for a, b in zip(first, last, strict=True)]


def draw(solution: Solution, summary: Summary, gaps: Intervals, withheld: Mapping[str, Scored]) -> str:
    """The lanes as one figure; empty for a run of a single epoch, or without lanes."""
    found = lanes(solution, summary, gaps, withheld) if len(solution) > 1 else []
    if not found:
        return ""
    n = len(found)
    edges = tuple(float(i) for i in range(n + 1))
    plot = Plot(time_of(solution), Axis(0.0, float(n), edges, ("",) * (n + 1)), "Timeline")
    plot.height_px = LANE_PX * n
    for i, lane in enumerate(found):
        _lane(plot, lane, float(n - 1 - i))
    return figure([plot], [("lane out", "Rejected")] if any(len(lane.out) for lane in found) else [])


def _lane(plot: Plot, lane: Lane, base: float) -> None:
    width = NARROWEST * (plot.x.hi - plot.x.lo)
    out = lane.out[thin_dots(np.zeros(len(lane.out), dtype=bool), 400)]
    for spans, cls, share in ((lane.spans, lane.cls, BAR), ([(float(x), float(x)) for x in out], "out", OUT)):
        low, high = base + share[0], base + share[1]
        for start, end in spans:
            a, b = max(start, plot.x.lo), min(max(end, start + width), plot.x.hi)
            if b > a:
                plot.area([a, b, b, a], [low, low, high, high], f"lane {cls}")
    plot.text(plot.x.lo, base + BAR[1], lane.name, "note", dx=5, dy=-5)
