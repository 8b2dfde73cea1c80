"""The report of one calibration as a self-contained HTML page, in the style of the run report."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape
from pathlib import Path

import numpy as np

from smartnav_graph.calibrate.result import Chart
from smartnav_graph.core.files import replacing
from smartnav_graph.output.report.charts import figure
from smartnav_graph.output.report.sections import contents, section
from smartnav_graph.output.report.svg import Plot, axis, log_axis
from smartnav_graph.output.report.template import filled, whole_page
from smartnav_graph.output.text import Row, Table, number
from smartnav_graph.session.calibration.pieces import Piece

CLASSES = {"line": "line s{}", "dots": "dots s{}", "band": "band s{}"}


def write_calibration_report(path: str | Path, kind: str, piece: Piece, charts: Sequence[Chart] = ()) -> None:
    """Write the report; an older file at `path` is replaced.

    Every value is a row ``tr[data-value-name][data-value][data-sigma]``.
    """
    parts = [
        warnings_part(piece),
        section("values", "Values", values_table(piece).html()),
        section("residuals", "Residuals", residuals_table(piece).html() if piece.residuals else ""),
        *(section(f"chart-{_letter(i)}", chart.title, drawn(chart)) for i, chart in enumerate(charts)),
    ]
    body = "\n".join(part for part in parts if part)
    title = f"{kind.capitalize()} calibration"
    lead = f"{len(piece.values)} values of {escape(', '.join(piece.sources))}, {escape(piece.date)}."
    head = (
        f'<header id="headline"><p class="kicker">smartnav calibration report</p><h1>{escape(title)}</h1>'
        f'<p class="lead">{lead}</p></header>{filled("contents", contents=contents(body))}'
    )
    page = whole_page(title, head, body, footer=f"{title}, {piece.date}")
    with replacing(path) as new:
        new.write_text(page, encoding="utf-8")


def _letter(i: int) -> str:
    return chr(ord("a") + i // 26) + chr(ord("a") + i % 26)


def warnings_part(piece: Piece) -> str:
    """Warnings, and terms that were refused."""
    found = [(text, "") for text in piece.warnings]
    found += [(f"{name}: not determined", why) for name, why in piece.refused.items()]
    items = "".join(f"<li><strong>{escape(what)}</strong><span>{escape(why)}</span></li>" for what, why in found)
    text = f'<ul class="warnings">{items}</ul>' if found else '<p class="calm">No warnings; nothing was refused.</p>'
    return section("warnings", "Warnings and refusals", text, {"count": len(found)})


def values_table(piece: Piece) -> Table:
    """Value, sigma, 95 % interval and unit."""
    rows = []
    for name, v in piece.values.items():
        low, high = v.interval()
        span = "–" if math.isnan(v.sigma) else f"{number(low, 5)} … {number(high, 5)}"
        data = {"value-name": name, "value": v.value, "sigma": None if math.isnan(v.sigma) else v.sigma}
        rows.append(Row((name, number(v.value, 5), number(v.sigma, 2), span, v.unit), data))
    return Table(("", "Value", "Sigma", "95 %", "Unit"), rows, frozenset({3, 4}))


def residuals_table(piece: Piece) -> Table:
    """Root mean squares."""
    rows = [Row((name, number(r.rms, 4), str(r.count), r.unit)) for name, r in piece.residuals.items()]
    return Table(("", "RMS", "Number", "Unit"), rows, frozenset({3}))


def drawn(chart: Chart) -> str:
    """One chart as SVG."""
    xs = np.concatenate([np.asarray(s.x, dtype=np.float64) for s in chart.series])
    ys = np.concatenate(
        [np.asarray(y, dtype=np.float64) for s in chart.series for y in (s.y, s.upper) if y is not None]
    )
    make = log_axis if chart.log else axis
    plot = Plot(make(xs), make(ys), chart.title, chart.y_title, chart.x_title, 320, chart.aspect)
    for s in chart.series:
        if s.mark == "band" and s.upper is not None:
            plot.band(s.x, s.y, s.upper, f"s{s.colour}")
        elif s.mark == "dots":
            plot.dots(s.x, s.y, f"s{s.colour}")
        else:
            plot.line(s.x, s.y, f"s{s.colour}")
    entries = [(CLASSES[s.mark].format(s.colour), s.name) for s in chart.series if s.name]
    return figure([plot], entries, chart.note)
