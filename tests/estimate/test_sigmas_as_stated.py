"""Sigmas that come with the fixes are checked against the scatter of the fixes."""

from dataclasses import replace

import numpy as np
import pytest

from smartnav_graph.estimate.config import Config
from smartnav_graph.estimate.problem import prepare
from smartnav_graph.simulation.degrade import Degrade, degrade
from smartnav_graph.simulation.fixes import Outliers


def with_sigma(session, sigma):
    return session.replace(gnss=replace(session.gnss, sigma=np.full((len(session.gnss), 3), sigma)))


@pytest.mark.parametrize("causal", [False, True])
def test_sigmas_far_below_the_scatter_are_raised_to_it_with_notice(kitti, causal):
    noisy = degrade(kitti, Degrade(gnss_white=3.0), 0)
    problem = prepare(with_sigma(noisy, 0.001), Config(), causal=causal)
    sigma = problem.session.gnss.sigma
    assert 2.0 < float(np.median(sigma)) < 5.5
    assert any("scatter" in text and "gnss" in text for text in problem.warnings)


@pytest.mark.parametrize("sigma", [3.0, 10.0])
def test_sigmas_that_agree_or_are_cautious_stay(kitti, sigma):
    noisy = degrade(kitti, Degrade(gnss_white=3.0), 0)
    problem = prepare(with_sigma(noisy, sigma), Config())
    assert (problem.session.gnss.sigma == sigma).all()
    assert not any("scatter" in text for text in problem.warnings)


def test_motion_is_no_scatter(kitti):
    problem = prepare(with_sigma(kitti, 0.02), Config())
    assert (problem.session.gnss.sigma == 0.02).all()


@pytest.mark.parametrize("causal", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_a_fifth_of_outliers_is_no_scatter(kitti, seed, causal):
    outliers = Outliers("isolated", 0.2, 50.0, 200.0)
    noisy = degrade(kitti, Degrade(gnss_white=3.0, outliers=outliers), seed)
    problem = prepare(with_sigma(noisy, 3.0), Config(), causal=causal)
    assert (problem.session.gnss.sigma == 3.0).all()
