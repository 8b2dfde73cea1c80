"""Errors of fixes: sigmas, correlation, outlier counts, outages, lever arm."""

from __future__ import annotations

import numpy as np
import pytest

from smartnav_graph.core.errors import ConfigError
from smartnav_graph.core.frames import LocalFrame, Origin
from smartnav_graph.core.timebase import ns_from_seconds
from smartnav_graph.simulation import fixes, motions
from smartnav_graph.simulation.fixes import GnssModel, Outliers

FRAME = LocalFrame(Origin(52.0, 11.0, 100.0))


def test_white_noise_has_its_sigma_per_axis():
    errors = fixes.white(20_000, 3.0, np.random.default_rng(0))
    np.testing.assert_allclose(errors.std(axis=0), [3.0, 3.0, 4.5], rtol=4 / np.sqrt(40_000))
    np.testing.assert_allclose(np.corrcoef(errors.T) - np.eye(3), 0.0, atol=4 / np.sqrt(20_000))


@pytest.mark.parametrize("steps", [[20.0], [1.0, 19.0]])
def test_gauss_markov_correlates_by_the_exponential_of_the_lag(steps):
    t = np.cumsum(np.tile(steps, 60_000 // len(steps)))
    errors = fixes.gauss_markov(ns_from_seconds(t), 4.0, 60.0, np.random.default_rng(1)) / [1.0, 1.0, 1.5]
    assert errors.std() == pytest.approx(4.0, rel=0.05)
    for seconds in (20.0, 60.0, 120.0):
        lag = round(seconds / 20.0) * len(steps)
        correlation = (errors[lag:] * errors[:-lag]).mean() / 16.0
        assert correlation == pytest.approx(np.exp(-seconds / 60.0), abs=0.05)


def test_gauss_markov_starts_stationary():
    first = np.array([fixes.gauss_markov(np.array([0, 1]), 4.0, 60.0, np.random.default_rng(s))[0] for s in range(800)])
    np.testing.assert_allclose(first.std(axis=0), [4.0, 4.0, 6.0], rtol=4 / np.sqrt(1600))


@pytest.mark.parametrize("kind", ["isolated", "burst"])
@pytest.mark.parametrize("seed", range(5))
def test_outliers_are_as_many_and_as_large_as_asked(kind, seed):
    t_ns = ns_from_seconds(np.arange(400.0))
    errors, mask = fixes.outlier_errors(t_ns, Outliers(kind, 0.05, 50.0, 200.0), np.random.default_rng(seed))
    size = np.linalg.norm(errors, axis=1)
    assert mask.sum() == 20
    assert (errors[~mask] == 0).all() and (errors[:, 2] == 0).all()
    assert size[mask].min() >= 50 and size[mask].max() <= 200
    runs = np.diff(np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(int))))[::2]
    if kind == "isolated":
        assert set(runs) == {1}
    else:
        assert max(runs) <= 9 and sum(runs >= 4) >= len(runs) - 1  # the last one drawn is cut to the count


def test_outliers_point_everywhere():
    t_ns = ns_from_seconds(np.arange(10_000.0))
    errors, mask = fixes.outlier_errors(t_ns, Outliers("isolated", 0.2, 50.0, 200.0), np.random.default_rng(0))
    angle = np.arctan2(errors[mask, 1], errors[mask, 0])
    assert np.abs(np.exp(1j * angle).mean()) < 4 / np.sqrt(2000)
    assert np.linalg.norm(errors[mask], axis=1).mean() == pytest.approx(125.0, abs=4 * 43.3 / np.sqrt(2000))


@pytest.mark.parametrize(
    ("outliers", "found"),
    [
        (("single", 0.05, 50, 200), "kind 'single'; expected isolated or burst"),
        (("burst", 0.0, 50, 200), "share 0.0; expected a share above 0"),
        (("burst", 5, 50, 200), "share 5; expected a share above 0, up to 0.45"),
        (("isolated", 0.05, 200, 50), "size 200-50 m; expected 0 < smallest <= largest"),
    ],
)
def test_impossible_outliers_are_refused(outliers, found):
    with pytest.raises(ConfigError) as error:
        Outliers(*outliers)
    assert str(error.value).startswith(f"--outliers: {found}")


def test_runs_never_touch_when_apart_and_never_overlap():
    for seed in range(50):
        lengths = [3, 1, 4, 2]
        for apart in (True, False):
            starts = fixes.place_runs(14, lengths, np.random.default_rng(seed), apart=apart)
            taken = np.concatenate([np.arange(s, s + n) for s, n in zip(starts, lengths, strict=True)])
            assert len(set(taken)) == 10 and taken.min() >= 0 and taken.max() < 14
            gaps = np.diff(starts) - lengths[:-1]
            assert (gaps >= (1 if apart else 0)).all()
    with pytest.raises(ConfigError, match="12 faulty rows of 10; expected fewer faults than rows"):
        fixes.place_runs(10, [6, 6], np.random.default_rng(0), apart=False)


def test_fixes_are_those_of_the_antenna_outside_of_outages():
    t = np.arange(60.0)
    truth = motions.figure_eight(60.0).sample(t)
    model = GnssModel(white_m=1e-9, body_t_antenna=(0.1, -0.6, 0.9), outages=((10.0, 5.0), (50.0, 100.0)))
    fix = fixes.gnss(truth, ns_from_seconds(t), model, FRAME, np.random.default_rng(0))
    seen = np.r_[0:10, 15:50]
    np.testing.assert_array_equal(fix.t_ns, ns_from_seconds(t[seen]))
    antenna = truth.nav_t_body + np.einsum("nij,j->ni", truth.nav_R_body, [0.1, -0.6, 0.9])
    np.testing.assert_allclose(FRAME.nav_from_lla(fix.lla), antenna[seen], atol=1e-6)


def test_outliers_are_marked_and_not_reported_in_the_sigma():
    t = np.arange(60.0)
    truth = motions.static(60.0).sample(t)
    model = GnssModel(white_m=1.0, outliers=Outliers("isolated", 0.1, 50.0, 60.0))
    fix = fixes.gnss(truth, ns_from_seconds(t), model, FRAME, np.random.default_rng(0))
    far = np.linalg.norm(FRAME.nav_from_lla(fix.lla)[:, :2], axis=1) > 20
    np.testing.assert_array_equal(fix.extra["is_outlier"], far.astype(int))
    assert far.sum() == 6
    np.testing.assert_array_equal(fix.sigma, np.tile([1.0, 1.0, 1.5], (60, 1)))
