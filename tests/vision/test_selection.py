"""Which kind of geometry explains matches with least."""

import math

import numpy as np
import pytest

from smartnav_graph.vision.refine import MatchedPoints
from smartnav_graph.vision.selection import ModelFit, by_chance, is_static, noise_variance, select_model


@pytest.fixture
def rng():
    return np.random.default_rng(5)


def models(rng, *, truth, n=200, variance=1.0, miss=0.0):
    """Squared misses of all models where `truth` holds; simpler models miss by `miss` sigmas more."""
    order = ["static", "rotation", "planar", "general"]
    out = {}
    for kind in order:
        residuals = rng.normal(0.0, math.sqrt(variance), (n, 1 if kind == "general" else 2))
        residuals[:, 0] += miss * (order.index(kind) < order.index(truth))
        out[kind] = ModelFit(np.sum(residuals**2, axis=1))
    return out


@pytest.mark.parametrize("truth", ["static", "rotation", "planar", "general"])
def test_the_simplest_that_explains_is_chosen(rng, truth):
    assert select_model(models(rng, truth=truth, miss=3.0)) == truth


def test_a_deviation_from_what_was_known_counts(rng):
    reported = models(rng, truth="static")
    turned = reported | {"static": ModelFit(reported["static"].square, 100.0)}
    assert select_model(reported) == "static" and select_model(turned) == "rotation"


def test_a_sigma_stated_too_large_lets_no_plane_pass_for_depth(rng):
    reported = models(rng, truth="general", variance=0.1, miss=1.0)
    assert noise_variance(reported["general"].square) == pytest.approx(0.2, abs=0.05)
    reported |= {kind: ModelFit(np.full(200, 50.0)) for kind in ("static", "rotation")}
    assert select_model(reported) == "general"
    assert (
        select_model(reported | {"general": ModelFit(reported["general"].square * 10.0)}) == "planar"
    )  # the noise as stated


def test_whether_there_is_a_baseline_depends_on_the_sigma_stated(rng):
    reported = models(rng, truth="general", variance=0.1, miss=0.6)
    assert select_model({**reported, "planar": ModelFit(np.full(200, 50.0))}) in ("static", "rotation")


@pytest.mark.parametrize("n", [12, 60, 600])
def test_points_at_rest_stand_still_and_a_shift_shows(rng, n):
    def share(shift, wrong=0):
        count = 0
        for _ in range(200):
            d = rng.normal(0.0, 1.0, (n, 2))  # in units of sqrt(2) sigma
            d[:, 0] += shift / math.sqrt(2.0)
            d[:wrong] = 50.0
            count += is_static(np.sum(d**2, axis=1))
        return count / 200

    assert share(0.0) > 0.97
    assert share(5.0) < 0.03
    assert share(0.0, wrong=n // 3) == 0.0


def test_agreement_by_chance(rng):
    def matched(n):
        return MatchedPoints(*rng.uniform(-0.5, 0.5, (2, n, 2)), np.full(n, 0.0015))

    n, k, s = 20, 12, 5
    share = 2.0 * math.sqrt(18.0) * 0.0015 * math.sqrt(2.0)  # band over a unit square, about
    by_hand = (n - s) * math.comb(n, k) * math.comb(k, s) * share ** (k - s)
    assert by_chance(matched(n), k, "general", s) == pytest.approx(by_hand, rel=2.0)
    assert by_chance(matched(8), 6, "general", 5) > 1.0 > by_chance(matched(8), 8, "general", 5)
    assert by_chance(matched(8), 6, "general", 2) < 1e-2  # a known rotation leaves less to chance
    assert by_chance(matched(300), 120, "general", 5) < 1e-50
    assert by_chance(matched(6), 5, "general", 5) == math.inf
