"""A heading that nothing shows is said to be unknown; one that a magnetometer or the motion shows is not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from smartnav_graph.cli.text import run_text
from smartnav_graph.estimate.config import Config
from smartnav_graph.estimate.replay import replay
from smartnav_graph.estimate.run import Run, smooth
from smartnav_graph.output.report import report_markdown
from smartnav_graph.simulation.scenarios import find_scenario

UNIFORM_DEG = 180.0 / np.sqrt(3.0)


def at_rest(causal: bool = False, **sensors: object) -> Run:
    scenario = replace(find_scenario("static-60s"), seconds=20.0, barometer=None, **sensors)
    config = Config()
    if causal:
        return replay(scenario(3), replace(config, replay=replace(config.replay, polish=False)))
    return smooth(scenario(3), config)


@pytest.mark.parametrize("causal", [False, True])
def test_at_rest_without_magnetometer_the_heading_is_unknown(causal):
    run = at_rest(causal, magnetometer=None)
    assert run.summary["heading_known"] is False
    solutions = [run.solution] if run.causal is None else [run.solution, run.causal]
    assert all((solution.sigma_heading_deg > UNIFORM_DEG - 0.1).all() for solution in solutions)
    assert (run.solution.sigmas[:, :2] < np.radians(2.0)).all()  # the vertical is known
    lines = run_text(run.summary | {"timings_s": {"total": 1.0}}, Path("run"))
    assert "start: Heading unknown" in lines and "warning: heading: unknown" in lines
    page = report_markdown(run.summary)
    assert "The heading is unknown." in page and "--initial" in page


def test_a_magnetometer_shows_the_heading_at_rest():
    run = at_rest()
    assert run.summary["heading_known"] and run.solution.sigma_heading_deg.max() < 10.0
    assert "The heading is unknown" not in report_markdown(run.summary)


def test_motion_shows_the_heading():
    run = smooth(replace(find_scenario("figure-eight-60s"), seconds=20.0)(0))
    assert run.summary["heading_known"] and run.solution.sigma_heading_deg.max() < 20.0
    assert not any("heading: unknown" in text for text in run.summary["warnings"])
