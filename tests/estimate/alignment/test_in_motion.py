"""The first state on which most fixes agree, with outliers, bursts and gaps among them."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from exact import GRAVITY, START_NS, angle_deg, record
from scipy.spatial.transform import Rotation

from smartnav_graph.core.timebase import Gap, ns_from_seconds
from smartnav_graph.estimate.alignment.in_motion import AlignmentProblem, Known, curve_of, starts_agreed
from smartnav_graph.graph.keyframes import KeyframeConfig, make_windows
from smartnav_graph.session.calibration.model import DEVICE_CLASSES
from smartnav_graph.simulation import motions

NOISE = DEVICE_CLASSES["mems"]
PLANTED = replace(NOISE, gyro_bias_sigma=0.02)  # rad/s: 0.7 rad in the time looked at
BIAS_SIGMA = np.array([NOISE.accel_bias_sigma] * 3 + [NOISE.gyro_bias_sigma] * 3)
SECONDS = 40


def case(seed: int, off=(), sigma: float = 3.0, gap: bool = False):
    """A car's drive with turn-on biases, fixes once a second, `off` of them 50 to 200 m away: windows,
    stamps, fixes, and the truth."""
    rng = np.random.default_rng(seed)
    recording = record(motions.car(SECONDS + 2.0, rng, start_speed=10.0), noise=PLANTED, seed=seed)
    at = START_NS + ns_from_seconds(np.arange(0.0037, SECONDS))
    gaps = [Gap(int(at[12]), int(at[14]), "missing")] if gap else []
    windows = make_windows(recording.session.imu, at, gaps, {}, KeyframeConfig(max_spacing_s=2.0))
    truth = recording.truth(at)
    fixes = truth.nav_t_body + sigma * rng.standard_normal((len(at), 3))
    turn, size = 0.0, 0.0
    for k, row in enumerate(off):
        if k == 0 or row != off[k - 1] + 1:  # a burst shares one offset
            turn, size = rng.uniform(0, 2 * np.pi), rng.uniform(50, 200)
        fixes[row] += size * np.array([np.cos(turn), np.sin(turn), 0.0])
    return windows, at, fixes, truth


def align_in_motion(windows, at, fixes, truth, turns_deg, sigma: float = 3.0):
    """From the true attitude turned about the vertical, at the first fix and at rest."""
    starts = []
    for turned in turns_deg:
        turn = Rotation.from_rotvec([0, 0, np.radians(turned)]).as_matrix()
        starts.append((turn @ truth.nav_R_body[0], fixes[0], np.zeros(3)))
    return starts_agreed(windows, at, fixes, starts, Known(np.zeros(6), BIAS_SIGMA, NOISE, GRAVITY, sigma))


ROUND = (0, 60, 120, 180, 240, 300)


@pytest.mark.parametrize("seed", [0, 2])
@pytest.mark.parametrize("turned_deg", [0.0, 90.0, 180.0])
def test_without_outliers_the_start_is_found_from_any_heading(seed, turned_deg):
    *given, truth = case(seed)
    best = align_in_motion(*given, truth, [turned_deg])[0]
    assert not best.outside.any()
    assert np.linalg.norm(best.p - truth.nav_t_body[0]) < 8.0  # m; the heading of a straight drive stays open


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    "off",
    [[0], [1, 8, 20], [3, 5, 9, 14, 18, 22, 27, 33], list(range(12, 19))],
    ids=["the first", "three", "a fifth", "a burst"],
)
def test_exactly_the_outliers_are_found(seed, off):
    *given, truth = case(seed, off)
    best = align_in_motion(*given, truth, ROUND)[0]
    assert np.flatnonzero(best.outside).tolist() == off


def test_a_gap_among_the_first_seconds_is_a_change_of_velocity_and_attitude():
    *given, truth = case(2, [4, 21, 30], gap=True)
    curve = curve_of(given[0], np.zeros(6), NOISE, BIAS_SIGMA)
    kicks = 2 + 3  # two windows of the gap, and ten seconds of noise three times
    assert curve.by.shape == (SECONDS, 3, 6 + 6 * kicks) and len(curve.sigma) == 6 + 6 * kicks
    assert np.flatnonzero(align_in_motion(*given, truth, ROUND)[0].outside).tolist() == [4, 21, 30]


def test_alike_starts_count_once_and_the_cheapest_comes_first():
    *given, truth = case(1, [5, 6, 7])
    states = align_in_motion(*given, truth, ROUND)
    assert len(states) < 3 * len(ROUND)  # what three points of integration and six headings lead to
    costs = [state.cost for state in states]
    assert costs == sorted(costs)
    for one, other in combinations(states, 2):
        assert not np.array_equal(one.outside, other.outside) or angle_deg(one.R, other.R) > 10.0


def test_many_fixes_are_thinned_and_all_tested():
    windows, at, fixes, truth = case(1)
    curve = curve_of(windows, np.zeros(6), NOISE, BIAS_SIGMA)
    rows = np.repeat(np.arange(len(at)), 20)
    problem = AlignmentProblem(curve.at(rows), fixes[rows], (at[rows] - at[0]) / 1e9, 3.0, GRAVITY, np.zeros(6))
    assert (
        len(problem.thinned().t) <= 300 and len(problem.agree(truth.nav_R_body[0], fixes[0], np.zeros(3)).square) == 800
    )
