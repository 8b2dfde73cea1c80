from __future__ import annotations

from pathlib import Path

import pytest
from drive_case import Drive, drive

from smartnav_graph.output.report import write_report


@pytest.fixture(scope="session")
def case() -> Drive:
    return drive()


@pytest.fixture(scope="session")
def page(case: Drive, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The full report of the made-up drive."""
    path = tmp_path_factory.mktemp("report") / "report.html"
    write_report(
        path,
        session=case.session,
        solution=case.solution,
        summary=case.summary,
        evaluation=case.evaluation,
        causal=case.causal,
        withheld=case.withheld,
        updates=case.updates,
    )
    return path
