"""The tables of the report for other programs: report.json with all of them, and a CSV each of those with rows."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

from smartnav_graph.estimate.config import Config
from smartnav_graph.graph.solution import Solution
from smartnav_graph.output.report.about import facts_of, options_of
from smartnav_graph.output.report.control_points import control_rows
from smartnav_graph.output.summary_json import Summary, plain, rows_of, table_of
from smartnav_graph.session.session import Session

AXES = ("e", "n", "u")
PLACE = ("crs_east", "crs_north", "crs_height")


def write_tables(folder: Path, *, session: Session, solution: Solution, summary: Summary, config: Config) -> None:
    """Write ``report.json``, ``control_points.csv``, ``rejected.csv`` and ``settings.csv``; those without rows are left
    out. Units are in the names, unknown values are empty."""
    tables: dict[str, Sequence[Mapping[str, object]]] = {
        "control_points": _points(session, solution, summary, config.report.crs),
        "rejected": rows_of(summary, "rejections"),
        "settings": [{"option": one.name, "value": one.value, "default": one.default} for one in options_of(config)],
    }
    counts = {
        name: table_of(summary, name) for name in ("used", "rejected", "dropped", "withheld", "states", "verdict")
    }
    about = dict(facts_of(session, solution, summary, config))
    text = json.dumps(
        plain({"about": about, **counts, "tables": tables}), indent=1, ensure_ascii=False, allow_nan=False
    )
    (folder / "report.json").write_text(text + "\n", encoding="utf-8")
    for name, rows in tables.items():
        if rows:
            with open(folder / f"{name}.csv", "w", encoding="utf-8", newline="") as file:
                writer = csv.DictWriter(file, list(dict.fromkeys(key for row in rows for key in row)))
                writer.writeheader()
                writer.writerows({key: plain(value) for key, value in row.items()} for row in rows)


def _points(session: Session, solution: Solution, summary: Summary, crs: str) -> list[Mapping[str, object]]:
    """Visits of control points; differences are computed less given."""
    found: list[Mapping[str, object]] = []
    for row in control_rows(session, solution, summary, crs):
        cells: dict[str, object] = {"point_id": row.point_id, "use": row.use, "t_s": row.t_s}
        for name, values in (
            ("d{}_m", row.difference),
            ("sigma_point_{}_m", row.sigma_point),
            ("sigma_solution_{}_m", row.sigma),
        ):
            cells |= {name.format(axis): float(value) for axis, value in zip(AXES, values, strict=True)}
        found.append(cells | dict(zip(PLACE, row.place, strict=False)))
    return found
