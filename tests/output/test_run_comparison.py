"""Two runs beside each other, in words and tables."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

import smartnav_graph as sn
from smartnav_graph.evaluation.compare import MEASURES
from smartnav_graph.output.run_comparison import MEANING, compare_runs
from smartnav_graph.output.run_folder import plain, read_run, write_run


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Two runs of one session: all fixes, and one in two, along a shorter stretch."""
    folder, session = tmp_path_factory.mktemp("runs"), sn.simulate("figure-eight-60s", 3)
    for name, options in (("all", {"end_s": 20.0}), ("half", {"end_s": 20.0, "withhold": ("gnss:every=2",)})):
        write_run(sn.run(session, **options), folder / name, report=False, recording=False)
    return read_run(folder / "all"), read_run(folder / "half")


def test_text_has_differences_and_options(runs):
    found = compare_runs(*runs)
    text = found.to_text()
    assert text.startswith(f"{runs[1].path} minus {runs[0].path} at {len(found.states)} common epochs (of ")
    assert re.search(r"^run\.withhold +\[\] +\[gnss:every=2\]$", text, re.MULTILINE)
    assert re.search(r"^withheld\.gnss +- +[\d.]+$", text, re.MULTILINE)
    assert max(len(line) for line in text.splitlines()[1:] if line != MEANING) <= 80
    (line,) = [line for line in text.splitlines() if line.startswith("horizontal m")]
    largest = found.states.statistics(MEASURES[1])
    assert MEANING in text.splitlines()
    assert line.split()[5:7] == [f"{largest.statistics.max:.4g}", f"{largest.largest_at_s:.2f}"]


def test_json_holds_all_of_it(runs):
    told = json.loads(json.dumps(plain(compare_runs(*runs).to_dict()), allow_nan=False))
    assert told["first"].endswith("all") and told["config"] == {"run.withhold": [[], ["gnss:every=2"]]}
    assert told["position_m"]["sigma_ratio"] > 1.0  # fewer fixes, less certain
    assert told["rejected"] == {}


def test_rejected_rows_of_one_run_are_named(runs):
    one, other = runs
    summary = {**other.summary, "rejections": [{"sensor": "gnss", "row": 4}, {"sensor": "gnss", "row": 7}]}
    text = compare_runs(one, replace(other, summary=summary)).to_text()
    assert "rejected gnss: in both 0, only in first: 0, only in second: 2 (rows 4, 7)" in text


def test_few_common_epochs_are_reported_with_a_remedy(runs):
    one, other = runs
    every = np.arange(0, len(other.solution), 5)
    names = ("t_ns", "nav_R_body", "nav_t_body", "nav_v_body", "accel_bias", "gyro_bias", "covariance")
    columns = {name: getattr(other.solution, name) for name in names}
    moved = columns["t_ns"] + 1  # another clock's rounding: no stamp in common but every fifth
    moved[every] -= 1
    text = compare_runs(one, replace(other, solution=replace(other.solution, **(columns | {"t_ns": moved})))).to_text()
    assert "use the same --rate HZ for both to get more" in text.splitlines()[0]


def test_the_document_has_a_table_for_each_kind(runs):
    document = compare_runs(*runs).to_markdown()
    assert (
        "| position m |" in document
        and "| config | all | half |" in document
        and "| figures | all | half |" in document
    )
