"""Errors of fixes that last beside stated sigmas: found, and joined by a state where the device may have them."""

from __future__ import annotations

import numpy as np
import pytest
from sessions import recorded, truth, with_gnss

from smartnav_graph.estimate.config import Config
from smartnav_graph.estimate.run import smooth
from smartnav_graph.factors.gnss import GnssConfig

STATED, AMPLITUDE, LASTS_S = 0.3, 1.0, 60.0  # m, m, s


@pytest.fixture(scope="module")
def eight():
    return recorded(seconds=90.0, white_m=STATED)


@pytest.fixture(scope="module")
def correlated(eight):
    """The same fixes with a Gauss-Markov error that their sigmas do not have."""
    rng, phi = np.random.default_rng(3), np.exp(-1.0 / LASTS_S)
    error = AMPLITUDE * rng.standard_normal((len(eight.gnss), 3))
    for k in range(1, len(error)):
        error[k] = phi * error[k - 1] + np.sqrt(1.0 - phi**2) * error[k]
    return with_gnss(eight, lla=eight.frame.lla_from_nav(eight.nav_position(eight.gnss) + error))


def lasting(run):
    return [reason for reason in run.summary["verdict"]["reasons"] if "last for many fixes" in reason["text"]]


def test_white_fixes_have_none(eight):
    run = smooth(eight)
    assert run.summary["verdict"]["level"] == "good"
    assert not run.pass_state.correlated


def test_they_are_a_reason_where_the_calibration_excludes_them(correlated):
    run = smooth(correlated)
    assert lasting(run)
    assert not run.pass_state.correlated


def test_they_have_a_state_where_the_class_has_them(correlated):
    """The sigma of the position covers what the fixes do not show: the mean of their error."""
    run = smooth(correlated.replace(calibration=None))
    assert lasting(run) and run.pass_state.correlated == {"gnss"}
    known = np.isin(run.solution.t_ns, correlated.reference.t_ns)
    position = truth(correlated, run.solution.t_ns[known])[1]
    covered = np.abs(run.solution.nav_t_body[known] - position) < 2.0 * run.solution.sigmas[known, 3:6]
    assert covered.mean() > 0.9


def test_none_are_looked_for_where_correlated_errors_are_switched_off(correlated):
    run = smooth(correlated, Config(gnss=GnssConfig(correlated=False)))
    assert not lasting(run) and not run.pass_state.correlated
