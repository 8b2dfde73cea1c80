"""Fixes left out one by one, without solving again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from sessions import recorded, with_gnss

from smartnav_graph.estimate.config import Config
from smartnav_graph.estimate.result.assemble import SolvedProblem
from smartnav_graph.estimate.result.left_out import curve_error, left_out
from smartnav_graph.estimate.run import Run, smooth
from smartnav_graph.factors.gnss import GnssConfig
from smartnav_graph.factors.imu import ImuConfig

# Noise and clock as they are known: what one fix changes is then its own part only.
CONFIG = replace(
    Config(), gnss=GnssConfig(time_offset_sigma=0.0, estimate_sigma=False), imu=ImuConfig(estimate_noise=False)
)


@pytest.fixture(scope="module")
def eight():
    return recorded(seconds=60.0, white_m=1.0)


def found(run: Run):
    return next(iter(left_out(SolvedProblem(run.problem, run.estimate, run.pass_state), 20)))


def test_a_fix_is_predicted_as_by_a_solution_without_it(eight):
    whole = found(smooth(eight, CONFIG))
    for row in (17, 30, 41):
        at = eight.seconds(eight.gnss.t_ns[row : row + 1])[0]
        without = replace(CONFIG.run, withhold=(f"gnss:outage={at - 0.1}-{at + 0.1}",))
        run = smooth(eight, replace(CONFIG, run=without))
        apart = np.linalg.norm(run.withheld["gnss"].error[0, :2])
        assert whole.solution[row - 5] == pytest.approx(apart, abs=0.05)  # m; the first five have few neighbours


def test_a_solution_predicts_fixes_better_than_their_neighbours_do(eight):
    one = found(smooth(eight, CONFIG))
    assert one.rms[0] < one.rms[1] and one.sigmas < 0.0
    assert one.rms[0] == pytest.approx(np.sqrt(2.0), rel=0.3)  # m: the noise of the fix left out


def test_fixes_with_errors_that_last_are_not_compared(eight):
    there = eight.reference.enu[np.searchsorted(eight.reference.t_ns, eight.gnss.t_ns)]
    wander = 3.0 * np.sin(2.0 * np.pi * eight.seconds(eight.gnss.t_ns) / 30.0)[:, None]  # m
    run = smooth(with_gnss(eight, enu=there + wander, lla=None), CONFIG)
    assert not list(left_out(SolvedProblem(run.problem, run.estimate, run.pass_state), 20))


def test_a_cubic_through_neighbours_is_exact_on_a_cubic():
    t = np.array([0.0, 1.0, 1.5, 3.0, 4.0, 4.2, 6.0])
    p = np.stack([t**3 - t, t], axis=1)
    assert curve_error(t, p, 2, 3)[2:-2] == pytest.approx(0.0, abs=1e-9)  # m
    assert np.isnan(curve_error(t, p, 2, 3)[[0, 1, -2, -1]]).all()
    assert abs(curve_error(t, p, 1, 1)[1:-1, 0]).min() > 0.5 and abs(curve_error(t, p, 1, 1)[1:-1, 1]).max() < 1e-9
