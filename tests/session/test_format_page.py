"""The page about the session folder is what the code says."""

from pathlib import Path

import pytest

from smartnav_graph.cli import main
from smartnav_graph.session.format_page import format_page, unit_of
from smartnav_graph.session.streams import STREAMS

PAGE = Path(__file__).parents[2] / "docs" / "session-format.md"


def test_the_page_of_the_docs_is_up_to_date(capsys):
    assert main(["formats", "--columns"]) == 0
    assert PAGE.read_text(encoding="utf-8") == capsys.readouterr().out, f"smartnav formats --columns > {PAGE}"


def test_every_stream_and_column_is_there():
    page = format_page()
    for name, kind in STREAMS.items():
        section = page.split(f"### {name}.parquet")[1].split("\n### ")[0]
        for spec in kind.specs():
            assert all(f"| `{column}` |" in section for column in spec.metadata["columns"])


@pytest.mark.parametrize(
    ("column", "unit"),
    [
        ("t_ns", "ns"),
        ("t_ns_1", "ns"),
        ("accel_x_m_s2", "m/s^2"),
        ("v_x_m_s", "m/s"),
        ("e_m", "m"),
        ("qw", ""),
        ("x0_n", "1"),
    ],
)
def test_units(column, unit):
    assert unit_of(column) == unit
