"""Redundancy against a dense covariance, and its sum against residuals less unknowns."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest

import smartnav_graph as sn
from smartnav_graph.estimate.config import Config
from smartnav_graph.graph.states import kind_of
from smartnav_graph.smoothers.redundancy import CALIBRATION, redundancies
from smartnav_graph.smoothers.whole_graph import WholeGraph


@pytest.fixture(scope="module")
def estimate(kitti):
    """A minute of a drive, with a time offset (a session state) and errors in a data gap (chain states)."""
    config = Config()
    found = sn.run(kitti, replace(config, run=replace(config.run, end_s=60.0))).estimate
    assert {chr(gtsam.symbolChr(k)) for k in found.values.keys()} == set("XVBGT")  # noqa: SIM118
    return found


def linearized(estimate):
    """Sensor of every factor in use, and the linear system (gtsam.GaussianFactorGraph) of them in that order."""
    priors = [
        gtsam.PriorFactorVector(state.key, state.prior_mean, gtsam.noiseModel.Diagonal.Sigmas(state.prior_sigma))
        for state in estimate.session.values()
    ]
    graph = WholeGraph([*(factor for _, factor in estimate.factors), *priors], estimate.blocks, {})
    sensors = [tag.sensor for tag, _ in estimate.factors] + [CALIBRATION] * len(priors)
    sensors += [stack.sensor for stack in graph.stacks for used in stack.used if used]
    return sensors, graph.linearize(estimate.values)


def test_redundancies_add_up_to_residuals_less_unknowns(estimate):
    """Unknowns by their keys, residuals by the rows of the linear system. Without a position prior the first keyframe
    has 12 prior rows for 15 unknowns."""
    found = redundancies(estimate)
    unknowns = sum(kind_of(name).dim for name in estimate.values.keys())  # noqa: SIM118
    residuals = linearized(estimate)[1].jacobian()[0].shape[0]
    assert sum(part.residuals for part in found.values()) == residuals
    assert sum(part.residuals - part.fitted for part in found.values()) == pytest.approx(residuals - unknowns, abs=1e-3)
    assert found["prior"].residuals == 12 and found[CALIBRATION].residuals == 1


def test_each_is_that_of_a_dense_covariance(estimate):
    sensors, linear = linearized(estimate)
    J, _ = linear.jacobian()
    order = {}
    for name in sorted(linear.keys()):
        order[name] = len(order)
    columns = np.concatenate([[0], np.cumsum([kind_of(name).dim for name in order])])
    assert columns[-1] == J.shape[1]
    scale = 1.0 / np.linalg.norm(J, axis=0)
    Q, _ = np.linalg.qr(J * scale)  # tr(J P J^T) of rows is the squared norm of their part of Q
    fitted, start = {}, 0
    for i, sensor in enumerate(sensors):
        rows = len(linear.at(i).jacobian()[0])
        fitted[sensor] = fitted.get(sensor, 0.0) + float((Q[start : start + rows] ** 2).sum())
        start += rows
    found = redundancies(estimate)
    assert set(found) == set(fitted)
    for name, value in fitted.items():
        assert found[name].fitted == pytest.approx(value, abs=1e-4), name
