"""The tables beside the report say what the report says."""

from __future__ import annotations

import csv
import json

import numpy as np

from smartnav_graph.estimate.config import Config, RunConfig
from smartnav_graph.output.report.tables import write_tables
from smartnav_graph.session.streams import ControlPoint


def rows(path):
    with open(path, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_tables_of_a_drive(tmp_path, case):
    at = [40, 90]
    points = ControlPoint(
        t_ns=case.solution.t_ns[at],
        enu=case.solution.nav_t_body[at] + [0.25, 0.0, np.nan],
        point_id=np.array(["A, 1", "B"], dtype=object),
    )
    summary = case.summary | {
        "rejections": [{"t_s": 50.0, "sensor": "gnss", "row": 50, "size_sigma": 9.0, "size_m": 54.1}]
    }
    config = Config(run=RunConfig(vehicle="car"))
    session = case.session.replace(control=points)
    write_tables(tmp_path, session=session, solution=case.solution, summary=summary, config=config)
    first, _ = rows(tmp_path / "control_points.csv")
    assert (first["point_id"], first["t_s"], first["du_m"], first["sigma_point_e_m"]) == ("A, 1", "40.0", "", "")
    assert float(first["de_m"]) == -0.25 and float(first["sigma_solution_e_m"]) > 0.01
    assert rows(tmp_path / "rejected.csv") == [
        {"t_s": "50.0", "sensor": "gnss", "row": "50", "size_sigma": "9.0", "size_m": "54.1"}
    ]
    changed = [row for row in rows(tmp_path / "settings.csv") if row["value"] != row["default"]]
    assert changed == [{"option": "run.vehicle", "value": "car", "default": "none"}]
    found = json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))
    assert found["tables"]["control_points"][0]["de_m"] == -0.25
    assert found["tables"]["control_points"][0]["du_m"] is None and found["used"] == {"gnss": 231}


def test_empty_tables_are_left_out(tmp_path, case):
    write_tables(tmp_path, session=case.session, solution=case.solution, summary={}, config=Config())
    assert {file.name for file in tmp_path.iterdir()} == {"report.json", "settings.csv"}
