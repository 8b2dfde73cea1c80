"""Readings that stray across a gap: the chain is a Brownian bridge; a row takes what strayed as if it were read."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from exact import GRAVITY

from smartnav_graph.core.timebase import NS, Gap
from smartnav_graph.factors.gap_error import GapErrors, row
from smartnav_graph.factors.gap_model import Bridge
from smartnav_graph.factors.imu import ImuBuilder
from smartnav_graph.graph.pass_state import PassState
from smartnav_graph.graph.states import key
from smartnav_graph.graph.update import GraphUpdate
from smartnav_graph.graph.windows import Window
from smartnav_graph.session.calibration.model import DEVICE_CLASSES
from smartnav_graph.smoothers.whole_graph import StackedFactors

NOISE = DEVICE_CLASSES["mems"]
GAP = Gap(10 * NS, 14 * NS, "missing")
ROOT = np.diag([0.8, 0.5, 0.1, 0.02, 0.03, 0.1]) + np.eye(6, k=-1) * 0.02
BRIDGE = Bridge(np.full(3, 0.1), np.full(3, 0.01), None, ROOT @ ROOT.T)


def window(index: int, t0_s: float, t1_s: float) -> Window:
    """A stretch of the gap that turns and is pushed."""
    n = round((t1_s - t0_s) * 100)
    t = t0_s + np.arange(n) / 100
    gyro = np.stack([0.2 * np.sin(t), 0.1 * np.cos(t), 0.3 + 0.1 * t], axis=1)
    accel = np.stack([np.sin(t), np.cos(t), np.full(n, GRAVITY)], axis=1)
    return Window(index, round(t0_s * NS), round(t1_s * NS), "gap", np.full(n, 0.01), accel, gyro)


def test_the_chain_is_a_brownian_bridge():
    """Covariance q s (T - t) / T of any two times s <= t, from its definition."""
    times, straying = [10.0, 10.5, 11.7, 13.0, 14.0], GapErrors()
    graph, values, names = gtsam.NonlinearFactorGraph(), gtsam.Values(), []
    for k in range(1, len(times)):
        update = GraphUpdate(k, round(times[k] * NS), times[k])
        found = straying.add(update, window(k, times[k - 1], times[k]), GAP, BRIDGE)
        assert found == (k > 1, k < 4)
        for _, factor in update.factors:
            graph.push_back(factor)
        for name, value in update.chain.items():
            values.insert(name, value)
            names.append(name)
    joint = gtsam.Marginals(graph, values).jointMarginalCovariance(names)
    for i, s in enumerate(times[1:4]):
        for j, t in enumerate(times[1 + i : 4], start=i):
            wanted = BRIDGE.diffusion * (s - 10.0) * (14.0 - t) / 4.0
            np.testing.assert_allclose(joint.at(names[i], names[j]), wanted, rtol=1e-3, atol=1e-7)


@pytest.mark.parametrize("ends", [(False, True), (True, True), (True, False)])
def test_a_row_holds_where_the_readings_were_off_by_what_strayed(ends):
    read, bias = window(1, 11.0, 11.5), gtsam.imuBias.ConstantBias(np.full(3, 0.05), np.full(3, 0.01))
    strayed = 0.02 * np.array([[3.0, -4.0, 1.0, 0.3, -0.2, 0.5], [5.0, 2.0, -2.0, 0.1, 0.4, -0.3]])
    x = ((np.arange(50) + 0.5) / 50)[:, None]
    more = ends[0] * (1 - x) * strayed[0] + ends[1] * x * strayed[1]
    true = replace(read, kind="normal", accel=read.accel + more[:, :3], gyro=read.gyro + more[:, 3:])
    builder = ImuBuilder(NOISE, GRAVITY)
    first = gtsam.NavState(gtsam.Rot3.Ypr(0.3, 0.1, -0.2), np.array([1.0, 2.0, 3.0]), np.array([4.0, 5.0, 6.0]))
    second = builder.preintegrate(true, bias, PassState()).predict(first, bias)
    values = gtsam.Values()
    for i, nav in enumerate((first, second)):
        values.insert(key("X", i), nav.pose())
        values.insert(key("V", i), nav.velocity())
        values.insert(key("G", i), strayed[i])
    values.insert(key("B", 0), bias)
    block = row(read, ends, bias, np.eye(9) * 1e-4, GRAVITY)
    residual, jacobians = StackedFactors(block.model, [block], {}).linearize(values)
    np.testing.assert_allclose(residual * 1e-2, 0.0, atol=4e-4)  # rad, m, m/s; second order
    bare = values
    for i in range(2):
        bare.update(key("G", i), np.zeros(6))
    assert np.abs(StackedFactors(block.model, [block], {}).linearize(bare)[0] * 1e-2).max() > 5e-3
    assert len(jacobians) == 5 + sum(ends)


def test_nothing_strays_where_nothing_is_learnt():
    update = GraphUpdate(1, 11 * NS, 11.0)
    assert GapErrors().add(update, window(1, 10.0, 11.0), GAP, replace(BRIDGE, diffusion=np.zeros((6, 6)))) == (
        False,
        False,
    )
    assert not update.chain and not update.factors


def test_a_new_pass_knows_nothing_of_the_one_before():
    builder = ImuBuilder(NOISE, GRAVITY, [GAP], {GAP.start_ns: BRIDGE})
    builder._gap_errors.known.add(3)
    assert not builder.begin()._gap_errors.known and builder._gap_errors.known == {3}
