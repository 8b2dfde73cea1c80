"""What a constraint's rows are worth: their variance and their correlation, from the residuals."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import SimpleNamespace

import gtsam
import numpy as np
import pytest

from smartnav_graph.core.timebase import NS
from smartnav_graph.estimate.reweight.constraint_noise import correlation_factor, row_scales
from smartnav_graph.graph.pass_state import PassState
from smartnav_graph.graph.states import key
from smartnav_graph.graph.update import FactorBatch
from smartnav_graph.smoothers.estimate import Posterior
from smartnav_graph.smoothers.whole_graph import Snapshot, stacks_of


def markov(n: int, rho: float, seed: int) -> np.ndarray:
    """First-order Gauss-Markov rows (n,) of unit variance."""
    rng = np.random.default_rng(seed)
    rows = rng.standard_normal(n)
    for i in range(1, n):
        rows[i] = rho * rows[i - 1] + np.sqrt(1 - rho**2) * rows[i]
    return rows


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.8])
def test_the_factor_of_a_markov_process(rho):
    # 1 + 2 sum rho^k = (1 + rho) / (1 - rho)
    found = np.mean([correlation_factor(markov(2000, rho, seed)) for seed in range(20)])
    assert found == pytest.approx((1 + rho) / (1 - rho), rel=0.2)


def test_rows_that_alternate_count_no_more_than_white_ones():
    assert correlation_factor(np.tile([1.0, -1.0], 50)) == 1.0


class Sideways:
    """r = v_x / 0.1, v_y / 0.2."""

    letters = ("X", "V")

    def linearize(self, states, data):
        _, v = states
        sigma = np.array([0.1, 0.2])
        by_v = np.zeros((len(v), 2, 3))
        by_v[:, 0, 0], by_v[:, 1, 1] = 1 / sigma
        return v[:, :2] / sigma, [np.zeros((len(v), 2, 6)), by_v]


MODEL = Sideways()


@dataclass
class Builder:
    name: str = "car"
    noise_groups: dict = field(default_factory=lambda: {"left": 0.1, "up": 0.2})


def estimate(speeds: np.ndarray, variance: float = 0.0, used: bool = True):
    """An estimate whose velocities are `speeds` (n, 2), known with `variance`."""
    values, n = gtsam.Values(), len(speeds)
    for k, (x, y) in enumerate(speeds):
        values.insert(key("X", k), gtsam.Pose3())
        values.insert(key("V", k), np.array([x, y, 0.0]))
    blocks = [
        FactorBatch("car", MODEL, [(key("X", k), key("V", k))], np.zeros((1, 1)), k * NS, used=(used,))
        for k in range(n)
    ]
    joint = np.tile(np.diag([0.0] * 6 + [variance] * 3 + [0.0] * 6), (n, 1, 1))
    return SimpleNamespace(
        snapshot=Snapshot(values, {}),
        t_ns=np.arange(n) * NS,
        marginals=Posterior(joint, joint[1:], {}),
        stacks=lambda name: stacks_of(blocks, {}),
    )


def test_white_rows_as_noisy_as_the_class_says_stay():
    rows = np.random.default_rng(1).standard_normal((400, 2)) * [0.1, 0.2]
    scales = row_scales([Builder()], estimate(rows), PassState())
    assert scales == pytest.approx({"left": 1.0, "up": 1.0}, abs=0.15)


def test_noisier_and_slower_rows_get_a_larger_sigma():
    rows = np.stack([0.3 * np.random.default_rng(1).standard_normal(400), 0.2 * markov(400, 0.8, 2)], axis=1)
    scales = row_scales([Builder()], estimate(rows), PassState())
    assert scales["left"] == pytest.approx(3.0, rel=0.15)
    assert scales["up"] == pytest.approx(3.0, rel=0.35)  # sqrt(1.8 / 0.2), held at one by the class


def test_what_the_solution_took_up_counts():
    # half the variance of each first row is in the solution
    rows = np.random.default_rng(1).standard_normal((400, 2)) * [0.3, 0.2]
    free = row_scales([Builder()], estimate(rows), PassState())["left"]
    bound = row_scales([Builder()], estimate(rows, variance=0.005), PassState())["left"]
    assert bound == pytest.approx(np.sqrt(2.0) * free, rel=0.05)


def test_quieter_rows_never_fall_below_the_class():
    rows = 1e-3 * np.random.default_rng(1).standard_normal((400, 2))
    assert row_scales([Builder()], estimate(rows), PassState()) == {"left": 1.0, "up": 1.0}


def test_few_rows_and_unused_rows_teach_nothing():
    rows = np.random.default_rng(1).standard_normal((400, 2))
    assert row_scales([Builder()], estimate(rows[:8]), PassState()) == {}
    assert row_scales([Builder()], estimate(rows, used=False), PassState()) == {}
    assert row_scales([Builder(noise_groups={})], estimate(rows), PassState()) == {}
