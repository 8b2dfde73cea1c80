"""What may lie between a fix and its neighbours."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from smartnav_graph.estimate.reweight.outliers import _by_correlated_error
from smartnav_graph.graph.pass_state import PassState
from smartnav_graph.session.calibration.model import GnssNoise

NOISE = GnssNoise()
ROWS, T_S = np.arange(8), np.arange(8.0)


def allowed(rejected, correlated=frozenset({"gnss"})):
    state = PassState(correlated=correlated, rejected={"gnss": frozenset(rejected)})
    return _by_correlated_error(SimpleNamespace(name="gnss", noise=NOISE), ROWS, T_S, state)


def test_a_correlated_error_changes_as_a_gauss_markov_process_between_the_rows_in_use():
    """The error at 4 s less its mean given those at 3 and 6 s."""
    found = allowed({4, 5})
    assert not found[[0, 1, 2, 3, 6, 7]].any()
    phi = np.exp(-np.abs(np.subtract.outer([4.0, 3.0, 6.0], [4.0, 3.0, 6.0])) / NOISE.correlated_time)
    left = phi[0, 0] - phi[0, 1:] @ np.linalg.solve(phi[1:, 1:], phi[1:, 0])
    assert found[4, 0] == pytest.approx(NOISE.correlated_horizontal_sigma * np.sqrt(left), rel=0.02)
    assert found[4, 2] == pytest.approx(NOISE.correlated_vertical_sigma * np.sqrt(left), rel=0.02)


def test_at_an_end_it_grows_to_the_whole_of_it():
    found = allowed({5, 6, 7})
    left = 1.0 - np.exp(-2.0 * 3.0 / NOISE.correlated_time)
    assert found[7, 0] == pytest.approx(NOISE.correlated_horizontal_sigma * np.sqrt(left))
    assert allowed(set(ROWS.tolist()))[:, 1] == pytest.approx(NOISE.correlated_horizontal_sigma)


def test_without_such_a_state_there_is_none():
    assert not allowed({4, 5}, frozenset()).any()
