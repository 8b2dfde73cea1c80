"""A run that was computed is written; what its report cannot show is said before."""

from __future__ import annotations

import numpy as np
import pytest

import smartnav_graph as sn
from smartnav_graph.cli import main, runs
from smartnav_graph.core.progress import silent
from smartnav_graph.estimate import both_ways, run
from smartnav_graph.simulation.scenarios import simulate

EMPTY = both_ways.BothWays(np.zeros(0, dtype=np.int64), np.zeros((0, 3)), np.zeros((0, 3)))


def test_ways_that_cannot_be_compared_are_left_out(monkeypatch, capsys):
    session = simulate("figure-eight-60s", 3)
    assert runs.forward_and_backward(session.replace(imu=None), sn.Config(), silent) is None
    monkeypatch.setattr(both_ways, "both_ways", lambda *_: EMPTY)
    assert runs.forward_and_backward(session, sn.Config(), silent) is None
    without_imu, apart = capsys.readouterr().err.splitlines()
    assert "not compared: " in without_imu and apart.endswith("no time in common")


@pytest.mark.parametrize(
    ("option", "says"), [("crs = 'EPSG:1'", "is not known"), ("logo = 'gone.png'", "cannot be read")]
)
def test_a_report_that_cannot_be_written_is_refused_first(monkeypatch, tmp_path, capsys, option, says):
    (tmp_path / "c.toml").write_text(f"[report]\n{option}\n")
    monkeypatch.setattr(run, "smooth", lambda *_, **__: pytest.fail("began to estimate"))
    line = ["smooth", str(tmp_path), "--config", str(tmp_path / "c.toml"), "--out", str(tmp_path / "run"), "--quiet"]
    assert main(line) == 1 and says in capsys.readouterr().err
